"""Rasters of boxes."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.structures.boxes import Boxes3D
from src.targets.box_raster import BoxRaster
from tests.targets.box_rows import GRID, boxes_of, key


def test_cells_of_two_samples() -> None:
    lying, standing = (boxes_of((0.5, 0.5, 3, 1, yaw, 0, 0)) for yaw in (0, torch.pi / 2))
    tight = BoxRaster([lying, standing], GRID, 0.0)
    assert tight.keys.tolist() == [key(0, 10, c) for c in (14, 15, 16)] + [key(1, r, 15) for r in (9, 10, 11)]
    assert tight.inside.all()
    wider = BoxRaster([lying, Boxes3D.empty()], GRID, 2.0)
    assert wider.keys.tolist() == [key(0, r, c) for r in (9, 10, 11) for c in range(13, 18)]
    assert wider.keys[wider.inside].tolist() == [key(0, 10, c) for c in (14, 15, 16)]
    asked = torch.tensor([key(0, 10, 14), key(0, 10, 13), key(1, 10, 14), -1])
    assert wider.in_boxes(asked).tolist() == [True, False, False, False]
    assert wider.velocities_in_boxes(asked).isnan().all(1).tolist() == [False, True, True, True]


def test_boxes_that_were_not_seen_or_lie_outside_cover_nothing() -> None:
    boxes = boxes_of((0.5, 0.5, 3, 1, 0, 0, 0), (15.5, 0.5, 5, 5, 0, 0, 0))
    boxes.num_points = torch.tensor([0, 9])
    unseen = BoxRaster([boxes], GRID, 4.8)
    assert len(unseen.keys) == 0
    assert unseen.on_open_ground(torch.tensor([key(0, 10, 15), key(0, 10, 2), -1])).tolist() == [False, True, False]
    assert len(BoxRaster([Boxes3D.empty(), Boxes3D.empty()], GRID, 4.8).keys) == 0


def test_a_margin_changes_neither_the_boxes_themselves_nor_their_velocities() -> None:
    rows = torch.rand(40, 7, generator=torch.Generator().manual_seed(0))
    rows = (rows - torch.tensor([0.5, 0.5, 0, 0, 0.5, 0.5, 0.5])) * torch.tensor([28.0, 18, 6, 3, 6, 30, 30])
    tight, wide = (BoxRaster([boxes_of(*rows.tolist())], GRID, margin_m) for margin_m in (0.0, 4.8))
    everywhere = torch.arange(600)
    assert torch.equal(tight.in_boxes(everywhere), wide.in_boxes(everywhere))
    assert tight.in_boxes(everywhere).any() and len(wide.keys) > len(tight.keys)
    torch.testing.assert_close(*(r.velocities_in_boxes(everywhere) for r in (tight, wide)), equal_nan=True)
    torch.testing.assert_close(tight.velocities_in_margins(tight.keys), wide.velocities_in_boxes(tight.keys))


def test_the_faster_box_wins_and_an_unknown_one_over_all() -> None:
    nan = float("nan")
    boxes = boxes_of((0.5, 0.5, 3, 1, 0, 1, 0), (2.5, 0.5, 3, 1, 0, -3, 0), (4.5, 0.5, 3, 1, 0, nan, nan))
    raster = BoxRaster([Boxes3D.empty(), boxes], GRID, 0.0)
    assert raster.keys.tolist() == [key(1, 10, c) for c in range(14, 21)]
    speeds = raster.velocities_in_margins(torch.tensor([key(1, 10, c) for c in range(14, 21)] + [key(0, 10, 14), -1]))
    expected = [[1, 0], [1, 0], [-3, 0], [-3, 0], [nan, nan], [nan, nan], [nan, nan], [nan, nan], [nan, nan]]
    torch.testing.assert_close(speeds, torch.tensor(expected, dtype=torch.float32), equal_nan=True)


def test_a_box_comes_before_the_margin_of_a_faster_one() -> None:
    """A standing sign beside a lane: its own cells stand, the rest of its margin belongs to the car."""
    nan = float("nan")
    sign, car = (0.5, 0.5, 1, 1, 0, 0.2, 0), (0.5, 2.5, 5, 1, 0, 30, 0)
    raster = BoxRaster([boxes_of(car, sign)], GRID, 4.0)
    found = raster.velocities_in_margins(torch.tensor([key(0, 10, 15), key(0, 10, 14), key(0, 12, 15), key(0, 8, 15)]))
    torch.testing.assert_close(found, torch.tensor([[0.2, 0], [30, 0], [30, 0], [0.2, 0]]))
    unknown = BoxRaster([boxes_of((0.5, 2.5, 5, 1, 0, nan, nan), sign)], GRID, 4.0)
    found = unknown.velocities_in_margins(torch.tensor([key(0, 10, 15), key(0, 10, 14)]))
    torch.testing.assert_close(found, torch.tensor([[0.2, 0], [nan, nan]]), equal_nan=True)


def test_velocity_raster_without_boxes() -> None:
    raster = BoxRaster([Boxes3D.empty()], GRID, 4.8)
    assert raster.velocities_in_margins(torch.tensor([3, -1])).isnan().all()


@pytest.mark.parametrize("margin_m", [0.0, 4.8])
@pytest.mark.parametrize("turn", [[[-1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -1.0]], [[0.0, -1.0], [1.0, 0.0]]])
def test_rasters_turn_with_the_scene(turn: list[list[float]], margin_m: float) -> None:
    grid = BEVGrid(cells=(64, 64), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    rows = torch.rand(14, 7, generator=torch.Generator().manual_seed(1))
    rows = (rows - torch.tensor([0.5, 0.5, 0, 0, 0.5, 0.5, 0.5])) * torch.tensor([48.0, 48, 9, 3, 6, 30, 30])
    boxes = boxes_of(*rows.tolist())
    aug_from_ego = torch.eye(4)
    aug_from_ego[:2, :2] = torch.tensor(turn)
    before = BoxRaster([boxes], grid, margin_m)
    after = BoxRaster([boxes.transform(aug_from_ego)], grid, margin_m)

    row, col = torch.div(before.keys, 64, rounding_mode="floor"), before.keys % 64
    centred = torch.stack([2 * col - 63, 2 * row - 63], 1).float() @ aug_from_ego[:2, :2].T
    col, row = ((centred + 63) / 2).long().unbind(1)
    keys, order = (row * 64 + col).sort()
    assert torch.equal(after.keys, keys)
    torch.testing.assert_close(after.velocities, (before.velocities @ aug_from_ego[:2, :2].T)[order])
