"""One key frame with its sensors, as one batch of one (method 1.1 to 1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from src.data.augment import AugmentationConfig, draw_bev_transform, draw_crop, frame_generator
from src.data.compensation import ego_poses, read_sweeps
from src.data.images import read_image, width_fit
from src.data.pcd import LidarCloud
from src.data.point_tensors import lidar_tensors, radar_tensors
from src.data.rays import lidar_rays, without_ego_body
from src.data.return_speeds import ReturnSpeeds
from src.data.schema import CHANNELS, DatasetIndex
from src.data.sensor_files import OnBadFile, SensorFiles, Skipped, sweeps_before
from src.data.timeline import LidarTimeline, RadialSpeeds, TimelineConfig
from src.geometry.camera import pixels_from_points
from src.geometry.transforms import invert_rigid, quaternion_to_matrix, yaw_of
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.ray_bundle import RayBundle
from src.structures.taxonomy import CAMERAS, LIDARS, RADARS, REFERENCE_CHANNEL

Array = np.ndarray


@dataclass(kw_only=True)
class ReaderOptions:
    """How frames are read, whatever a model takes of them."""

    num_sweeps: int  # past sweeps of each radar, the key frame's included
    num_lidar_sweeps: int  # past sweeps of each LiDAR, the key frame's included
    lidar_origins: bool  # also where the ray of each LiDAR point began
    deskew_lidar: bool  # LiDAR points are moved by what was driven between their own times and the sweep's
    timeline: TimelineConfig | None  # LiDAR frames between key frames; None: key frames alone
    num_future_frames: int  # frames of the timeline's future, drawn in training, whose rays supervise; 0: no rays
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
        self._files = SensorFiles(index, settings.on_bad_file, settings.deskew_lidar)
        self._preceding = _preceding(index)  # [N] row of the scene's sample before, -1 for none
        self.timeline = settings.timeline and LidarTimeline(index, settings.timeline)
        source = settings.timeline.radial_speeds if settings.timeline is not None else RadialSpeeds.none
        unknown = source is RadialSpeeds.none
        self._speeds = None if unknown else ReturnSpeeds(index, self._files, source, settings.min_distance_m)

    def read(
        self,
        sample: int,
        augmentation: AugmentationConfig | None,
        seed: int = 0,
        epoch: int = 0,
        clip: str | None = None,
        history: Sequence[int] = (),
        targets: Sequence[int] = (),
    ) -> FrameBatch:
        """The frame at row `sample` of the sample table; random draws depend on (seed, epoch, token) alone.

        `clip` is the token of the first frame of the clip that this frame is part of: A_t is then that frame's, so
        that it stays the same throughout the clip (method 6.4). `history` and `targets` are steps of the timeline: its
        LiDAR frames at the first are `past`, those at the second `rays`. A moment of the past without a sweep becomes a
        frame with the token, time and pose of the key frame and no points; such frames come first, because at one a
        memory forgets those before it.
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
        skipped = Skipped(lost=self._files.lost(sample))
        batch = self._key_frame(sample, aug_from_ego)
        if self.settings.num_sweeps:
            batch |= self._radar_points(sample, global_from_ego, aug_from_ego, skipped)
        if self.settings.num_lidar_sweeps:
            batch |= self._lidar_points(sample, global_from_ego, aug_from_ego, skipped)
        if self.settings.image_size_px is not None:
            batch |= self._images(sample, global_from_ego, aug_from_ego, augmentation, rng, skipped)
        if history:
            past = [self._past_frame(sample, step, aug_from_ego, skipped) for step in history]
            batch["past"] = tuple(sorted(past, key=lambda frame: frame.tokens != batch["tokens"]))
        if targets:
            batch["rays"] = self._rays(sample, targets, aug_from_ego @ invert_rigid(global_from_ego), skipped)
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
        return ego_poses(self.index, self.index.frame_poses[sample])

    # ---------------------------------------------------------------- radar and LiDAR

    def _radar_points(
        self,
        sample: int,
        global_from_ego: Array,  # [4, 4]
        aug_from_ego: Array,  # [4, 4]
        skipped: Skipped,
    ) -> dict[str, torch.Tensor]:
        files = self._files.of_frame(sample, RADARS, self.settings.num_sweeps, skipped)
        rows, clouds = self._files.radar_clouds(sample, files, skipped)
        times_us = self.index.data_times_us[rows]
        ages_s = 1e-6 * (self.index.frame_times_us[sample] - times_us)
        sweeps = read_sweeps(self.index, rows, clouds, times_us)
        how = (self.settings.min_distance_m, self.settings.propagate_points)
        return radar_tensors(sweeps, ages_s, global_from_ego, aug_from_ego, *how)

    def _lidar_points(
        self,
        sample: int,
        global_from_ego: Array,  # [4, 4]
        aug_from_ego: Array,  # [4, 4]
        skipped: Skipped,
    ) -> dict[str, torch.Tensor]:
        files = self._files.of_frame(sample, LIDARS, self.settings.num_lidar_sweeps, skipped)
        rows, clouds = self._files.lidar_clouds(sample, files, skipped)
        aug_from_global, time_us = aug_from_ego @ invert_rigid(global_from_ego), int(self.index.frame_times_us[sample])
        return self._input(sample, rows, clouds, aug_from_global, time_us, skipped)

    def _input(
        self,
        sample: int,
        rows: Array,  # [S]
        clouds: list[LidarCloud],
        aug_from_global: Array,  # [4, 4]
        frame_time_us: int,
        skipped: Skipped,
    ) -> dict[str, torch.Tensor]:
        """`lidar_tensors` of these files; where the timeline has a source of speeds, with speeds and origins."""
        origins = self.settings.lidar_origins or self._speeds is not None
        tensors = self._placed(rows, clouds, aug_from_global, frame_time_us, origins)
        if self._speeds is None:
            return tensors
        directed = (tensors["lidar_points"][:, :3] != tensors["lidar_origins"]).any(1)
        rays = lidar_rays({name: value[directed] for name, value in tensors.items()}, step=0)
        speeds = torch.full((len(directed),), torch.nan)
        if len(rays):
            speeds[directed] = self._speeds.along(sample, rays, aug_from_global, frame_time_us, skipped)
        return tensors | {"lidar_speeds": speeds}

    def _placed(
        self,
        rows: Array,  # [S]
        clouds: list[LidarCloud],
        aug_from_global: Array,  # [4, 4]
        frame_time_us: int,
        origins: bool = True,
    ) -> dict[str, torch.Tensor]:
        """`lidar_tensors` of these files."""
        pose_times_us = self.index.pose_times_us[self.index.data_poses[rows]]
        points = [cloud.points for cloud in clouds]
        return lidar_tensors(
            read_sweeps(self.index, rows, points, pose_times_us if self.settings.deskew_lidar else None),
            [1e-6 * (frame_time_us - cloud.times_us) for cloud in clouds],
            [1e-6 * (cloud.times_us - time_us) for cloud, time_us in zip(clouds, pose_times_us, strict=True)],
            aug_from_global,
            self.settings.min_distance_m,
            origins,
        )

    # ---------------------------------------------------------------- LiDAR of the timeline

    def _past_frame(self, sample: int, step: int, aug_from_ego: Array, skipped: Skipped) -> FrameBatch:
        """The LiDAR frame at a moment, in the ego frame of its LIDAR_LEFT sweep or else of the first there is."""
        files = sweeps_before(self.index, self.timeline.sweeps(sample, step), self.settings.num_lidar_sweeps)
        rows, clouds = self._files.lidar_clouds(sample, files, skipped)
        frame, aug_from_global, time_us = self._key_frame(sample, aug_from_ego), np.eye(4), 0
        if len(rows):
            own = rows[np.argmax(self.index.data_channels[rows] == CHANNELS.index(REFERENCE_CHANNEL))]
            global_from_ego = ego_poses(self.index, self.index.data_poses[own])
            time_us = int(self.index.data_times_us[own])
            aug_from_global = aug_from_ego @ invert_rigid(global_from_ego)
            frame |= {
                "tokens": [f"{frame['tokens'][0]}{step * self.settings.timeline.interval_s:+.1f}s"],
                "timestamps_s": torch.tensor([1e-6 * time_us], dtype=torch.float64),
                "global_from_ego": torch.from_numpy(global_from_ego[None]),
            }
        return FrameBatch(**frame, **self._input(sample, rows, clouds, aug_from_global, time_us, skipped))

    def _rays(self, sample: int, steps: Sequence[int], aug_from_global: Array, skipped: Skipped) -> RayBundle:
        """Returns of one sweep of each LiDAR at each moment; a moment without sweeps gives no rays."""
        frame_time_us, parts = int(self.index.frame_times_us[sample]), []
        for step in steps:
            files = sweeps_before(self.index, self.timeline.sweeps(sample, step), 1)
            rows, clouds = self._files.lidar_clouds(sample, files, skipped)
            mounts = self.index.ego_from_sensor[self.index.data_calibrations[rows]]
            clouds = list(map(without_ego_body, clouds, mounts))
            parts.append(lidar_rays(self._placed(rows, clouds, aug_from_global, frame_time_us), step))
        rays = RayBundle.concatenate(parts, dim=0)
        if self._speeds is None or not len(rays):
            return rays
        return replace(rays, speeds=self._speeds.along(sample, rays, aug_from_global, frame_time_us, skipped))

    # ---------------------------------------------------------------- cameras

    def _images(
        self,
        sample: int,
        global_from_ego: Array,  # [4, 4]
        aug_from_ego: Array,  # [4, 4]
        augmentation: AugmentationConfig | None,
        rng: np.random.Generator,
        skipped: Skipped,
    ) -> dict[str, torch.Tensor]:
        """Images at network size and P_n by each camera's own pose; a missing camera stays black and masked."""
        index, settings = self.index, self.settings
        images = np.zeros((len(CAMERAS), 3, *settings.image_size_px), np.uint8)
        valid = np.zeros(len(CAMERAS), bool)
        pix_from_aug = np.tile(np.eye(4), (len(CAMERAS), 1, 1))
        ida = augmentation.image if augmentation is not None else None
        rows = index.key_data[sample, [CHANNELS.index(channel) for channel in CAMERAS]]
        poses, calibrations = index.data_poses[rows], index.data_calibrations[rows]
        global_from_cam = ego_poses(index, poses) @ index.ego_from_sensor[calibrations]
        cam_from_aug = invert_rigid(global_from_cam) @ global_from_ego @ np.linalg.inv(aug_from_ego)
        for view, channel in enumerate(CAMERAS):
            row = int(rows[view])
            if row < 0:
                skipped.channels[f"{channel} (not recorded)"] += 1
                continue
            if not self._files.with_known_poses(sample, rows[view : view + 1], [channel], skipped)[1]:
                continue
            source_px = tuple(int(n) for n in index.data_sizes[row])
            crop = (
                width_fit(source_px, settings.image_size_px, settings.test_resize_offset)
                if ida is None
                else draw_crop(ida, rng, source_px, settings.image_size_px)
            )
            read = partial(read_image, source_px=source_px, crop=crop)
            image = self._files.guarded(sample, channel, row, read, skipped)
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


def _preceding(index: DatasetIndex) -> Array:  # [N] int64
    order = np.lexsort((index.frame_times_us, index.sample_scenes))
    preceding = np.full(len(order), -1)
    linked = np.diff(index.sample_scenes[order]) == 0
    preceding[order[1:][linked]] = order[:-1][linked]
    return preceding
