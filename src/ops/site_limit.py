"""A guard on the number of sites that a dilating convolution makes (lrs 5.4, 13)."""

from __future__ import annotations

from src.ops.kernel_map import KernelMap
from src.ops.segment_reduce import rank_per_sample, segment_count
from src.ops.sites import Sites, rows_of_keys


def limit_sites(
    kernel_map: KernelMap,  # from `before` to `after`, of stride 1
    before: Sites,
    after: Sites,
    limit: int,
) -> tuple[KernelMap, Sites]:
    """The map to at most `limit` of its output sites per sample, and these; the given ones where they are no more.

    First stay those that were there before, then those that the most input sites reach; on ties the lowest index.
    Raises ValueError when the two sets lie on different grids.
    """
    if before.shape != after.shape:
        raise ValueError(f"a limit on added sites needs one grid, but got shapes {before.shape} and {after.shape}")
    if len(after) <= limit:
        return kernel_map, after
    scores = segment_count(kernel_map.outputs.long(), len(after))  # at most one pair an offset
    scores = scores + kernel_map.num_offsets * (rows_of_keys(before.keys, after.keys) >= 0)
    order, rank = rank_per_sample(scores, after.indices()[:, 0])
    kept = order[rank < limit].sort().values
    if len(kept) == len(after):
        return kernel_map, after
    return kernel_map.keep_outputs(kept), Sites(after.shape, after.keys.index_select(0, kept))
