"""The camera heads: starting point, shapes, and views that do not influence each other."""

import torch

from src.models.heads.keypoint_head import CameraKeypointHead


def test_shapes_starting_probability_and_size():
    torch.manual_seed(0)
    head = CameraKeypointHead(256, 128, 80)
    maps = head(torch.randn(1, 2, 256, 4, 6))
    assert maps.keypoint_logits.shape == (1, 2, 4, 6)
    assert maps.depth_logits.shape == (1, 2, 80, 4, 6)
    assert maps.features.shape == (1, 2, 128, 4, 6)
    assert abs(float(maps.keypoint_logits.sigmoid().mean().detach()) - 0.1) < 0.05
    assert abs(sum(p.numel() for p in head.parameters()) - 0.53e6) < 0.02 * 0.53e6  # method 4.2


def test_every_view_stands_alone():
    torch.manual_seed(0)
    head = CameraKeypointHead(8, 16, 5)  # train mode: group norm keeps no statistics across views
    level = torch.randn(2, 3, 8, 4, 6)
    both = head(level)
    level[1, 2] += 1.0
    changed = head(level)
    same = torch.ones(2, 3, dtype=torch.bool)
    same[1, 2] = False
    torch.testing.assert_close(both.keypoint_logits[same], changed.keypoint_logits[same])
    torch.testing.assert_close(both.depth_logits[same], changed.depth_logits[same])
    assert not torch.allclose(both.depth_logits[~same], changed.depth_logits[~same])
