"""Perspective-aware aggregation against a loop over views, levels and points; where layers predict from."""

import torch
import torch.nn.functional as F
from torch import nn

from src.models.far3d.perspective_decoder import CameraScaling, PerspectiveDecoder, PerspectiveDecoderConfig
from src.models.heads.decode import DecodeConfig
from src.models.heads.query_head import SetPredictionHead
from src.models.layers.views import CameraViews
from src.structures.queries import Queries
from tests.models.frames import GRID, SIZE, make_batch

C, IMAGE, POINTS, HEADS = 8, 5, 3, 4


def make():
    torch.manual_seed(0)
    config = PerspectiveDecoderConfig(num_layers=2, num_heads=2, num_points=POINTS)
    decoder = PerspectiveDecoder(config, C, IMAGE, 4, 2, GRID)
    return decoder, SetPredictionHead(DecodeConfig(score_threshold=0.0, max_boxes=10), C, GRID, 1.0)


def scene():
    batch = make_batch()
    levels = [torch.randn(2, 4, IMAGE, SIZE[0] // stride, SIZE[1] // stride) for stride in (8, 16)]
    views = CameraViews(levels, batch.pix_from_aug, batch.image_valid, SIZE)
    centers = torch.rand(2, 6, 3) * torch.tensor([30.0, 24.0, 2.0]) - torch.tensor([15.0, 12.0, 0.0])
    return Queries.unknown(torch.randn(2, 6, C), centers, torch.ones(2, 6, dtype=torch.bool)), views


@torch.no_grad()
def test_a_layer_samples_every_visible_point_of_every_view_and_level():
    (decoder, _), (queries, views) = make(), scene()
    layer = decoder.layers[0]
    nn.init.normal_(layer.offsets.weight, std=0.3)
    nn.init.normal_(layer.image_attention.logits.weight)
    values = [decoder.image_value(level.flatten(0, 1)).unflatten(0, (2, 4)) for level in views.levels]
    embedding = decoder.embedding(queries)
    found = layer(queries, embedding, None, views, values)
    x = queries.features
    x = layer.norms[0](x + layer.self_attention(x + embedding, x + embedding, x, queries.valid))
    query = x + embedding
    added = F.linear(query, layer.offsets.weight, layer.offsets.bias)
    points = queries.centers[:, :, None] + added.view(2, 6, POINTS, 3)
    attention = layer.image_attention
    rows = F.normalize(views.pix_from_aug[:, :, :3], dim=-1).flatten(2)
    gathered = torch.zeros(2, 6, C)
    for b in range(2):
        for q in range(6):
            samples, scores = [], []
            for n in range(4):
                camera = attention.camera(rows[b, n])
                weight = attention.logits.weight.view(4, -1, C)[n]
                bias = attention.logits.bias.view(4, -1)[n]
                logits = (weight @ (query[b, q] + camera) + bias).view(HEADS, 2, POINTS)
                for p in range(POINTS):
                    u, v, d, _ = (views.pix_from_aug[b, n] @ torch.cat([points[b, q, p], torch.ones(1)])).tolist()
                    if d <= 0.5 or not (0 <= u / d < SIZE[1] and 0 <= v / d < SIZE[0]):
                        continue
                    place = torch.tensor([[[[2 * u / d / SIZE[1] - 1, 2 * v / d / SIZE[0] - 1]]]])
                    for level, value in enumerate(values):
                        samples.append(F.grid_sample(value[b, n][None], place, align_corners=False).view(HEADS, -1))
                        scores.append(logits[:, level, p])
            if samples:
                weights = torch.stack(scores).softmax(0)  # [n, heads]
                gathered[b, q] = (weights[..., None] * torch.stack(samples)).sum(0).flatten()
    x = layer.norms[1](x + attention.output(gathered))
    torch.testing.assert_close(found, layer.norms[2](x + layer.mlp(x)), atol=1e-4, rtol=1e-3)


@torch.no_grad()
def test_features_are_scaled_by_their_camera_and_untrained_they_stay():
    torch.manual_seed(0)
    part, (_, views) = CameraScaling(IMAGE), scene()
    assert torch.equal(part(views.levels[0], views.pix_from_aug), views.levels[0])
    nn.init.normal_(part.scale_shift.weight)
    rows = views.pix_from_aug[1, 2, :3] / views.pix_from_aug[1, 2, :3].norm(dim=1, keepdim=True)
    scale, shift = part.scale_shift(part.hidden(rows.flatten()).relu()).split(IMAGE)
    wanted = views.levels[0][1, 2] * scale[:, None, None] + shift[:, None, None]
    torch.testing.assert_close(part(views.levels[0], views.pix_from_aug)[1, 2], wanted)
    views.pix_from_aug[0, 0] = 0.0  # a missing camera
    assert part(views.levels[0], views.pix_from_aug).isfinite().all()


@torch.no_grad()
def test_every_layers_boxes_are_relative_to_where_queries_began_and_the_past_is_seen():
    (decoder, head), (queries, views) = make(), scene()
    nn.init.zeros_(head.box[-1].weight)
    head.box[-1].bias[:3] = torch.tensor([3.0, 0.0, 0.0])
    past = Queries.unknown(torch.randn(2, 2, C), torch.randn(2, 2, 3), torch.tensor([[True, False], [False, False]]))
    without, _ = decoder(queries, None, views, head)
    layers, features = decoder(queries, past, views, head)
    for layer in layers:
        torch.testing.assert_close(layer.codes[..., :3], queries.centers + torch.tensor([3.0, 0.0, 0.0]))
    assert not torch.equal(layers[0].logits, layers[1].logits) and len(features) == 2
    assert not torch.allclose(layers[0].logits[0], without[0].logits[0])
    torch.testing.assert_close(layers[1].logits[1], without[1].logits[1])  # nothing valid is remembered there
