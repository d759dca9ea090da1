"""The camera heads: starting point, shapes, views that do not influence each other, and their losses."""

import math

import pytest
import torch

from src.models.heads.keypoint_head import CameraKeypointHead, CameraMaps, camera_losses
from src.models.layers.views import CameraViews
from src.targets.projection import view_boxes
from tests.targets.box_views import SIZE, boxes_at, camera


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


def test_losses_by_hand():
    """Two samples of two views, each with a box 20 m away; the second sample's other view is missing."""
    matrices = torch.stack([torch.stack([camera(a), camera(b)]) for a, b in ((0, math.pi / 2), (math.pi, -1.5))])
    valid = torch.tensor([[True, True], [True, False]])
    views = CameraViews([torch.zeros(2, 2, 1, 16, 32)], matrices, valid, SIZE)
    boxes = boxes_at((20, 4, -1, 2, 2, 2, 0), (-20, 4, -1, 2, 2, 2, 0))
    seen = view_boxes(boxes, torch.tensor([0, 1]), matrices, valid, SIZE)
    logits = torch.full((2, 2, 16, 32), -30.0)  # kept at 1e-4, which costs next to nothing
    logits[0, 0, 8, 13], logits[1, 0, 8, 18] = 0.0, math.log(3)  # where they are: u = 128 -+ 100 * 4 / 20
    logits[0, 1, 2, 3] = math.log(9)  # nothing is there
    logits[1, 1] = 5.0  # says nothing
    depths = torch.zeros(2, 2, 4, 16, 32)
    found = camera_losses(CameraMaps(logits, depths, None), views, seen, (10.0, 30.0), 2.0, 3.0)
    focal = -(0.5**2) * math.log(0.5) - 0.25**2 * math.log(0.75) - 0.9**2 * math.log(0.1)
    assert float(found["keypoint"]) == pytest.approx(2 * focal / 2, rel=1e-5)
    assert float(found["depth"]) == pytest.approx(3 * -(math.log(1 / 4) + 3 * math.log(3 / 4)), rel=1e-5)
    depths[:, :, 2] = 60.0  # from 16 to 22 m: the bins of 2, 4, 6 and 8 m begin at 10 m
    for weights, names in (((None, 1.0), {"depth"}), ((1.0, None), {"keypoint"})):
        found = camera_losses(CameraMaps(logits, depths, None), views, seen, (10.0, 30.0), *weights)
        assert found.keys() == names and float(found.get("depth", torch.zeros(()))) < 1e-4
