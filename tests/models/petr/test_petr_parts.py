"""What makes PETR: every pixel knows where it could be looking, and every query looks at all of them."""

import math

import pytest
import torch
from torch import nn

from src.models.heads.query_head import QueryHeadConfig, SetPredictionHead
from src.models.layers.views import CameraViews
from src.models.petr.decoder import GlobalAttention, PETRDecoder, PETRDecoderConfig
from src.models.petr.position_embedding import EDGE, PositionEmbedding, PositionEmbeddingConfig
from src.structures.queries import Queries
from tests.models.dense_bev.dense_frames import GRID, SIZE, make_batch

DEPTHS, NEAR, FAR, LOW, HIGH = 5, 2.0, 32.0, -10.0, 10.0


def embedding():
    config = PositionEmbeddingConfig(num_depth_bins=DEPTHS, depth_range_m=[NEAR, FAR], z_range_m=[LOW, HIGH])
    return PositionEmbedding(config, 8, GRID)


def views_of(batch, stride=16):
    level = torch.zeros(*batch.image_valid.shape, 1, SIZE[0] // stride, SIZE[1] // stride)
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


def test_the_network_reads_logits_of_coordinates_normalised_by_the_range():
    part, views = embedding(), views_of(make_batch())
    x, y, z = part.places(views)[1, 2, 3, 4, 1].tolist()
    part.mlp = nn.Identity()
    found = part(views)[1, 2, 3, 4].view(DEPTHS, 3)[1].tolist()
    low, size = (2.0 - 0.8 * 64 / 2, -1.0 - 0.8 * 48 / 2, LOW), (0.8 * 64, 0.8 * 48, HIGH - LOW)
    for value, place, start, extent in zip(found, (x, y, z), low, size, strict=True):
        share = min(max((place - start) / extent, EDGE), 1 - EDGE)
        assert value == pytest.approx(math.log(share / (1 - share)), abs=1e-4)


def test_a_missing_camera_has_a_finite_embedding():
    batch = make_batch()
    batch.image_valid[0, 1] = False
    batch.pix_from_aug[0, 1] = 0.0
    assert embedding()(views_of(batch)).isfinite().all()


@torch.no_grad()
def test_attention_is_a_softmax_over_all_valid_keys():
    torch.manual_seed(0)
    part = GlobalAttention(8, 2)
    query, key, value = torch.randn(2, 3, 8), torch.randn(2, 5, 8), torch.randn(2, 5, 8)
    valid = torch.tensor([[True, False, True, True, False], [False] * 5])
    found = part(query, key, value, valid)
    q, k, v = part.query(query)[0], part.key(key)[0], part.value(value)[0]
    for row in range(3):
        heads = []
        for head in (slice(0, 4), slice(4, 8)):
            scores = [float(q[row, head] @ k[j, head]) / 2.0 for j in (0, 2, 3)]
            total = sum(map(math.exp, scores))
            heads.append(sum(math.exp(s) / total * v[j, head] for s, j in zip(scores, (0, 2, 3), strict=True)))
        torch.testing.assert_close(found[0, row], part.output(torch.cat(heads)))
    torch.testing.assert_close(found[1], part.output.bias.expand(3, 8))
    key[:, 1], value[:, 4] = 1e3, -1e3
    torch.testing.assert_close(part(query, key, value, valid), found)


def test_every_layers_boxes_are_relative_to_the_anchors():
    torch.manual_seed(0)
    head = SetPredictionHead(QueryHeadConfig(score_threshold=0.0, max_boxes=10), 8, GRID, 1.0)
    nn.init.constant_(head.box[-1].bias, 0.0)
    with torch.no_grad():
        head.box[-1].bias[0] = 3.0
        head.box[-1].weight.zero_()
    decoder = PETRDecoder(PETRDecoderConfig(num_layers=3, num_heads=2), 8, GRID)
    centers = torch.randn(1, 4, 3)
    queries = Queries.unknown(torch.zeros(1, 4, 8), centers, torch.ones(1, 4, dtype=torch.bool))
    images = (torch.randn(1, 6, 8), torch.randn(1, 6, 8), torch.ones(1, 6, dtype=torch.bool))
    layers, _ = decoder(queries, None, images, head)
    for layer in layers:
        torch.testing.assert_close(layer.codes[..., :3], centers + torch.tensor([3.0, 0.0, 0.0]))
    assert not torch.equal(layers[0].logits, layers[2].logits)
