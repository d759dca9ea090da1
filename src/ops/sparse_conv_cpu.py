"""Sparse convolution on a CPU: in the form and the type that are fastest there."""

from __future__ import annotations

import torch
from torch import Tensor

from src.ops.kernel_map import KernelMap
from src.ops.products import prefers_onednn, product_type
from src.ops.sparse_conv_blocks import blocked_sparse_conv
from src.ops.sparse_conv_tiles import tiled_sparse_conv

LEAST_FILLED_CHANNELS = 26.0
"""Channels of the narrow side times the share of (output, offset) pairs that exist, from which blocks in bfloat16 are
faster than tiles in float32, since few of their products are of zeros. Measured with AMX: equal at 27, 0.6 of the time
at 45 and 52, 1.2 to 1.4 times as long at 15 to 18."""


def cpu_sparse_conv(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """`sparse_conv` in the form of `form_of`."""
    tiles, dtype = form_of(features, weight, kernel_map)
    if tiles:
        return tiled_sparse_conv(features, weight, kernel_map, bias)
    return blocked_sparse_conv(features, weight, kernel_map, bias, dtype)


def form_of(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
) -> tuple[bool, torch.dtype]:
    """Whether tiles are fastest, or blocks, and in which type.

    Tiles where the library takes products of any shape: up to twice as fast as blocks. oneDNN, which multiplies
    bfloat16, and float32 where `prefers_onednn`, makes a program for every shape it meets: there it is blocks.
    """
    dtype = product_type(features, weight.shape[2])
    if dtype != features.dtype and not prefers_onednn():
        places = max(kernel_map.num_offsets * kernel_map.num_outputs, 1)
        if min(weight.shape[1:]) * len(kernel_map.inputs) / places < LEAST_FILLED_CHANNELS:
            dtype = features.dtype
    return dtype.itemsize >= 4 and not prefers_onednn(), dtype
