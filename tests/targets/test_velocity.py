"""Velocity rasters of boxes."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.structures.boxes import Boxes3D
from src.targets.velocity import velocity_raster
from tests.targets.box_rows import GRID, boxes_of, key


def test_the_faster_box_wins_and_an_unknown_one_over_all() -> None:
    nan = float("nan")
    boxes = boxes_of((0.5, 0.5, 3, 1, 0, 1, 0), (2.5, 0.5, 3, 1, 0, -3, 0), (4.5, 0.5, 3, 1, 0, nan, nan))
    raster = velocity_raster([Boxes3D.empty(), boxes], GRID, 0.0)
    assert raster.keys.tolist() == [key(1, 10, c) for c in range(14, 21)]
    speeds = raster.at(torch.tensor([key(1, 10, c) for c in range(14, 21)] + [key(0, 10, 14), -1]))
    expected = [[1, 0], [1, 0], [-3, 0], [-3, 0], [nan, nan], [nan, nan], [nan, nan], [nan, nan], [nan, nan]]
    torch.testing.assert_close(speeds, torch.tensor(expected, dtype=torch.float32), equal_nan=True)


def test_a_box_comes_before_the_margin_of_a_faster_one() -> None:
    """A standing sign beside a lane: its own cells stand, the rest of its margin belongs to the car."""
    nan = float("nan")
    sign, car = (0.5, 0.5, 1, 1, 0, 0.2, 0), (0.5, 2.5, 5, 1, 0, 30, 0)
    raster = velocity_raster([boxes_of(car, sign)], GRID, 4.0)
    found = raster.at(torch.tensor([key(0, 10, 15), key(0, 10, 14), key(0, 12, 15), key(0, 8, 15)]))
    torch.testing.assert_close(found, torch.tensor([[0.2, 0], [30, 0], [30, 0], [0.2, 0]]))
    unknown = velocity_raster([boxes_of((0.5, 2.5, 5, 1, 0, nan, nan), sign)], GRID, 4.0)
    found = unknown.at(torch.tensor([key(0, 10, 15), key(0, 10, 14)]))
    torch.testing.assert_close(found, torch.tensor([[0.2, 0], [nan, nan]]), equal_nan=True)


def test_velocity_raster_without_boxes() -> None:
    raster = velocity_raster([Boxes3D.empty()], GRID, 4.8)
    assert raster.at(torch.tensor([3, -1])).isnan().all()


@pytest.mark.parametrize("margin_m", [0.0, 4.8])
@pytest.mark.parametrize("turn", [[[-1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, -1.0], [1.0, 0.0]]])
def test_rasters_turn_with_the_scene(turn: list[list[float]], margin_m: float) -> None:
    grid = BEVGrid(cells=(64, 64), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    rows = torch.rand(14, 7, generator=torch.Generator().manual_seed(1))
    rows = (rows - torch.tensor([0.5, 0.5, 0, 0, 0.5, 0.5, 0.5])) * torch.tensor([48.0, 48, 9, 3, 6, 30, 30])
    boxes = boxes_of(*rows.tolist())
    aug_from_ego = torch.eye(4)
    aug_from_ego[:2, :2] = torch.tensor(turn)
    before = velocity_raster([boxes], grid, margin_m)
    after = velocity_raster([boxes.transform(aug_from_ego)], grid, margin_m)

    row, col = torch.div(before.keys, 64, rounding_mode="floor"), before.keys % 64
    centred = torch.stack([2 * col - 63, 2 * row - 63], 1).float() @ aug_from_ego[:2, :2].T
    col, row = ((centred + 63) / 2).long().unbind(1)
    keys, order = (row * 64 + col).sort()
    assert torch.equal(after.keys, keys)
    torch.testing.assert_close(after.velocities, (before.velocities @ aug_from_ego[:2, :2].T)[order])
