"""Every width of Table 1 of the supplement, and the sizes that follow from it (lrs 1, 5, 13)."""

import pytest
import torch
from torch import nn

from src.models.layers.sparse import SparseConv, SparseInverseConv, SparseKernel, SubmanifoldConv
from src.models.lrs4fusion.late_encoder import FusionStem
from src.models.lrs4fusion.voxel_pointnet import VoxelPointNet
from tests.models.lrs4fusion.lrs_frames import lrs_model

STRIDED, SAME, BACK = "strided", "submanifold", "inverse"
KINDS = {SparseConv: STRIDED, SubmanifoldConv: SAME, SparseInverseConv: BACK}


@pytest.fixture(scope="module")
def models():
    """On no device: only shapes are asked for."""
    stages = ("detection", "forecast")
    with torch.device("meta"):
        return {stage: lrs_model(f"phase.options.stage={stage}", scale="paper") for stage in stages}


def convs(module):
    """(kind, in, out, kernel as written in the source: x, y, z) of all sparse convolutions, in order."""
    return [
        (KINDS[type(conv)], conv.in_channels, conv.out_channels, conv.kernel_size[::-1])
        for conv in module.modules()
        if isinstance(conv, SparseKernel)
    ]


def linears(module):
    return [(layer.in_features, layer.out_features) for layer in module.modules() if isinstance(layer, nn.Linear)]


def millions(module):
    return sum(parameter.numel() for parameter in module.parameters()) / 1e6


CUBE = (3, 3, 3)


def test_sparse_unet(models):
    unet = models["detection"].unet
    encoder = [[conv[1:3] for conv in convs(level)] for level in unet.encoder]
    assert encoder == [
        [(32, 32)],
        [(32, 64), (64, 64)],
        [(64, 128), (128, 128)],
        [(128, 128), (128, 128), (128, 128)],
        [(128, 256), (256, 256), (256, 256)],
    ]
    assert [[conv[0] for conv in convs(level)] for level in unet.encoder] == [
        [SAME], [STRIDED, SAME], [STRIDED, SAME], [STRIDED, SAME, SAME], [STRIDED, SAME, SAME]
    ]  # fmt: skip
    triples = [tuple(conv[2] for conv in convs(level)[1:]) for level in unet.decoder]  # two convs in a lateral block
    assert triples == [(256, 256, 128), (128, 128, 128), (128, 128, 64), (64, 64, 32), (32, 32, 32)]
    assert [convs(level)[2][1] for level in unet.decoder] == [512, 256, 256, 128, 64]  # merging what is side by side
    assert [convs(level)[-1][0] for level in unet.decoder] == [BACK] * 4 + [SAME]
    assert all(conv[3] == CUBE for conv in convs(unet)) and unet.out_channels == 32
    assert round(millions(unet), 1) == 19.4


def test_points_and_fusion(models):
    model = models["detection"]
    assert isinstance(model.pointnet, VoxelPointNet) and linears(model.pointnet) == [(10, 32)]
    assert convs(model.stem) == [(SAME, 32, 64, CUBE), (SAME, 64, 32, (1, 1, 1))]
    assert model.stem.norm.normalized_shape == (64,) and isinstance(model.stem.norm, nn.LayerNorm)
    with_cameras = FusionStem(64 + 32, 64, 32, {"eps": 1e-3, "momentum": 0.01})
    assert convs(with_cameras)[0] == (SAME, 96, 64, CUBE)


def test_late_encoder(models):
    late = models["detection"].late_encoder
    xy, xz, yz, wide = (3, 3, 1), (3, 1, 3), (1, 3, 3), (5, 5, 1)
    assert [convs(part) for part in late.completions] == [
        [(STRIDED, 32, 32, xy)],
        [(STRIDED, 32, 32, xy), (STRIDED, 32, 32, xz), (STRIDED, 32, 32, yz)],
        [(STRIDED, 64, 64, xy)],
        [(STRIDED, 128, 128, xy)],
    ]
    assert [convs(part) for part in late.aggregations] == [
        [(SAME, 32, 32, xy), (SAME, 32, 32, xz), (SAME, 32, 32, yz), (SAME, 32, 32, xy)],
        [(SAME, 32, 32, xy), (SAME, 32, 64, xz), (SAME, 32, 32, yz), (SAME, 32, 64, xy)],
        [(SAME, 64, 64, wide), (SAME, 64, 128, wide)],
        [(SAME, 128, 128, wide), (SAME, 128, 256, wide)],
    ]
    assert [convs(pool) for pool in late.pools] == [[(STRIDED, c, c, CUBE)] for c in (32, 64, 128)]
    assert all(pool.stride == 2 for pool in late.pools) and convs(late.last) == [(SAME, 256, 256, (1, 1, 1))]
    biased = {
        conv.kernel_size[::-1] for conv in late.modules() if isinstance(conv, SparseKernel) and conv.bias is not None
    }
    assert biased == {wide} and round(millions(late), 1) == 2.5


def test_temporal_attention(models):
    temporal = models["detection"].temporal
    assert linears(temporal.query) == [(32, 16), (16, 16)] and linears(temporal.key) == [(64, 16), (16, 16)]
    assert linears(temporal.query_position) == linears(temporal.key_position) == [(4, 16), (16, 16)]
    assert linears(temporal.out) == [(16, 16), (16, 32)]
    assert temporal.config.num_heads == 4 and temporal.config.window == 3
    assert temporal.grid.cells == (32, 512, 896) and round(millions(temporal), 3) == 0.005


def test_decoders(models):
    decoders = models["detection"].decoders
    assert decoders.sampler.out_channels == 544
    assert linears(decoders.sampler) == [(4, 16), (64, 16), (16, 16), (16, 16), (16, 3)]
    for head in (decoders.occupancy, decoders.velocity):
        assert linears(head) == [(4, 16)] + [(544, 16)] * 3 + [(16, 16)] * 6 + [(16, 1)]
    assert round(millions(decoders.sampler) + millions(decoders.occupancy), 3) == 0.030


def test_ray_head(models):
    head = models["forecast"].ray_head
    assert head.places.shape == (2000,) and round(head.reach_m) == 270
    assert [(c.in_channels, c.out_channels) for c in head.convs] == [
        (128, 64), (64, 32), (32, 16), (16, 16), (16, 16), (16, 8)
    ]  # fmt: skip
    assert linears(head) == [(1, 128), (1, 128), (232, 64), (64, 32), (32, 16), (16, 1)]
    assert round(millions(head), 3) == 0.064


def test_detection_neck_and_head(models):
    model = models["detection"]
    stages = [[(c.in_channels, c.out_channels, c.stride[0]) for c in _dense(stage)] for stage in model.neck.stages]
    assert stages == [[(256, 128, 1)] + [(128, 128, 1)] * 5, [(128, 256, 2)] + [(256, 256, 1)] * 5]
    ups = [(up.conv.in_channels, up.conv.out_channels, up.conv.stride[0]) for up in model.neck.ups]
    assert ups == [(128, 256, 1), (256, 256, 2)] and model.neck.out_channels == 512
    shared = model.head.shared[0].conv
    assert (shared.in_channels, shared.out_channels, shared.kernel_size) == (512, 64, (3, 3))
    widths = [[output.out_features for output in branches.outputs] for branches in model.head.regressions]
    assert widths == [[2, 1, 3, 2, 2]] * 7  # offset, height, log-size, heading, velocity
    assert sum(branches.outputs[0].out_features for branches in model.head.heatmaps) == 12
    assert {layer.kernel_size for stage in model.neck.stages for layer in _dense(stage)} == {(3, 3)}
    assert model.head.grid.cells == (128, 224) and model.head.grid.cell_m == 1.5625


def _dense(module):
    return [layer for layer in module.modules() if isinstance(layer, nn.Conv2d)]
