"""Oracles of an evaluation: a memory that is told how everything it holds really moves.

They bound what velocity compensation can give: what is left to gain with true velocities is what better predicted ones
could bring, and with the true motion what any model of motion could.
"""

from __future__ import annotations

from enum import Enum
from functools import partial

import numpy as np
import torch
from torch import Tensor

from src.geometry.box_distance import footprint_distances
from src.geometry.tensor_transforms import rotate
from src.metrics.diagnostics import NEAR_M
from src.metrics.submission import to_ego
from src.models.memory import FrameMemory, RememberedFrame
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import EvaluationSet


class Oracle(Enum):
    """What a memory is told in an evaluation."""

    none = "none"
    velocity = "velocity"  # of the nearest box at the time that is remembered, if within NEAR_M; 0 beside all boxes
    motion = "motion"  # where that box has gone since, rigidly; its velocity where it is not annotated any more


class TrueMotion:
    """Replaces remembered velocities by those of the annotations of a split."""

    def __init__(self, truth: EvaluationSet, oracle: Oracle) -> None:
        self.truth, self.oracle = truth, oracle
        keys = zip(truth.scenes.tolist(), truth.times_s.tolist(), strict=True)
        self.sample_at = {key: sample for sample, key in enumerate(keys)}

    def correct(self, memory: FrameMemory, batch: FrameBatch) -> FrameMemory:
        """The memory with true velocities, for the batch's frames. Raises ConfigError for one that holds none."""
        now = [self.truth.index_of[token] for token in batch.tokens]
        return memory.mapped(lambda frame: frame.with_velocities(partial(self._velocities, frame, now)))

    def _velocities(
        self,
        frame: RememberedFrame,
        now: list[int],  # B samples
        stream: int,
        xy: Tensor,  # [n, 2] m, ego frame of its own time
        predicted: Tensor,  # [n, 2] m/s over ground, same axes
    ) -> Tensor:  # [n, 2]
        """True velocities of what one stream remembers of a frame; the predicted ones where the truth is not known."""
        key = int(self.truth.scenes[now[stream]]), float(frame.timestamps_s[stream])
        if key not in self.sample_at:  # padding of a stream that began later
            return predicted
        then, pose = self.sample_at[key], frame.global_from_ego[stream].cpu().numpy()
        boxes, instances = self._boxes(then, pose)
        if not len(boxes):
            return torch.zeros_like(predicted)
        distances, nearest = footprint_distances(xy.cpu(), boxes.bev()).min(dim=1)
        velocities = boxes.velocities
        if self.oracle is Oracle.motion:
            elapsed_s = self.truth.times_s[now[stream]] - self.truth.times_s[then]
            later, places = self._boxes(now[stream], pose)
            moved = _carried(xy.cpu(), boxes[nearest], later, _rows_of(instances[nearest.numpy()], places))
            velocities = torch.where(moved.isnan(), velocities[nearest], (moved - xy.cpu()) / elapsed_s)
        else:
            velocities = velocities[nearest]
        velocities = torch.where((distances <= NEAR_M)[:, None], velocities, 0.0).to(predicted)
        return torch.where(velocities.isnan(), predicted, velocities)

    def _boxes(self, sample: int, global_from_ego: np.ndarray) -> tuple[Boxes3D, np.ndarray]:
        """All annotations of a sample in an ego frame, and which objects they are."""
        rows = np.flatnonzero(self.truth.ground_truth.samples == sample)
        return to_ego(self.truth.ground_truth[rows], global_from_ego), self.truth.instances[rows]


def _rows_of(wanted: np.ndarray, places: np.ndarray) -> Tensor:
    """Where each of `wanted` stands in `places`, -1 for nowhere: [n] int64."""
    rows = {int(instance): row for row, instance in enumerate(places)}
    return torch.tensor([rows.get(int(instance), -1) for instance in wanted], dtype=torch.int64)


def _carried(
    xy: Tensor,  # [n, 2] m
    boxes: Boxes3D,  # n
    later: Boxes3D,
    rows: Tensor,  # [n] int64 row of each box in `later`, -1 for none
) -> Tensor:  # [n, 2] m, NaN for none
    """Points that a box takes along as it moves and turns."""
    if not len(later):
        return torch.full_like(xy, torch.nan)
    turn = later.yaws[rows] - boxes.yaws
    offset = xy - boxes.centers[:, :2]
    turned = torch.stack(rotate(turn.cos(), turn.sin(), *offset.unbind(1)), dim=1)
    return torch.where((rows >= 0)[:, None], later.centers[rows, :2] + turned, torch.nan)
