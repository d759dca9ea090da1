"""Maths on plain tensors: each file is one operation with its torch reference; these names are the public ones."""

from src.ops.deform_sample import deform_attend_bev, deform_attend_images, sample_sparse_bev
from src.ops.farthest_point import farthest_points
from src.ops.kernel_maps import KernelMap, strided_map, submanifold_map, temporal_map
from src.ops.nms import maxpool_peaks
from src.ops.segment_reduce import segment_mean, segment_sum
from src.ops.sites import Sites, union
from src.ops.sparse_conv import neighbour_sum, sparse_conv
from src.ops.splat import Splat, log1mexp, splat_gaussians
from src.ops.voxelize import voxelize

__all__ = [
    "KernelMap",
    "Sites",
    "Splat",
    "deform_attend_bev",
    "deform_attend_images",
    "farthest_points",
    "log1mexp",
    "maxpool_peaks",
    "neighbour_sum",
    "sample_sparse_bev",
    "segment_mean",
    "segment_sum",
    "sparse_conv",
    "splat_gaussians",
    "strided_map",
    "submanifold_map",
    "temporal_map",
    "union",
    "voxelize",
]
