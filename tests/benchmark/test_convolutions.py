"""The baselines of sparse convolution compute what ours computes."""

import pytest
import torch
from torch.utils.benchmark import set_torch_threads

from src.benchmark.convolutions import (
    Layer,
    dense_convolution,
    fits_dense,
    layers_of,
    remembered_sites,
)
from src.benchmark.scenes import Highway, highway_points
from src.benchmark.spconv_baseline import (
    build_layer,
    largest_difference,
    load_spconv,
    sorted_map,
    sparse_tensor,
    spconv_encoder,
)
from src.config import compose_config
from src.models.backbones.sparse_voxel import RadarEncoder
from src.models.layers.sparse import SparseConv, SubmanifoldConv
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv
from src.structures.sparse_bev import SparseMap

CPU = torch.device("cpu")
SPCONV = load_spconv(CPU)
needs_spconv = pytest.mark.skipif(SPCONV is None, reason="spconv, of the extra `oracle`, is not installed")


def sites_on(shape, number):
    draw = torch.Generator().manual_seed(0)
    cells = torch.stack([torch.randint(0, size, (number,), generator=draw) for size in shape], 1)
    return Sites.unique(cells, shape)[0]


def layers():
    flat, deep = (1, 9, 11), (1, 5, 8, 7)
    return [
        Layer("flat", sites_on(flat, 30), SubmanifoldConv(4, 6, 3, 2, bias=False)),
        Layer("deep", sites_on(deep, 40), SubmanifoldConv(4, 6, 3, 3, bias=False)),
        Layer("down", sites_on(deep, 40), SparseConv(4, 6, 3, 3, False, 2)),
        Layer("time", sites_on(deep, 40), SparseConv(4, 6, 3, 3, False, (2, 1, 1))),
    ]


@pytest.mark.parametrize("layer", layers(), ids=lambda layer: layer.name)
def test_the_dense_convolution_computes_the_same(layer):
    features = torch.randn(len(layer.sites), 4, requires_grad=True)
    kernel_map, out_sites = layer.kernel.map(layer.sites)
    ours = sparse_conv(features, layer.kernel.weight, kernel_map)
    dense = dense_convolution(layer, features, out_sites)
    torch.testing.assert_close(dense, ours)
    gradients = [torch.autograd.grad(y.square().sum(), [features, layer.kernel.weight]) for y in (ours, dense)]
    torch.testing.assert_close(gradients[1], gradients[0])
    assert fits_dense(layer, out_sites)


@needs_spconv
@pytest.mark.parametrize("layer", layers(), ids=lambda layer: layer.name)
def test_spconv_computes_the_same_at_one_thread(layer):
    with set_torch_threads(1):
        features = torch.randn(len(layer.sites), 4, requires_grad=True)
        kernel_map, out_sites = layer.kernel.map(layer.sites)
        baseline = build_layer(SPCONV, layer.kernel, "pairs")
        theirs = sorted_map(baseline(sparse_tensor(SPCONV, SparseMap(layer.sites, features))))
        ours = sparse_conv(features, layer.kernel.weight, kernel_map)
    assert torch.equal(theirs.sites.keys, out_sites.keys) and theirs.sites.shape == out_sites.shape
    assert largest_difference([ours], [theirs.features]) < 1e-5


def encoder_of(scale):
    config, _ = compose_config([f"scale={scale}", "data=synthetic"])
    encoder = RadarEncoder(config.model.radar_encoder, config.grid.build(), config.model.channels).train()
    encoder.local_means = None
    points = highway_points(Highway(150, 10, 5, 150.0))
    voxels = encoder.voxelise(points, torch.zeros(len(points), dtype=torch.int64), 1)
    return encoder, voxels, config.grid.build()


@needs_spconv
@pytest.mark.parametrize("scale", ["mini", "paper"])
def test_the_whole_backbone_in_spconv_computes_the_same(scale):
    """Two and three dimensions, with submanifold and with dilating output."""
    with set_torch_threads(1):
        encoder, voxels, _ = encoder_of(scale)
        theirs = sorted_map(spconv_encoder(SPCONV, encoder).encode(voxels).tensor)
        ours = encoder.encode(voxels)
    assert torch.equal(theirs.sites.keys, ours.sites.keys)
    assert largest_difference([ours.features], [theirs.features]) < 1e-5


def test_layers_are_those_of_the_backbone_and_of_the_memory():
    encoder, voxels, grid = encoder_of("debug")
    bev = sites_on((1, *grid.cells), 40)
    past = remembered_sites(grid, bev, 3)
    assert past.shape == (1, 3, *grid.cells) and len(past) == 3 * len(bev)
    found = layers_of(encoder, voxels, 16, bev, past)
    assert [layer.kernel.ndim for layer in found] == [2, 2, 2, 3, 3, 3]
    assert [layer.temporal for layer in found] == [False] * 5 + [True]
    assert not fits_dense(found[-1], past)  # no dense convolution keeps to occupied columns
    wide = Sites((1, 64, 3072, 3072), past.keys[:0])
    assert not fits_dense(Layer("wide", wide, SubmanifoldConv(64, 64, 3, 3, False)), wide)
