"""The keypoint heat map drawn from projected boxes."""

import math

import torch

from src.targets.keypoints import keypoint_heatmap
from src.targets.projection import BoxViews
from tests.targets.box_views import SIZE, boxes_at, camera, view


def test_keypoint_by_hand() -> None:
    seen = view(boxes_at((20, 1, 0.5, 4, 12, 8, 0)), camera())
    heatmap = keypoint_heatmap(seen, 1, SIZE, (1.0, 160.0), 8)[0]
    # Hull: u 94.7..156 (7 m to the left, 5 m to the right of the axis at 18 m), centre u = 123, v = 61.5.
    hull, center = seen.hulls_px[0], seen.centers_px[0]
    radius = math.ceil(min(*(center - hull[:2]).tolist(), *(hull[2:] - center).tolist()) / 8)
    assert heatmap[7, 15] == 1 and int((heatmap == 1).sum()) == 1
    sigma = (2 * radius + 1) / 6
    torch.testing.assert_close(heatmap[8, 17], torch.tensor(math.exp(-5 / (2 * sigma**2))))
    assert int((heatmap > 0).sum()) == (2 * radius + 1) ** 2


def test_keypoints_take_the_maximum_and_stay_inside() -> None:
    centers = torch.tensor([[4.0, 4.0], [20.0, 4.0], [-1.0, 4.0], [4.0, 4.0], [4.0, 4.0]])
    hulls = torch.tensor([[0.0, 0, 16, 16]] * 5)
    seen = BoxViews(
        torch.arange(5), torch.tensor([0, 0, 0, 1, 1]), centers, torch.tensor([10.0, 10, 10, 160, 0.9]), hulls
    )
    heatmap = keypoint_heatmap(seen, 2, (32, 64), (1.0, 160.0), 8)
    value = math.exp(-1 / (2 * 0.5**2))
    torch.testing.assert_close(heatmap[0, 0], torch.tensor([1, value, 1, value, 0, 0, 0, 0]))
    assert float(heatmap[1].sum()) == 0  # d_max itself has no bin, and 0.9 m is too near
    assert float(heatmap[0, 2:].sum()) == 0


def test_radius_is_capped() -> None:
    seen = BoxViews(
        torch.zeros(1).long(), torch.zeros(1).long(), torch.tensor([[400.0, 400.0]]), torch.tensor([5.0]),
        torch.tensor([[0.0, 0, 800, 800]]),
    )  # fmt: skip
    assert int((keypoint_heatmap(seen, 1, (800, 800), (1.0, 160.0), 8) > 0).sum()) == 33**2
