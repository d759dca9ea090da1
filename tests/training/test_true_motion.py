"""Oracles of the memory, by hand: a car that drives and turns, one that leaves, a cone, and open ground."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from src.errors import ConfigError
from src.geometry.transforms import pose_matrix
from src.models.crt_fusion.motion_fusion import StackFrame, StackMemory, StoredCellStack
from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory, StoredCells
from src.models.memory import FrameMemory, RememberedFrame
from src.structures.batch import FrameBatch
from src.structures.detections import DetectionTable
from src.structures.gaussians import GaussianSet
from src.training.true_motion import Oracle, TrueMotion
from tests.evaluation_sets import set_of

HALF = np.sqrt(0.5)
NORTH = pose_matrix(np.array([HALF, 0, 0, HALF]), np.array([1000.0, 2000.0, 0.0]))  # the ego looks along global y
LATER = pose_matrix(np.array([HALF, 0, 0, HALF]), np.array([1000.0, 2010.0, 0.0]))


def at(pose, xy):
    return (pose @ np.array([*xy, 0.0, 1.0]))[:3]


def table(rows):
    """Rows (sample, global centre, global yaw, global velocity): boxes of 4 x 2 m."""
    n = len(rows)
    yaws = np.array([row[2] for row in rows])
    return DetectionTable(
        samples=np.array([row[0] for row in rows]),
        labels=np.zeros(n, np.int64),
        centers=np.array([row[1] for row in rows]),
        sizes=np.tile([2.0, 4.0, 1.5], (n, 1)),
        rotations=np.stack([np.cos(yaws / 2), 0 * yaws, 0 * yaws, np.sin(yaws / 2)], 1),
        velocities=np.array([row[3] for row in rows], float),
        attributes=np.full(n, -1),
        scores=np.zeros(n),
        num_points=np.full(n, 9),
    )


# Car 0 is 20 m ahead and drives on at 30 m/s (global y), after a second it has driven 24 m and turned by 90 degrees to
# the left. Car 1 is 20 m to the left and not annotated any more. Car 2's speed is unknown. All of scene 5.
NAN = float("nan")
TRUTH = table(
    [
        (0, at(NORTH, (20, 0)), np.pi / 2, (0, 30)),
        (0, at(NORTH, (0, 20)), np.pi / 2, (-3, 0)),
        (0, at(NORTH, (-30, 0)), np.pi / 2, (NAN, NAN)),
        (1, at(NORTH, (44, 0)), np.pi, (0, 30)),
    ]
)
SET = set_of(TRUTH, "ab", scenes=np.array([5, 5]), times_s=np.array([7.0, 8.0]), instances=np.array([0, 1, 2, 0]))
# On car 0's nose, 2 m beside it, on car 1, on car 2, 2.5 m from car 0, far from all.
XY = torch.tensor([[22.0, 0.0], [20.0, 3.0], [0.0, 20.0], [-30.0, 0.0], [24.6, 0.0], [80.0, 80.0]])
PREDICTED = torch.full((6, 2), 9.0)


def frame(**parts):
    return DPTFFrame(
        timestamps_s=torch.tensor([7.0]).double(),
        global_from_ego=torch.from_numpy(NORTH)[None],
        present=torch.tensor([True]),
        **({"cells": None, "gaussians": None} | parts),
    )


def batch():
    return FrameBatch(
        tokens=["b"],
        timestamps_s=torch.tensor([8.0]).double(),
        global_from_ego=torch.from_numpy(LATER)[None],
        aug_from_ego=torch.eye(4)[None],
    )


def cells(rows=None):
    rows = torch.zeros(6, dtype=torch.int64) if rows is None else rows
    return StoredCells(XY, PREDICTED.clone(), torch.zeros(6, 1), rows)


def corrected(oracle, *frames, truth=SET):
    return TrueMotion(truth, oracle).correct(DPTFMemory(frames), batch()).frames


def test_true_velocities():
    (found,) = corrected(Oracle.velocity, frame(cells=cells()))
    expected = torch.tensor([[30.0, 0], [30, 0], [0, 3], [9, 9], [0, 0], [0, 0]])  # global y is the ego's x
    torch.testing.assert_close(found.cells.velocities, expected, atol=1e-4, rtol=0)
    assert found.cells.xy is XY, "nothing but velocities changes"


def test_true_motion_carries_points_along_with_the_box():
    (found,) = corrected(Oracle.motion, frame(cells=cells()))
    moved = XY + found.cells.velocities * 1.0
    # The nose, 2 m before the centre, is 2 m left of it after the turn; what was 3 m left is 3 m behind.
    expected = torch.tensor([[44.0, 2], [41, 0], [0, 23], [-21, 9], [24.6, 0], [80, 80]])
    torch.testing.assert_close(moved, expected, atol=1e-4, rtol=0)


def test_gaussians_are_told_as_well():
    pair, one = torch.zeros(1, 6, 2), torch.zeros(1, 6)
    gaussians = GaussianSet(
        means=XY[None], scales=pair + 1, directions=pair, opacity_logits=one, velocities=PREDICTED[None],
        features=torch.zeros(1, 6, 1), sources=one.long(), elapsed_s=one, valid=one == 0,
    )  # fmt: skip
    (found,) = corrected(Oracle.velocity, frame(gaussians=gaussians))
    (of_cells,) = corrected(Oracle.velocity, frame(cells=cells()))
    torch.testing.assert_close(found.gaussians.velocities[0], of_cells.cells.velocities)


def test_the_cells_of_crt_fusion_are_told_as_well():
    frame_of_maps = StackFrame(
        timestamps_s=torch.tensor([7.0]).double(),
        global_from_ego=torch.from_numpy(NORTH)[None],
        present=torch.tensor([True]),
        ages_s=torch.tensor([[0.0, 0.5]]),
        cells=StoredCellStack(XY, PREDICTED.clone(), torch.zeros(6, 4), torch.zeros(6, dtype=torch.int64)),
    )
    (of_cells,) = corrected(Oracle.velocity, frame(cells=cells()))
    (found,) = TrueMotion(SET, Oracle.velocity).correct(StackMemory((frame_of_maps,)), batch()).frames
    torch.testing.assert_close(found.cells.velocities, of_cells.cells.velocities)


def test_streams_do_not_mix_and_another_scene_is_not_known():
    two = replace(
        frame(cells=cells(torch.tensor([0, 0, 0, 1, 1, 1]))),
        timestamps_s=torch.tensor([7.0, 3.0]).double(),
        global_from_ego=torch.from_numpy(NORTH).repeat(2, 1, 1),
        present=torch.tensor([True, False]),
    )
    both = FrameBatch(
        tokens=["b", "b"],
        timestamps_s=torch.tensor([8.0, 8.0]).double(),
        global_from_ego=torch.from_numpy(LATER).repeat(2, 1, 1),
        aug_from_ego=torch.eye(4).repeat(2, 1, 1),
    )
    (found,) = TrueMotion(SET, Oracle.velocity).correct(DPTFMemory((two,)), both).frames
    assert (found.cells.velocities[3:] == 9).all(), "padding: there is no such frame"
    torch.testing.assert_close(found.cells.velocities[0], torch.tensor([30.0, 0.0]), atol=1e-4, rtol=0)
    elsewhere = replace(SET, scenes=np.array([4, 5]))
    (found,) = corrected(Oracle.velocity, frame(cells=cells()), truth=elsewhere)
    assert (found.cells.velocities == 9).all()


def test_a_frame_without_any_box_stands_still():
    empty = set_of(DetectionTable.empty(), "ab", scenes=np.array([5, 5]), times_s=np.array([7.0, 8.0]))
    for oracle in (Oracle.velocity, Oracle.motion):
        (found,) = corrected(oracle, frame(cells=cells()), truth=empty)
        assert (found.cells.velocities == 0).all()


@dataclass(frozen=True)
class Sums(FrameMemory[RememberedFrame]):
    """A memory without velocities."""


def test_a_memory_without_velocities_has_nothing_to_be_told():
    plain = RememberedFrame(
        timestamps_s=torch.tensor([7.0]).double(),
        global_from_ego=torch.eye(4)[None].double(),
        present=torch.tensor([True]),
    )
    with pytest.raises(ConfigError, match="RememberedFrame holds no velocities"):
        TrueMotion(SET, Oracle.velocity).correct(Sums((plain,)), batch())
