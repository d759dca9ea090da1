"""Process-wide switches of the CPU: large freed blocks are kept for reuse, denormal numbers are zero; peak memory."""

from __future__ import annotations

import ctypes
import mmap
import os
import resource
import sys
from functools import cache

import torch

from src.errors import ConfigError

VARIABLE = "HORIZON3D_ALLOCATOR"
TUNED, DEFAULT = "tuned", "default"

# Parameters of glibc's mallopt and the largest value it takes.
M_TRIM_THRESHOLD = -1
M_MMAP_THRESHOLD = -3
LARGEST = 2**31 - 1
RESERVED_BYTES = 3 << 29
"""Address space that is reserved for huge pages; memory is taken only as it is written."""
MADV_HUGEPAGE = 14


def tune_cpu() -> None:
    """What commands that run a model do once before any work, since threads take the switches from who starts them.

    Denormal numbers, below 1e-38, become 0: where the softmax of attention saturates, gradients shrink to them, and
    processors are slow over each (a step of a saturated PETR took 0.90 instead of 0.33 s). Raises as `tune_allocator`.
    """
    tune_allocator()
    torch.set_flush_denormal(True)


def tune_allocator() -> bool:
    """Let glibc keep large freed blocks for reuse, in huge pages; True if it does, False without glibc or if unwanted.

    By default glibc asks the kernel for every large tensor anew, and each fresh page faults on first touch: gathering
    37 MiB costs 24.7 ms into fresh memory and 3.2 ms into reused memory. The price is that the process gives memory
    back late, if at all. Huge pages spare look-ups of addresses, 4 to 6 % of a training step, where Linux gives them to
    who asks. Results do not change. The environment variable HORIZON3D_ALLOCATOR=default leaves glibc as it is. Raises
    ConfigError for another value of it.
    """
    choice = os.environ.get(VARIABLE, TUNED)
    if choice not in (TUNED, DEFAULT):
        raise ConfigError(f"{VARIABLE}={choice}: must be {TUNED} or {DEFAULT}")
    if choice == DEFAULT or not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # a C library without mallopt, for example musl
        return False
    mallopt.argtypes, mallopt.restype = (ctypes.c_int, ctypes.c_int), ctypes.c_int
    took = mallopt(M_MMAP_THRESHOLD, LARGEST) == 1 and mallopt(M_TRIM_THRESHOLD, LARGEST) == 1
    if took:
        _reserve_huge_pages()
    return took


@cache
def _reserve_huge_pages() -> None:
    """Once a process, grow the heap by address space that no one has written and ask for huge pages in it.

    glibc asks for them itself only where GLIBC_TUNABLES said glibc.malloc.hugetlb=1 before the process began.
    """
    libc = ctypes.CDLL(None)
    libc.malloc.argtypes, libc.malloc.restype = (ctypes.c_size_t,), ctypes.c_void_p
    libc.free.argtypes, libc.free.restype = (ctypes.c_void_p,), None
    libc.madvise.argtypes, libc.madvise.restype = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int), ctypes.c_int
    start = libc.malloc(RESERVED_BYTES)
    if start:  # else the address space is limited
        aligned = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
        libc.madvise(aligned, RESERVED_BYTES - mmap.PAGESIZE, MADV_HUGEPAGE)
        libc.free(start)


def peak_resident_bytes(who: int) -> int:
    """Largest resident memory of `resource.RUSAGE_SELF`, or of the largest of RUSAGE_CHILDREN that have ended."""
    unit = 1 if sys.platform == "darwin" else 1024  # macOS counts bytes, Linux KiB
    return unit * resource.getrusage(who).ru_maxrss
