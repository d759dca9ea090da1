import math
from pathlib import Path

import numpy as np
import pytest
import torch

from src.ops.nms import conflicting_pairs, greedy_survivors, maxpool_peaks, pair_iou
from src.ops.sites import Sites

GOLDEN = np.load(Path(__file__).parents[1] / "golden" / "rotated_iou_nms" / "case.npz")


def rotated_iou(a, b):
    """[n, m] of all pairs, in float64."""
    i, j = torch.cartesian_prod(torch.arange(len(a)), torch.arange(len(b))).unbind(1)
    return pair_iou(a.double(), b.double(), i, j).view(len(a), len(b))


def nms_rotated(boxes, scores, iou_threshold, radius_m=None):
    """Rows that stay of one block, best first."""
    order = scores.argsort(descending=True, stable=True)
    better, worse = conflicting_pairs(boxes[order], [len(order)], [radius_m], iou_threshold)
    return order[greedy_survivors(better.tolist(), worse.tolist(), len(order))]


def nms_circle(centers, scores, radius_m):
    return nms_rotated(torch.nn.functional.pad(centers, (0, 3)), scores, 0.0, radius_m)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.float32, 1e-3)])
def test_golden_case(dtype, tolerance):
    boxes = torch.from_numpy(GOLDEN["boxes"]).to(dtype)
    iou = rotated_iou(boxes, boxes)
    torch.testing.assert_close(iou, torch.from_numpy(GOLDEN["iou"]), rtol=0, atol=tolerance)
    for threshold in (0.1, 0.2, 0.5):
        kept = nms_rotated(boxes, torch.from_numpy(GOLDEN["score"]), threshold)
        assert kept.tolist() == GOLDEN[f"keep_{threshold}"].tolist()


def test_overlap_by_hand():
    square = [0.0, 0.0, 2.0, 2.0, 0.0]
    others = torch.tensor(
        [
            [1.0, 0.0, 2.0, 2.0, 0.0],  # half of each: 2 / 6
            [0.0, 0.0, 2.0, 2.0, math.pi / 4],  # regular octagon
            [0.0, 0.0, 1.0, 1.0, 0.3],  # inside: 1 / 4
            [2.0, 0.0, 2.0, 2.0, 0.0],  # shares an edge
            [0.0, 0.0, 0.0, 0.0, 0.0],  # no area
            [1.0, 1.0, 8.0, 1e-3, math.pi / 4],  # a needle along the diagonal
        ],
        dtype=torch.float64,
    )
    octagon = 8 * (math.sqrt(2) - 1)
    iou = rotated_iou(torch.tensor([square], dtype=torch.float64), others)[0]
    expected = [1 / 3, octagon / (8 - octagon), 0.25, 0.0, 0.0]
    assert iou[:5].tolist() == pytest.approx(expected, abs=1e-12)
    needle = 1e-3 * 2 * math.sqrt(2) - 1e-6 / 2  # its band through the square, less the two cut corners
    assert iou[5].item() == pytest.approx(needle / (4 + 8e-3 - needle), rel=1e-9)


def test_far_from_the_origin_and_symmetric():
    torch.manual_seed(0)
    boxes = torch.cat([torch.randn(30, 2) * 2, torch.rand(30, 2) * 4 + 0.5, torch.rand(30, 1) * 6], 1).double()
    near = rotated_iou(boxes, boxes)
    torch.testing.assert_close(near, near.T)
    torch.testing.assert_close(near.diagonal(), torch.ones(30).double())
    away = boxes + torch.tensor([5e5, 4e6, 0, 0, 0]).double()
    torch.testing.assert_close(rotated_iou(away, away), near, rtol=0, atol=1e-7)


def test_chunks_do_not_change_the_result(monkeypatch):
    boxes = torch.from_numpy(GOLDEN["boxes"]).double()
    whole = rotated_iou(boxes, boxes)
    monkeypatch.setattr("src.ops.nms.PAIR_CHUNK", 7)
    assert torch.equal(rotated_iou(boxes, boxes), whole)


def test_a_suppressed_box_suppresses_nobody():
    """0 removes 1; 2 overlaps 1 only and stays."""
    boxes = torch.tensor([[0.0, 0, 2, 2, 0], [1.2, 0, 2, 2, 0], [2.4, 0, 2, 2, 0]])
    assert nms_rotated(boxes, torch.tensor([0.9, 0.8, 0.7]), 0.1).tolist() == [0, 2]
    assert nms_rotated(boxes, torch.tensor([0.7, 0.8, 0.9]), 0.1).tolist() == [2, 0]
    assert nms_rotated(boxes, torch.tensor([0.7, 0.9, 0.8]), 0.1).tolist() == [1]
    assert nms_circle(boxes[:, :2], torch.tensor([0.9, 0.8, 0.7]), 1.5).tolist() == [0, 2]


def test_circle_takes_metres_and_equal_scores_keep_their_order():
    centers = torch.tensor([[0.0, 0.0], [0.39, 0.0], [0.0, 0.41]])
    assert nms_circle(centers, torch.ones(3), 0.4).tolist() == [0, 2]


def test_no_boxes():
    none = torch.zeros(0, 5)
    assert nms_rotated(none, torch.zeros(0), 0.2).tolist() == []
    assert nms_circle(none[:, :2], torch.zeros(0), 1.0).tolist() == []
    sites = Sites.from_linear(torch.zeros(0, dtype=torch.int64), (1, 4, 4))
    assert maxpool_peaks(torch.zeros(0, 2), sites).shape == (0, 2)


def test_peaks_are_local_maxima_per_channel_and_sample():
    linear = torch.tensor([0, 1, 5, 10, 12, 16, 17])  # last two in sample 1
    scores = torch.tensor([[0.1, 0.9], [0.5, 0.2], [0.4, 0.8], [0.3, 0.1], [0.05, 0.0], [0.2, 0.3], [0.2, 0.4]])
    peaks = maxpool_peaks(scores, Sites.from_linear(linear, (2, 4, 4)))
    dense = torch.full((2, 2, 16), -1.0)
    dense[linear // 16, :, linear % 16] = scores
    pooled = torch.nn.functional.max_pool2d(dense.view(2, 2, 4, 4), 3, 1, 1).view(2, 2, 16)
    assert torch.equal(peaks, pooled[linear // 16, :, linear % 16] == scores)
    assert peaks[:, 0].tolist() == [False, True, False, False, True, True, True]


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="one row a site"):
        maxpool_peaks(torch.zeros(3, 1), Sites.from_linear(torch.tensor([0]), (1, 2, 2)))
