"""Attention that falls off with distance: a loop as oracle, who is seen, ranges, and what a place is embedded as."""

import math

import pytest
import torch
import torch.nn.functional as F

from src.geometry.bev_grid import BEVGrid
from src.models.layers.image_attention import PointOffsets
from src.models.layers.query_attention import DistanceAttention, QueryEmbedding
from src.structures.queries import Queries

GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
C = 8


def scene():
    generator = torch.Generator().manual_seed(0)
    spread = torch.tensor([60.0, 60.0, 2.0])
    places = [(torch.rand(2, n, 3, generator=generator, dtype=torch.float64) - 0.5) * spread for n in (5, 12)]
    features = [torch.randn(2, n, C, generator=generator, dtype=torch.float64) for n in (5, 12)]
    valid = torch.rand(2, 12, generator=generator) < 0.7
    return features[0], places[0], features[1], places[1], valid


def make_attention():
    torch.manual_seed(0)
    attention = DistanceAttention(C, 2, 4).double()
    torch.nn.init.normal_(attention.penalty.weight, std=0.3)
    return attention


def literal(attention, query, centers, keys, key_centers, valid):
    out = torch.zeros_like(query)
    for b in range(len(query)):
        for row in range(query.shape[1]):
            apart = (key_centers[b, :, :2] - centers[b, row, :2]).norm(dim=1)
            near = [k for k in apart.argsort().tolist() if valid[b, k]][: attention.count]
            reach = torch.log(1 + centers[b, row, :2].norm())[None]
            tau = F.softplus(attention.penalty(torch.cat([query[b, row], reach])))
            heads = []
            for head in range(2):
                part = slice(4 * head, 4 * head + 4)
                q = attention.query(query[b, row])[part]
                scores = torch.stack([
                    q @ attention.key_value(keys[b, k])[part] / math.sqrt(4) - tau[head] * apart[k] for k in near
                ])  # fmt: skip
                values = torch.stack([
                    (attention.key_value(keys[b, k])[C:] + attention.offset((key_centers[b, k] - centers[b, row]) / 4))[
                        part
                    ]
                    for k in near
                ])  # fmt: skip
                heads.append(scores.softmax(0) @ values)
            out[b, row] = attention.output(torch.cat(heads))
    return out


def test_the_formula():
    attention, inputs = make_attention(), scene()
    found = attention(*inputs)
    torch.testing.assert_close(found, literal(attention, *inputs), atol=1e-5, rtol=1e-5)  # scores are float32


def test_only_the_nearest_that_exist_count():
    attention, (query, centers, keys, key_centers, valid) = make_attention(), scene()
    found = attention(query, centers, keys, key_centers, valid)
    changed = torch.where(valid[..., None], keys, 1e3)
    assert torch.equal(attention(query, centers, changed, key_centers, valid), found)
    far = key_centers.clone()
    far[0, 0], valid[0, 0] = torch.tensor([900.0, 0.0, 0.0]), True
    before = attention(query, centers, keys, far, valid)
    keys[0, 0] += 1.0
    assert torch.equal(attention(query, centers, keys, far, valid), before)


def test_without_any_key_there_is_nothing_but_the_bias():
    attention, (query, centers, keys, key_centers, valid) = make_attention(), scene()
    torch.nn.init.normal_(attention.output.bias)
    valid[1] = False
    found = attention(query, centers, keys, key_centers, valid)
    torch.testing.assert_close(found[1], attention.output.bias.expand(5, C))
    found.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in attention.parameters())


def test_the_penalty_adapts_to_the_range():
    """With a weight of -1 on log(1 + range) alone, a query at 100 m reaches further than one at 10 m."""
    attention, (query, centers, *_) = make_attention(), scene()
    torch.nn.init.zeros_(attention.penalty.weight)
    with torch.no_grad():
        attention.penalty.weight[:, -1] = -1.0
        attention.penalty.bias.zero_()
    centers[0, 0], centers[0, 1] = torch.tensor([10.0, 0.0, 0.0]), torch.tensor([0.0, 100.0, 0.0])
    tau = attention.penalties(query, centers)[0, :2, 0]
    torch.testing.assert_close(tau, torch.tensor([1 / 11, 1 / 101]).log1p(), rtol=1e-4, atol=0.0)


def test_without_any_key_at_all():
    attention, (query, centers, *_) = make_attention(), scene()
    nothing = (query[:, :0], centers[:, :0], torch.zeros(2, 0, dtype=torch.bool))
    found = attention(query, centers, *nothing)
    found.sum().backward()
    assert not found.any() and all(p.grad is not None for p in attention.parameters())


@pytest.mark.parametrize("step", [0.3, 3.0, 30.0])
def test_places_are_told_apart(step):
    torch.manual_seed(0)
    embedding = QueryEmbedding(32, GRID)
    centers = torch.tensor([[[100.0, 0.0, 0.0], [100.0 + step, 0.0, 0.0], [100.0, 0.0, 0.0]]])
    velocities = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [10.0, 0.0]]])
    queries = Queries(torch.zeros(1, 3, 32), centers, velocities, torch.zeros(1, 3, 12), torch.ones(1, 3) > 0)
    with torch.autocast("cpu", torch.bfloat16):
        found = embedding(queries)
    assert found.dtype == torch.float32
    assert (found[0, 0] - found[0, 1]).norm() > 0.01 and (found[0, 0] - found[0, 2]).norm() > 0.01


def test_untrained_sampling_points_lie_within_their_reach_and_are_what_the_layer_adds_to_a_querys_place():
    torch.manual_seed(0)
    layer = PointOffsets(C, 64, reach_m=2.0)
    query, centers = torch.randn(2, 5, C), torch.randn(2, 5, 3) * 50
    offsets = layer(query, centers) - centers[:, :, None]
    assert 1.9 < offsets.abs().max() < 2.0001
    torch.testing.assert_close(offsets[0, 0], offsets[1, 4], atol=1e-4, rtol=0)  # the same of every query
    torch.nn.init.normal_(layer.weight)
    added = (query[1, 3] @ layer.weight.T + layer.bias).view(64, 3)  # point by point, x, y, z
    torch.testing.assert_close(layer(query, centers)[1, 3], centers[1, 3] + added)
    assert layer.bfloat16()(query.bfloat16(), centers).dtype == torch.float32  # places keep their digits
