"""The radar dense encoder: written out once more, how far a pillar reaches, samples, sizes that do not fit."""

import pytest
import torch
import torch.nn.functional as F

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.rctrans.radar_densifier import DensifierConfig, RadarDensifier

GRID = BEVGrid(cells=(48, 32), cell_m=2.0, centre_m=(3.0, -1.0), z_range_m=(-3.0, 5.0))


def make(num_layers=1, grid=GRID, **changes):
    torch.manual_seed(0)
    settings = {"channels": 4, "num_layers": num_layers, "num_heads": 2} | changes
    return RadarDensifier(DensifierConfig(**settings), 3, grid).eval()


def one_pillar():
    x = torch.zeros(2, 3, *GRID.cells)
    x[0, :, 1, 12] = torch.tensor([1.0, -2.0, 3.0])
    return x


@torch.no_grad()
def test_it_is_the_sum_of_its_parts():
    """Max pooling between levels; at the bottom x + attention(x); going up the finer level comes first."""
    part, x = make(), torch.randn(2, 3, *GRID.cells)
    one = part.down[0](x)
    two = part.down[1](F.max_pool2d(one, 2))
    three = part.down[2](F.max_pool2d(two, 2))
    four = part.down[3](F.max_pool2d(three, 2))
    assert four.shape == (2, 32, 6, 4)
    layer = part.attention[0]
    cells = four.flatten(2).transpose(1, 2)  # row by row
    places = torch.tensor([[3.0 + 16 * (col - 1.5), -1.0 + 16 * (row - 2.5)] for row in range(6) for col in range(4)])
    placed = cells + layer.embedding(places)
    query, key, value = (
        getattr(layer.attention, name)(placed).unflatten(2, (2, 16)).transpose(1, 2)
        for name in ("query", "key", "value")
    )
    seen = (query @ key.transpose(2, 3) / 4.0).softmax(3) @ value
    cells = layer.norms[0](cells + layer.attention.output(seen.transpose(1, 2).flatten(2)))
    cells = layer.norms[1](cells + layer.mlp(cells))
    x4 = four + cells.transpose(1, 2).unflatten(2, (6, 4))
    x3 = part.up[0](torch.cat([three, part.raise_[0](x4)], 1))
    x2 = part.up[1](torch.cat([two, part.raise_[1](x3)], 1))
    wanted = part.up[2](torch.cat([one, part.raise_[2](x2)], 1))
    torch.testing.assert_close(part(x), wanted, atol=1e-5, rtol=1e-4)


@torch.no_grad()
def test_a_pillar_fills_the_cells_around_it_and_by_attention_the_whole_map():
    changed = [(make(layers)(one_pillar()) - make(layers)(0 * one_pillar())).abs().amax(1) for layers in (0, 1)]
    without, attended = (value > 0 for value in changed)
    assert without[0].sum() > 100 and not without[0, 46:].any()
    assert attended[0].float().mean() > 0.99
    assert not without[1].any() and not attended[1].any()  # the other sample


def test_what_does_not_fit_is_named():
    with pytest.raises(ConfigError, match="48 x 36 pillars.*multiple of 8"):
        make(grid=BEVGrid((48, 36), 2.0, (0.0, 0.0), (-3.0, 5.0)))
    with pytest.raises(ConfigError, match="num_heads=3.*32 channels"):
        make(num_heads=3)
    with pytest.raises(ConfigError, match="model.densifier.num_layers=-1"):
        make(num_layers=-1)
