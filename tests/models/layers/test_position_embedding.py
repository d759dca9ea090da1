"""Every pixel knows where it could be looking, and every query what the pixel that sees it knows."""

import math

import pytest
import torch
from torch import nn

from src.models.layers.position_embedding import EDGE, PositionEmbedding, PositionEmbeddingConfig
from src.models.layers.views import CameraViews
from tests.models.frames import GRID, SIZE, make_batch

DEPTHS, NEAR, FAR, LOW, HIGH = 5, 2.0, 32.0, -10.0, 10.0


def embedding(**options):
    config = PositionEmbeddingConfig(num_depth_bins=DEPTHS, depth_range_m=[NEAR, FAR], z_range_m=[LOW, HIGH])
    return PositionEmbedding(config, 8, GRID, **options)


def views_of(batch):
    level = torch.zeros(*batch.image_valid.shape, 1, SIZE[0] // 16, SIZE[1] // 16)
    return CameraViews([level], batch.pix_from_aug, batch.image_valid, SIZE)


def test_places_lie_on_the_pixels_ray_at_depths_that_grow_linearly_wider():
    """Seen through the camera again, every place is at its pixel's centre; bin i is twice (i + 1) / D (D + 1) wide."""
    part, batch = embedding(), make_batch()
    places = part.places(views_of(batch)).double()
    edges = [NEAR + (FAR - NEAR) * i * (i + 1) / (DEPTHS * (DEPTHS + 1)) for i in range(DEPTHS + 1)]
    wanted = torch.tensor([(a + b) / 2 for a, b in zip(edges, edges[1:], strict=False)], dtype=torch.float64)
    assert places.shape == (2, 4, 4, 6, DEPTHS, 3)
    ones = torch.ones_like(places[..., :1])
    seen = torch.einsum("bnij,bnhwdj->bnhwdi", batch.pix_from_aug.double(), torch.cat([places, ones], -1))
    torch.testing.assert_close(seen[..., 2], wanted.expand_as(seen[..., 2]), atol=1e-4, rtol=1e-4)
    pixels = seen[..., :2] / seen[..., 2:3]
    rows, cols = torch.arange(4, dtype=torch.float64) * 16 + 8, torch.arange(6, dtype=torch.float64) * 16 + 8
    torch.testing.assert_close(pixels[..., 0], cols[:, None].expand_as(pixels[..., 0]), atol=1e-2, rtol=1e-3)
    torch.testing.assert_close(pixels[..., 1], rows[:, None, None].expand_as(pixels[..., 1]), atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("logits", [True, False])
def test_the_network_reads_coordinates_normalised_by_the_range_or_their_logits(logits):
    part, views = embedding(logits=logits), views_of(make_batch())
    x, y, z = part.places(views)[1, 2, 3, 4, 1].tolist()
    part.mlp = nn.Identity()
    found = part(views)[1, 2, 3, 4].view(DEPTHS, 3)[1].tolist()
    low, size = (2.0 - 0.8 * 64 / 2, -1.0 - 0.8 * 48 / 2, LOW), (0.8 * 64, 0.8 * 48, HIGH - LOW)
    for value, place, start, extent in zip(found, (x, y, z), low, size, strict=True):
        share = (place - start) / extent
        kept = min(max(share, EDGE), 1 - EDGE)
        assert value == pytest.approx(math.log(kept / (1 - kept)) if logits else share, abs=1e-4)


def test_a_missing_camera_has_a_finite_embedding():
    batch = make_batch()
    batch.image_valid[0, 1] = False
    batch.pix_from_aug[0, 1] = 0.0
    assert embedding()(views_of(batch)).isfinite().all()


@torch.no_grad()
def test_a_points_embedding_is_that_of_the_pixels_that_see_it():
    """At pixel centres, in one view and in two that overlap; of a point that nothing sees it is zero."""
    part, batch = embedding(), make_batch()
    batch.pix_from_aug[:, 2] = batch.pix_from_aug[:, 0]
    views = views_of(batch)
    of_pixels, places = part(views), part.places(views)
    in_one, in_two = places[1, 1, 2, 3, 2], places[1, 0, 1, 4, 3]
    points = torch.stack([in_one, in_two, torch.tensor([0.0, 0.0, 50.0])])
    found = part.of_points(points.expand(2, 3, 3), views)[1]
    torch.testing.assert_close(found[0], of_pixels[1, 1, 2, 3], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found[1], 2 * of_pixels[1, 0, 1, 4], atol=1e-3, rtol=1e-3)
    assert not found[2].any()
    batch.image_valid[1, 0] = False
    found = part.of_points(points.expand(2, 3, 3), views_of(batch))[1]
    torch.testing.assert_close(found[1], of_pixels[1, 0, 1, 4], atol=1e-3, rtol=1e-3)
