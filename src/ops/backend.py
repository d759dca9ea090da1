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
TRITON = "triton"
# The environment variable that chooses the backend of a process, and the one of Triton's interpreter.
VARIABLE = "HORIZON3D_OPS"
INTERPRETER = "TRITON_INTERPRET"
# Modules that register kernels, imported when their operation first runs in that backend: Triton is a large import.
KERNELS = {
    TRITON: {
        "farthest_points": "src.ops.kernels.farthest_point_triton",
        "sparse_conv": "src.ops.kernels.sparse_conv_triton",
        "splat": "src.ops.kernels.splat_triton",
    }
}

_implementations: dict[str, dict[str, Callable[..., Any]]] = {}
_chosen: str | None = None  # until the first operation asks


def register(operation: str, backend: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: make a function the implementation of `operation` in `backend`."""

    def keep(function: Callable[..., Any]) -> Callable[..., Any]:
        _implementations.setdefault(operation, {})[backend] = function
        return function

    return keep


def available() -> tuple[str, ...]:
    """Names of the backends that can run in this process."""
    names = {name for table in _implementations.values() for name in table} | {REFERENCE, TRITON}
    return tuple(sorted(names - ({TRITON} if _triton_obstacle() else set())))


def use(name: str) -> None:
    """Choose the backend of this process; operations it lacks stay with the torch reference.

    Raises ValueError for a name that is not available.
    """
    global _chosen
    if name not in available():
        raise ValueError(f"backend {name!r}: expected one of {', '.join(available())}")
    _chosen = name


def chosen() -> str:
    """Name of the backend in use: the environment's HORIZON3D_OPS, else Triton where there is CUDA, else the reference.

    The first call decides for the process. Raises ConfigError for a HORIZON3D_OPS that is unknown or cannot run here.
    """
    global _chosen
    if _chosen is None:
        _chosen = _first_choice()
    return _chosen


def implementation(operation: str, backend: str | None = None) -> Callable[..., Any]:
    """The function that runs `operation` in the given backend, by default the chosen one, else its torch reference."""
    name = chosen() if backend is None else backend
    table = _implementations[operation]
    if name not in table and operation in KERNELS.get(name, {}):
        importlib.import_module(KERNELS[name][operation])
    return table.get(name, table[REFERENCE])


def runs_kernels(tensor: Tensor) -> bool:
    """Whether Triton's kernels take this tensor: one on a GPU, and one of the CPU only through the interpreter."""
    return tensor.is_cuda or interpreted()


def interpreted() -> bool:
    """Whether Triton was asked to interpret its kernels on the CPU, which is for tests."""
    return os.environ.get(INTERPRETER) == "1"


def _first_choice() -> str:
    wanted = os.environ.get(VARIABLE, "")
    if not wanted:
        return TRITON if torch.cuda.is_available() and not _triton_obstacle() else REFERENCE
    if wanted not in (REFERENCE, *KERNELS):
        raise ConfigError(f"{VARIABLE}={wanted}: expected {' or '.join((REFERENCE, *KERNELS))}, or leave it unset")
    if wanted == TRITON and (obstacle := _triton_obstacle()):
        raise ConfigError(f"{VARIABLE}={wanted}: {obstacle}; unset it or set {VARIABLE}={REFERENCE}")
    return wanted


def _triton_obstacle() -> str | None:
    """Why Triton's kernels cannot run here, None if they can; imports Triton only if there is something to run on."""
    if not (torch.cuda.is_available() or interpreted()):
        return f"there is no CUDA device, and Triton's interpreter is not asked for ({INTERPRETER}=1)"
    try:
        importlib.import_module("triton")
    except ImportError as error:
        return f"Triton cannot be imported ({error})"
    return None
