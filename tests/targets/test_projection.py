"""Projected centres and hulls of boxes."""

import math

import pytest
import torch

from src.structures.boxes import Boxes3D
from src.targets.keypoints import keypoint_heatmap
from tests.targets.box_views import SIZE, boxes_at, camera, view


def test_hull_of_a_box_ahead() -> None:
    seen = view(boxes_at((20, 1, 0.5, 4, 2, 1, 0)), camera())
    torch.testing.assert_close(seen.centers_px, torch.tensor([[128 - 5.0, 64 - 2.5]]))
    torch.testing.assert_close(seen.depths_m, torch.tensor([20.0]))
    nearest = 100 / 18
    torch.testing.assert_close(seen.hulls_px, torch.tensor([[128 - 2 * nearest, 64 - nearest, 128.0, 64.0]]))


def test_each_camera_sees_its_own_side_and_invalid_images_nothing() -> None:
    boxes = boxes_at((20, 0, 0, 4, 2, 1, 0), (-20, 0, 0, 4, 2, 1, 0))
    both = torch.stack([camera(), camera(math.pi)])
    seen = view(boxes, both)
    assert list(zip(seen.boxes.tolist(), seen.views.tolist(), strict=True)) == [(0, 0), (1, 1)]
    assert len(view(boxes, both, valid=False).boxes) == 0


def test_box_through_the_image_plane_keeps_its_near_part() -> None:
    """A long vehicle beside the camera: its rear is behind the image plane, its side runs out of the image."""
    seen = view(boxes_at((3, 2.0, 0, 12, 2, 3, 0)), camera())
    assert seen.boxes.tolist() == [0]
    hull = seen.hulls_px[0]
    far_edge = 128 - 100 * 1 / 9
    torch.testing.assert_close(hull, torch.tensor([0.0, 0.0, far_edge, 128.0]))


def test_hull_equals_a_dense_sample_of_the_surface() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(40, 7, generator=generator) * torch.tensor([30.0, 20, 4, 10, 3, 3, 6]) + torch.tensor(
        [-5.0, -10, -2, 1, 1, 1, 0]
    )
    boxes = boxes_at(*rows.tolist())
    seen = view(boxes, camera())
    steps = torch.linspace(-0.5, 0.5, 41)
    unit = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    hulls = {}
    for k in range(len(boxes)):
        local = unit * boxes.sizes[k]
        cos, sin = boxes.yaws[k].cos(), boxes.yaws[k].sin()
        turned = torch.stack(
            [cos * local[:, 0] - sin * local[:, 1], sin * local[:, 0] + cos * local[:, 1], local[:, 2]], 1
        )
        points = torch.cat([turned + boxes.centers[k], torch.ones(len(turned), 1)], 1) @ camera().T
        points = points[points[:, 2] > 0.1]
        if len(points):
            uv = points[:, :2] / points[:, 2:3]
            hulls[k] = torch.cat([uv.amin(0).clamp(min=0), torch.minimum(uv.amax(0), torch.tensor([256.0, 128.0]))])
    found = dict(zip(seen.boxes.tolist(), seen.hulls_px, strict=True))
    compared = 0
    for k, hull in hulls.items():
        if (hull[2:] - hull[:2]).min() < 2 or boxes.centers[k, 0] - boxes.sizes[k, :2].norm() / 2 < 0.1:
            continue  # the samples of a box cut by the image plane miss its exact border
        torch.testing.assert_close(found[k], hull, rtol=0, atol=1e-3)
        compared += 1
    assert compared > 10


@pytest.mark.parametrize("boxes", [boxes_at(), boxes_at((-20, 0, 0, 4, 2, 1, 0))])
def test_nothing_visible(boxes: Boxes3D) -> None:
    seen = view(boxes, camera())
    assert len(seen.boxes) == 0
    assert float(keypoint_heatmap(seen, 1, SIZE, (1.0, 160.0), 8).sum()) == 0


def test_augmented_frame_gives_the_same_image_targets() -> None:
    """P_n A^-1 with boxes moved by A (method 9): what the camera sees does not change."""
    boxes = boxes_at((20, 1, 0.5, 4, 2, 1, 0.3), (12, -4, 0, 8, 2.5, 3, 2.0))
    aug = torch.eye(4)
    aug[:2, :2] = (
        1.05
        * torch.tensor([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]])
        @ torch.diag(torch.tensor([1.0, -1.0]))
    )
    aug[2, 2] = 1.05
    before = view(boxes, camera())
    after = view(boxes.transform(aug), camera() @ torch.linalg.inv(aug))
    torch.testing.assert_close(after.hulls_px, before.hulls_px, rtol=0, atol=1e-3)
    torch.testing.assert_close(after.centers_px, before.centers_px, rtol=0, atol=1e-3)
    torch.testing.assert_close(after.depths_m, before.depths_m)
