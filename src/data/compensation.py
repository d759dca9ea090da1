"""Sweeps of a moving sensor in the key frame's ego frame: by each radar sweep's pose, by each LiDAR point's time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.data.schema import DatasetIndex
from src.errors import DataError
from src.geometry.transforms import pose_matrix, quaternion_to_matrix, rotation_vector
from src.structures.batch import LIDAR_POINT_FIELDS, MAX_EGO_SPEED_MPS

Array = np.ndarray
VELOCITY_WINDOW_US = 100_000
"""Ego velocity is the pose difference over +- this time; the chassis table reads zero for long stretches."""
POSE_NOISE_M = 1.0
"""Two poses of one moment may lie so far apart."""


@dataclass(kw_only=True)
class Sweeps:
    """S sweeps of one kind of sensor, and the vehicle at each."""

    clouds: list[Array]  # S of [n, 7] in the order of RADAR_FIELDS or [n, 4] of LIDAR_FIELDS, sensor frame
    ego_from_sensor: Array  # [S, 4, 4] mounts
    global_from_ego: Array  # [S, 4, 4] ego poses
    velocity: Array  # [S, 3] m/s of the ego at its pose, its own axes
    rate: Array  # [S, 3] rad/s, same axes


def ego_poses(
    index: DatasetIndex,
    rows: Array,  # [...] int64, of the pose table
) -> Array:  # [..., 4, 4] global_from_ego
    """The ego's poses."""
    return pose_matrix(index.pose_rotations[rows], index.pose_translations[rows])


def read_sweeps(
    index: DatasetIndex,
    rows: Array,  # [S] of the files
    clouds: list[Array],
    times_us: Array | None,  # [S] at which the ego's motion is that of its sweep; None: it is not asked for
) -> Sweeps:
    """The sweeps of these files with their mounts, poses and motion."""
    global_from_ego = ego_poses(index, index.data_poses[rows])
    velocity = rate = np.zeros((len(rows), 3))
    if times_us is not None:
        velocity, rate = ego_motion(index, times_us, global_from_ego[:, :3, :3])
    mounts = index.ego_from_sensor[index.data_calibrations[rows]]
    return Sweeps(clouds=clouds, ego_from_sensor=mounts, global_from_ego=global_from_ego, velocity=velocity, rate=rate)


def ego_motion(
    index: DatasetIndex,
    times_us: Array,  # [S] int64
    global_from_ego: Array,  # [S, 3, 3] rotations at those times
) -> tuple[Array, Array]:  # [S, 3] m/s, [S, 3] rad/s, both in ego axes
    """Velocity and rotation rate by finite differences of the ego poses within +-0.1 s.

    Raises DataError when poses are too sparse for a difference or jump.
    """
    first, last, elapsed_s, speed = _window(index, times_us)
    if np.isnan(elapsed_s).any():
        at = int(np.argmax(np.isnan(elapsed_s)))
        raise DataError(
            f"{index.root / index.version}/ego_pose.json: fewer than two ego poses within 0.1 s of time "
            f"{int(times_us[at])} us, so the ego velocity is unknown; unpack the release again"
        )
    start, end = quaternion_to_matrix(index.pose_rotations[first]), quaternion_to_matrix(index.pose_rotations[last])
    shift = (index.pose_translations[last] - index.pose_translations[first]) / elapsed_s[:, None]
    velocity = np.einsum("sji,sj->si", global_from_ego, shift)
    rate = rotation_vector(np.swapaxes(start, -1, -2) @ end) / elapsed_s[:, None]
    if not (speed <= MAX_EGO_SPEED_MPS).all():
        at = int(np.argmax(~(speed <= MAX_EGO_SPEED_MPS)))
        raise DataError(
            f"{index.root / index.version}/ego_pose.json: the poses around time {int(times_us[at])} us move at "
            f"{speed[at]:.0f} m/s; a truck stays below {MAX_EGO_SPEED_MPS:.0f}, so the pose table is damaged there; "
            "unpack the release again"
        )
    return velocity, rate


def motion_known(
    index: DatasetIndex,
    times_us: Array,  # [S] int64
) -> Array:  # [S] bool
    """Whether `ego_motion` has an answer."""
    return _window(index, times_us)[3] <= MAX_EGO_SPEED_MPS


def reached(
    index: DatasetIndex,
    poses: Array,  # [S] rows of the pose table
    key_pose: int,
) -> Array:  # [S] bool
    """Whether a truck can drive from each pose to that of the key frame, or back, in the time between them."""
    distance = np.linalg.norm(index.pose_translations[poses] - index.pose_translations[key_pose], axis=1)
    elapsed_s = 1e-6 * np.abs(index.pose_times_us[poses] - index.pose_times_us[key_pose])
    return distance <= MAX_EGO_SPEED_MPS * elapsed_s + POSE_NOISE_M


def _window(index: DatasetIndex, times_us: Array) -> tuple[Array, Array, Array, Array]:
    """First and last pose [S] within +-0.1 s of each time, seconds between them, m/s; NaN where there are not two."""
    stamps = index.pose_times_us
    first = np.searchsorted(stamps, times_us - VELOCITY_WINDOW_US, side="left").clip(max=len(stamps) - 1)
    last = (np.searchsorted(stamps, times_us + VELOCITY_WINDOW_US, side="right") - 1).clip(0)
    elapsed_s = 1e-6 * (stamps[last] - stamps[first])
    elapsed_s = np.where((last > first) & (elapsed_s > 0), elapsed_s, np.nan)
    shift = index.pose_translations[last] - index.pose_translations[first]
    return first, last, elapsed_s, np.linalg.norm(shift, axis=1) / elapsed_s


def compensate_clouds(
    sweeps: Sweeps,  # at least one
    key_from_global: Array,  # [4, 4] global to ego(t)
    elapsed_s: Array,  # [S] key frame minus sweep
    min_distance_m: float,  # points nearer than this in both x and y of the sensor are dropped
    propagate_points: bool,  # move points by their own radial velocity to the key frame's time
) -> Array:  # [P, 7] float64: x, y, z (m, ego(t)), rcs, vx, vy (m/s over ground, radial, ego(t) axes), dt (s)
    """Move sweeps to ego(t) and turn relative radial velocities into velocities over ground (method 1.3).

    r_hat points from the sensor to the target, v_s is the sensor's own velocity, lever arm included:
    v_r = vrel . r_hat + v_s . r_hat, zero for whatever stands still.
    """
    clouds, ego_from_sensor = sweeps.clouds, sweeps.ego_from_sensor
    key_from_sweep = key_from_global @ sweeps.global_from_ego
    sensor_velocity = sweeps.velocity + np.cross(sweeps.rate, ego_from_sensor[:, :3, 3])
    key_from_sensor = key_from_sweep @ ego_from_sensor
    counts = [len(cloud) for cloud in clouds]

    def rows(values: Array, *shape: int) -> Array:  # [S, ...] -> [..., P]
        """A sweep's numbers once for each of its points, as rows: whole rows are what numpy is fast on."""
        return np.repeat(values.reshape(len(counts), -1).T, counts, axis=1).reshape(*shape, -1)

    # [3, P] each
    place, relative, (rcs,) = np.split(np.concatenate(clouds).T.astype(np.float64, order="C"), (3, 6))
    distance = np.sqrt(_dot(place, place))
    near = (np.abs(place[:2]) < min_distance_m).all(axis=0) | (distance < 1e-6)
    distance[near] = 1.0  # left out at the end; until then no division by zero
    direction = place / distance  # sensor frame
    direction_ego = _rotate(rows(ego_from_sensor[:, :3, :3], 3, 3), direction)
    speed = _dot(relative, direction) + _dot(rows(sensor_velocity, 3), direction_ego)
    position = _rotate(rows(key_from_sensor[:, :3, :3], 3, 3), place) + rows(key_from_sensor[:, :3, 3], 3)
    ground_velocity = speed * _rotate(rows(key_from_sweep[:, :2, :3], 2, 3), direction_ego)
    lag = rows(elapsed_s)
    if propagate_points:
        position[:2] += ground_velocity * lag
    points = np.stack([*position, rcs, *ground_velocity, lag])
    return (points[:, ~near] if near.any() else points).T


def _dot(
    a: Array,  # [3, P]
    b: Array,  # [3, P]
) -> Array:  # [P]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _rotate(
    matrices: Array,  # [n, 3, P], or [n, 3, 1] for all points
    vectors: Array,  # [3, P]
) -> Array:  # [n, P]
    """A matrix of its own for every point; without BLAS, whose threads fight over the cores of loader processes."""
    # The order of the sum is that of numpy's einsum on x86, to the last bit.
    return matrices[:, 0] * vectors[0] + matrices[:, 2] * vectors[2] + matrices[:, 1] * vectors[1]


def place_sweep(
    points: Array,  # [n, 4] float32: x, y, z (m, sensor frame), intensity
    ages_s: Array,  # [n] key frame's time less the point's
    offsets_s: Array,  # [n] the point's time less that of the sweep's pose; zeros leave the sweep as it is
    ego_from_sensor: Array,  # [4, 4]
    aug_from_sweep: Array,  # [4, 4] (augmented) ego frame of the key frame from the ego frame at the sweep's pose
    velocity: Array,  # [3] m/s of the ego at that pose, its own axes
    rate: Array,  # [3] rad/s, same axes
    min_distance_m: float,  # points nearer than this in both x and y of the sensor are dropped
    origins: bool,
) -> tuple[Array, Array | None]:  # [n, 5] float32 in the order of LIDAR_POINT_FIELDS, [n, 3] float32 m if asked for
    """Points of one sweep, each moved from the ego frame at its own time, and where the sensor was at that time."""
    rows = points.T.astype(np.float32, order="C")  # [4, n]
    near = (np.abs(rows[:2]) < max(min_distance_m, 1e-6)).all(axis=0)
    if near.any():
        rows, ages_s, offsets_s = rows[:, ~near], ages_s[~near], offsets_s[~near]
    offsets_s = offsets_s.astype(np.float32)
    mount, target = (matrix[:3, :, None].astype(np.float32) for matrix in (ego_from_sensor, aug_from_sweep))

    def place(in_ego: Array) -> Array:  # [3, n] -> [n, 3]
        return (_rotate(target[:, :3], deskew(in_ego, offsets_s, velocity, rate)) + target[:, 3]).T

    placed = np.empty((len(offsets_s), len(LIDAR_POINT_FIELDS)), np.float32)
    placed[:, :3] = place(_rotate(mount[:, :3], rows[:3]) + mount[:, 3])
    placed[:, 3] = rows[3]
    placed[:, 4] = ages_s
    return placed, place(np.broadcast_to(mount[:, 3], (3, len(offsets_s)))) if origins else None


def deskew(
    points: Array,  # [3, n] float32 m, ego frame at each point's own time
    offsets_s: Array,  # [n] float32, that time less the pose's
    velocity: Array,  # [3] m/s, ego axes
    rate: Array,  # [3] rad/s, ego axes
) -> Array:  # [3, n] float32 m, ego frame at the pose
    """p + t (v + w x p) + t^2/2 w x (v + w x p): motion with the constant twist (v, w), to the second order.

    What is left out is a sixth of (|w| t)^3 of the range: 4 mm at 200 m, 0.5 rad/s and 0.1 s.
    """
    cross_rate = np.cross(rate, np.eye(3)).T[..., None].astype(np.float32)  # its product with p is w x p
    moving = _rotate(cross_rate, points) + velocity[:, None].astype(np.float32)
    return points + offsets_s * (moving + (0.5 * offsets_s) * _rotate(cross_rate, moving))
