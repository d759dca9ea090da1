"""Maths on plain tensors: each file is one operation with its torch reference; these names are the public ones."""

from src.ops.allocator import tune_cpu_allocator
from src.ops.kernel_maps import KernelMap, strided_map, submanifold_map, temporal_map
from src.ops.sites import Sites, union
from src.ops.sparse_conv import sparse_conv

__all__ = [
    "KernelMap",
    "Sites",
    "sparse_conv",
    "strided_map",
    "submanifold_map",
    "temporal_map",
    "tune_cpu_allocator",
    "union",
]
