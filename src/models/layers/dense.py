"""Convolutions of images, and layers on whole BEV maps [B, C, rows, cols] with channels last in memory."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.norm import MapBatchNorm
from src.ops.map_conv import conv2d, map_conv2d
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV


class Conv2d(nn.Conv2d):
    """A convolution by `conv2d`, neither dilated nor grouped, with one stride and padding."""

    def forward(
        self,
        x: Tensor,  # [M, C, H, W]
    ) -> Tensor:  # [M, C', H', W']
        return conv2d(x, self.weight, self.bias, self.stride[0], self.padding[0])


class MapConv2d(nn.Conv2d):
    """A convolution padded by half its kernel, so that it keeps or divides the size, by `map_conv2d`."""

    def forward(
        self,
        x: Tensor,  # [B, C, H, W]
    ) -> Tensor:  # [B, C', H / stride, W / stride]
        return map_conv2d(x, self.weight, self.bias, self.stride[0])


class DenseConvNormReLU(nn.Module):
    """A convolution that keeps or divides the size, batch norm and ReLU."""

    norm_pairs = (("conv", "norm"),)

    def __init__(
        self, in_channels: int, out_channels: int, kernel_size: int, stride: int = 1, bias: bool = False
    ) -> None:
        super().__init__()
        self.conv = MapConv2d(in_channels, out_channels, kernel_size, stride, kernel_size // 2, bias=bias)
        self.norm = MapBatchNorm(out_channels)

    def forward(
        self,
        x: Tensor,  # [B, C, H, W]
    ) -> Tensor:  # [B, C', H / stride, W / stride]
        return F.relu(self.norm(self.conv(x)), inplace=True)


class DenseToSparse(nn.Module):
    """A whole map as a sparse one whose sites are all cells, for what works on sites; no copy where channels are last.

    The sites of the last batch size are kept, since they never change.
    """

    def __init__(self) -> None:
        super().__init__()
        self._sites: Sites | None = None

    def forward(
        self,
        x: Tensor,  # [B, C, rows, cols]
    ) -> SparseBEV:
        return SparseBEV(self.sites(x), rows_of_map(x))

    def sites(
        self,
        x: Tensor,  # [B, C, rows, cols]
    ) -> Sites:
        """Every cell of the B maps."""
        shape = (x.shape[0], x.shape[2], x.shape[3])
        if self._sites is None or self._sites.shape != shape or self._sites.device != x.device:
            with torch.inference_mode(False):  # made in a validation, they must still serve a backward pass
                cells = torch.arange(torch.Size(shape).numel(), device=x.device)
                self._sites = Sites.from_linear(cells, shape)
                self._sites.indices()
        return self._sites


def rows_of_map(
    x: Tensor,  # [B, C, rows, cols]
) -> Tensor:  # [B * rows * cols, C]
    """One row per cell, in the order of linear keys; a view where channels are last in memory."""
    return x.permute(0, 2, 3, 1).reshape(-1, x.shape[1])


def map_of_rows(
    rows: Tensor,  # [B * rows * cols, C]
    shape: tuple[int, int, int],  # (B, rows, cols)
) -> Tensor:  # [B, C, rows, cols], channels last in memory
    """The map whose cells these are; a view."""
    return rows.view(*shape, rows.shape[1]).permute(0, 3, 1, 2)
