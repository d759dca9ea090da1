import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.frame_motion import (
    relative_motion,
    relative_motion_reference,
    warp_gaussians,
    warp_gaussians_reference,
)
from tests.models.moving import UTM, bda, pose

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(8.0, 0.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize("newest", [False, True])
@pytest.mark.parametrize("frames", [0, 5])
def test_frames(device, frames, newest):
    """Absent ones, too old ones, one not in the past and two that jumped, columns of one tensor."""
    now = (torch.stack([pose(20.0, 3.0, 0.4, UTM), pose(1.0, 0.0), pose(0.0, 0.0)]), torch.tensor([4.0, 4.5, 4.0]))
    poses = torch.zeros(5, 3, 4, 4, dtype=torch.float64)
    for age in range(5):
        jumps = (pose(0.0, float(age), -0.1), pose(1000.0 * (age == 2), 0.0))
        poses[age] = torch.stack([pose(9.0 - age, 2.0, 0.3 * age, UTM), *jumps])
    times = torch.tensor([[3.5 - age, 4.5 - age, 4.0 - 0.5 * (age + 1)] for age in range(5)], dtype=torch.float64)
    held = torch.cat([times[..., None], poses.flatten(2), times[..., None]], dim=2)[:frames]
    present = torch.tensor([[True, age != 3, True] for age in range(5)])[:frames]
    now, aug = (now[0], now[1].double()), torch.stack([bda(0.3), bda(), bda(-1.0)]).float()
    past = (held[..., 1:17].view(-1, 3, 4, 4), held[..., 0])
    wanted = relative_motion_reference(now, aug, past, present, 1.6, 100.0, newest)
    moved = held.to(device)
    now, past = tuple(x.to(device) for x in now), (moved[..., 1:17].view(-1, 3, 4, 4), moved[..., 0])
    found = relative_motion(now, aug.to(device), past, present.to(device), 1.6, 100.0, newest)
    for value, expected in zip(found, wanted, strict=True):
        torch.testing.assert_close(value.cpu(), expected, rtol=1e-6, atol=1e-6)
    assert not frames or 0 < wanted[3].sum() < wanted[3].numel()


@pytest.mark.parametrize("min_speed_mps", [None, 0.0, 3.0])
@pytest.mark.parametrize("count", [0, 90])
def test_gaussians(device, count, min_speed_mps):
    draw = torch.Generator().manual_seed(count)
    rows = torch.randn(3, count, 11, generator=draw) * torch.tensor([4.0] * 8 + [1.0] * 3)
    valid, usable = torch.rand(3, count, generator=draw) > 0.2, torch.tensor([True, False, True])
    aug_from_past = torch.stack([pose(8.0, 1.0, angle) for angle in (0.3, -0.2, 2.0)]).float()
    aug_from_past[2, :3, :3] *= 1.1
    rest = (valid, aug_from_past, torch.tensor([0.5, 1.0, 1.5]), usable)
    shapes = rows.split([2, 2, 2, 2, 3], dim=2)[:4]  # columns of one tensor
    wanted, there = warp_gaussians_reference(shapes, *rest, min_speed_mps, GRID)
    shapes = rows.to(device).split([2, 2, 2, 2, 3], dim=2)[:4]
    found, here = warp_gaussians(shapes, *(x.to(device) for x in rest), min_speed_mps, GRID)
    assert torch.equal(here.cpu(), there) and (not count or 0 < there.sum() < valid[usable].sum())
    for value, expected in zip(found, wanted, strict=True):
        torch.testing.assert_close(value.cpu(), expected, rtol=1e-5, atol=1e-5)
