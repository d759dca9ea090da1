"""Which implementation of each operation runs, chosen once per process."""

from __future__ import annotations

import importlib
import os
import pkgutil
from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from src.errors import ConfigError
from src.ops import kernels

REFERENCE = "reference"
COUNTED = "counted"  # the reference, with no product but those of the formula, for counting arithmetic
TRITON = "triton"
# The environment variable that chooses the backend of a process, and the one of Triton's interpreter.
VARIABLE = "HORIZON3D_OPS"
INTERPRETER = "TRITON_INTERPRET"

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
    """The function that runs an operation in the chosen backend, of its torch reference.

    That of `<operation>_reference` in `src/ops/<file>.py` is `<operation>_triton` in `kernels/<file>_triton.py`, which
    is imported when it first runs: Triton is a large import.
    """
    if chosen() != TRITON:
        return reference
    file, operation = reference.__module__.rpartition(".")[2], reference.__name__.removesuffix("_reference")
    return getattr(importlib.import_module(f"{kernels.__name__}.{file}_{TRITON}"), f"{operation}_{TRITON}")


def kernel_modules() -> list[ModuleType]:
    """All files of kernels, imported."""
    names = [found.name for found in pkgutil.iter_modules(kernels.__path__)]
    return [importlib.import_module(f"{kernels.__name__}.{name}") for name in names]


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
