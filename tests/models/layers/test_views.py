"""Projection into views and lifting out of them are inverse to each other."""

import math

import torch

from src.models.layers.views import CameraViews


def make_views(pix_from_aug, valid=None):
    b, n = pix_from_aug.shape[:2]
    valid = torch.ones(b, n, dtype=torch.bool) if valid is None else valid
    return CameraViews([torch.zeros(b, n, 4, 8, 12)], pix_from_aug, valid, (64, 96))


def augmented_camera():
    """A camera at (1, 2, 3) looking along +x, image scaled, flipped and rotated, BEV rotated, scaled and mirrored."""
    intrinsics = torch.tensor([[60.0, 0.0, 50.0], [0.0, 60.0, 30.0], [0.0, 0.0, 1.0]])
    c, s = math.cos(0.08), math.sin(0.08)
    image = torch.tensor([[c, -s, 3.0], [s, c, -2.0], [0.0, 0.0, 1.0]]) @ torch.diag(torch.tensor([-0.9, 0.9, 1.0]))
    image[0, 2] += 90.0
    rotation = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # right, down, forward
    pix_from_ego = torch.eye(4)
    pix_from_ego[:3, :3] = image @ intrinsics @ rotation
    pix_from_ego[:3, 3] = pix_from_ego[:3, :3] @ -torch.tensor([1.0, 2.0, 3.0])
    c, s = math.cos(0.3), math.sin(0.3)
    aug_from_ego = torch.eye(4)
    aug_from_ego[:3, :3] = 1.03 * torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    aug_from_ego[:3, :3] = aug_from_ego[:3, :3] @ torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    return (pix_from_ego @ torch.linalg.inv(aug_from_ego))[None, None], aug_from_ego


def test_lifting_undoes_projection_under_every_augmentation():
    matrix, aug_from_ego = augmented_camera()
    views = make_views(matrix)
    depth = torch.rand(1, 1, 8, 12) * 140 + 2
    points = views.lift(depth)  # [1, 1, 8, 12, 3]
    pixels, _ = views.project(points.reshape(1, -1, 1, 3))
    u, v = torch.meshgrid((torch.arange(12) + 0.5) * 8, (torch.arange(8) + 0.5) * 8, indexing="xy")
    expected = torch.stack([u, v], -1).reshape(1, 96, 1, 1, 2)
    torch.testing.assert_close(pixels, expected, atol=2e-2, rtol=0)
    # Depth is measured along the optical axis, in real metres: undo the BEV augmentation and subtract the camera.
    ego = torch.linalg.inv(aug_from_ego) @ torch.cat([points, torch.ones_like(points[..., :1])], -1)[..., None]
    torch.testing.assert_close(ego[0, 0, ..., 0, 0] - 1.0, depth[0, 0], atol=1e-3, rtol=1e-4)


def forward_camera():
    """Focal length 10, principal point (48, 32), at the origin, looking along +x."""
    rows = [[48.0, -10.0, 0.0, 0.0], [32.0, 0.0, -10.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return torch.tensor(rows)[None, None]


def test_known_point_by_hand():
    # 20 m ahead, 8 m left, 4 m up.
    pixels, visible = make_views(forward_camera()).project(torch.tensor([[[[20.0, 8.0, 4.0]]]]))
    assert pixels.flatten().tolist() == [44.0, 30.0]
    assert visible.all()


def test_visibility_ends_at_half_a_metre_the_image_edge_and_missing_cameras():
    points = torch.tensor([[0.4, 0.0, 0.0], [-5.0, 0.0, 0.0], [10.0, 50.0, 0.0], [10.0, 47.0, 0.0], [10.0, 0.0, 40.0]])
    two = forward_camera().repeat(1, 2, 1, 1)
    _, visible = make_views(two, valid=torch.tensor([[True, False]])).project(points[None, :, None])
    assert visible[0, :, 0, 0].tolist() == [False, False, False, True, False]
    assert not visible[0, :, 1].any()


def test_a_missing_view_may_carry_a_singular_matrix():
    matrix = torch.zeros(1, 2, 4, 4)
    matrix[0, 0] = torch.eye(4)
    points = make_views(matrix, valid=torch.tensor([[True, False]])).lift(torch.ones(1, 2, 8, 12))
    assert points.isfinite().all()
