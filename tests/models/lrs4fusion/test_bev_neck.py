import pytest
import torch

from src.errors import ConfigError
from src.models.lrs4fusion.bev_neck import BEVNeck, BEVNeckConfig, columns
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseMap


def settings(**changes):
    values = {"stage_channels": [16, 24], "stage_strides": [1, 2], "layers_per_stage": 1, "fpn_channels": 8}
    return BEVNeckConfig(**(values | changes))


def test_columns_have_their_largest_value_also_below_zero():
    cells = torch.tensor([[0, 0, 1, 1], [0, 2, 1, 1], [0, 1, 0, 3], [1, 2, 1, 1]])
    sites, order = Sites.from_indices(cells, (2, 3, 2, 4))
    volume = SparseMap(sites, torch.tensor([[-3.0, 5], [-1, 2], [-7, -8], [4, 4]])[order])
    bev = columns(volume)
    assert bev.indices.tolist() == [[0, 0, 3], [0, 1, 1], [1, 1, 1]]
    assert bev.features.tolist() == [[-7, -8], [-1, 5], [4, 4]]


@pytest.mark.parametrize("plane", [(8, 12), (7, 5)])
def test_the_map_has_the_columns_of_the_volume(plane):
    neck = BEVNeck(settings(), 3)
    cells = torch.cat([torch.zeros(6, 1), torch.randint(0, 5, (6, 3), generator=torch.Generator().manual_seed(0))], 1)
    sites, rows = Sites.unique(cells.long(), (2, 5, *plane))
    volume = SparseMap(sites, torch.randn(len(sites), 3, requires_grad=True))
    out = neck(volume)
    assert out.shape == (2, neck.out_channels, *plane) and neck.out_channels == 16
    out.square().sum().backward()
    assert volume.features.grad.any() and all(p.grad is not None for p in neck.parameters())


def test_a_volume_without_sites_gives_a_map():
    volume = SparseMap(Sites((1, 3, 4, 4), torch.zeros(0, dtype=torch.int64)), torch.zeros(0, 3))
    assert BEVNeck(settings(), 3)(volume).shape == (1, 16, 4, 4)


def test_lists_of_different_length():
    with pytest.raises(ConfigError, match="must be of the same length"):
        settings(stage_strides=[1])
