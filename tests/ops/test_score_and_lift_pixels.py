"""How good a keypoint a pixel is and where it lies, worked by hand."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.score_and_lift_pixels import (
    lift_pixel_centres,
    most_likely_depth,
    peak_scores,
    score_and_lift_pixels,
)

GRID = BEVGrid(cells=(20, 20), cell_m=1.0, centre_m=(10.0, 0.0), z_range_m=(-3.0, 5.0))  # x 0 to 20, y -10 to 10
IMAGE, FOCAL = (8, 16), 8.0  # four pixels of the image a pixel of the map
CENTRES = torch.tensor([2.0, 6.0, 10.0, 30.0])


def looking_forward(height_m=1.5):
    """aug_from_pix of a pinhole whose axis leaves the middle of the image along x: y = -(u - 8) d / 8."""
    return torch.tensor(
        [[0.0, 0, 1, 0], [-1 / FOCAL, 0, 8 / FOCAL, 0], [0, -1 / FOCAL, 4 / FOCAL, height_m], [0, 0, 0, 1]]
    )


def sharp(bins):
    """Depth logits [B, N, D, h, w] with all in one bin a pixel."""
    bins = torch.tensor(bins)
    return 60.0 * (bins[:, :, None] == torch.arange(len(CENTRES)).view(1, 1, -1, 1, 1)).float()


def test_depth_is_the_mean_over_the_best_bin_and_its_neighbours():
    centres = torch.tensor([1.0, 2.0, 4.0, 8.0])
    probabilities = torch.tensor([[0.1, 0.2, 0.4, 0.3], [0.7, 0.1, 0.1, 0.1], [0.1, 0.1, 0.1, 0.7]])
    logits = probabilities.log().T.reshape(1, 1, 4, 1, 3)
    depth, confidence = most_likely_depth(logits, centres)
    expected = [(0.2 * 2 + 0.4 * 4 + 0.3 * 8) / 0.9, (0.7 + 0.2) / 0.8, (0.4 + 5.6) / 0.8]
    torch.testing.assert_close(depth.flatten(), torch.tensor(expected))
    torch.testing.assert_close(confidence.flatten(), torch.tensor([0.9, 0.8, 0.8]))


def test_a_window_keeps_local_maxima_only():
    logits = torch.full((1, 1, 5, 8), -12.0)
    logits[0, 0, 2, 2:5] = torch.tensor([1.0, 2.0, 1.5])
    assert (peak_scores(logits, None)[0, 0, 2, 2:5] > 0.5).all()
    assert (peak_scores(logits, 3)[0, 0, 2, 2:5] > 0).tolist() == [False, True, False]
    assert (peak_scores(logits, 1)[0, 0, 2, 2:5] > 0).all()


def test_points_lie_on_the_rays_of_the_pixels_middles():
    """Pixels of the map at u = 2, 6, 10, 14 and v = 2, 6."""
    depth = torch.tensor([[[[8.0, 4.0, 8.0, 16.0], [8.0, 4.0, 8.0, 16.0]]]])
    points = lift_pixel_centres(depth, looking_forward()[None, None], IMAGE)[0, 0]
    assert points[..., 0].tolist() == depth[0, 0].tolist()
    assert points[..., 1].tolist() == [[6.0, 1.0, -2.0, -12.0]] * 2
    assert points[..., 2].tolist() == [[3.5, 2.5, 3.5, 5.5], [-0.5, 0.5, -0.5, -2.5]]


def test_scores_are_the_keypoints_times_the_confidence_where_they_can_be_used():
    """Two cameras alike, the second missing; depths of 6 m, 10 m and, outside the grid, 30 m."""
    bins = [[[1, 1, 2, 3], [1, 2, 2, 3]]] * 2
    depth = sharp([bins])
    depth[0, :, :, 1, 0] = torch.tensor([0.5, 0.2, 0.2, 0.1]).log()  # the best are the first two: 0.7
    logits = torch.tensor([[[0.6, 0.5, 0.2, 0.9], [0.4, 0.7, 0.3, 0.8]]] * 2).logit()[None]
    matrix = looking_forward().expand(1, 2, 4, 4)
    scores, points = score_and_lift_pixels(
        logits, depth, CENTRES, matrix, torch.tensor([[True, False]]), IMAGE, GRID, None
    )
    torch.testing.assert_close(scores[0, 0], torch.tensor([[0.6, 0.5, 0.2, 0.0], [0.4 * 0.7, 0.7, 0.3, 0.0]]))
    assert not scores[0, 1].any() and torch.equal(points[0, 0], points[0, 1])
    assert points[0, 0, 0, :, 0].tolist() == pytest.approx([6.0, 6.0, 10.0, 30.0])
    assert points[0, 0, 1, 0, 0].item() == pytest.approx((0.5 * 2 + 0.2 * 6) / 0.7)


def test_the_window_is_of_keypoints_not_of_what_is_left_of_them():
    """The highest lies outside the grid and still suppresses its neighbour."""
    logits = torch.tensor([[[[-9.0, -9.0, 1.0, 2.0]] * 2]])
    depth = sharp([[[[1, 1, 1, 3]] * 2]])
    scores, _ = score_and_lift_pixels(
        logits, depth, CENTRES, looking_forward()[None, None], torch.ones(1, 1).bool(), IMAGE, GRID, 3
    )
    assert scores[0, 0, :, 2:].tolist() == [[0.0, 0.0]] * 2


def test_no_cameras():
    scores, points = score_and_lift_pixels(
        torch.zeros(2, 0, 2, 4), torch.zeros(2, 0, 4, 2, 4), CENTRES, torch.zeros(2, 0, 4, 4),
        torch.zeros(2, 0).bool(), IMAGE, GRID, None,
    )  # fmt: skip
    assert scores.shape == (2, 0, 2, 4) and points.shape == (2, 0, 2, 4, 3)
