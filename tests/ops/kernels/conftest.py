"""Where kernels run: on a GPU, or on the CPU in the process of Triton's interpreter (see test_without_a_gpu.py)."""

import os
from importlib.util import find_spec

import pytest
import torch

from src.ops import backend

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"

if not (INTERPRETED or torch.cuda.is_available()):
    collect_ignore_glob = ["test_*_triton.py"]


@pytest.fixture(params=["cpu"] if INTERPRETED else [pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request, monkeypatch):
    """A device whose float32 and half tensors the kernels take; a fallback to the reference fails there."""
    if find_spec("triton") is None:
        pytest.skip("Triton is not installed")
    monkeypatch.setattr(backend, "_chosen", "triton")
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    for module in backend.kernel_modules():
        for fallback in [name for name in vars(module) if name.endswith("_reference")]:
            kernel = getattr(module, fallback.replace("_reference", "_triton"))
            assert backend.implementation(getattr(module, fallback)) is kernel
            monkeypatch.setattr(module, fallback, for_float64(getattr(module, fallback)))
    return torch.device(request.param)


def for_float64(reference):
    def run(first, *others):
        assert first.dtype == torch.float64, "the kernel left its work to the reference"
        return reference(first, *others)

    return run
