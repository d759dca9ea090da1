"""The late encoder: completion spreads the sites, aggregation mixes them, at four scales (lrs 5.3, 5.4).

Kernels are written (z, row, col), reversing the (x, y, z) of the source.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch.nn.functional as F
from torch import nn

from src.models.layers.sparse import ConvNormReLU, RowBatchNorm, SparseConv, SubmanifoldConv
from src.models.lrs4fusion.measured_motion import MeasuredMotion
from src.ops.site_limit import limit_sites
from src.structures.sparse_bev import SparseMap

NUM_SCALES = 4
FUSED_SCALE = 1
"""Where the memory joins, counting from 0: between completion and aggregation of the second finest (lrs 5.5)."""
SLOPE = 0.01
PLANE, ACROSS_X, ACROSS_Y = (1, 3, 3), (3, 3, 1), (3, 1, 3)
"""Kernels in the xy plane, the yz plane and the xz plane."""
WIDE_PLANE = (1, 5, 5)
COMPLETION = ((PLANE,), (PLANE, ACROSS_Y, ACROSS_X), (PLANE,), (PLANE,))
"""Dilating kernels of each scale: only along xy, but for the second scale."""
Norm = dict[str, float]


class FusionStem(nn.Module):
    """The voxels of all sensors, side by side, to what the late encoder reads (lrs 5.3; the second layer O9)."""

    def __init__(self, in_channels: int, hidden: int, channels: int, norm: Norm) -> None:
        super().__init__()
        self.conv = SubmanifoldConv(in_channels, hidden, 3, 3, bias=False)
        self.norm = nn.LayerNorm(hidden)
        self.reduce = ConvNormReLU(SubmanifoldConv(hidden, channels, 1, 3, bias=False), **norm)

    def forward(self, x: SparseMap) -> SparseMap:
        y = self.conv(x)
        return self.reduce(y.with_features(F.relu(self.norm(y.features))))


class Completion(nn.Module):
    """Dilating convolutions, each with norm and leaky ReLU; no sample has more than `max_sites` sites after any."""

    def __init__(self, channels: int, kernels: Sequence[tuple[int, ...]], max_sites: int, norm: Norm) -> None:
        super().__init__()
        self.max_sites = max_sites
        self.layers = nn.ModuleList(
            ConvNormReLU(SparseConv(channels, channels, kernel, 3, bias=False), **norm, negative_slope=SLOPE)
            for kernel in kernels
        )

    def forward(self, x: SparseMap) -> tuple[SparseMap, int]:
        """The completed map, and how many sites the guard has left out."""
        dropped = 0
        for layer in self.layers:
            kernel_map, reached = layer.conv.map(x.sites)
            kernel_map, sites = limit_sites(kernel_map, x.sites, reached, self.max_sites)
            dropped += len(reached) - len(sites)
            x = layer.activate(layer.conv.convolve(x, kernel_map, sites))
        return x, dropped


class Aggregation3D(nn.Module):
    """Two branches of flat kernels, across each other, summed."""

    def __init__(self, in_channels: int, channels: int, norm: Norm) -> None:
        super().__init__()
        self.branches = nn.ModuleList(
            _pair(in_channels, channels, kernels, False, norm) for kernels in ((PLANE, ACROSS_Y), (ACROSS_X, PLANE))
        )

    def forward(self, x: SparseMap) -> SparseMap:
        a, b = (branch(x) for branch in self.branches)
        return a.with_features(a.features + b.features)


class SparseConvNorm(nn.Module):
    """A submanifold convolution and batch norm."""

    norm_pairs = (("conv", "norm"),)

    def __init__(self, conv: SubmanifoldConv, norm: Norm) -> None:
        super().__init__()
        self.conv = conv
        self.norm = RowBatchNorm(conv.out_channels, **norm)

    def forward(self, x: SparseMap) -> SparseMap:
        y = self.conv(x)
        return y.with_features(self.norm(y.features))


@dataclass
class Volumes:
    """The multi-scale volume of B frames: features on sparse voxels, the finest scale first."""

    scales: tuple[SparseMap, ...]  # V1 .. V4
    dropped: tuple[int, ...]  # sites that the guard of each scale has left out, over all samples
    measured: MeasuredMotion | None = None  # of FUSED_SCALE; None: all rests


class LateEncoder(nn.Module):
    """A sparse map of the finest scale to V1 .. V4; V_l is the aggregation's output before it is pooled."""

    def __init__(self, in_channels: int, channels: Sequence[int], max_sites: Sequence[int], norm: Norm) -> None:
        super().__init__()
        widths = [in_channels, *channels]
        self.completions, self.aggregations = nn.ModuleList(), nn.ModuleList()
        for scale, (before, after) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            self.completions.append(Completion(before, COMPLETION[scale], max_sites[scale], norm))
            if scale <= FUSED_SCALE:
                self.aggregations.append(Aggregation3D(before, after, norm))
            else:
                self.aggregations.append(_pair(before, after, (WIDE_PLANE, WIDE_PLANE), True, norm))
        self.pools = nn.ModuleList(SparseConv(width, width, 3, 3, bias=False, stride=2) for width in channels[:-1])
        self.last = SubmanifoldConv(channels[-1], channels[-1], 1, 3, bias=False)  # in a pool's place, part of V4

    def forward(
        self,
        x: SparseMap,  # on (B, z, y, x)
        fuse: Callable[[SparseMap], SparseMap] = lambda current: current,  # with the memory, at the second scale
    ) -> Volumes:
        scales, dropped = [], []
        for scale, (complete, aggregate) in enumerate(zip(self.completions, self.aggregations, strict=True)):
            x, left_out = complete(x)
            x = aggregate(fuse(x) if scale == FUSED_SCALE else x)
            scales.append(x if scale < len(self.pools) else self.last(x))
            dropped.append(left_out)
            if scale < len(self.pools):
                x = self.pools[scale](x)
        return Volumes(tuple(scales), tuple(dropped))


def _pair(in_channels: int, channels: int, kernels: Sequence[tuple[int, ...]], bias: bool, norm: Norm) -> nn.Sequential:
    """Convolution, norm, leaky ReLU, convolution, norm."""
    first, second = kernels
    return nn.Sequential(
        ConvNormReLU(SubmanifoldConv(in_channels, in_channels, first, 3, bias=bias), **norm, negative_slope=SLOPE),
        SparseConvNorm(SubmanifoldConv(in_channels, channels, second, 3, bias=bias), norm),
    )
