"""Triton's kernels on the simulated device: each launch is counted, and its plain form fills the output.

The code around the kernels is that of a GPU. Gradients are not computed: nothing is launched or waited for by their
values.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from inspect import signature
from types import ModuleType
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as F
from torch import Tensor

from src.benchmark.plain_kernels import KERNELS
from src.benchmark.simulated_device import SimTensor, count_launch, host_values
from src.ops import backend, conv_relu


@contextmanager
def simulated_kernels() -> Iterator[None]:
    """Within the context tensors of the simulated device take the Triton path, whether Triton is installed or not."""
    with ExitStack() as stack:
        try:
            importlib.import_module("triton")
        except ImportError:
            stack.enter_context(patch.dict(sys.modules, _stub()))  # and what is imported meanwhile goes with it
        stack.enter_context(patch.object(backend, "_chosen", backend.TRITON))
        for module in backend.kernel_modules():
            if hasattr(module, "runs_kernels"):
                stack.enter_context(patch.object(module, "runs_kernels", lambda tensor: isinstance(tensor, SimTensor)))
            for name, function in KERNELS.items():
                if hasattr(module, name):
                    stack.enter_context(patch.object(module, name, _Launcher(name, function)))
        stack.enter_context(patch.object(F, "scaled_dot_product_attention", _attention))
        stack.enter_context(patch.object(conv_relu, "_fuses", lambda x: isinstance(x, SimTensor)))
        stack.enter_context(patch.object(conv_relu, "_fused", _fused_convolution))
        yield


def _stub() -> dict[str, ModuleType]:
    """What the kernels' modules need of Triton to be imported."""
    triton, language = ModuleType("triton"), ModuleType("triton.language")
    triton.jit = lambda function=None, **options: function or (lambda own: own)
    triton.cdiv = lambda a, b: -(-a // b)
    triton.next_power_of_2 = lambda n: 1 << max(n - 1, 0).bit_length()
    triton.language, language.constexpr = language, lambda value=None: value
    return {"triton": triton, "triton.language": language}


class _Launcher:
    """Stands for a jitted kernel: `kernel[grid](...)` counts one launch and runs the plain form."""

    def __init__(self, name: str, function: Callable[..., None] | None) -> None:
        self.name, self.function = name, function
        parameters = signature(function).parameters.values() if function is not None else ()
        self.asked = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY]

    def __getitem__(self, grid: tuple[int, ...]) -> Callable[..., None]:
        def launch(*args: Any, **options: Any) -> None:
            count_launch(self.name, grid, *args)
            if self.function is not None:
                with torch.no_grad(), torch.utils._python_dispatch._disable_current_modes():
                    self.function(*host_values(args), **{name: options[name] for name in self.asked})

        return launch


_plain_attention = F.scaled_dot_product_attention


def _attention(query: Tensor, key: Tensor, value: Tensor, attn_mask: Tensor) -> Tensor:
    return _Attention.apply(query, key, value, attn_mask)


def _fused_convolution(x: Tensor, weight: Tensor, bias: Tensor, *sizes: Any) -> Tensor:
    count_launch("cudnn_convolution_relu", x, weight)
    with torch.no_grad(), torch.utils._python_dispatch._disable_current_modes():
        return SimTensor(conv_relu.conv_relu(*host_values((x, weight, bias, *sizes))))


class _Attention(torch.autograd.Function):
    """Fused attention, as torch runs it on a GPU: a launch forward, and two backward."""

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor, mask: Tensor) -> Tensor:
        ctx.save_for_backward(query, key, value)
        count_launch("attention", query, key, value, mask)
        with torch.utils._python_dispatch._disable_current_modes():
            return SimTensor(_plain_attention(*host_values((query, key, value)), attn_mask=host_values(mask)))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        for name in ("attention_delta", "attention_backward"):
            count_launch(name, grad)
        return *(torch.empty_like(value) for value in ctx.saved_tensors), None
