"""suite=ops: each heavy operation beside GEMM, other libraries and naive implementations, timed in turns."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from src.assembly import build_datamodule, data_root
from src.benchmark.convolutions import (
    backbone_operations,
    layers_of,
    measure_backbone,
    measure_layers,
    remembered_sites,
)
from src.benchmark.machine import measure_roofline
from src.benchmark.naive import SIZES, measure_operations
from src.benchmark.operation_table import OPERATIONS_NOTE
from src.benchmark.page import gpu_notes
from src.benchmark.scenes import highway_points
from src.benchmark.spconv_baseline import load_spconv
from src.config import Config
from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.sparse_voxel import RadarEncoder, RadarEncoderConfig
from src.ops.sites import Sites


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """Tables of sparse convolutions, of the whole radar backbone, and of everything else.

    Raises ConfigError for a model without a sparse radar backbone.
    """
    encoders = [part for part in vars(config.model).values() if isinstance(part, RadarEncoderConfig)]
    if not encoders:
        raise ConfigError(f"suite=ops measures a sparse radar backbone, which model={config.model.name} does not have")
    torch.manual_seed(config.seed)
    device, sizes, grid = config.trainer.device(), SIZES[config.scale], config.grid.build()
    every = torch.get_num_threads()
    threads = sorted({1, every}) if device.type == "cpu" else [every]
    points = highway_points(sizes.road).to(device)
    encoder = RadarEncoder(encoders[0], grid, config.model.channels).to(device)
    with torch.no_grad():
        voxels = encoder.voxelise(points, torch.zeros(len(points), dtype=torch.int64, device=device), 1)
    bev = bev_sites(points, grid, sizes.cells)
    past = remembered_sites(grid, Sites(bev.shape, bev.keys[::4]), sizes.frames)
    layers = layers_of(encoder, voxels, config.model.channels, bev, past)
    config.data.batch_size, config.data.num_workers = 1, 0
    recorded = next(iter(build_datamodule(config, data_root(config)).train_dataloader())).radar_points
    scenes = {"synthetic highway": points.cpu(), f"first frame, {len(recorded)} points": recorded}
    spconv = load_spconv(device)
    return {
        "notes": [
            f"Scale {config.scale}, float32 on {device}; everything but the convolutions on {every} threads. A row's "
            "candidates are timed in turns in one run. Ratios above 1: ours is faster. % of GEMM: the arithmetic's "
            "rate as a share of that of one large matrix product, timed in the same turns. ± is the interquartile "
            "range.",
            "Dense convolution: scatter to the whole grid, torch's convolution, gather; left blank where it does not "
            "fit. Kernel maps are cached on the sites by all (made once for all layers of a stage): `map ms` is ours. "
            "The backbone makes its maps anew. `tiles` or `blocks`: the form that this processor does not take.",
            "spconv: " + ("not installed, so its columns are absent." if spconv is None else spconv_note(device)),
            f"Dense splat: {sizes.splat_subset} of {sizes.gaussians} Gaussians against every cell, time and memory "
            "multiplied; all of them would not fit.",
            OPERATIONS_NOTE,
            *gpu_notes(device),
        ],
        "sparse convolution": measure_layers(layers, device, threads),
        "radar backbone": measure_backbone(encoder, scenes, device, threads),
        **backbone_operations(encoder, points),
        "other operations": measure_operations(config, sizes, grid, points, bev, device),
        "roofline": measure_roofline(device),
    }


def spconv_note(device: torch.device) -> str:
    """What a reader of spconv's numbers must know."""
    if device.type == "cuda":
        return "its own choice of algorithm, float32."
    return (
        "CPU build, `ConvAlgo.Native`. `differs by` is the largest relative difference of outputs and gradients at one "
        "thread. On several threads its gathering shares buffers between threads, so results are wrong at random: "
        "`wrong` counts runs; its times there are of such runs."
    )


def bev_sites(points: Tensor, grid: BEVGrid, number: int) -> Sites:
    """Sites of at most `number` of the cells that hold points or lie beside one that does, evenly picked."""
    cells = grid.cell_of(points[grid.contains(points[:, :2]), :2])
    near = torch.cat([cells + torch.tensor(shift, device=cells.device) for shift in ((0, 0), (0, 1), (1, 0), (1, 1))])
    limit = torch.tensor(grid.cells, device=cells.device)
    near = near[((near >= 0) & (near < limit)).all(1)]
    sites, _ = Sites.unique(torch.cat([torch.zeros_like(near[:, :1]), near], 1), (1, *grid.cells))
    kept = torch.linspace(0, len(sites) - 1, min(number, len(sites)), device=cells.device).long().unique()
    return Sites(sites.shape, sites.keys[kept])
