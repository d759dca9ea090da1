import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.sparse_voxel import ConvOut, RadarEncoder, RadarEncoderConfig
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV, SparseMap

GRID = BEVGrid(cells=(16, 24), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
PILLARS = RadarEncoderConfig(
    voxel_size_m=[0.4, 0.4, 8.0],
    stage_channels=[4, 8, 8, 8],
    blocks_per_stage=1,
    max_voxels=10_000,
    conv_out=ConvOut.subm,
    norm_momentum=0.01,
    point_count_channel=True,
    local_means=False,
    height_tolerance_deg=0.0,
    pruning_ratio=0.0,
)
VOXELS = replace(PILLARS, voxel_size_m=[0.2, 0.2, 1.0], stage_channels=[4, 6, 8, 8], conv_out=ConvOut.sparse)
FULL = RadarEncoderConfig(
    voxel_size_m=[0.1, 0.1, 0.2],
    stage_channels=[16, 32, 64, 128, 128, 128],
    blocks_per_stage=2,
    max_voxels=60_000,
    conv_out=ConvOut.sparse,
    norm_momentum=0.01,
    point_count_channel=False,
    local_means=False,
    height_tolerance_deg=0.0,
    pruning_ratio=0.0,
)
PRUNED = replace(VOXELS, pruning_ratio=0.5)
both = pytest.mark.parametrize("config", [PILLARS, VOXELS, PRUNED], ids=["pillars", "voxels", "pruned"])


def radar_points(count: int = 120, seed: int = 0) -> torch.Tensor:
    random = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 7, generator=random)
    lower = torch.tensor([-9.6, -6.4, -3.0, -10.0, -30.0, -5.0, 0.0])
    upper = torch.tensor([9.6, 6.4, 5.0, 40.0, 30.0, 5.0, 0.5])
    return lower + unit * (upper - lower)


def encoder_of(config: RadarEncoderConfig) -> RadarEncoder:
    torch.manual_seed(0)
    return RadarEncoder(config, GRID, channels=10)


def published_name(key: str) -> str:
    """Name in the public code of one of our tensors."""
    key = key.replace("conv_input.conv.", "conv_input.0.").replace("conv_input.norm.", "conv_input.1.")
    key = re.sub(r"^(conv_out|shared_conv)\.conv\.", r"\1.0.", key)
    key = re.sub(r"^(conv_out|shared_conv)\.norm\.", r"\1.1.", key)
    key = re.sub(r"^stages\.(\d)\.", lambda m: f"conv{int(m[1]) + 1}.", key)
    return re.sub(r"^(conv\d)\.0\.conv\.", r"\1.0.0.", re.sub(r"^(conv\d)\.0\.norm\.", r"\1.0.1.", key))


def test_points_just_outside_the_height_band_may_be_moved_in() -> None:
    """Ten metres away two degrees are 0.35 m: of points above and below the band the nearer ones count, at its edge."""
    points = radar_points(6)
    points[:, :2] = torch.tensor([[8.0, 6.0]])
    points[:, 2] = torch.tensor([5.0, 5.3, 5.4, -3.3, -3.4, 1.0])
    encoder = encoder_of(replace(VOXELS, height_tolerance_deg=2.0))
    moved = encoder._into_band(points)
    assert moved[:, 2].tolist() == pytest.approx([4.999, 4.999, 5.4, -3.0, -3.4, 1.0])
    assert torch.equal(moved[:, [0, 1, 3, 4, 5, 6]], points[:, [0, 1, 3, 4, 5, 6]])
    batch = torch.zeros(6, dtype=torch.int64)
    assert encoder.voxelise(moved, batch, 1).indices[:, 1].tolist() == [0, 4, 7]
    assert encoder_of(VOXELS).voxelise(points, batch, 1).indices[:, 1].tolist() == [4]
    assert not torch.equal(encoder(points, batch, 1).features, encoder_of(VOXELS)(points, batch, 1).features)
    for wrong in (-1.0, 90.0):
        with pytest.raises(ConfigError, match=f"model.radar_encoder.height_tolerance_deg={wrong}"):
            replace(VOXELS, height_tolerance_deg=wrong)


def test_agrees_with_the_recorded_backbone(golden: Callable) -> None:
    case = golden("voxelnext_backbone")
    assert case.weights["conv_input.0.weight"].flatten()[:3].tolist() == pytest.approx(
        [-0.03195676, 0.11305511, -0.08174068]
    )
    grid = replace(GRID, cells=(256 // 8, 320 // 8))
    encoder = RadarEncoder(replace(FULL, stage_channels=[8, 8, 16, 16, 16, 16]), grid, 16).eval()
    state = {}
    for key, value in encoder.state_dict().items():
        recorded = case.weights[published_name(key)]
        if key.endswith("weight") and value.dim() == 3:  # (out, k..., in) -> (K, in, out)
            recorded = recorded.flatten(1, -2).permute(1, 2, 0)
        state[key] = recorded
    assert len(state) == len(case.weights)
    encoder.load_state_dict(state)
    assert encoder.input_shape == (41, 256, 320)

    sites, order = Sites.from_indices(_tensor(case, "in_coords").long(), (2, *encoder.input_shape))
    voxels = SparseMap(sites, _tensor(case, "in_feats")[order])
    with torch.no_grad():
        _compare(case, "conv_input", encoder.conv_input(voxels))
        stages = encoder.run_stages(voxels)
        for number, stage in enumerate(stages, start=1):
            _compare(case, f"conv{number}", stage)
        bev = encoder.compress(stages[3:])
        _compare(case, "bev_in", bev)
        _compare(case, "conv_out", encoder.conv_out(bev))
        _compare(case, "shared_conv", encoder.encode(voxels))


def _tensor(case: object, name: str) -> torch.Tensor:
    return torch.from_numpy(case.arrays[name])


def _compare(case: object, name: str, found: SparseMap) -> None:
    if f"{name}_shape" in case.arrays:
        assert tuple(case.arrays[f"{name}_shape"]) == found.sites.shape[1:]
    assert np.array_equal(found.indices.numpy(), case.arrays[f"{name}_coords"]), name
    expected = case.arrays[f"{name}_feats"]
    assert np.abs(found.features.numpy() - expected).max() <= 1e-5 * np.abs(expected).max(), name


def test_parameter_count_and_shape_at_full_size() -> None:
    encoder = RadarEncoder(FULL, replace(GRID, cells=(384, 384)), 128)
    assert sum(p.numel() for p in encoder.parameters()) / 1e6 == pytest.approx(7.37, rel=0.002)
    assert encoder.input_shape == (41, 3072, 3072) and encoder.ndim == 3 and encoder.bev_stage == 3
    norms = {name: (m.eps, m.momentum) for name, m in encoder.named_modules() if isinstance(m, nn.BatchNorm1d)}
    assert norms.pop("shared_conv.norm") == (1e-5, 0.1)
    assert set(norms.values()) == {(1e-3, 0.01)}


@both
def test_output_lies_on_the_grid_and_gradients_reach_every_parameter(config: RadarEncoderConfig) -> None:
    encoder = encoder_of(config)
    assert encoder.ndim == (2 if config is PILLARS else 3)
    bev = encoder(radar_points(), torch.arange(120) // 60, 3)
    assert isinstance(bev, SparseBEV) and bev.sites.shape == (3, 16, 24) and bev.channels == 10
    assert (
        bev.sites.indices()[:, 0].bincount(minlength=bev.sites.shape[0])[2] == 0
        and bev.sites.indices()[:, 0].bincount(minlength=bev.sites.shape[0])[:2].min() > 0
    )
    (bev.features**2).sum().backward()
    # A bias in front of batch norm has no effect in training; its gradient exists but is zero up to rounding.
    cancelled = re.compile(r"(conv1|conv2|shared_conv\.conv)\.bias$")
    without = [name for name, p in encoder.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    zero = [n for n, p in encoder.named_parameters() if not p.grad.any() and not cancelled.search(n)]
    assert without == [] and zero == []


@both
def test_no_points_give_no_sites(config: RadarEncoderConfig) -> None:
    for mode in (True, False):
        encoder = encoder_of(config).train(mode)
        bev = encoder(torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64), 2)
        assert bev.features.shape == (0, 10) and bev.sites.shape == (2, 16, 24)
    encoder = encoder_of(config).train()
    encoder(torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64), 2).features.sum().backward()
    assert all(p.grad is not None and not p.grad.any() for p in encoder.parameters())


@both
def test_one_point_can_be_trained_on(config: RadarEncoderConfig) -> None:
    bev = encoder_of(config).train()(torch.zeros(1, 7), torch.zeros(1, dtype=torch.int64), 1)
    assert len(bev) > 0 and bev.features.isfinite().all()


@pytest.mark.slow
@both
def test_samples_do_not_mix(config: RadarEncoderConfig) -> None:
    encoder = encoder_of(config).eval()
    first, second = radar_points(seed=1), radar_points(seed=2)
    batch = torch.arange(2).repeat_interleave(120)
    with torch.no_grad():
        alone = encoder(second, torch.zeros(120, dtype=torch.int64), 1)
        together = encoder(torch.cat([first, second]), batch, 2)
    mine = together.indices[:, 0] == 1
    assert torch.equal(together.indices[mine][:, 1:], alone.indices[:, 1:])
    torch.testing.assert_close(together.features[mine], alone.features, rtol=1e-5, atol=1e-6)


@both
def test_order_of_points_does_not_matter(config: RadarEncoderConfig) -> None:
    encoder = encoder_of(config).eval()
    points, batch = radar_points(), torch.zeros(120, dtype=torch.int64)
    with torch.no_grad():
        a, b = encoder(points, batch, 1), encoder(points[torch.randperm(120)], batch, 1)
    assert torch.equal(a.indices, b.indices)
    torch.testing.assert_close(a.features, b.features, rtol=1e-5, atol=1e-6)


def test_voxel_features_are_means_of_normalised_points() -> None:
    points = torch.tensor(
        [
            [0.1, 0.1, 1.0, 20.0, 10.0, -10.0, 0.1],
            [0.3, 0.3, 2.0, 10.0, 0.0, 0.0, 0.5],
            [-9.5, 6.3, 4.9, 0.0, 0.0, 0.0, 0.0],
            [0.1, 0.1, 5.1, 0.0, 0.0, 0.0, 0.0],  # above the band
            [9.7, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0],  # beside the grid
        ]
    )
    voxels = encoder_of(PILLARS).voxelise(points, torch.tensor([0, 0, 1, 1, 1]), 2)
    assert voxels.indices.tolist() == [[0, 16, 24], [1, 31, 0]]
    expected = [0.2 / 150, 0.2 / 150, 1.5 / 5, 15 / 20, 5 / 20, -5 / 20, 0.3 / 0.5, np.log(2)]
    torch.testing.assert_close(voxels.features[0], torch.tensor(expected, dtype=torch.float32))
    assert voxels.features[1, 7] == 0  # log of a single point

    voxels = encoder_of(replace(VOXELS, point_count_channel=False)).voxelise(points[:3], torch.tensor([0, 0, 1]), 2)
    assert voxels.indices.tolist() == [[0, 4, 32, 48], [0, 5, 33, 49], [1, 7, 63, 0]]
    assert voxels.features.shape == (3, 7) and voxels.sites.shape == (2, 9, 64, 96)


def test_coarse_sites_land_on_the_first_cell_of_their_block_and_are_summed() -> None:
    def stage(cells: list[list[int]], shape: tuple[int, ...], values: list[float]) -> SparseMap:
        sites, order = Sites.from_indices(torch.tensor(cells), shape)
        return SparseMap(sites, torch.tensor(values)[order, None])

    fine = stage([[0, 0, 2, 4], [0, 3, 2, 4], [0, 1, 3, 4]], (1, 5, 16, 24), [1.0, 2.0, 4.0])
    coarse = stage([[0, 1, 1, 2], [0, 0, 7, 11]], (1, 3, 8, 12), [8.0, 16.0])
    bev = encoder_of(VOXELS).compress([fine, coarse])
    assert bev.indices.tolist() == [[0, 2, 4], [0, 3, 4], [0, 14, 22]]
    assert bev.features.squeeze(1).tolist() == [11, 4, 16]


def test_conv_out_dilates_only_when_asked() -> None:
    points, batch = radar_points(count=3), torch.zeros(3, dtype=torch.int64)
    kept, grown = encoder_of(PILLARS), encoder_of(replace(PILLARS, conv_out=ConvOut.sparse))
    narrow, wide = kept(points, batch, 1), grown(points, batch, 1)
    reached = nn.functional.max_pool2d(narrow.with_features(torch.ones(len(narrow), 1)).to_dense(), 3, 1, 1)
    assert len(wide) == reached.sum() > len(narrow)


def test_pruning_keeps_every_voxels_own_cell_and_the_parameters() -> None:
    """Down to the BEV cell; the coarser stages dilate as ever."""
    whole, pruned = encoder_of(VOXELS), encoder_of(PRUNED)
    pruned.load_state_dict(whole.state_dict())
    voxels = whole.voxelise(radar_points(), torch.arange(120) % 2, 2)
    counts = []
    for encoder in (whole, pruned):
        stages = encoder.run_stages(voxels)
        counts.append(torch.tensor([len(stage.sites) for stage in stages]))
        for depth in range(1, 4):
            cells = voxels.indices // torch.tensor([1, 2**depth, 2**depth, 2**depth])
            assert (stages[depth].sites.rows_of(cells) >= 0).all()
    assert counts[1][0] == counts[0][0] and (counts[1][1:3] < counts[0][1:3]).all()


@pytest.mark.parametrize(
    ("change", "grid_change", "message"),
    [
        ({"voxel_size_m": [0.3, 0.3, 8.0]}, {}, "divided by a power of two, but the quotient is 2.66667"),
        ({"voxel_size_m": [1.6, 1.6, 8.0]}, {}, "the quotient is 0.5"),
        ({"voxel_size_m": [0.4, 0.4, 3.0]}, {}, "z must divide the height 8 m"),
        ({"voxel_size_m": [0.4, 0.4, 16.0]}, {}, "z must divide the height 8 m"),
        ({"voxel_size_m": [0.1, 0.1, 8.0], "stage_channels": [4, 4]}, {}, "at least 4 stages"),
        ({"stage_channels": [4, 8, 8, 16]}, {}, r"equal from stage 2 on, .* but got \[8, 8, 16\]"),
        (
            {},
            {"cells": (382, 384)},
            r"grid.cells=\[382, 384\]: each must be a multiple of 4, the coarsest stride of "
            "model.radar_encoder in cells",
        ),
        ({"voxel_size_m": [0.4, 0.2, 8.0]}, {}, "x equal to y"),
        ({"stage_channels": []}, {}, "at least one positive width"),
        ({"max_voxels": 0}, {}, "max_voxels=0: must be at least 1"),
        ({"pruning_ratio": 1.5}, {}, r"model.radar_encoder.pruning_ratio=1.5: must lie in \[0, 1\]"),
    ],
)
def test_impossible_settings_are_refused(change: dict, grid_change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RadarEncoder(replace(PILLARS, **change), replace(GRID, **grid_change), 8)
