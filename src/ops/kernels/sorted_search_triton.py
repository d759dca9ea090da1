"""The binary search that kernels share."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def lower_bound(keys, wanted, num, steps, BLOCK: tl.constexpr):  # noqa: ANN001, ANN201
    """First row of `num` sorted keys that is not below each of BLOCK wanted ones; `num` where all are.

    `steps` is the bit length of `num`, as many halvings as the search needs.
    """
    low = tl.zeros((BLOCK,), tl.int32)
    high = low + num
    for _ in range(0, steps):
        open_ = low < high
        middle = (low + high) // 2
        below = open_ & (tl.load(keys + middle, mask=open_, other=0) < wanted)
        low = tl.where(below, middle + 1, low)
        high = tl.where(open_ & (below == 0), middle, high)
    return low
