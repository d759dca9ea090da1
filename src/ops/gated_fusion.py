"""Gated fusion of two sparse branches that never multiplies the zeros of their union (Eq. 11-12)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from src.ops.kernel_maps import makes_tables, stacked_map, submanifold_map
from src.ops.linear import linear
from src.ops.segment_reduce import inverse_rows, permute_rows
from src.ops.sites import Sites, places_among, union
from src.ops.sparse_conv import sparse_conv


def gated_fusion_conv(
    features: tuple[Tensor, Tensor],  # F_G [n_G, C], F_R [n_R, C]
    sites: tuple[Sites, Sites],  # of either, two-dimensional
    gates: Sequence[tuple[Tensor, Tensor]],  # psi_G, psi_R: weight [k * k, 2C, C] and bias [C]
    weight: Tensor,  # [9, 2C, C'] of the 3x3 convolution
    bias: Tensor | None,  # [C']
    shortcut: Tensor,  # [2C, C'] of the 1x1 convolution
) -> tuple[Sites, Tensor, tuple[Tensor, Tensor]]:  # [M, C'], each [M, C']
    """Union of the sites, the convolution of H = [w_G F_G, w_R F_R] on it, and the two addends of H's shortcut.

    w = sigmoid(psi([F_G, F_R])), a branch counting as zero where it has no site. The same as its layers one by one on
    the union, but products exist on a branch's own cells only: the branches are stacked row below row, not side by
    side, and a gate of kernel size 1 is computed where its branch has a site.
    """
    joint, *rows = union(*sites)
    # Row of a branch in each cell of the union, -1 for none.
    if makes_tables(joint):
        places = tuple(places_among(own, joint) for own in sites)
    else:
        places = tuple(inverse_rows(own, len(joint)) for own in rows)
    gated = [x * gate.sigmoid() for x, gate in zip(features, _gates(features, joint, rows, places, gates), strict=True)]
    kernel_map = stacked_map(joint, math.isqrt(len(weight)), places, (len(rows[0]), len(rows[1])))
    convolved = sparse_conv(torch.cat(gated), torch.cat(weight.chunk(2, dim=1)), kernel_map, bias)
    addends = tuple(
        permute_rows(linear(x, matrix), place, own)
        for x, matrix, place, own in zip(gated, shortcut.chunk(2), places, rows, strict=True)
    )
    return joint, convolved, addends


def _gates(
    features: tuple[Tensor, Tensor],
    joint: Sites,
    rows: list[Tensor],  # [n_p] int64, row of each branch's cells in the union
    places: tuple[Tensor, Tensor],  # [M], their inverse
    gates: Sequence[tuple[Tensor, Tensor]],
) -> list[Tensor]:  # [n_p, C]
    """Logits of each branch's gate on its own cells."""
    (gaussian, radar), (place_gaussian, place_radar) = features, places
    kernel_size = math.isqrt(len(gates[0][0]))
    if kernel_size == 1:
        radar_there, gaussian_there = place_radar.index_select(0, rows[0]), place_gaussian.index_select(0, rows[1])
        pairs = (
            torch.cat([gaussian, permute_rows(radar, radar_there, gaussian_there)], dim=1),  # [n_G, 2C]
            torch.cat([permute_rows(gaussian, gaussian_there, radar_there), radar], dim=1),  # [n_R, 2C]
        )
        return [linear(x, weight[0], bias) for x, (weight, bias) in zip(pairs, gates, strict=True)]
    both = torch.cat([permute_rows(*part) for part in zip(features, places, rows, strict=True)], dim=1)  # [M, 2C]
    kernel_map = submanifold_map(joint, kernel_size)
    return [
        sparse_conv(both, weight, kernel_map, bias).index_select(0, own)
        for (weight, bias), own in zip(gates, rows, strict=True)
    ]
