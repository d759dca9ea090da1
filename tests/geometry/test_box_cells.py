import math
from pathlib import Path

import numpy as np
import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import cells_in_boxes, window_cells

GOLDEN = np.load(Path(__file__).parents[1] / "golden" / "box_raster" / "case.npz")
GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
SMALL = BEVGrid(cells=(4, 6), cell_m=1.0, centre_m=(3.0, 2.0), z_range_m=(-3.0, 5.0))  # corner at the origin


@pytest.mark.parametrize("margin", ["0.0", "0.8", "4.8"])
def test_golden_case(margin):
    box, cell, fallback = cells_in_boxes(torch.from_numpy(GOLDEN["boxes"]), GRID, float(margin))
    ignored = set(GOLDEN[f"e{margin}/dont_care"].tolist())
    pairs = zip(GOLDEN[f"e{margin}/pair_box"].tolist(), GOLDEN[f"e{margin}/pair_cell"].tolist(), strict=True)
    expected = {pair for pair in pairs if pair[1] not in ignored}
    found = {pair for pair in zip(box.tolist(), cell.tolist(), strict=True) if pair[1] not in ignored}
    assert found == expected
    assert set(cell.tolist()) - ignored == set(GOLDEN[f"e{margin}/cells"].tolist()) - ignored
    assert fallback.nonzero().squeeze(1).tolist() == GOLDEN[f"e{margin}/fallback_boxes"].tolist()
    keys = box * GRID.rows * GRID.cols + cell
    assert (keys.diff() > 0).all()


def test_boxes_by_hand():
    boxes = torch.tensor(
        [
            [1.5, 1.5, 2.0, 1.0, 0.0],  # edges on the centres of columns 0 and 2: closed
            [1.5, 1.5, 2.0, 1.0, math.pi / 2],  # the same, standing
            [3.0, 3.0, 0.2, 0.2, math.pi / 4],  # at a corner of four cells, at least one cell wide: reaches none
            [5.9, 3.9, 1.0, 1.0, 0.0],  # corner of the grid
            [7.0, 1.0, 1.0, 1.0, 0.0],  # outside
        ]
    )
    box, cell, fallback = cells_in_boxes(boxes, SMALL)
    cells = [cell[box == i].tolist() for i in range(5)]
    assert cells == [[6, 7, 8], [1, 7, 13], [21], [23], []]
    assert fallback.tolist() == [False, False, True, False, False]


def test_margin_is_the_total_growth_of_each_dimension():
    box = torch.tensor([[3.5, 2.5, 1.0, 1.0, 0.0]])
    rows, cols = (lambda cell: (cell // 6, cell % 6))(cells_in_boxes(box, SMALL, 2.0)[1])
    assert (rows.min(), rows.max(), cols.min(), cols.max()) == (1, 3, 2, 4)


def test_no_boxes_and_wrong_shapes():
    box, cell, fallback = cells_in_boxes(torch.zeros(0, 5), SMALL)
    assert len(box) == len(cell) == len(fallback) == 0
    with pytest.raises(ValueError, match=r"expected \[n, 5\]"):
        cells_in_boxes(torch.zeros(3, 7), SMALL)


def test_windows_are_cut_at_the_grid():
    centres = torch.tensor([[0.0, 0.0], [2.5, 1.5], [-9.0, 1.0], [math.nan, 0.0]])
    window, row, col = window_cells(centres, torch.tensor([[1.2, 0.5], [0.5, 0.5], [2.0, 9.0], [1.0, 1.0]]), SMALL)
    found = list(zip(window.tolist(), row.tolist(), col.tolist(), strict=True))
    assert found[:6] == [(0, 0, 0), (0, 0, 1), (1, 1, 2), (1, 1, 3), (1, 2, 2), (1, 2, 3)]
    assert all(entry[0] == 3 for entry in found[6:])
