"""Depth bins against Far3D's, painted depth against a loop over cells."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from src.targets.depth import lid_centres, lid_edges, lid_index, paint_depth
from src.targets.projection import BoxViews

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "lid_bins" / "case.json").read_text())
CASES = [name for name, case in GOLDEN.items() if isinstance(case, dict)]


@pytest.mark.parametrize("name", CASES)
def test_golden_bins(name: str) -> None:
    case = GOLDEN[name]
    limits, bins = (case["d_min"], case["d_max"]), case["bins"]
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-4)):
        np.testing.assert_allclose(lid_edges(limits, bins, dtype), case["edges"], rtol=0, atol=tolerance)
        np.testing.assert_allclose(lid_centres(limits, bins, dtype), case["centres"], rtol=0, atol=tolerance)
        assert lid_index(torch.tensor(case["depth"], dtype=dtype), limits, bins).tolist() == case["index"]


def test_outside_has_no_bin() -> None:
    depths = torch.tensor([160.0, 0.999, math.nan, math.inf, -math.inf, 1.0, 159.999])
    assert lid_index(depths, (1.0, 160.0), 80).tolist() == [-1, -1, -1, -1, -1, 0, 79]


def test_near_boxes_hide_far_ones_and_what_is_out_of_range_hides_too() -> None:
    hulls = torch.tensor([[0.0, 0, 40, 24], [17, 9, 40, 24], [33, 0, 39, 24], [0, 0, 8, 8]])
    depths = torch.tensor([50.0, 10.0, 0.5, 200.0])
    seen = BoxViews(torch.arange(4), torch.tensor([1, 1, 1, 0]), torch.zeros(4, 2), depths, hulls)
    painted = paint_depth(seen, 2, (24, 48), (1.0, 160.0), 80, 8)
    far, near = (int(lid_index(torch.tensor(d), (1.0, 160.0), 80)) for d in (50.0, 10.0))
    assert painted[1].tolist() == [
        [far, far, far, far, -1, -1],
        [far, far, near, near, -1, -1],
        [far, far, near, near, -1, -1],
    ]
    assert (painted[0] == -1).all()


def test_no_box_is_all_background() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    seen = BoxViews(none, none, torch.zeros(0, 2), torch.zeros(0), torch.zeros(0, 4))
    painted = paint_depth(seen, 4, (24, 48), (1.0, 160.0), 80, 8)
    assert painted.shape == (4, 3, 6) and (painted == -1).all()
