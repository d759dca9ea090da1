"""How remembered frames and their Gaussians come to the present, worked by hand."""

import math

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.frame_motion import relative_motion, warp_gaussians, zero_slow_velocities
from tests.models.moving import UTM, bda, pose

GRID = BEVGrid(cells=(20, 30), cell_m=1.0, centre_m=(5.0, 0.0), z_range_m=(-3.0, 5.0))
QUARTER = math.pi / 2


def moves(frames, *, newest=False, aug=None):
    """To one stream at (10, 0) and 2 s, of frames (pose, time, present) up to 1 s old."""
    poses, times, present = zip(*frames, strict=True)
    past = (torch.stack(poses)[:, None], torch.tensor(times, dtype=torch.float64)[:, None])
    here = (pose(10.0, 0.0, 0.0, UTM)[None], torch.tensor([2.0], dtype=torch.float64))
    aug = bda() if aug is None else aug
    present = torch.tensor(present)[:, None]
    kept, matrix, elapsed, usable = relative_motion(here, aug[None], past, present, 1.0, 50.0, newest)
    return kept[:, 0].tolist(), matrix[:, 0], elapsed[:, 0], usable[:, 0].tolist()


def test_a_place_of_the_past_is_where_the_ego_has_left_it():
    """Past: at (6, 3) heading left. Its point (2, 1) is (5, 5) of the world, seen from (10, 0) at (-5, 5)."""
    _, matrix, elapsed, usable = moves([(pose(6.0, 3.0, QUARTER, UTM), 1.5, True)], aug=bda(QUARTER, 2.0))
    found = matrix[0] @ torch.tensor([2.0, 1.0, 0.0, 1.0])
    torch.testing.assert_close(found[:2], torch.tensor([-10.0, -10.0]))  # turned to the left and twice as far
    assert matrix.dtype == elapsed.dtype == torch.float32
    assert elapsed.tolist() == [0.5] and usable == [True]


def test_what_is_absent_old_to_come_or_too_far_does_not_move_in_no_time():
    near = pose(9.0, 0.0, 0.0, UTM)
    frames = [
        (near, 1.9, True),
        (near, 1.9, False),
        (near, 0.5, True),  # 1.5 s
        (near, 2.0, True),  # now
        (near, 2.5, True),
        (pose(-20.0, 0.0, 0.0, UTM), 1.5, True),  # 30 m in half a second
        (pose(-14.0, 0.0, 0.0, UTM), 1.5, True),  # 24 m: 48 of 50 m/s
    ]
    kept, matrix, elapsed, usable = moves(frames)
    assert kept == [present for _, _, present in frames]
    assert usable == [True, False, False, False, False, False, True]
    torch.testing.assert_close(elapsed, torch.tensor([0.1, 0, 0, 0, 0, 0, 0.5]))
    for number, there in enumerate(usable):
        assert there or torch.equal(matrix[number], torch.eye(4))


@pytest.mark.parametrize(("jumped", "kept"), [(False, [True, False, True]), (True, [False, False, False])])
def test_a_jump_to_the_newest_frame_forgets_a_stream(jumped, kept):
    newest = pose(500.0 if jumped else 9.0, 0.0, 0.0, UTM)
    frames = [(newest, 1.9, True), (pose(9.0, 0.0, 0.0, UTM), 2.1, True), (pose(8.0, 0.0, 0.0, UTM), 1.8, True)]
    assert moves(frames, newest=True)[0] == kept


def shapes_of(means, velocities):
    means = torch.tensor(means)[None]
    directions = torch.tensor([1.0, 0.0]).expand_as(means)
    return means, torch.full_like(means, 2.0), directions, torch.tensor(velocities)[None]


def test_gaussians_move_by_their_velocity_and_then_with_the_ego():
    """The ego has turned by 90 degrees to the left at its place, in an augmented frame of 1.5 times the size."""
    shapes = shapes_of([[2.0, 2.0], [2.0, 2.0], [8.0, 4.0]], [[10.0, 0.0], [0.0, 0.0], [0.0, -3.0]])
    matrix = (bda(0.0, 1.5) @ bda(-QUARTER))[None]
    valid, usable, elapsed = torch.tensor([[True, False, True]]), torch.tensor([True]), torch.tensor([0.4])
    found, there = warp_gaussians(shapes, valid, matrix, elapsed, usable, 0.0, GRID)
    means, scales, directions, velocities = (part[0] for part in found)
    assert there[0].tolist() == [True, False, False]  # the third comes to (4.2, -12), beside the grid
    torch.testing.assert_close(means[0], torch.tensor([3.0, -9.0]))
    torch.testing.assert_close(scales, torch.full((3, 2), 3.0))
    torch.testing.assert_close(directions, torch.tensor([0.0, -1.0]).expand(3, 2), atol=1e-6, rtol=0)
    torch.testing.assert_close(velocities[0], torch.tensor([0.0, -15.0]), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("min_speed_mps", "moved"), [(None, [0, 0]), (0.0, [0.5, 2.0]), (2.0, [0, 2.0])])
def test_slow_ones_stay(min_speed_mps, moved):
    shapes = shapes_of([[0.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [4.0, 0.0]])
    valid, usable, half = torch.ones(1, 2).bool(), torch.tensor([True]), torch.tensor([0.5])
    found, _ = warp_gaussians(shapes, valid, torch.eye(4)[None], half, usable, min_speed_mps, GRID)
    assert found[0][0, :, 0].tolist() == moved
    assert torch.equal(found[3], shapes[3])


def test_the_speed_at_the_limit_counts_as_moving():
    velocities = torch.tensor([[3.0, 4.0], [3.0, 3.9]])
    assert zero_slow_velocities(velocities, 5.0).tolist() == [[3.0, 4.0], [0.0, 0.0]]


def test_frames_of_no_use_put_theirs_at_the_centre_of_the_grid():
    shapes = shapes_of([[1.0, 1.0]], [[2.0, 0.0]])
    found, there = warp_gaussians(
        shapes, torch.ones(1, 1).bool(), torch.eye(4)[None], torch.zeros(1), torch.tensor([False]), 0.0, GRID
    )
    assert not there.any() and found[0].tolist() == [[[5.0, 0.0]]]
