"""The encoder layer: where it samples, what it may change, and what padding may not."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
import torch.nn.functional as F

from src.models.horizon3d.cross_attention import RadarCrossAttention
from src.models.horizon3d.gaussian_encoder import (
    AnchorEncoder,
    EncoderLayer,
    GaussianBounds,
    GaussianEncoder,
    Refinement,
    SelfEncoding,
)
from src.models.layers.image_attention import ImageCrossAttention
from src.ops.sites import Sites
from src.structures.gaussians import GaussianSet
from src.structures.sparse_bev import SparseBEV

BOUNDS = GaussianBounds((0.2, 3.2), 4.0, 60.0, 1.0)
C = 16


def make_gaussians(means):
    """Gaussians with random attributes at given places [B, G, 2]."""
    generator = torch.Generator().manual_seed(0)
    b, g, _ = means.shape
    angles = torch.rand(b, g, generator=generator) * 6.3
    return GaussianSet(
        means=means,
        scales=torch.rand(b, g, 2, generator=generator) * 2 + 0.3,
        directions=torch.stack([angles.cos(), angles.sin()], -1),
        opacity_logits=torch.randn(b, g, generator=generator),
        velocities=torch.randn(b, g, 2, generator=generator),
        features=torch.randn(b, g, C, generator=generator),
        sources=torch.zeros(b, g, dtype=torch.int64),
        elapsed_s=torch.zeros(b, g),
        valid=torch.ones(b, g, dtype=torch.bool),
    )


def make_radar(grid):
    generator = torch.Generator().manual_seed(1)
    linear = torch.randperm(grid.rows * grid.cols, generator=generator)[:300].sort().values
    sites = Sites.from_linear(linear, (1, *grid.cells))
    return SparseBEV(sites, torch.randn(300, C, generator=generator))


def make_encoder(grid, layers=2, chained=False, early=False, learnable=3, heads=None):
    torch.manual_seed(3)
    layer = partial(EncoderLayer, C, learnable, 4, 3, grid, BOUNDS, chained, early, heads)
    return GaussianEncoder(C, 16, grid, BOUNDS, layers, layer).eval()


def places(count):
    generator = torch.Generator().manual_seed(5)
    return torch.rand(1, count, 2, generator=generator) * torch.tensor([40.0, 30.0]) - torch.tensor([18.0, 16.0])


def test_sampling_points_follow_scale_and_rotation(grid):
    torch.manual_seed(0)
    layer = EncoderLayer(C, 0, 4, 3, grid, BOUNDS, False, False, None)
    angle = math.radians(30.0)
    gaussians = replace(
        make_gaussians(torch.tensor([[[3.0, 4.0]]])),
        scales=torch.tensor([[[2.0, 1.0]]]),
        directions=torch.tensor([[[math.cos(angle), math.sin(angle)]]]),
    )
    points = layer.sampling_points(torch.zeros(1, 1, C), gaussians)[0, 0] - torch.tensor([3.0, 4.0])
    along = torch.tensor([math.cos(angle), math.sin(angle)])
    across = torch.tensor([-math.sin(angle), math.cos(angle)])
    expected = torch.stack([0 * along, 0.9 * along, -0.9 * along, 0.45 * across, -0.45 * across])
    torch.testing.assert_close(points, expected)


def test_learnable_points_stay_within_three_sigma(grid):
    layer = EncoderLayer(C, 6, 4, 3, grid, BOUNDS, False, False, None)
    gaussians = make_gaussians(places(20))
    points = layer.sampling_points(1e3 * torch.randn(1, 20, C), gaussians)
    offset = points - gaussians.means[:, :, None]
    cos, sin = gaussians.directions[:, :, None].unbind(-1)
    local = torch.stack([cos * offset[..., 0] + sin * offset[..., 1], cos * offset[..., 1] - sin * offset[..., 0]], -1)
    reach = (local / gaussians.scales[:, :, None]).abs()
    assert points.shape == (1, 20, 11, 2)
    assert reach.max() <= 3.0 + 1e-4
    assert reach[:, :, 5:].max() > 2.9


def test_radar_attention_reads_the_cell_under_its_points(grid):
    attention = RadarCrossAttention(C, 1, grid)
    torch.nn.init.eye_(attention.value.weight)
    torch.nn.init.eye_(attention.output.weight)
    sites, _ = Sites.from_indices(torch.tensor([[0, 10, 20], [1, 30, 40]]), (2, *grid.cells))
    radar = SparseBEV(sites, torch.randn(2, C))
    cells = torch.tensor([[10, 20], [30, 40]])
    points = grid.centre_of(cells)[None, :, None].repeat(2, 1, 1, 1)  # both places in both samples
    out = attention(torch.randn(2, 2, C), points, radar)
    torch.testing.assert_close(out[0, 0], radar.features[0])
    torch.testing.assert_close(out[1, 1], radar.features[1])
    assert not out[0, 1].any() and not out[1, 0].any()  # the other sample's cell is not there


def test_image_attention_sees_a_blob_where_the_point_projects(grid, make_views):
    torch.manual_seed(0)
    attention = ImageCrossAttention(C, 1, 4, 1, grid)
    torch.nn.init.zeros_(attention.height.weight)  # every point at its initial height of 1 m
    torch.nn.init.eye_(attention.output.weight)
    views = make_views(strides=(8,))
    points = torch.tensor([[[[12.0, 9.0]], [[12.0, -9.0]]]])  # left front, right front
    pixels, visible = views.project(torch.cat([points, torch.ones(1, 2, 1, 1)], -1))
    assert visible[0, 0, :, 0].tolist() == [True, False, False, False]
    u, v = (pixels[0, 0, 0, 0] / 8).tolist()
    values = [torch.zeros(1, 4, C, 8, 12)]
    # Fill the four cells around the sampling place, so that the bilinear sample is the blob's value wherever it falls.
    blob = torch.randn(C)
    for row in (math.floor(v - 0.5), math.floor(v - 0.5) + 1):
        for col in (math.floor(u - 0.5), math.floor(u - 0.5) + 1):
            values[0][0, 0, :, row, col] = blob
    query = torch.randn(1, 2, C)
    out = attention(query, query, points, views, values)
    torch.testing.assert_close(out[0, 0], blob)
    assert not out[0, 1].any()


def test_image_weights_are_a_softmax_over_what_is_visible(grid, make_views):
    torch.manual_seed(0)
    attention = ImageCrossAttention(C, 3, 4, 3, grid)
    torch.nn.init.normal_(attention.logits.weight)
    visible = torch.rand(1, 6, 4, 3) < 0.4
    visible[0, 2] = False
    weights = attention._weights(torch.randn(1, 6, C), make_views().pix_from_aug, visible)  # [1, 6, heads, N, L, P]
    expected = visible.flatten(2).any(2).float()[..., None].expand(1, 6, 4)
    torch.testing.assert_close(weights.flatten(3).sum(3), expected)
    assert not weights[~visible[:, :, None, :, None].expand_as(weights)].any()
    assert not weights[0, 2].any()


def test_a_gaussian_that_no_camera_sees_is_finite_with_finite_gradients(grid, make_views):
    encoder, views = make_encoder(grid), make_views()
    views.valid[:] = False
    gaussians = make_gaussians(places(10))
    gaussians.features.requires_grad_()
    out, _ = encoder(gaussians, make_radar(grid), views)
    out.means.sum().backward()
    assert out.features.isfinite().all() and gaussians.features.grad.isfinite().all()


def test_self_encoding_joins_cell_mates_and_stops_at_its_reach(grid):
    torch.manual_seed(0)
    encoding = SelfEncoding(C, grid).eval()
    home = grid.centre_of(torch.tensor([20, 30]))
    far = grid.centre_of(torch.tensor([20, 45]))
    means = torch.stack([home, home + 0.1, far])[None]
    gaussians = make_gaussians(means)
    out = encoding(gaussians.features, gaussians)
    assert torch.equal(out[0, 0], out[0, 1])
    changed = gaussians.features.clone()
    changed[0, 2] += 1.0
    assert torch.equal(encoding(changed, gaussians)[0, :2], out[0, :2])
    # Only the mean of a cell counts, however many share it.
    averaged = gaussians.features.clone()
    averaged[0, :2] = averaged[0, :2].mean(0)
    torch.testing.assert_close(encoding(averaged, gaussians), out)


def test_refinement_keeps_to_its_bounds(grid):
    refinement = Refinement(C, grid, BOUNDS)
    torch.nn.init.normal_(refinement.output.weight, std=50.0)
    gaussians = make_gaussians(places(400))
    out = refinement(torch.randn(1, 400, C), gaussians)
    shift = (out.means - gaussians.means).abs()
    assert shift.max() <= 4.0 + 1e-4 and shift.max() > 3.9
    assert grid.contains(out.means).all()
    assert out.scales.min() >= 0.2 and out.scales.max() <= 3.2
    assert out.velocities.abs().max() <= 60.0
    torch.testing.assert_close(out.directions.norm(dim=-1), torch.ones(1, 400))


def test_untrained_refinement_hardly_moves_a_gaussian(grid):
    torch.manual_seed(0)
    refinement = Refinement(C, grid, BOUNDS)
    gaussians = make_gaussians(places(50))
    out = refinement(torch.randn(1, 50, C), gaussians)
    assert (out.means - gaussians.means).abs().max() < 0.8  # one cell
    assert (out.opacity_logits.sigmoid() - 0.25).abs().max() < 0.05


def test_a_raw_velocity_has_a_unit():
    raw = torch.zeros(3, 7)
    raw[:, 5:] = torch.tensor([[0.3, 0.0], [0.0, -2.0], [40.0, 0.0]])
    found = replace(BOUNDS, velocity_unit_mps=10.0).activate(raw)["velocities"]
    torch.testing.assert_close(found, 60 * torch.tanh(torch.tensor([[3.0, 0], [0, -20], [400, 0]]) / 60))


@pytest.mark.parametrize("chained", [False, True])
@pytest.mark.parametrize("early", [False, True])
def test_padding_changes_nothing(grid, make_views, chained, early):
    encoder, radar, views = make_encoder(grid, chained=chained, early=early), make_radar(grid), make_views()
    means = places(12)
    full = make_gaussians(means)
    first = GaussianSet(**{name: getattr(full, name)[:, :8] for name in GaussianSet.__dataclass_fields__})
    valid = torch.arange(12)[None] < 8
    padded = replace(full, valid=valid, features=torch.where(valid[..., None], full.features, 1e3))
    (a, _), (b, _) = encoder(first, radar, views), encoder(padded, radar, views)
    torch.testing.assert_close(b.means[:, :8], a.means)
    torch.testing.assert_close(b.features[:, :8], a.features)


class Recorded(torch.nn.Module):
    """Keeps what it is given and passes on its first number."""

    def forward(self, x):
        self.seen = x
        return x[..., :1].expand(*x.shape[:-1], C)


def test_the_anchor_encoder_sees_attributes_in_their_units(grid):
    """The middle of the grid lies at (2, -1), 25.6 and 19.2 m from its edges; scales end at 3.2 m, speeds at 60 m/s."""
    anchor = AnchorEncoder(C, grid, BOUNDS)
    for name in anchor.embed:
        anchor.embed[name] = Recorded()
    anchor.output = torch.nn.Identity()
    gaussians = replace(
        make_gaussians(torch.tensor([[[14.8, -10.6], [2.0, -1.0]]])),
        scales=torch.tensor([[[1.6, 0.8], [3.2, 0.2]]]),
        directions=torch.tensor([[[0.6, 0.8], [0.0, -1.0]]]),
        opacity_logits=torch.tensor([[0.0, math.log(3.0)]]),
        velocities=torch.tensor([[[30.0, -15.0], [0.0, 6.0]]]),
    )
    found = anchor(gaussians)
    expected = {
        "mean": [[0.5, -0.5], [0, 0]],
        "scale": [[0.5, 0.25], [1, 0.0625]],
        "direction": [[0.6, 0.8], [0, -1]],
        "opacity": [[0.5], [0.75]],
        "velocity": [[0.5, -0.25], [0, 0.1]],
    }
    for name, values in expected.items():
        torch.testing.assert_close(
            anchor.embed[name].seen, torch.tensor([values]), msg=lambda text, n=name: f"{n}: {text}"
        )
    torch.testing.assert_close(found[0, :, 0], torch.tensor([0.5 + 0.5 + 0.6 + 0.5 + 0.5, 0 + 1 + 0 + 0.75 + 0]))


@pytest.mark.parametrize("chained", [False, True])
@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("heads", [None, 4])
def test_layers_are_those_of_method_5_1(grid, make_views, chained, early, heads):
    """Written out line by line with the parts of each layer."""
    encoder, radar, views = make_encoder(grid, 2, chained, early, heads=heads), make_radar(grid), make_views()
    for parameter in encoder.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    g = given = make_gaussians(places(8))

    def norm(layer, number, x):
        return F.layer_norm(x, (C,), layer.norms[number].weight, layer.norms[number].bias)

    def ffn(layer, number, x):
        widen, _, _, narrow, _ = layer.feed_forward[number]
        return narrow(widen(x).relu())

    values = [torch.stack([encoder.image_value(view) for view in level.unbind(1)], 1) for level in views.levels]
    for layer in encoder.layers:
        f, e = g.features, encoder.anchor(g)
        f = f if heads is None else f + layer.temporal_attention(f, e, g, None)
        points = layer.sampling_points(f + e, g)
        after_radar = f + layer.radar_attention(f + e, points, radar)
        first, query = (after_radar, after_radar + e) if chained else (f, f + e)
        hat = norm(layer, 0, after_radar + layer.image_attention(first, query, points, views, values))
        hat = norm(layer, 1, hat + ffn(layer, 0, hat))
        new = norm(layer, 2, hat + layer.self_encoding(hat, g))
        new = norm(layer, 3, new + ffn(layer, 1, new))
        g = replace(layer.refinement((hat if early else new) + e, g), features=new)
    found, velocities = encoder(given, radar, views)
    for name in ("features", "means", "scales", "directions", "opacity_logits", "velocities"):
        torch.testing.assert_close(getattr(found, name), getattr(g, name), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(velocities, found.velocities)


def test_order_of_attention_and_source_of_refinement_matter(grid, make_views):
    radar, views, gaussians = make_radar(grid), make_views(), make_gaussians(places(8))
    results = []
    for chained, early in ((False, False), (True, False), (False, True)):
        encoder = make_encoder(grid, layers=1, chained=chained, early=early)
        for parameter in encoder.parameters():  # the same weights in all three, large enough to tell them apart
            torch.nn.init.normal_(parameter, std=0.3, generator=torch.Generator().manual_seed(parameter.numel()))
        results.append(encoder(gaussians, radar, views)[0])
    parallel, chained, early = results
    assert not torch.allclose(parallel.features, chained.features, atol=1e-3)
    torch.testing.assert_close(parallel.features, early.features)  # features pass the same way,
    assert not torch.allclose(parallel.means, early.means, atol=1e-3)  # only attributes are read earlier


def test_no_detach_between_layers(grid, make_views):
    encoder = make_encoder(grid)
    gaussians = make_gaussians(places(8))
    encoder(gaussians, make_radar(grid), make_views())[0].scales.sum().backward()
    assert encoder.layers[0].refinement.output.weight.grad.abs().sum() > 0
