"""The parts of a detector: what they are called, and each of them alone with the inputs it has within the model."""

from __future__ import annotations

import copy
import dataclasses
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from src.models.detector import Detector

Paths = Mapping[str, tuple[str, ...]]
"""Methods of each part, as `module.method`, or its functions, as `package.module:function`."""

PART_METHODS = ("forward", "recall", "aggregate", "remember", "decode")
"""What a detector calls its parts by; a memory is not a function of one input, so it has no forward."""


def parts_of(model: Detector) -> Paths:
    """What each child of the model does, in their order, with the parts within that the model declares."""
    parts: dict[str, tuple[str, ...]] = {}
    for child, module in model.named_children():
        methods = [method for method in PART_METHODS if method != "decode" and _defines(module, method)]
        parts[child] = tuple(f"{child}.{method}" for method in methods)
        parts |= {name: paths for name, paths in model.benchmark_parts.items() if name.partition(":")[0] == child}
        if _defines(module, "decode"):
            parts[f"{child}: decode"] = (f"{child}.decode",)
    return {name: paths for name, paths in parts.items() if paths}


def _defines(module: nn.Module, method: str) -> bool:
    found = getattr(type(module), method, None)
    return found is not None and found is not nn.Module.forward


def is_within(name: str) -> bool:
    """Whether a part lies within another, so that sums leave it out; decoding comes after the model and counts."""
    return ":" in name and not name.endswith(": decode")


@contextmanager
def wrapped_parts(
    model: nn.Module,
    parts: Paths,
    wrap: Callable[[str, Callable[..., Any]], Callable[..., Any]],  # of part and the function
) -> Iterator[None]:
    """Within the context every method and function that is a part is wrapped, for each part that it belongs to.

    A method of a module that the model lacks is left out.
    """
    modules = dict(model.named_modules())
    with ExitStack() as stack:
        for name, paths in parts.items():
            for path in paths:
                place, colon, function = path.rpartition(":" if ":" in path else ".")
                owner = importlib.import_module(place) if colon == ":" else modules.get(place)
                if owner is not None:
                    stack.enter_context(patch.object(owner, function, wrap(name, getattr(owner, function))))
        yield


@dataclasses.dataclass
class Call:
    """A part's call within the model, to be made again alone."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    named: dict[str, Any]
    result: Any

    def prepare(self) -> Callable[[], Any]:
        """The recorded call on fresh inputs: with the values and caches of the first time and no gradient history."""
        arguments, named = fresh((self.arguments, self.named))
        return lambda: self.function(*arguments, **named)


def record_calls(model: Detector, parts: Paths, run: Callable[[], Any]) -> dict[str, list[Call]]:
    """The calls of every part that happen while the model runs once; parts that are not called are left out."""
    calls: dict[str, list[Call]] = {name: [] for name in parts}

    def wrap(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            kept = fresh((arguments, named))  # before the part fills the caches of its inputs
            result = function(*arguments, **named)
            calls[name].append(Call(plain, *kept, result))
            return result

        plain = getattr(function, "plain_function", function)
        call.plain_function = plain
        return call

    with wrapped_parts(model, parts, wrap):
        run()
    return {name: found for name, found in calls.items() if found}


def fresh(value: Any) -> Any:
    """A deep copy around the same numbers: tensors are leaves that want the gradients they wanted, caches hold what
    they held, and what was shared stays shared."""

    def leaf(tensor: Tensor, memo: dict[int, Any]) -> Tensor:
        return tensor.detach().requires_grad_(tensor.requires_grad)

    with patch.object(Tensor, "__deepcopy__", leaf), patch.object(nn.Parameter, "__deepcopy__", leaf):
        return copy.deepcopy(value)


def tensors_in(value: Any, seen: set[int] | None = None) -> list[Tensor]:
    """All tensors in nested dataclasses, lists and tuples; those in dicts are caches and left out."""
    seen = set() if seen is None else seen
    if id(value) in seen:
        return []
    seen.add(id(value))
    if isinstance(value, Tensor):
        return [value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, (list, tuple)):
        return [tensor for item in value for tensor in tensors_in(item, seen)]
    return []


def backward_from(result: Any) -> bool:
    """Backward, with gradients of one, from every tensor of a result that has a history; False where none has."""
    roots = [x for x in tensors_in(result) if x.grad_fn is not None]
    if roots:
        torch.autograd.backward(roots, [torch.ones_like(x) for x in roots])
    return bool(roots)
