"""Sparse convolutions layer by layer, and the whole radar backbone, beside GEMM, dense convolution and spconv."""

from __future__ import annotations

import copy
import logging
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.benchmark import set_torch_threads

from src.benchmark.counting import counted_work
from src.benchmark.machine import Gemm
from src.benchmark.operation_table import operation_table
from src.benchmark.spconv_baseline import (
    build_layer,
    largest_difference,
    load_spconv,
    sorted_map,
    sparse_tensor,
    spconv_encoder,
)
from src.benchmark.timing import MODES, added_mib, clock, interleaved, ratio_columns
from src.geometry.bev_grid import BEVGrid
from src.models.backbones.sparse_voxel import RadarEncoder
from src.models.layers.sparse import SparseConv, SparseKernel, SubmanifoldConv, TemporalConv
from src.ops.kernel_map import KernelMap
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv
from src.ops.sparse_conv_blocks import blocked_sparse_conv
from src.ops.sparse_conv_cpu import form_of
from src.ops.sparse_conv_tiles import tiled_sparse_conv
from src.structures.sparse_bev import SparseMap

logger = logging.getLogger(__name__)

ROUNDS = 7
LAYER_BUDGET_S, BACKBONE_BUDGET_S = 4.0, 20.0  # of each candidate; what takes longer has fewer rounds
DENSE_LIMIT_BYTES = 2**31  # of the dense input and output together; larger grids have no dense baseline
DENSE_LIMIT_FLOPS = 1.5e12  # a quarter of a minute on two cores
AGREEMENT = 1e-5  # of outputs and gradients, relative to the largest; float32 sums in another order
SPCONV_TRIALS = 6  # runs on several threads that are checked for spconv's race


@dataclass
class Layer:
    """One convolution on a set of sites."""

    name: str
    sites: Sites
    kernel: SparseKernel

    @property
    def temporal(self) -> bool:
        """Whether time shortens without spreading over the plane, which no baseline offers."""
        return isinstance(self.kernel, TemporalConv)


def layers_of(
    encoder: RadarEncoder,
    voxels: SparseMap,
    channels: int,
    bev_sites: Sites,  # of a sparse BEV map
    past_sites: Sites,  # [B, T, rows, cols] of remembered cells
) -> list[Layer]:
    """Layers as the models have them: those of the backbone's stages, of the BEV map, and over time."""
    layers: list[Layer] = []
    with torch.no_grad():
        stages = encoder.eval().run_stages(voxels)
    previous = voxels.sites
    for number, stage in enumerate(stages):
        ndim, width = stage.sites.ndim, stage.channels
        if number and number == encoder.bev_stage:
            narrow = stages[number - 1].channels
            down = SparseConv(narrow, width, 3, ndim, bias=False, stride=2)
            name = f"stage {number + 1} stride 2, {narrow} to {width} channels"
            layers.append(Layer(name, previous, down))
        subm = SubmanifoldConv(width, width, 3, ndim, bias=False)
        layers.append(Layer(f"stage {number + 1} submanifold {ndim}D, {width} channels", stage.sites, subm))
        previous = stage.sites
    flat = SubmanifoldConv(channels, channels, 3, 2, bias=False)
    layers.append(Layer(f"BEV submanifold 2D, {channels} channels", bev_sites, flat))
    cube = SubmanifoldConv(channels, channels, 3, 3, bias=False)
    layers.append(Layer(f"time submanifold (t, y, x), {channels} channels", past_sites, cube))
    halving = SparseConv(channels, channels, 3, 3, bias=False, stride=(2, 1, 1))
    layers.append(Layer(f"time stride (2, 1, 1), {channels} channels", past_sites, halving))
    kept = TemporalConv(channels, channels, dilating=False)
    name = f"time stride (2, 1, 1) on occupied columns, {channels} channels"
    layers.append(Layer(name, past_sites, kept))
    return layers


def measure_layers(layers: list[Layer], device: torch.device, threads: list[int]) -> list[dict[str, Any]]:
    """Rows of all layers at every number of threads."""
    spconv, gemm = load_spconv(device), Gemm(device)
    rows = []
    for layer in layers:
        logger.info("%s", layer.name)
        layer.kernel.to(device)
        for number in threads:
            with set_torch_threads(number):
                rows += measure_layer(layer, spconv, device, gemm, number)
    return rows


def measure_layer(
    layer: Layer, spconv: ModuleType | None, device: torch.device, gemm: Gemm, threads: int
) -> list[dict[str, Any]]:
    """Forward, and forward with both gradients; kernel maps of all are made before, ours timed by themselves."""
    kernel_map, out_sites = layer.kernel.map(layer.sites)
    features = torch.randn(len(layer.sites), layer.kernel.in_channels, device=device, requires_grad=True)
    weight = layer.kernel.weight
    flops = 2 * len(kernel_map.inputs) * layer.kernel.in_channels * layer.kernel.out_channels
    functions: dict[str, Callable[[], Tensor]] = {"ours": lambda: sparse_conv(features, weight, kernel_map)}
    leaves: dict[str, list[Tensor]] = {"ours": [features, weight]}
    if device.type == "cpu":
        name, convolve = other_form(features, weight, kernel_map)
        functions[name] = lambda: convolve(features, weight, kernel_map, None)
        leaves[name] = [features, weight]
    if spconv is not None and not layer.temporal:
        baseline = build_layer(spconv, layer.kernel, "pairs").to(device)
        empty = sparse_tensor(spconv, SparseMap(layer.sites, features))
        baseline(empty)  # fills the tensor's rulebook
        order = Sites.from_indices(baseline(empty).indices.long(), out_sites.shape)[1]
        functions["spconv"] = lambda: baseline(empty.replace_feature(features)).features
        leaves["spconv"] = [features, baseline.weight]
    if fits_dense(layer, out_sites):
        functions["dense"] = lambda: dense_convolution(layer, features, out_sites)
        leaves["dense"] = [features, weight]

    gradient = torch.randn(kernel_map.num_outputs, layer.kernel.out_channels, device=device)
    both = {
        name: lambda name=name: torch.autograd.grad(functions[name](), leaves[name], gradient) for name in functions
    }
    agreement: dict[str, Any] = {}
    if "spconv" in functions:
        turned = torch.zeros_like(gradient).index_copy(0, order, gradient)
        both["spconv"] = lambda: torch.autograd.grad(functions["spconv"](), leaves["spconv"], turned)
        if threads == 1 or device.type == "cuda":
            agreement["spconv differs by"] = spconv_difference(functions, both, order)
        else:
            reference = sparse_conv(features, weight, kernel_map).detach()
            runs = (functions["spconv"]().detach().index_select(0, order) for _ in range(SPCONV_TRIALS))
            wrong = sum(largest_difference([reference], [run]) > AGREEMENT for run in runs)
            agreement["spconv wrong"] = f"{wrong} of {SPCONV_TRIALS}"
    forward = {name: torch.no_grad()(function) for name, function in functions.items()}
    forward["map"] = lambda: layer.kernel.map(Sites(layer.sites.shape, layer.sites.keys))
    rows = []
    for mode, candidates, times in (("forward", forward, 1), ("f+b", both, 3)):
        seconds = interleaved(candidates | {"GEMM": gemm}, clock(device), ROUNDS, LAYER_BUDGET_S)
        sizes = {"sites": len(layer.sites), "outputs": len(out_sites), "pairs": len(kernel_map.inputs)}
        row = {"layer": layer.name, "mode": mode, "threads": threads}
        maps = seconds.pop("map", None)
        row |= rate_columns(seconds, times * flops, gemm)
        row |= {"map ms": 1e3 * statistics.median(maps)} if maps else {}
        rows.append(row | agreement | sizes)
    return rows


def other_form(features: Tensor, weight: Tensor, kernel_map: KernelMap) -> tuple[str, Callable[..., Tensor]]:
    """The form of the convolution that a CPU does not take, so that a page shows where the choice is wrong."""
    tiles, dtype = form_of(features, weight, kernel_map)
    return ("blocks", partial(blocked_sparse_conv, dtype=dtype)) if tiles else ("tiles", tiled_sparse_conv)


def rate_columns(seconds: dict[str, list[float]], flops: float, gemm: Gemm) -> dict[str, float]:
    """Ours as a share of the GEMM rate beside it, and beside its baselines."""
    rate = gemm.flops / statistics.median(seconds.pop("GEMM"))
    share = 100 * flops / statistics.median(seconds["ours"]) / rate
    return {"% of GEMM": share, **ratio_columns(seconds), "GEMM GFLOP/s": rate / 1e9}


def spconv_difference(
    functions: dict[str, Callable[[], Tensor]],
    both: dict[str, Callable[[], tuple[Tensor, ...]]],
    order: Tensor,
) -> float:
    """Largest relative difference of outputs and of both gradients."""
    ours, theirs = both["ours"](), both["spconv"]()
    cube = theirs[1].permute(*range(1, theirs[1].dim()), 0)  # [out, *k, in] -> [*k, in, out]
    outputs = functions["ours"](), functions["spconv"]().index_select(0, order)
    return largest_difference([outputs[0], *ours], [outputs[1], theirs[0], cube.reshape(ours[1].shape)])


def fits_dense(layer: Layer, out_sites: Sites) -> bool:
    """Whether the dense convolution has room and ends in time."""
    cells = [torch.Size(sites.shape).numel() for sites in (layer.sites, out_sites)]
    kernel = layer.kernel
    room = 4 * (cells[0] * kernel.in_channels + cells[1] * kernel.out_channels)
    flops = 2 * cells[1] * kernel.in_channels * kernel.out_channels * len(kernel.weight)
    return not layer.temporal and room <= DENSE_LIMIT_BYTES and flops <= DENSE_LIMIT_FLOPS


def dense_convolution(layer: Layer, features: Tensor, out_sites: Sites) -> Tensor:  # [M_out, Cout]
    """All cells: scatter the features, convolve the whole grid, take the cells that ours computes."""
    kernel, ndim = layer.kernel, layer.kernel.ndim
    grid = SparseMap(layer.sites, features).to_dense()
    cube = kernel.weight.view(*kernel.kernel_size, *kernel.weight.shape[1:])
    convolve = F.conv2d if ndim == 2 else F.conv3d
    dense = convolve(grid, cube.permute(-1, -2, *range(ndim)), stride=kernel.stride, padding=kernel.padding)
    return dense.movedim(1, -1).flatten(0, -2).index_select(0, out_sites.linear())


# ---------------------------------------------------------------- the whole backbone


def measure_backbone(
    encoder: RadarEncoder,
    scenes: dict[str, Tensor],  # by name the radar points [P, 7] of one frame
    device: torch.device,
    threads: list[int],
) -> list[dict[str, Any]]:
    """Rows by scene, mode and threads; kernel maps are made anew every time, batch norm uses the batch."""
    spconv, gemm = load_spconv(device), Gemm(device)
    encoder = copy.deepcopy(encoder).train()
    encoder.local_means = None  # spconv has no counterpart, and it is not part of the backbone
    rows = []
    for name, points in scenes.items():
        logger.info("backbone, %s", name)
        points = points.to(device)
        with torch.no_grad():
            voxels = encoder.voxelise(points, torch.zeros(len(points), dtype=torch.int64, device=device), 1)

        def ours(sites: Sites = voxels.sites, features: Tensor = voxels.features) -> Tensor:
            return encoder.encode(SparseMap(Sites(sites.shape, sites.keys), features)).features

        functions: dict[str, Callable[[], Tensor]] = {"ours": ours}
        if spconv is not None:
            twin = spconv_encoder(spconv, encoder)
            functions["spconv"] = lambda v=voxels, twin=twin: sorted_map(twin.encode(v).tensor).features
        for count in threads:
            with set_torch_threads(count):
                found = _backbone_rows(functions, device, gemm, count)
            rows += [{"scene": name, **row, "voxels": len(voxels)} for row in found]
    return rows


def _backbone_rows(
    functions: dict[str, Callable[[], Tensor]], device: torch.device, gemm: Gemm, threads: int
) -> list[dict[str, Any]]:
    agreement = {}
    if "spconv" in functions and threads == 1:
        with torch.no_grad():
            agreement["spconv differs by"] = largest_difference([functions["ours"]()], [functions["spconv"]()])
    rows = []
    for mode, wrap in MODES.items():
        candidates = {kind: wrap(function) for kind, function in functions.items()}
        with counted_work() as work:
            candidates["ours"]()
        seconds = interleaved(candidates | {"GEMM": gemm}, clock(device), ROUNDS, BACKBONE_BUDGET_S)
        row = {"mode": mode, "threads": threads} | rate_columns(seconds, work.flops, gemm)
        row |= {"GFLOP": work.flops / 1e9}
        row |= {f"{kind} added MiB": added_mib(function, device) for kind, function in candidates.items()}
        rows.append(row | agreement)
    return rows


def backbone_operations(encoder: RadarEncoder, points: Tensor) -> dict[str, list[dict[str, Any]]]:
    """Where the time of our backbone goes, by mode, as `operation_table` has it."""
    encoder = copy.deepcopy(encoder).train()
    owners = torch.zeros(len(points), dtype=torch.int64, device=points.device)

    def run() -> Tensor:
        return encoder(points, owners, 1).features

    return {
        f"operations of the backbone, {mode}": operation_table(wrap(run), points.device) for mode, wrap in MODES.items()
    }


def remembered_sites(grid: BEVGrid, bev: Sites, frames: int) -> Sites:
    """The cells of a map, moved by a few cells from frame to frame as traffic is: [1, T, rows, cols]."""
    cells = bev.indices()
    parts = []
    for age in range(frames):
        col = (cells[:, 2] + 7 * age * (1 - 2 * (cells[:, 1] % 2))) % grid.cols  # both directions of travel
        parts.append(torch.stack([cells[:, 0], torch.full_like(col, age), cells[:, 1], col], 1))
    return Sites.unique(torch.cat(parts), (1, frames, grid.rows, grid.cols))[0]
