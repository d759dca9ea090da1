"""Adaptive queries: where pixels above the threshold are lifted to, what their features are told, what teaches them."""

import math

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.models.far3d.adaptive_queries import AdaptiveQueries, AdaptiveQueryConfig
from src.models.heads.keypoint_head import CameraMaps
from src.models.layers.views import CameraViews
from src.targets.depth import lid_centres
from tests.models.frames import GRID, SIZE, make_batch

BINS, NEAR, FAR = 6, 2.0, 40.0
SHAPE = (2, 4, 4, 6)  # B, N, h, w at stride 16


def make(**changes):
    torch.manual_seed(0)
    settings = {
        "num_proposals": 5, "score_threshold": 0.1, "num_depth_bins": BINS, "depth_range_m": [NEAR, FAR],
        "keypoint_nms_cells": 3,
    }  # fmt: skip
    return AdaptiveQueries(AdaptiveQueryConfig(**(settings | changes)), 8, 3, GRID)


def views_of(batch):
    return CameraViews([torch.randn(2, 4, 3, *SHAPE[2:])], batch.pix_from_aug, batch.image_valid, SIZE)


def maps_with(peaks, depth_bin=2):
    """(sample, view, row, col, score) in a map of nothing; depth is sure."""
    scores = torch.full(SHAPE, 1e-4)
    for *place, score in peaks:
        scores[tuple(place)] = score
    depths = torch.zeros(2, 4, BINS, *SHAPE[2:])
    depths[:, :, depth_bin] = 60.0
    return CameraMaps(scores.logit(), depths, torch.randn(2, 4, 8, *SHAPE[2:]))


PEAKS = [(0, 0, 1, 2, 0.5), (0, 0, 1, 3, 0.4), (0, 2, 3, 5, 0.09), (0, 1, 2, 1, 0.8), (1, 3, 0, 0, 0.2)]


class Given(nn.Module):
    """A camera head that has decided already."""

    def __init__(self, maps):
        super().__init__()
        self.maps = maps

    def forward(self, level):
        return self.maps


def test_the_best_local_maxima_above_the_threshold_are_lifted_and_told_their_log_odds():
    part, batch, maps = make(), make_batch(), maps_with(PEAKS)
    part.head, part.context = Given(maps), nn.Identity()
    views = views_of(batch)
    queries, given = part(views)
    assert given is maps
    # The second peak is beside a higher one, the third below the threshold.
    assert queries.valid.tolist() == [[True, True, False, False, False], [True] + [False] * 4]
    depth = float(lid_centres((NEAR, FAR), BINS)[2])
    for query, (sample, view, row, col, score) in ((0, PEAKS[3]), (1, PEAKS[0]), (0, PEAKS[4])):
        pixel = torch.tensor([16 * col + 8.0, 16 * row + 8.0, 1.0]) * depth
        seen = views.pix_from_aug[sample, view] @ torch.cat([queries.centers[sample, query], torch.ones(1)])
        torch.testing.assert_close(seen[:3], pixel, atol=1e-2, rtol=1e-3)
        torch.testing.assert_close(queries.features[sample, query, :8], maps.features[sample, view, :, row, col])
        odds = math.log(score / (1 - score)) - math.log(0.1 / 0.9)
        assert float(queries.features[sample, query, 8]) == pytest.approx(odds, abs=1e-3)
    assert not queries.features[1, 1:].any() and not queries.centers[1, 1:].any()


def test_missing_cameras_and_places_outside_the_grid_give_no_query():
    part, batch = make(), make_batch()
    part.head = Given(maps_with(PEAKS))
    batch.image_valid[0, 1] = False
    assert part(views_of(batch))[0].valid.sum(1).tolist() == [1, 1]
    part.head = Given(maps_with(PEAKS, depth_bin=BINS - 1))  # 37 m: beyond the grid's sides, within its ends
    assert part(views_of(make_batch()))[0].valid.sum() < 3


def test_queries_teach_the_context_alone():
    part, views = make(score_threshold=0.001), views_of(make_batch())
    queries, _ = part(views)
    assert queries.valid.any() and not queries.centers.requires_grad
    queries.features.sum().backward()
    assert all(p.grad is None for p in part.head.parameters())
    assert all(p.grad is not None for p in part.context.parameters())


def test_fewer_pixels_than_queries_are_padded():
    queries, _ = make(num_proposals=120, score_threshold=0.001)(views_of(make_batch()))
    assert queries.valid.shape == (2, 120) and not queries.valid[:, 96:].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_proposals": 0}, "num_proposals=0"),
        ({"score_threshold": 1.0}, "score_threshold=1.0.*between 0 and 1"),
        ({"depth_range_m": [3.0, 2.0]}, "depth_range_m"),
        ({"keypoint_nms_cells": 2}, "keypoint_nms_cells=2.*odd"),
    ],
)
def test_mistakes_are_named(change, message):
    with pytest.raises(ConfigError, match=message):
        make(**change)
