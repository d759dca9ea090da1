import pytest
import torch

from src.errors import ConfigError
from src.models.lrs4fusion.bev_neck import BEVNeck, BEVNeckConfig, columns
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseMap


def settings(**changes):
    values = {
        "finest_scale": 4,
        "stage_channels": [16, 24],
        "stage_strides": [1, 2],
        "layers_per_stage": 1,
        "fpn_channels": 8,
    }
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
    neck = BEVNeck(settings(), (5, 5, 2, 3))
    cells = torch.cat([torch.zeros(6, 1), torch.randint(0, 5, (6, 3), generator=torch.Generator().manual_seed(0))], 1)
    sites, rows = Sites.unique(cells.long(), (2, 5, *plane))
    volume = SparseMap(sites, torch.randn(len(sites), 3, requires_grad=True))
    out = neck([volume] * 4)
    assert out.shape == (2, neck.out_channels, *plane) and neck.out_channels == 16
    out.square().sum().backward()
    assert volume.features.grad.any() and all(p.grad is not None for p in neck.parameters())


def test_a_volume_without_sites_gives_a_map():
    volume = SparseMap(Sites((1, 3, 4, 4), torch.zeros(0, dtype=torch.int64)), torch.zeros(0, 3))
    assert BEVNeck(settings(), (5, 5, 2, 3))([volume] * 4).shape == (1, 16, 4, 4)


@pytest.mark.parametrize("plane", [(8, 12), (7, 5)])
def test_coarser_scales_are_repeated_beside_the_finest(plane):
    """Each cell of V4 serves four of V3; without layers and with a unit kernel the map is the input."""
    neck = BEVNeck(settings(finest_scale=3, stage_channels=[5], stage_strides=[1], layers_per_stage=0), (9, 9, 2, 3))
    seen = []
    neck.stages[0].register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    volumes = []
    for size, width in ((plane, 2), ([(n + 1) // 2 for n in plane], 3)):
        cells = torch.nonzero(torch.ones(1, 1, *size))
        sites, order = Sites.from_indices(cells, (1, 1, *size))
        volumes.append(SparseMap(sites, torch.randn(len(cells), width)[order]))
    out = neck([None, None, *volumes])
    fine, coarse = (volume.features.view(*volume.sites.shape[2:], -1) for volume in volumes)
    assert out.shape == (1, 8, *plane) and torch.equal(seen[0][0, :2].permute(1, 2, 0), fine)
    for row, col in ((0, 0), (3, 2), (plane[0] - 1, plane[1] - 1)):
        assert torch.equal(seen[0][0, 2:, row, col], coarse[row // 2, col // 2])


@pytest.mark.parametrize("scale", [0, 5])
def test_a_scale_that_there_is_not(scale):
    with pytest.raises(ConfigError, match=f"model.neck.finest_scale={scale}: must be 1 to 4"):
        settings(finest_scale=scale)


def test_lists_of_different_length():
    with pytest.raises(ConfigError, match="must be of the same length"):
        settings(stage_strides=[1])
