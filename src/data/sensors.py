"""Frames from one's own sensors: the same arithmetic as the reader of recorded data, without tables or files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from PIL import Image

from src.data.compensation import Sweeps
from src.data.images import MAX_PIXELS, resample, width_fit
from src.data.pcd import LIDAR_FIELDS, RADAR_FIELDS
from src.data.point_tensors import lidar_tensors, radar_tensors
from src.data.reader import ReaderSettings
from src.data.sensor_files import MAX_SCAN_S
from src.errors import DataError
from src.geometry.camera import pixels_from_points
from src.geometry.transforms import invert_rigid
from src.structures.batch import MAX_EGO_SPEED_MPS, FrameBatch
from src.structures.taxonomy import CAMERAS

Array = np.ndarray

MAX_SWEEP_AGE_S = 2.0
"""An older sweep is a stalled sensor or a clock in other units; models are trained on about half a second."""
MAX_SWEEP_LEAD_S = 0.1
"""Sensors are triggered some milliseconds apart; a sweep further ahead of its frame has another clock."""
RIGID_TOLERANCE = 1e-3
FLOAT32_REACH_M = 1e5
"""Beyond, float32 coordinates are wrong by centimetres and soon by half a metre (method 1.1)."""
FLOAT32_REACH_S = 1e4
"""Beyond, float32 times are wrong by a millisecond and soon by the half second between frames."""


@dataclass(kw_only=True)
class Camera:
    """One undistorted image with its pinhole; z looks forward, x right, y down."""

    image: Array  # [H, W, 3] uint8 RGB
    intrinsics: Array  # [3, 3] K in pixels of `image`, pixel centres at +0.5
    ego_from_camera: Array  # [4, 4] mount
    global_from_ego: Array | None = None  # [4, 4] ego pose at the exposure; None: that of the frame


@dataclass(kw_only=True)
class _Sweep:
    """One sweep of a sensor that measures points, and what the vehicle does then."""

    points: Array
    ego_from_sensor: Array  # [4, 4] mount
    timestamp_s: float
    ego_velocity_mps: Array  # [3] velocity of the ego's origin at the sweep, ego axes
    ego_rate_radps: Array = (0.0, 0.0, 0.0)  # [3] rotation rate at the sweep, ego axes
    global_from_ego: Array | None = None  # [4, 4] ego pose at the sweep; None: the frame's, driven back to the sweep


@dataclass(kw_only=True)
class RadarSweep(_Sweep):
    """One sweep of one radar as the sensor gives it, Doppler relative to the moving sensor.

    `points` is [n, 7]: x, y, z (m), vrel_x, vrel_y, vrel_z (m/s, radial), rcs (dB), sensor frame; n may be 0.
    """


@dataclass(kw_only=True)
class LidarSweep(_Sweep):
    """One sweep of one LiDAR as the sensor gives it, not compensated for the vehicle's motion.

    `points` is [n, 4]: x, y, z (m), intensity as in the training data, sensor frame; n may be 0.
    """

    point_times_s: Array | None = None  # [n] when each was measured, clock of `timestamp_s`; None: all at that time


def frame_from_sensors(
    timestamp_s: float,
    global_from_ego: Array,  # [4, 4] float64; any fixed frame serves, the same one for all frames
    cameras: Mapping[str, Camera | None],
    radars: Mapping[str, Sequence[RadarSweep] | None],
    settings: ReaderSettings,
    lidars: Mapping[str, Sequence[LidarSweep] | None] | None = None,
) -> FrameBatch:
    """A batch of one frame, without annotations and augmentation, as `FrameReader.read` makes it from a data set.

    Ego is x forward, y left, z up, its origin on the ground under the rear axle. `cameras` go by the names in
    `taxonomy.CAMERAS`; one that is absent or None is masked. `radars` and `lidars` go by any name; of each the newest
    `settings.num_sweeps` or `num_lidar_sweeps` sweeps are used, in whatever order they come, and None is as no sweep.
    Sensors that the settings leave unread are not used, whatever is given of them.

    Raises DataError naming the sensor, what was expected and what was found.
    """
    timestamp_s = float(_seconds(timestamp_s, "timestamp_s of the frame"))
    global_from_ego = _rigid(global_from_ego, "global_from_ego of the frame")
    batch = {
        "tokens": [f"{timestamp_s:.6f}"],
        "timestamps_s": torch.tensor([timestamp_s], dtype=torch.float64),
        "global_from_ego": torch.from_numpy(global_from_ego[None]),
        "aug_from_ego": torch.eye(4)[None],
    }
    if settings.num_sweeps:
        sweeps, ages_s, _ = _newest(RadarSweep, RADAR_FIELDS, settings.num_sweeps, radars, timestamp_s, global_from_ego)
        how = (settings.min_distance_m, settings.propagate_points)
        batch |= radar_tensors(sweeps, np.array(ages_s), global_from_ego, np.eye(4), *how)
    if settings.num_lidar_sweeps:
        fields, count = LIDAR_FIELDS[:4], settings.num_lidar_sweeps
        sweeps, ages_s, point_ages_s = _newest(
            LidarSweep, fields, count, lidars or {}, timestamp_s, global_from_ego, settings.deskew_lidar
        )
        offsets_s = [age_s - of_points for age_s, of_points in zip(ages_s, point_ages_s, strict=True)]
        ego_from_global, least_m = invert_rigid(global_from_ego), settings.min_distance_m
        batch |= lidar_tensors(sweeps, point_ages_s, offsets_s, ego_from_global, least_m, settings.lidar_origins)
    if settings.image_size_px is not None:
        batch |= _images(global_from_ego, cameras, settings)
    return FrameBatch(**batch)


Sweep = TypeVar("Sweep", RadarSweep, LidarSweep)


def _newest(
    kind: type[Sweep],
    fields: tuple[str, ...],  # of a point
    count: int,  # of each sensor
    sensors: Mapping[str, Sequence[Sweep] | None],
    timestamp_s: float,
    global_from_ego: Array,  # [4, 4]
    deskew: bool = False,
) -> tuple[Sweeps, list[float], list[Array]]:  # frame's time less that of each sweep, and [n] of its points
    """The newest sweeps of each sensor, checked."""
    sensor, checked = kind.__name__.removesuffix("Sweep").lower(), []
    for name, sweeps in sensors.items():
        if not isinstance(sweeps, Sequence | None) or not all(isinstance(sweep, kind) for sweep in sweeps or ()):
            got = type(sweeps).__name__
            raise DataError(f"{sensor} {name}: must be a list of {kind.__name__}, or None, but got {got}")
        timed = [(float(_seconds(sweep.timestamp_s, f"{sensor} {name}: timestamp_s")), sweep) for sweep in sweeps or ()]
        newest = sorted(timed, key=lambda pair: pair[0], reverse=True)[:count]
        for number, (time_s, sweep) in enumerate(newest):
            where = f"{sensor} {name}, sweep {number} (0 is the newest)"
            age = timestamp_s - time_s
            if not -MAX_SWEEP_LEAD_S <= age <= MAX_SWEEP_AGE_S:
                raise DataError(
                    f"{where}: is {age:g} s older than its frame, expected {-MAX_SWEEP_LEAD_S:g} to "
                    f"{MAX_SWEEP_AGE_S:g}; give all times in seconds of one clock and leave older sweeps out"
                )
            points = _array(sweep.points, (None, len(fields)), f"{where}: points ({', '.join(fields)})")
            mount = _rigid(sweep.ego_from_sensor, f"{where}: ego_from_sensor")
            velocity = _array(sweep.ego_velocity_mps, (3,), f"{where}: ego_velocity_mps")
            speed = np.linalg.norm(velocity)
            if speed > MAX_EGO_SPEED_MPS:
                limit = f"below {MAX_EGO_SPEED_MPS:.0f} m/s"
                raise DataError(f"{where}: ego_velocity_mps must be {limit}, but got {speed:.0f} m/s")
            rate = _array(sweep.ego_rate_radps, (3,), f"{where}: ego_rate_radps")
            if sweep.global_from_ego is None:
                pose = global_from_ego @ _driven(velocity, rate, -age)
            else:
                pose = _rigid(sweep.global_from_ego, f"{where}: global_from_ego")
            point_ages = np.full(len(points), age)
            if deskew and sweep.point_times_s is not None:
                where += ": point_times_s"
                point_ages = timestamp_s - _seconds(sweep.point_times_s, where, (len(points),))
                away = np.abs(point_ages - age).max(initial=0)
                if away > MAX_SCAN_S:
                    raise DataError(
                        f"{where} must lie within {MAX_SCAN_S} s of timestamp_s, but one is {away:g} s from it"
                    )
            checked.append((points, mount, pose, velocity, rate, age, point_ages))
    clouds, mounts, poses, velocities, rates, ages, point_ages = zip(*checked, strict=True) if checked else [()] * 7
    placed = Sweeps(
        clouds=list(clouds),
        ego_from_sensor=np.reshape(mounts, (-1, 4, 4)),
        global_from_ego=np.reshape(poses, (-1, 4, 4)),
        velocity=np.reshape(velocities, (-1, 3)),
        rate=np.reshape(rates, (-1, 3)),
    )
    return placed, list(ages), list(point_ages)


def _driven(
    velocity: Array,  # [3] m/s, ego axes
    rate: Array,  # [3] rad/s, ego axes
    seconds: float,
) -> Array:  # [4, 4] the ego frame after that time in the one before it
    """Motion with a constant twist, which is the exponential of it."""
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross(rate, np.eye(3)).T
    twist[:3, 3] = velocity
    return torch.linalg.matrix_exp(torch.from_numpy(seconds * twist)).numpy()


def _images(
    global_from_ego: Array,  # [4, 4]
    cameras: Mapping[str, Camera | None],
    settings: ReaderSettings,
) -> dict[str, torch.Tensor]:
    """Images at network size and P_n by each camera's own pose; a missing camera stays black and masked."""
    unknown = [name for name in cameras if name not in CAMERAS]
    if unknown:
        raise DataError(f"camera {unknown[0]!r}: must be one of {', '.join(CAMERAS)}, by where it looks")
    images = np.zeros((len(CAMERAS), 3, *settings.image_size_px), np.uint8)
    valid = np.zeros(len(CAMERAS), bool)
    pix_from_ego = np.tile(np.eye(4), (len(CAMERAS), 1, 1))
    for view, name in enumerate(CAMERAS):
        camera = cameras.get(name)
        if camera is None:
            continue
        image = _image(camera.image, f"camera {name}: image")
        intrinsics = _intrinsics(camera.intrinsics, f"camera {name}: intrinsics")
        mount = _rigid(camera.ego_from_camera, f"camera {name}: ego_from_camera")
        pose = camera.global_from_ego
        pose = global_from_ego if pose is None else _rigid(pose, f"camera {name}: global_from_ego")
        crop = width_fit(image.shape[:2], settings.image_size_px, settings.test_resize_offset)
        images[view], valid[view] = resample(Image.fromarray(image), crop, image.shape[:2]), True
        cam_from_ego = invert_rigid(pose @ mount) @ global_from_ego
        pix_from_ego[view] = pixels_from_points(intrinsics, cam_from_ego, crop.matrix())
    return {
        "images": torch.from_numpy(images[None]),
        "image_valid": torch.from_numpy(valid[None]),
        "pix_from_aug": torch.from_numpy(pix_from_ego[None].astype(np.float32)),
    }


# -------------------------------------------------------------------- checks


def _array(value: object, shape: tuple[int | None, ...], name: str) -> Array:
    """Finite float64 of the given shape, None standing for any length. Raises DataError."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(f"{name} must be an array of numbers ({error})") from None
    wanted = list("n" if length is None else length for length in shape)
    if array.ndim != len(shape) or any(w not in (None, n) for w, n in zip(shape, array.shape, strict=True)):
        raise DataError(f"{name} must have the shape {wanted}, but got {list(array.shape)}")
    if not np.isfinite(array).all():
        raise DataError(f"{name} must be finite, but entry {np.argwhere(~np.isfinite(array))[0].tolist()} is not")
    return array


def _seconds(value: object, name: str, shape: tuple[int, ...] = ()) -> Array:
    seconds = _array(value, shape, name)
    largest = np.abs(seconds).max(initial=0)
    if getattr(value, "dtype", None) == np.float32 and largest > FLOAT32_REACH_S:
        raise DataError(f"{name} is float32 and {largest:.0f} s, which rounds times; give float64")
    return seconds


def _rigid(value: object, name: str) -> Array:  # [4, 4]
    matrix = _array(value, (4, 4), name)
    rotation = matrix[:3, :3]
    orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() < RIGID_TOLERANCE
    if not (orthogonal and np.linalg.det(rotation) > 0 and np.array_equal(matrix[3], [0, 0, 0, 1])):
        raise DataError(
            f"{name} must be a rotation without mirroring or scale and a translation over the row 0 0 0 1, but got "
            f"{matrix.round(4).tolist()}"
        )
    far = np.abs(matrix[:3, 3]).max()
    if getattr(value, "dtype", None) == np.float32 and far > FLOAT32_REACH_M:
        raise DataError(f"{name} is float32 and {far:.0f} m from the origin, which rounds poses; give float64")
    return matrix


def _intrinsics(value: object, name: str) -> Array:  # [3, 3]
    matrix = _array(value, (3, 3), name)
    focal = matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not (focal and np.array_equal(matrix[2], [0, 0, 1]) and abs(np.linalg.det(matrix)) > 1e-9):
        raise DataError(
            f"{name} must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy, but got {matrix.tolist()}"
        )
    return matrix


def _image(value: object, name: str) -> Array:  # [H, W, 3] uint8
    if not isinstance(value, np.ndarray) or value.dtype != np.uint8 or value.ndim != 3 or value.shape[2] != 3:
        found = f"{list(value.shape)} {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
        raise DataError(f"{name} must be an array [H, W, 3] uint8 in RGB order, but got {found}")
    if not 0 < value.shape[0] * value.shape[1] <= MAX_PIXELS:
        raise DataError(f"{name} must have 1 to {MAX_PIXELS} pixels, but got {value.shape[1]} x {value.shape[0]}")
    return np.ascontiguousarray(value)
