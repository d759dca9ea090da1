"""Attention of every site to the sites of another set in the window around it."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from src.ops.kernel_map import KernelMap
from src.ops.segment_reduce import segment_sum


def window_attention(
    queries: Tensor,  # [M_out, H, D]
    keys: Tensor,  # [M_in, H, D]
    values: Tensor,  # [M_in, H, D]
    window: KernelMap,
) -> Tensor:  # [M_out, H, D]
    """softmax(q k / sqrt(D)) v in every of H heads over the pairs of a kernel map; zeros where a window is empty."""
    heads, width = queries.shape[1:]
    inputs, outputs = window.inputs.long(), window.outputs.long()

    def gathered(rows: Tensor, table: Tensor) -> Tensor:  # [pairs, H, D]
        return F.embedding(rows, table.flatten(1)).view(-1, heads, width)

    scores = (gathered(outputs, queries) * gathered(inputs, keys)).sum(2) / math.sqrt(width)  # [pairs, H]
    with torch.no_grad():  # softmax does not change with what is subtracted
        index = outputs[:, None].expand_as(scores)
        highest = scores.new_zeros(len(queries), heads).scatter_reduce(0, index, scores, "amax", include_self=False)
    weights = (scores - highest[outputs]).exp()
    summed = segment_sum((weights[..., None] * gathered(inputs, values)).flatten(1), outputs, len(queries))
    total = segment_sum(weights, outputs, len(queries)).clamp(min=torch.finfo(weights.dtype).tiny)
    return summed.view(-1, heads, width) / total[..., None]
