"""Random sites, the kinds of kernel maps over (t, y, x), or (z, y, x), and what a convolution makes of them."""

import torch

from src.ops.kernel_maps import stacked_map, strided_map, submanifold_map, temporal_map
from src.ops.segment_reduce import inverse_rows
from src.ops.sites import Sites


def random_sites(shape, count, seed=0, device="cpu"):
    generator = torch.Generator().manual_seed(seed)
    picks = torch.randperm(torch.Size(shape).numel(), generator=generator)[:count]
    return Sites.from_linear(picks.sort().values.to(device), shape)


def map_of(mode, sites):
    if mode == "submanifold":
        return submanifold_map(sites, 3)
    if mode == "inverse":
        return strided_map(sites, 3, 2, 1)[0].transposed
    build = strided_map if mode == "strided" else temporal_map
    return build(sites, 3, (2, 1, 1), 1)[0]


def stack_of(sites, kernel, parts):
    """`stacked_map` of two subsets, given as the rows that each has of the sites."""
    return stacked_map(sites, kernel, tuple(inverse_rows(rows, len(sites)) for rows in parts), tuple(map(len, parts)))


def values_and_gradients(convolve, kernel_map, width=3, dtype=torch.float64):
    torch.manual_seed(0)
    x = torch.randn(kernel_map.num_inputs, width, dtype=dtype).requires_grad_()
    w = torch.randn(kernel_map.num_offsets, width, width + 1, dtype=dtype).requires_grad_()
    out = convolve(x, w, kernel_map, None)
    (out * torch.randn(out.shape, dtype=dtype)).sum().backward()
    return out.detach(), x.grad, w.grad
