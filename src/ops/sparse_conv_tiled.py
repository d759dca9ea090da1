"""Sparse convolution tile by tile on a CPU, with every temporary in reused memory that fits the cache."""

from __future__ import annotations

import threading

import torch
from torch import Tensor

from src.ops.kernel_maps import KernelMap
from src.ops.segment_reduce import gather_segment_sum
from src.ops.sparse_conv_function import SparseConvFunction
from src.ops.tiled_rulebook import tiled_rulebook


def tiled_sparse_conv(
    features: Tensor,  # [M_in, Cin]
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    bias: Tensor | None,  # [Cout]
) -> Tensor:  # [M_out, Cout]
    """`sparse_conv` as gather, one product per offset and segment sum within each tile of the rulebook."""
    return SparseConvFunction.apply(features, weight, bias, kernel_map, _forward, _gradients)


def _forward(features: Tensor, weight: Tensor, bias: Tensor | None, kernel_map: KernelMap) -> Tensor:
    out, _ = _convolve(features, weight, kernel_map, backward=False)
    return out if bias is None else out.add_(bias)


def _gradients(
    features: Tensor, weight: Tensor, grad: Tensor, kernel_map: KernelMap, needed: list[bool]
) -> tuple[Tensor, Tensor | None]:
    return _convolve(grad, weight, kernel_map, backward=True, others=features if needed[1] else None)


def _convolve(
    rows: Tensor,  # [n, Ca] features, or backward the gradient of the output
    weight: Tensor,  # [K, Cin, Cout]
    kernel_map: KernelMap,
    backward: bool,
    others: Tensor | None = None,  # [m, Cin] the features, if backward is to make the gradient of the weight
) -> tuple[Tensor, Tensor | None]:  # [m, Cb], [K, Cin, Cout]
    """The convolution, or both its gradients: backward, a tile's gathered rows serve the features and the weight."""
    num = kernel_map.num_inputs if backward else kernel_map.num_outputs
    matrices = (weight.transpose(1, 2) if backward else weight).unbind(0)
    width_in, width = matrices[0].shape
    # Sums over tiles in float32 at least: half precision would swallow the last ones.
    full = torch.promote_types(weight.dtype, torch.float32)
    grad_weight = None if others is None else torch.zeros_like(weight, dtype=full)
    gradients = () if grad_weight is None else grad_weight.unbind(0)
    centre = kernel_map.centre
    if centre is None:
        out = rows.new_empty(num, width)
    else:
        out = torch.mm(rows, matrices[centre])
        if others is not None:
            gradients[centre].add_(torch.mm(others.t(), rows))
    if backward and kernel_map.mirrored:  # the tiles are those of the forward pass
        matrices, gradients = matrices[::-1], gradients[::-1]
    rulebook = tiled_rulebook(kernel_map, backward, width_in + width, rows.dtype)
    gathered_rows = scratch("gathered", rulebook.most_pairs, width_in, rows.dtype, rows.device)
    products = scratch("products", rulebook.most_pairs, width, rows.dtype, rows.device)
    for tile in rulebook.tiles:
        gathered = torch.index_select(rows, 0, tile.gathered, out=gathered_rows[: len(tile.gathered)])
        for offset, first, last in tile.spans:
            torch.mm(gathered[first:last], matrices[offset], out=products[first:last])
        sums = gather_segment_sum(products, tile.order, tile.starts)
        block = out[tile.first : tile.last]
        if centre is None:
            block.copy_(sums)
        else:
            block.add_(sums)
        if others is not None:
            partners = torch.index_select(others, 0, tile.summed, out=products[: len(tile.summed)])
            for offset, first, last in tile.spans:
                product = torch.mm(partners[first:last].t(), gathered[first:last])  # addmm_ is slow in bfloat16
                gradients[offset].add_(product)
    return out, None if grad_weight is None else grad_weight.to(weight.dtype)


class _Scratch(threading.local):
    """Memory that every convolution of a thread uses again: fresh memory costs a page fault for every 4 KiB."""

    def __init__(self) -> None:
        self.blocks: dict[tuple[str, torch.device], Tensor] = {}


_scratch = _Scratch()


def scratch(
    name: str,
    rows: int,
    columns: int,
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor:  # [rows, columns]
    """Memory with arbitrary content; the same name gives the same memory again."""
    size = rows * columns * dtype.itemsize
    block = _scratch.blocks.get((name, device))
    if block is None or len(block) < size:
        with torch.inference_mode(False):  # or training could not use it after an evaluation
            block = _scratch.blocks[name, device] = torch.empty(size, dtype=torch.uint8, device=device)
    return block[:size].view(dtype).view(rows, columns)


def release_scratch() -> None:
    """Free the calling thread's reused memory; the next convolution allocates it anew."""
    _scratch.blocks.clear()
