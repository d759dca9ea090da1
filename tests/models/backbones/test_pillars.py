"""Radar pillars: one plain loop per pillar as oracle, order of points, points outside, no points."""

import pytest
import torch

from src.errors import ConfigError
from src.models.backbones.pillars import PillarConfig, PillarEncoder
from src.models.backbones.sparse_voxel import POINT_SCALES
from tests.models.frames import GRID, make_batch


def make_encoder(num_layers=4):
    torch.manual_seed(0)
    encoder = PillarEncoder(PillarConfig(channels=8, num_layers=num_layers), GRID)
    with torch.no_grad():
        for norm in encoder.norms:
            norm.running_mean.uniform_(-0.2, 0.2)
            norm.running_var.uniform_(0.5, 1.5)
    return encoder


def slow_pillar(encoder, points, row, col):
    """One pillar from its points [n, 7], in double, in eval mode."""
    points = points.double()
    centre = torch.tensor(
        [GRID.x_min_m + (col + 0.5) * GRID.cell_m, GRID.y_min_m + (row + 0.5) * GRID.cell_m], dtype=torch.float64
    )
    mean = points[:, :3].mean(0)
    features = torch.cat(
        [
            points / torch.tensor(POINT_SCALES, dtype=torch.float64),
            (points[:, :2] - centre) / GRID.cell_m,
            (points[:, :3] - mean) / torch.tensor([0.8, 0.8, 5.0], dtype=torch.float64),
            torch.full((len(points), 1), len(points), dtype=torch.float64).log(),
        ],
        dim=1,
    )
    for layer, norm in zip(encoder.layers, encoder.norms, strict=True):
        x = features @ layer.weight.double().t()
        x = (x - norm.running_mean.double()) / (norm.running_var.double() + norm.eps).sqrt()
        x = (x * norm.weight.double() + norm.bias.double()).clamp(min=0)
        best = x.amax(0)
        features = torch.cat([x, best.expand_as(x)], dim=1)
    return best


@pytest.mark.parametrize("num_layers", [1, 4])
def test_every_pillar_is_the_point_networks_maximum(num_layers):
    encoder = make_encoder(num_layers).eval()
    batch = make_batch(points=(60, 40))
    points = batch.radar_points.clone()
    points[:30, :2] = points[:30, :2] * 0.05  # several points share a pillar
    bev = encoder(points, batch.radar_batch, 2).detach()
    assert bev.shape == (2, 8, GRID.rows, GRID.cols) and bev.is_contiguous(memory_format=torch.channels_last)
    wanted = torch.zeros_like(bev)
    cells = [(int(b), *GRID.cell_of(p[:2]).tolist()) for b, p in zip(batch.radar_batch, points, strict=True)]
    assert len(set(cells)) < 90
    for b, row, col in set(cells):
        mine = points[torch.tensor([cell == (b, row, col) for cell in cells])]
        wanted[b, :, row, col] = slow_pillar(encoder, mine, row, col).float()
    torch.testing.assert_close(bev, wanted, rtol=1e-4, atol=1e-5)


def test_the_order_of_points_and_points_outside_do_not_matter():
    encoder, batch = make_encoder().eval(), make_batch(points=(80, 50))
    bev = encoder(batch.radar_points, batch.radar_batch, 2)
    order = torch.randperm(len(batch.radar_points), generator=torch.Generator().manual_seed(4))
    outside = batch.radar_points[:4].clone()
    outside[0, 0], outside[1, 1], outside[2, 2], outside[3, 0] = 500.0, -500.0, 5.0, torch.nan
    points = torch.cat([batch.radar_points[order], outside])
    owners = torch.cat([batch.radar_batch[order], torch.ones(4, dtype=torch.int64)])
    torch.testing.assert_close(encoder(points, owners, 2), bev, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_points(count):
    """Zero everywhere without points; every parameter has a gradient, which DDP waits for."""
    encoder, batch = make_encoder().train(), make_batch(points=(count, 0))
    bev = encoder(batch.radar_points, batch.radar_batch, 2)
    assert bool(bev.any(dim=1).sum() <= count) and bev.isfinite().all()
    bev.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in encoder.parameters())


def test_positions_keep_their_precision_under_autocast():
    encoder, batch = make_encoder().eval(), make_batch()
    plain = encoder(batch.radar_points, batch.radar_batch, 2)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(encoder(batch.radar_points, batch.radar_batch, 2), plain)


def test_mistakes_are_named():
    for values, message in (({"channels": 7}, "channels=7"), ({"num_layers": 0}, "num_layers=0")):
        with pytest.raises(ConfigError, match=f"model.radar_encoder.{message}"):
            PillarConfig(**({"channels": 8, "num_layers": 4} | values))
