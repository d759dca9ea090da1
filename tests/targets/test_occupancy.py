"""Masks of boxes."""

import torch

from src.structures.boxes import Boxes3D
from src.targets.occupancy import occupied_cells
from tests.targets.box_rows import GRID, boxes_of, key


def test_cells_of_two_samples() -> None:
    keys = occupied_cells(
        [boxes_of((0.5, 0.5, 3, 1, 0, 0, 0)), boxes_of((0.5, 0.5, 3, 1, torch.pi / 2, 0, 0))], GRID, 0.0
    )
    assert keys.tolist() == [key(0, 10, c) for c in (14, 15, 16)] + [key(1, r, 15) for r in (9, 10, 11)]
    wider = occupied_cells([boxes_of((0.5, 0.5, 3, 1, 0, 0, 0)), Boxes3D.empty()], GRID, 2.0)
    assert wider.tolist() == [key(0, r, c) for r in (9, 10, 11) for c in range(13, 18)]
    assert key(0, 10, 14) in keys and key(0, 10, 2) not in keys


def test_boxes_that_were_not_seen_or_lie_outside_cover_nothing() -> None:
    boxes = boxes_of((0.5, 0.5, 3, 1, 0, 0, 0), (15.5, 0.5, 5, 5, 0, 0, 0))
    boxes.num_points = torch.tensor([0, 9])
    assert len(occupied_cells([boxes], GRID, 4.8)) == 0
    assert len(occupied_cells([Boxes3D.empty(), Boxes3D.empty()], GRID, 4.8)) == 0
