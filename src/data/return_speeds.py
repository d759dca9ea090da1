"""How fast what LiDAR returns met moves along their rays, from the source that the timeline names (lrs 2.5)."""

from __future__ import annotations

import numpy as np
import torch

from src.data.compensation import ego_poses, read_sweeps
from src.data.point_tensors import radar_tensors
from src.data.rays import RADAR_WINDOW_S, TRUE_MARGIN_M, radar_speeds
from src.data.schema import DatasetIndex
from src.data.sensor_files import SensorFiles, Skipped
from src.data.timeline import RadialSpeeds, SweepTimeline
from src.data.true_geometry import TrueGeometry
from src.structures.ray_bundle import RayBundle
from src.structures.taxonomy import RADARS

Array = np.ndarray


class ReturnSpeeds:
    """Radial speeds over ground of the returns of one release. Raises DataError for a file that is needed."""

    def __init__(
        self,
        index: DatasetIndex,
        files: SensorFiles,
        source: RadialSpeeds,  # not `none`
        min_distance_m: float,  # of radar points, as `ReaderOptions`
    ) -> None:
        self.index, self.min_distance_m = index, min_distance_m
        self._files = files
        self._find = self._true_speeds if source is RadialSpeeds.exact else self._radar_speeds
        self._radars: SweepTimeline | None = None  # made on first need
        self._truth: tuple[int, TrueGeometry] | None = None  # of the scene read last, by its row

    def along(
        self,
        sample: int,
        rays: RayBundle,
        aug_from_global: Array,  # [4, 4] of the frame that the rays are in
        frame_time_us: int,  # from which their times count
        skipped: Skipped,
    ) -> torch.Tensor:  # [R] float32 m/s, NaN where unknown
        """Of each ray's return."""
        times_us = frame_time_us + np.round(1e6 * rays.times_s.double().numpy()).astype(np.int64)
        speeds = self._find(sample, rays, times_us, aug_from_global, frame_time_us, skipped)
        return torch.from_numpy(speeds.astype(np.float32))

    def _true_speeds(
        self,
        sample: int,
        rays: RayBundle,
        times_us: Array,  # [R] int64, of the rays
        aug_from_global: Array,  # [4, 4]
        frame_time_us: int,
        skipped: Skipped,
    ) -> Array:  # [R]
        """By the true motion that a synthetic world knows, in metres of the augmented frame."""
        scene = int(self.index.sample_scenes[sample])
        if self._truth is None or self._truth[0] != scene:
            self._truth = scene, TrueGeometry.read(self.index.root, str(self.index.scene_names[scene]))
        global_from_aug = np.linalg.inv(aug_from_global)
        points = rays.points.double().numpy() @ global_from_aug[:3, :3].T + global_from_aug[:3, 3]
        velocities = self._truth[1].velocities(points, times_us, TRUE_MARGIN_M) @ aug_from_global[:3, :3].T
        return (velocities * rays.directions.double().numpy()).sum(1)

    def _radar_speeds(
        self,
        sample: int,
        rays: RayBundle,
        times_us: Array,  # [R] int64, of the rays
        aug_from_global: Array,  # [4, 4]
        frame_time_us: int,
        skipped: Skipped,
    ) -> Array:  # [R]
        """By the radar returns beside the rays' ends."""
        index = self.index
        if self._radars is None:
            self._radars = SweepTimeline(index, RADARS)
        window_us, files = round(1e6 * RADAR_WINDOW_S), set()
        for step in rays.steps.unique().tolist():
            own_us = times_us[rays.steps.numpy() == step]
            files |= set(self._radars.between(sample, own_us.min() - window_us, own_us.max() + window_us).tolist())
        rows, clouds = self._files.radar_clouds(sample, sorted(files), skipped)
        sweeps = read_sweeps(index, rows, clouds, index.data_times_us[rows])
        ages_s = 1e-6 * (frame_time_us - index.data_times_us[rows])
        pose = ego_poses(index, index.frame_poses[sample])
        unmoved = radar_tensors(
            sweeps, ages_s, pose, aug_from_global @ pose, self.min_distance_m, propagate_points=False
        )
        return radar_speeds(rays, unmoved["radar_points"].double().numpy())
