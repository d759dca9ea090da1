"""Radar points in patches of a space-filling curve: the curve by hand, a plain loop as oracle, padding, no points."""

import pytest
import torch

from src.errors import ConfigError
from src.models.sparc.point_transformer import (
    PointTransformer,
    PointTransformerConfig,
    SerialisedBlock,
    z_order,
)
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV
from tests.models.frames import GRID, make_batch


def make_config(**changes):
    values = {"channels": 8, "num_layers": 2, "num_blocks": 2, "num_heads": 2, "patch_size": 4}
    return PointTransformerConfig(**(values | changes))


def random_bev(counts):
    """So many distinct cells of each sample."""
    generator = torch.Generator().manual_seed(0)
    cells = [torch.randperm(GRID.rows * GRID.cols, generator=generator)[:count].sort().values for count in counts]
    linear = torch.cat([own + sample * GRID.rows * GRID.cols for sample, own in enumerate(cells)])
    sites = Sites.from_linear(linear, (len(counts), GRID.rows, GRID.cols))
    return SparseBEV(sites, torch.randn(len(linear), 8, generator=generator))


def test_the_curve_runs_in_the_shape_of_a_z():
    row, col = torch.tensor([0, 0, 1, 1, 0, 2, 3]), torch.tensor([0, 1, 0, 1, 2, 0, 3])
    assert z_order(row, col).tolist() == [0, 1, 2, 3, 4, 8, 15]
    assert z_order(col, row).tolist() == [0, 2, 1, 3, 8, 4, 15]


@pytest.mark.parametrize("transposed", [False, True])
def test_a_patch_attends_to_itself_alone(transposed):
    torch.manual_seed(0)
    block, bev = SerialisedBlock(8, 2, 4, transposed).double(), random_bev((10, 3, 0, 5))
    x = torch.randn(18, 8, dtype=torch.float64)
    found = block.attend(x, block.patches(bev))
    wanted = torch.zeros_like(found)
    for sample in range(4):
        rows = (bev.indices[:, 0] == sample).nonzero().squeeze(1).tolist()

        def place(row):
            _, a, b = bev.indices[row].tolist()
            a, b = (b, a) if transposed else (a, b)
            return sum((a >> k & 1) << (2 * k + 1) | (b >> k & 1) << (2 * k) for k in range(10))

        rows.sort(key=place)
        for first in range(0, len(rows), 4):
            patch = rows[first : first + 4]
            q, k, v = block.query_key_value(x[patch]).view(len(patch), 3, 2, 4).unbind(1)
            heads = [(q[:, h] @ k[:, h].T / 2).softmax(1) @ v[:, h] for h in range(2)]
            wanted[patch] = block.output(torch.cat(heads, dim=1))
    torch.testing.assert_close(found, wanted)


def test_means_and_padding():
    encoder, batch = PointTransformer(make_config(), GRID).eval(), make_batch(points=(60, 30))
    points = batch.radar_points.clone()
    points[:20, :2] = points[0, :2]  # in one cell
    radar = encoder(points, batch.radar_batch, 2)
    cell = (radar.bev.indices == torch.cat([torch.zeros(1), GRID.cell_of(points[0, :2])]).long()).all(1)
    inside = (GRID.cell_of(points[:60, :2]) == GRID.cell_of(points[0, :2])).all(1)
    torch.testing.assert_close(radar.means[cell][0], points[:60][inside].mean(0))
    padded = radar.padded()
    for sample in range(2):
        own = radar.bev.indices[:, 0] == sample
        count = int(own.sum())
        assert padded.valid[sample].sum() == count and padded.valid[sample, :count].all()
        assert torch.equal(padded.features[sample, :count], radar.bev.features[own])
        assert torch.equal(padded.xyz[sample, :count], radar.means[own, :3])


def test_samples_do_not_mix_and_the_order_of_points_does_not_matter():
    torch.manual_seed(0)
    encoder, batch = PointTransformer(make_config(), GRID).eval(), make_batch(points=(70, 40))
    both = encoder(batch.radar_points, batch.radar_batch, 2)
    order = torch.cat([torch.randperm(70), 70 + torch.randperm(40)])
    again = encoder(batch.radar_points[order], batch.radar_batch, 2)
    torch.testing.assert_close(again.bev.features, both.bev.features, atol=1e-5, rtol=1e-5)
    alone = encoder(batch.radar_points[70:], batch.radar_batch[70:] * 0, 1)
    torch.testing.assert_close(alone.bev.features, both.bev.features[-len(alone.bev) :], atol=1e-5, rtol=1e-5)


def test_no_points():
    encoder = PointTransformer(make_config(), GRID)
    radar = encoder(torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64), 2)
    padded = radar.padded()
    assert len(radar.bev) == 0 and padded.valid.shape == (2, 0)
    padded.features.sum().backward()
    assert all(p.grad is not None and not p.grad.any() for p in encoder.parameters())


@pytest.mark.parametrize(
    ("changes", "message"), [({"num_heads": 3}, "num_heads=3.*channels=8"), ({"patch_size": 1}, "patch_size=1")]
)
def test_mistakes_are_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        make_config(**changes)
