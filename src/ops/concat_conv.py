"""Convolution of several maps side by side as channels, without their concatenation."""

from __future__ import annotations

from collections.abc import Iterable

from torch import Tensor

from src.ops.map_conv import map_conv2d


def concat_conv2d(
    maps: Iterable[Tensor],  # of [B, C_i, h, w]
    weight: Tensor,  # [C', sum of C_i and of the missing maps, 1, 1]
    bias: Tensor | None,  # [C']
) -> Tensor:  # [B, C', h, w] of the first map's type
    """F.conv2d(torch.cat(maps, dim=1), weight, bias), maps that are missing at the end counting as zeros.

    It is the sum of the convolutions of the single maps with their slices of the weight: one map is held at a time, and
    a missing one costs nothing. Raises ValueError without a map, and for maps of more channels than the weight's.
    """
    maps = iter(maps)
    first = next(maps, None)
    if first is None:
        raise ValueError("maps: expected at least one")
    end = first.shape[1]
    total = map_conv2d(first, weight[:, :end], bias)
    for part in maps:
        start, end = end, end + part.shape[1]
        if end > weight.shape[1]:
            raise ValueError(f"maps: expected at most {weight.shape[1]} channels, but got {end}")
        total = total + map_conv2d(part.to(first.dtype), weight[:, start:end])
    return total
