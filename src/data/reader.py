"""One key frame with its sensors, as one batch of one (method 1.1 to 1.3)."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch

from src.data.augment import AugmentationConfig, draw_bev_transform, draw_crop, frame_generator
from src.data.compensation import Sweeps, compensate_clouds, ego_motion, motion_known, place_sweep, reached
from src.data.images import read_image, width_fit
from src.data.pcd import LidarCloud, read_lidar_points, read_radar_points
from src.data.schema import CHANNELS, DatasetIndex
from src.errors import DataError
from src.geometry.camera import pixels_from_points
from src.geometry.transforms import invert_rigid, pose_matrix, quaternion_to_matrix, yaw_of
from src.structures.batch import LIDAR_POINT_FIELDS, RADAR_POINT_FIELDS, FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CAMERAS, LIDARS, RADARS

Array = np.ndarray
T = TypeVar("T")

MAX_SCAN_S = 0.3
"""Points further in time from their sweep are of another clock; a LiDAR takes 0.1 s for a sweep."""

_log = logging.getLogger(__name__)


class OnBadFile(Enum):
    """What an unreadable sensor file, or one whose ego pose no truck can have, does."""

    error = "error"
    skip = "skip"  # counted; a radar or LiDAR file gives no points, an image a masked camera


@dataclass
class _Skipped:
    """What a frame does without."""

    channels: Counter[str] = field(default_factory=Counter)
    files: list[str] = field(default_factory=list)
    lost: bool = False  # the key frame's own pose is wrong, so that no annotation is where it says


@dataclass(kw_only=True)
class ReaderOptions:
    """How frames are read, whatever a model takes of them."""

    num_sweeps: int  # past sweeps of each radar, the key frame's included
    num_lidar_sweeps: int  # past sweeps of each LiDAR, the key frame's included
    lidar_origins: bool  # also where the ray of each LiDAR point began
    deskew_lidar: bool  # LiDAR points are moved by what was driven between their own times and the sweep's
    num_future_frames: int  # next key frames of the scene whose LiDAR comes along as supervision
    min_distance_m: float  # points nearer than this in both x and y (sensor frame) are dropped: the truck itself
    propagate_points: bool  # move radar points by their own radial velocity to the key frame's time
    on_bad_file: OnBadFile
    test_resize_offset: float  # added to the scale that fits the image's width, without augmentation


@dataclass(kw_only=True)
class ReaderSettings(ReaderOptions):
    """What is read of a frame; a number of sweeps of 0 means that sensor is not read."""

    image_size_px: tuple[int, int] | None  # (height, width); None: images are not read


class FrameReader:
    """Reads the frames of one release."""

    def __init__(self, index: DatasetIndex, settings: ReaderSettings) -> None:
        self.index = index
        self.settings = settings
        self._root = os.path.realpath(index.root)
        self._folders: dict[str, str] = {}  # where the folders of files lead to
        self._reported: set[str] = set()
        self._following = _following(index)  # [N] row of the scene's next sample, -1 for none
        self._preceding = inverse = np.full_like(self._following, -1)
        inverse[self._following[self._following >= 0]] = np.flatnonzero(self._following >= 0)

    def read(
        self,
        sample: int,
        augmentation: AugmentationConfig | None,
        seed: int = 0,
        epoch: int = 0,
        clip: str | None = None,
    ) -> FrameBatch:
        """The frame at row `sample` of the sample table; random draws depend on (seed, epoch, token) alone.

        `clip` is the token of the first frame of the clip that this frame is part of: A_t is then that frame's, so
        that it stays the same throughout the clip (method 6.4).
        Raises DataError for an unreadable file (unless skipped) and for poses that jump.
        """
        index = self.index
        token = str(index.sample_tokens[sample])
        rng = frame_generator(seed, epoch, token)
        bev = augmentation.bev if augmentation is not None else None
        aug_from_ego = np.eye(4) if bev is None else draw_bev_transform(bev, rng)
        if bev is not None and clip is not None:
            aug_from_ego = draw_bev_transform(bev, frame_generator(seed, epoch, clip))
        global_from_ego = self._global_from_ego(sample)
        skipped = _Skipped(lost=self._lost(sample))
        batch = self._key_frame(sample, aug_from_ego)
        if self.settings.num_sweeps:
            batch |= self._radar_points(sample, global_from_ego, aug_from_ego, skipped)
        if self.settings.num_lidar_sweeps:
            sweeps, origins = self.settings.num_lidar_sweeps, self.settings.lidar_origins
            batch |= self._lidar_points(sample, global_from_ego, aug_from_ego, sweeps, origins, skipped)
        if self.settings.image_size_px is not None:
            batch |= self._images(sample, global_from_ego, aug_from_ego, augmentation, rng, skipped)
        if self.settings.num_future_frames:
            batch["future"] = self._future(sample, aug_from_ego, skipped)
        if index.annotated:
            boxes = self._boxes(sample, global_from_ego).transform(torch.from_numpy(aug_from_ego))
            batch["boxes"] = [Boxes3D.empty() if skipped.lost else boxes]
        return FrameBatch(**batch, skipped=dict(skipped.channels), bad_files=skipped.files)

    def before(self, sample: int, count: int) -> list[int]:
        """Rows of the scene's `count` samples before this one, the oldest first; -1 where it had not begun."""
        rows = [sample]
        for _ in range(count):
            rows.append(int(self._preceding[rows[-1]]) if rows[-1] >= 0 else -1)
        return rows[:0:-1]

    def _key_frame(self, sample: int, aug_from_ego: Array) -> dict[str, Any]:
        """What every frame has."""
        return {
            "tokens": [str(self.index.sample_tokens[sample])],
            "timestamps_s": torch.tensor([1e-6 * float(self.index.frame_times_us[sample])], dtype=torch.float64),
            "global_from_ego": torch.from_numpy(self._global_from_ego(sample)[None]),
            "aug_from_ego": torch.from_numpy(aug_from_ego[None].astype(np.float32)),
        }

    def _global_from_ego(self, sample: int) -> Array:  # [4, 4]
        pose = self.index.frame_poses[sample]
        return pose_matrix(self.index.pose_rotations[pose], self.index.pose_translations[pose])

    # ---------------------------------------------------------------- radar and LiDAR

    def _radar_points(
        self,
        sample: int,
        global_from_ego: Array,  # [4, 4]
        aug_from_ego: Array,  # [4, 4]
        skipped: _Skipped,
    ) -> dict[str, torch.Tensor]:
        rows, clouds = self._clouds(
            sample, RADARS, self.settings.num_sweeps, lambda path, row: read_radar_points(path), skipped
        )
        times_us = self.index.data_times_us[rows]
        ages_s = 1e-6 * (self.index.frame_times_us[sample] - times_us)
        sweeps = self._sweeps(rows, clouds, times_us)
        return radar_tensors(sweeps, ages_s, global_from_ego, aug_from_ego, self.settings)

    def _clouds(
        self,
        sample: int,
        channels: tuple[str, ...],
        count: int,
        read: Callable[[str, int], T],  # of the path and the row of the file
        skipped: _Skipped,
    ) -> tuple[Array, list[T]]:  # [S] int64 rows of the files
        """The key frame's and the sweeps before it of each channel, fewer at a scene's start."""
        rows, owners = [], []
        for channel in channels:
            row = int(self.index.key_data[sample, CHANNELS.index(channel)])
            if row < 0 and count:
                skipped.channels[f"{channel} (not recorded)"] += 1
            for _ in range(count):
                if row < 0:
                    break
                rows.append(row)
                owners.append(channel)
                row = int(self.index.data_previous[row])
        kept, clouds = [], []
        for row, channel in zip(
            *self._with_known_poses(sample, np.array(rows, np.int64), owners, skipped), strict=True
        ):
            cloud = self._guarded(sample, channel, row, partial(read, row=row), skipped)
            if cloud is not None:
                kept.append(row)
                clouds.append(cloud)
        return np.array(kept, np.int64), clouds

    def _sweeps(
        self,
        rows: Array,  # [S]
        clouds: list[Array],
        times_us: Array | None,  # [S] at which the ego's motion is that of its sweep; None: it is not asked for
    ) -> Sweeps:
        index = self.index
        poses, calibrations = index.data_poses[rows], index.data_calibrations[rows]
        global_from_ego = pose_matrix(index.pose_rotations[poses], index.pose_translations[poses])
        velocity = rate = np.zeros((len(rows), 3))
        if times_us is not None:
            velocity, rate = ego_motion(index, times_us, global_from_ego[:, :3, :3])
        return Sweeps(
            clouds=clouds,
            ego_from_sensor=index.ego_from_sensor[calibrations],
            global_from_ego=global_from_ego,
            velocity=velocity,
            rate=rate,
        )

    def _lidar_points(
        self,
        sample: int,
        global_from_ego: Array,  # [4, 4]
        aug_from_ego: Array,  # [4, 4]
        num_sweeps: int,
        origins: bool,
        skipped: _Skipped,
    ) -> dict[str, torch.Tensor]:
        index, frame_time_us = self.index, int(self.index.frame_times_us[sample])
        rows, clouds = self._clouds(sample, LIDARS, num_sweeps, self._lidar_cloud, skipped)
        pose_times_us = index.pose_times_us[index.data_poses[rows]]
        points = [cloud.points for cloud in clouds]
        return lidar_tensors(
            self._sweeps(rows, points, pose_times_us if self.settings.deskew_lidar else None),
            [1e-6 * (frame_time_us - cloud.times_us) for cloud in clouds],
            [1e-6 * (cloud.times_us - time_us) for cloud, time_us in zip(clouds, pose_times_us, strict=True)],
            aug_from_ego @ invert_rigid(global_from_ego),
            self.settings.min_distance_m,
            origins,
        )

    def _lidar_cloud(self, path: str, row: int) -> LidarCloud:
        """One file, its points' times checked against the table's."""
        cloud = read_lidar_points(path)
        stamp = int(self.index.data_times_us[row])
        if not self.settings.deskew_lidar:
            return LidarCloud(cloud.points, np.full_like(cloud.times_us, stamp))
        away = np.abs(cloud.times_us - stamp)
        if len(away) and away.max() > 1e6 * MAX_SCAN_S:
            at = int(np.argmax(away))
            raise DataError(
                f"{path}: point {at} was measured at {cloud.times_us[at]} us, more than {MAX_SCAN_S} s from its sweep, "
                f"{stamp} us; with data.deskew_lidar=false times of points are not used"
            )
        return cloud

    def _future(self, sample: int, aug_from_ego: Array, skipped: _Skipped) -> tuple[FrameBatch, ...]:
        """LiDAR of the next key frames, see `FrameBatch.future`."""
        frames, row = [], sample
        for _ in range(self.settings.num_future_frames):
            row = int(self._following[row]) if row >= 0 else -1
            at, sweeps = (row, 1) if row >= 0 else (sample, 0)
            points = self._lidar_points(at, self._global_from_ego(at), aug_from_ego, sweeps, True, skipped)
            frames.append(FrameBatch(**self._key_frame(at, aug_from_ego), **points))
        return tuple(frames)

    # ---------------------------------------------------------------- cameras

    def _images(
        self,
        sample: int,
        global_from_ego: Array,  # [4, 4]
        aug_from_ego: Array,  # [4, 4]
        augmentation: AugmentationConfig | None,
        rng: np.random.Generator,
        skipped: _Skipped,
    ) -> dict[str, torch.Tensor]:
        """Images at network size and P_n by each camera's own pose; a missing camera stays black and masked."""
        index, settings = self.index, self.settings
        images = np.zeros((len(CAMERAS), 3, *settings.image_size_px), np.uint8)
        valid = np.zeros(len(CAMERAS), bool)
        pix_from_aug = np.tile(np.eye(4), (len(CAMERAS), 1, 1))
        ida = augmentation.image if augmentation is not None else None
        rows = index.key_data[sample, [CHANNELS.index(channel) for channel in CAMERAS]]
        poses, calibrations = index.data_poses[rows], index.data_calibrations[rows]
        global_from_cam = (
            pose_matrix(index.pose_rotations[poses], index.pose_translations[poses])
            @ index.ego_from_sensor[calibrations]
        )
        cam_from_aug = invert_rigid(global_from_cam) @ global_from_ego @ np.linalg.inv(aug_from_ego)
        for view, channel in enumerate(CAMERAS):
            row = int(rows[view])
            if row < 0:
                skipped.channels[f"{channel} (not recorded)"] += 1
                continue
            if not self._with_known_poses(sample, rows[view : view + 1], [channel], skipped)[1]:
                continue
            source_px = tuple(int(n) for n in index.data_sizes[row])
            crop = (
                width_fit(source_px, settings.image_size_px, settings.test_resize_offset)
                if ida is None
                else draw_crop(ida, rng, source_px, settings.image_size_px)
            )
            read = partial(read_image, source_px=source_px, crop=crop)
            image = self._guarded(sample, channel, row, read, skipped)
            if image is not None:
                images[view], valid[view] = image, True
            pix_from_aug[view] = pixels_from_points(
                index.intrinsics[calibrations[view]], cam_from_aug[view], crop.matrix()
            )
        return {
            "images": torch.from_numpy(images[None]),
            "image_valid": torch.from_numpy(valid[None]),
            "pix_from_aug": torch.from_numpy(pix_from_aug[None].astype(np.float32)),
        }

    # ---------------------------------------------------------------- annotations

    def _boxes(self, sample: int, global_from_ego: Array) -> Boxes3D:
        """Boxes of the 12 classes in ego(t); velocities by the devkit's rule, NaN where unknown."""
        index = self.index
        rows = np.arange(index.box_starts[sample], index.box_starts[sample + 1])
        rows = rows[index.box_labels[rows] >= 0]
        ego_from_global = invert_rigid(global_from_ego)
        rotation = ego_from_global[:3, :3]

        def floats(values: Array) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))

        return Boxes3D(
            centers=floats(index.box_centers[rows] @ rotation.T + ego_from_global[:3, 3]),
            sizes=floats(index.box_sizes[rows][:, [1, 0, 2]]),
            yaws=floats(yaw_of(rotation @ quaternion_to_matrix(index.box_rotations[rows]))),
            velocities=floats((index.box_velocities[rows] @ rotation.T)[:, :2]),
            labels=torch.from_numpy(index.box_labels[rows].astype(np.int64)),
            attributes=torch.from_numpy(index.box_attributes[rows].astype(np.int64)),
            num_points=torch.from_numpy(index.box_points[rows].astype(np.int64)),
        )

    # ---------------------------------------------------------------- files

    def _guarded(self, sample: int, channel: str, row: int, read: Callable[[str], T], skipped: _Skipped) -> T | None:
        """Read a sensor file; when it cannot be, raise or count and return None, as `on_bad_file` says."""
        name = self.index.filename(row)
        try:
            return read(self._inside(name))
        except DataError as error:
            if self.settings.on_bad_file is OnBadFile.error:
                remedy = "restore the file, or skip and count such files with data.on_bad_file=skip"
                raise DataError(f"{error} (sample {self.index.sample_tokens[sample]}); {remedy}") from error
            skipped.channels[channel] += 1
            skipped.files.append(name)
            if name not in self._reported:
                self._reported.add(name)
                _log.warning("skipped: %s", error)
            return None

    def _with_known_poses(
        self,
        sample: int,
        rows: Array,  # [S] int64, of files
        channels: list[str],  # S
        skipped: _Skipped,
    ) -> tuple[list[int], list[str]]:
        """Files that the truck can have recorded where their poses say; for others raise or count, as `on_bad_file`."""
        index, poses = self.index, self.index.data_poses[rows]
        good = reached(index, poses, index.frame_poses[sample])
        if self.settings.on_bad_file is OnBadFile.error:
            if not good.all():
                name = index.filename(int(rows[np.argmin(good)]))
                raise DataError(
                    f"{index.root / index.version}/ego_pose.json: from the pose of {name} a truck cannot have come to "
                    f"that of its key frame, sample {index.sample_tokens[sample]}, so the table is damaged there; "
                    "unpack the release again, or skip and count such files with data.on_bad_file=skip"
                )
            return rows.tolist(), channels  # where the poses around a sweep jump `ego_motion` says so
        if set(channels) <= set(RADARS):
            good &= motion_known(index, index.data_times_us[rows])
        elif set(channels) <= set(LIDARS) and self.settings.deskew_lidar:
            good &= motion_known(index, index.pose_times_us[poses])
        for row, channel in zip(rows[~good].tolist(), np.array(channels)[~good].tolist(), strict=True):
            name = index.filename(row)
            skipped.channels[f"{channel} (ego pose)"] += 1
            skipped.files.append(name)
            if name not in self._reported:
                self._reported.add(name)
                _log.warning("skipped: the ego pose of %s is not one that a truck can have driven to", name)
        return rows[good].tolist(), np.array(channels)[good].tolist()

    def _lost(self, sample: int) -> bool:
        """Whether none of a key frame's files was recorded where a truck could have come from its pose."""
        rows = self.index.key_data[sample]
        poses = self.index.data_poses[rows[rows >= 0]]
        poses = poses[poses != self.index.frame_poses[sample]]
        return len(poses) > 0 and not reached(self.index, poses, self.index.frame_poses[sample]).any()

    def _inside(self, name: str) -> str:
        """The file's path, refused when a symbolic link leads out of the data set.

        A folder is followed once: sixty files of a frame lie in a dozen folders.
        """
        folder, _, file = name.rpartition("/")
        if folder not in self._folders:
            self._folders[folder] = os.path.realpath(os.path.join(self._root, folder))
        path = f"{self._folders[folder]}/{file}"
        if os.path.islink(path):
            path = os.path.realpath(path)
        if not path.startswith(f"{self._root}/"):
            stated = os.path.join(self._root, name)
            raise DataError(f"{stated}: leads to {path}, which is outside the dataset folder")
        return path


def _following(index: DatasetIndex) -> Array:  # [N] int64
    order = np.lexsort((index.frame_times_us, index.sample_scenes))
    following = np.full(len(order), -1)
    linked = np.diff(index.sample_scenes[order]) == 0
    following[order[:-1][linked]] = order[1:][linked]
    return following


def radar_tensors(
    sweeps: Sweeps,
    ages_s: Array,  # [S] key frame minus sweep
    global_from_ego: Array,  # [4, 4] ego(t)
    aug_from_ego: Array,  # [4, 4]
    settings: ReaderSettings,
) -> dict[str, torch.Tensor]:
    """The radar of a batch of one: moved to ego(t), compensated for the ego motion by the full mount (method 1.3)."""
    points = np.zeros((0, len(RADAR_POINT_FIELDS)))
    if sweeps.clouds:
        least_m, propagated = settings.min_distance_m, settings.propagate_points
        points = compensate_clouds(sweeps, invert_rigid(global_from_ego), ages_s, least_m, propagated)
        linear = aug_from_ego[:3, :3]
        points[:, :3] = points[:, :3] @ linear.T + aug_from_ego[:3, 3]
        points[:, 4:6] = points[:, 4:6] @ linear[:2, :2].T
    owners = torch.zeros(len(points), dtype=torch.int64)
    return {"radar_points": torch.from_numpy(points.astype(np.float32, order="C")), "radar_batch": owners}


def lidar_tensors(
    sweeps: Sweeps,
    ages_s: list[Array],  # S of [n] key frame's time less the point's
    offsets_s: list[Array],  # S of [n] the point's time less that of its sweep's pose
    aug_from_global: Array,  # [4, 4]
    min_distance_m: float,  # as `ReaderOptions`
    origins: bool,
) -> dict[str, torch.Tensor]:
    """The LiDAR of a batch of one, in the (augmented) ego frame of the key frame."""
    placed = [(np.zeros((0, len(LIDAR_POINT_FIELDS)), np.float32), np.zeros((0, 3), np.float32))]
    mounts, targets = sweeps.ego_from_sensor, aug_from_global @ sweeps.global_from_ego
    columns = (sweeps.clouds, ages_s, offsets_s, mounts, targets, sweeps.velocity, sweeps.rate)
    placed += [place_sweep(*sweep, min_distance_m, origins) for sweep in zip(*columns, strict=True)]
    points, starts = zip(*placed, strict=True)
    tensors = {"lidar_points": torch.from_numpy(np.concatenate(points))}
    tensors["lidar_batch"] = torch.zeros(len(tensors["lidar_points"]), dtype=torch.int64)
    if origins:
        tensors["lidar_origins"] = torch.from_numpy(np.concatenate(starts))
    return tensors
