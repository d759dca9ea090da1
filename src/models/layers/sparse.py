"""Layers on sparse maps of two or three dimensions: convolutions, batch norm over the active cells, residual blocks."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.norm import normalize
from src.ops.kernel_maps import (
    KernelMap,
    Size,
    inverse_map,
    per_axis,
    pruned_map,
    strided_map,
    submanifold_map,
    temporal_map,
)
from src.ops.linear import linear
from src.ops.segment_reduce import rank_per_sample, segment_count
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv, sparse_conv_relu
from src.structures.sparse_bev import SparseMap


class SparseKernel(nn.Module):
    """A sparse convolution; weight and bias are drawn like those of torch's dense one.

    `weight` is [K, in, out], its K offsets in C order over the kernel axes (z, row, col). Sizes are one number, or one
    for each axis.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: Size,
        ndim: int,
        bias: bool,
        stride: Size = 1,
    ) -> None:
        super().__init__()
        self.in_channels, self.out_channels = in_channels, out_channels
        self.kernel_size, self.ndim = per_axis(kernel_size, ndim, "kernel_size"), ndim
        self.stride = stride
        self.padding = tuple(size // 2 for size in self.kernel_size)
        self.relu = False  # of the layer behind, once that is merged into this one
        num_offsets = math.prod(self.kernel_size)
        self.weight = nn.Parameter(torch.empty(num_offsets, in_channels, out_channels))
        self.bias = nn.Parameter(torch.empty(out_channels)) if bias else None
        bound = 1 / math.sqrt(num_offsets * in_channels)
        nn.init.uniform_(self.weight, -bound, bound)
        if self.bias is not None:
            nn.init.uniform_(self.bias, -bound, bound)

    def map(self, sites: Sites) -> tuple[KernelMap, Sites]:
        """The kernel map and the sites of the output, cached on the sites."""
        raise NotImplementedError

    def forward(self, x: SparseMap) -> SparseMap:
        return self.convolve(x, *self.map(x.sites))

    def convolve(self, x: SparseMap, kernel_map: KernelMap, sites: Sites) -> SparseMap:
        """Convolve to the given sites through a kernel map from those of `x`; prepared for inference with its ReLU."""
        convolve = sparse_conv_relu if self.relu else sparse_conv
        return type(x)(sites, convolve(x.features, self.weight, kernel_map, self.bias))

    def extra_repr(self) -> str:
        """Sizes for the printed module."""
        return f"{self.in_channels}, {self.out_channels}, kernel_size={self.kernel_size}, ndim={self.ndim}"


class SubmanifoldConv(SparseKernel):
    """Convolution whose output sites are its input sites."""

    def map(self, sites: Sites) -> tuple[KernelMap, Sites]:
        return submanifold_map(sites, self.kernel_size), sites


class SparseConv(SparseKernel):
    """Convolution with an output at every cell that some input site reaches; at stride 1 it dilates the map."""

    def map(self, sites: Sites) -> tuple[KernelMap, Sites]:
        return strided_map(sites, self.kernel_size, self.stride, self.padding)


class PrunedSparseConv(SparseConv):
    """A `SparseConv` that only part of its input dilates (VoxelNeXt 3.1: spatially voxel pruning).

    Of every sample the `pruning_ratio` of the sites with the smallest mean magnitude over the channels, rounded down,
    reach no cell but their own; ties by row.
    """

    def __init__(self, *arguments: Any, pruning_ratio: float, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.pruning_ratio = pruning_ratio

    def forward(self, x: SparseMap) -> SparseMap:
        sample = x.sites.indices()[:, 0]
        order, rank = rank_per_sample(x.features.detach().abs().mean(1), sample)
        counts = segment_count(sample, x.batch_size + 1)  # one for padding
        most = counts - (self.pruning_ratio * counts.double()).long()  # [B + 1]
        wide = torch.empty_like(sample, dtype=torch.bool).index_copy_(0, order, rank < most[sample[order]])
        return self.convolve(x, *pruned_map(x.sites, wide, self.kernel_size, self.stride, self.padding))


class SparseInverseConv(SparseKernel):
    """Convolution back to the sites that a `SparseConv` of the same kernel, stride and padding started from.

    As a transposed convolution of the dense grid, read at those sites.
    """

    def forward(
        self,
        x: SparseMap,
        sites: Sites,  # the finer ones; their strided map, cached since the way down, is read backwards
    ) -> SparseMap:
        return self.convolve(x, inverse_map(sites, x.sites, self.kernel_size, self.stride, self.padding), sites)


class TemporalConv(SparseKernel):
    """3x3x3 convolution over (t, y, x) that halves the time axis and, unless dilating, keeps to occupied columns."""

    def __init__(self, in_channels: int, out_channels: int, dilating: bool) -> None:
        super().__init__(in_channels, out_channels, kernel_size=3, ndim=3, bias=False, stride=(2, 1, 1))
        self.dilating = dilating

    def map(self, sites: Sites) -> tuple[KernelMap, Sites]:
        build = strided_map if self.dilating else temporal_map
        return build(sites, self.kernel_size, self.stride, self.padding)


class RowBatchNorm(nn.BatchNorm1d):
    """Batch norm over the rows of all samples; fewer than two rows carry no statistics, so running ones serve them."""

    def forward(
        self,
        x: Tensor,  # [M, C]
    ) -> Tensor:  # [M, C]
        if len(x) == 0:
            return x * self.weight + self.bias  # keeps the parameters in the graph, which DDP expects on every rank
        if self.training and len(x) < 2:
            return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, False, 0.0, self.eps)
        return normalize(self, x)


class LinearNormReLU(nn.Module):
    """Linear, batch norm and ReLU on rows."""

    norm_pairs = (("linear", "norm"),)

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.linear = nn.Linear(in_channels, out_channels, bias=False)
        self.norm = RowBatchNorm(out_channels)

    def forward(
        self,
        x: Tensor,  # [n, C]
    ) -> Tensor:  # [n, C']
        return F.relu(self.norm(linear(x, self.linear.weight.t(), self.linear.bias)))


class ConvNormReLU(nn.Module):
    """A sparse convolution, batch norm and ReLU, leaky if it has a slope below zero."""

    norm_pairs = (("conv", "norm"),)

    def __init__(self, conv: SparseKernel, eps: float, momentum: float, negative_slope: float = 0.0) -> None:
        super().__init__()
        self.conv, self.negative_slope = conv, negative_slope
        self.norm = RowBatchNorm(conv.out_channels, eps=eps, momentum=momentum)

    def forward(
        self,
        x: SparseMap,
        *sites: Sites,  # those of the output, where the convolution asks for them
    ) -> SparseMap:
        y = self.conv(x, *sites)
        return y if self.conv.relu else self.activate(y)

    def merge_for_inference(self) -> None:
        """The convolution applies the ReLU."""
        self.conv.relu = not self.negative_slope

    def activate(self, y: SparseMap) -> SparseMap:
        """Norm and activation of what the convolution gave."""
        features = self.norm(y.features)
        if self.negative_slope:
            return y.with_features(F.leaky_relu(features, self.negative_slope, inplace=True))
        return y.with_features(F.relu(features, inplace=True))


class ResidualBlock(nn.Module):
    """Two submanifold convolutions with bias and norm around an identity (method 2)."""

    norm_pairs = (("conv1", "bn1"), ("conv2", "bn2"))

    def __init__(self, channels: int, ndim: int, eps: float, momentum: float) -> None:
        super().__init__()
        self.conv1 = SubmanifoldConv(channels, channels, 3, ndim, bias=True)
        self.bn1 = RowBatchNorm(channels, eps=eps, momentum=momentum)
        self.conv2 = SubmanifoldConv(channels, channels, 3, ndim, bias=True)
        self.bn2 = RowBatchNorm(channels, eps=eps, momentum=momentum)

    def merge_for_inference(self) -> None:
        """The convolutions apply the ReLUs and add the identity."""
        self.conv1.relu = True

    def forward(self, x: SparseMap) -> SparseMap:
        y = self.conv1(x)
        if self.conv1.relu:
            conv, kernel_map = self.conv2, self.conv2.map(x.sites)[0]
            return x.with_features(sparse_conv_relu(y.features, conv.weight, kernel_map, conv.bias, x.features))
        y = self.conv2(y.with_features(F.relu(self.bn1(y.features), inplace=True)))
        return x.with_features(F.relu(self.bn2(y.features).add_(x.features), inplace=True))
