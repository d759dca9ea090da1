"""Which implementation of each operation runs, chosen once per process."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from src.errors import ConfigError

REFERENCE = "reference"
COUNTED = "counted"  # the reference, with no product but those of the formula, for counting arithmetic
TRITON = "triton"
# The environment variable that chooses the backend of a process, and the one of Triton's interpreter.
VARIABLE = "HORIZON3D_OPS"
INTERPRETER = "TRITON_INTERPRET"
# Modules with an operation's kernel, imported when it first runs in that backend: Triton is a large import.
KERNELS = {
    "attend_cells": "src.ops.kernels.attend_cells_triton",
    "attend_views": "src.ops.kernels.attend_views_triton",
    "candidate_sort_keys": "src.ops.kernels.candidate_sort_keys_triton",
    "decoded_boxes": "src.ops.kernels.box_codes_triton",
    "farthest_points": "src.ops.kernels.farthest_point_triton",
    "radial_votes": "src.ops.kernels.radial_correction_triton",
    "unpack_candidates": "src.ops.kernels.candidate_sort_keys_triton",
    "cell_centres": "src.ops.kernels.cell_keys_triton",
    "cell_keys": "src.ops.kernels.cell_keys_triton",
    "distinct_keys": "src.ops.kernels.distinct_keys_triton",
    "group_sum": "src.ops.kernels.segment_reduce_triton",
    "grouped_keys": "src.ops.kernels.distinct_keys_triton",
    "refined_attributes": "src.ops.kernels.gaussian_shapes_triton",
    "relative_motion": "src.ops.kernels.frame_motion_triton",
    "relu_norm_columns": "src.ops.kernels.add_layer_norm_triton",
    "sampling_points": "src.ops.kernels.gaussian_shapes_triton",
    "warp_gaussians": "src.ops.kernels.frame_motion_triton",
    "moved_keys": "src.ops.kernels.moved_keys_triton",
    "moved_table": "src.ops.kernels.neighbour_table_triton",
    "initial_gaussians": "src.ops.kernels.initial_gaussians_triton",
    "near_pairs": "src.ops.kernels.gaussian_cells_triton",
    "neighbour_table": "src.ops.kernels.neighbour_table_triton",
    "padded_pairs": "src.ops.kernels.gaussian_cells_triton",
    "radial_correction": "src.ops.kernels.radial_correction_triton",
    "score_and_lift_pixels": "src.ops.kernels.score_and_lift_pixels_triton",
    "sparse_conv": "src.ops.kernels.sparse_conv_triton",
    "sparse_conv_relu": "src.ops.kernels.sparse_conv_triton",
    "splat": "src.ops.kernels.splat_triton",
    "add_layer_norm": "src.ops.kernels.add_layer_norm_triton",
    "stacked_table": "src.ops.kernels.neighbour_table_triton",
    "gather_rows": "src.ops.kernels.segment_reduce_triton",
    "gather_cells": "src.ops.kernels.gather_cells_triton",
    "view_sampling_locations": "src.ops.kernels.view_samples_triton",
    "view_attention_weights": "src.ops.kernels.view_samples_triton",
    "transposed_table": "src.ops.kernels.neighbour_table_triton",
}

_chosen: str | None = None  # until the first operation asks


def use(name: str) -> None:
    """Choose the backend of this process.

    Raises ConfigError, in the words of HORIZON3D_OPS, for a name that is unknown or cannot run here.
    """
    global _chosen
    if name not in (REFERENCE, TRITON, COUNTED):
        raise ConfigError(f"{VARIABLE}={name}: expected {REFERENCE} or {TRITON}, or leave it unset")
    if name == TRITON and (obstacle := _triton_obstacle()):
        raise ConfigError(f"{VARIABLE}={name}: {obstacle}; unset it or set {VARIABLE}={REFERENCE}")
    _chosen = name


def chosen() -> str:
    """Name of the backend in use: the environment's HORIZON3D_OPS, else Triton where there is CUDA, else the reference.

    The first call decides for the process. Raises ConfigError for a HORIZON3D_OPS that is unknown or cannot run here.
    """
    if _chosen is None:
        fastest = TRITON if torch.cuda.is_available() and not _triton_obstacle() else REFERENCE
        use(os.environ.get(VARIABLE) or fastest)
    return _chosen


def implementation(reference: Callable[..., Any]) -> Callable[..., Any]:
    """The function that runs an operation in the chosen backend, of its torch reference `<operation>_reference`."""
    if chosen() != TRITON:
        return reference
    operation = reference.__name__.removesuffix("_reference")
    return getattr(importlib.import_module(KERNELS[operation]), f"{operation}_{TRITON}")


def runs_kernels(tensor: Tensor) -> bool:
    """Whether Triton's kernels take this tensor: one on a GPU, and one of the CPU only through the interpreter."""
    return tensor.is_cuda or interpreted()


def interpreted() -> bool:
    """Whether Triton was asked to interpret its kernels on the CPU, which is for tests."""
    return os.environ.get(INTERPRETER) == "1"


def _triton_obstacle() -> str | None:
    """Why Triton's kernels cannot run here, None if they can; imports Triton only if there is something to run on."""
    if not (torch.cuda.is_available() or interpreted()):
        return f"there is no CUDA device, and Triton's interpreter is not asked for ({INTERPRETER}=1)"
    try:
        importlib.import_module("triton")
    except ImportError as error:
        return f"Triton cannot be imported ({error})"
    return None
