"""A simulated accelerator on the CPU: what a frame would launch, wait for and upload on a GPU, without one.

Every tensor of device `sim` wraps a CPU tensor; each operation on it is checked, counted, and computed on the CPU.
Built on torch's Python backends, which are experimental (torch 2.13).
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Self
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

DEVICE = "sim"
# Operations that read and write nothing on the device: names for memory, and memory without values.
FREE = {
    "view", "_unsafe_view", "slice", "select", "expand", "permute", "transpose", "t", "unsqueeze", "squeeze", "alias",
    "detach", "as_strided", "split", "split_with_sizes", "unbind", "diagonal", "_reshape_alias", "unfold", "chunk",
    "view_as_real", "view_as_complex", "narrow", "lift_fresh", "is_same_size", "sym_size", "sym_numel", "movedim",
    "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "set_", "resize_", "_local_scalar_dense",
    "_linalg_check_errors",
}  # fmt: skip
# How often the host waits in one operation: for the size of its result, for a value, or for an error flag.
WAITS = {
    "_local_scalar_dense": 1, "nonzero": 1, "unique_consecutive": 1, "_unique2": 1, "unique_dim": 2,
    "masked_select": 1, "equal": 1, "is_nonzero": 1, "bincount": 2, "histc": 2, "repeat_interleave": 1,
    "_linalg_check_errors": 1,
}  # fmt: skip
BACKWARD = "backward"  # what autograd runs, outside of any line of src
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}
HOST_VALUES = {"_local_scalar_dense", "equal", "is_nonzero"}


@dataclass
class Tally:
    """What was counted, in total by `launches`, `waits`, `uploads`, `dispatches`, each by operation and line of src."""

    launches: Counter[tuple[str, str]] = field(default_factory=Counter)
    waits: Counter[tuple[str, str]] = field(default_factory=Counter)
    uploads: Counter[tuple[str, str]] = field(default_factory=Counter)  # host to device, pinned or not
    mixed: Counter[tuple[str, str]] = field(default_factory=Counter)  # tensors of two devices, which CUDA refuses
    dispatches: int = 0  # operations that torch dispatches, views included
    sequence: list[tuple[Any, ...]] = field(default_factory=list)  # operation, shapes and types, in order

    def totals(self) -> dict[str, int]:
        """Launches, waits, uploads and dispatches so far."""
        return {
            "launches": self.launches.total(),
            "waits": self.waits.total(),
            "uploads": self.uploads.total(),
            "dispatches": self.dispatches,
        }


class SimTensor(Tensor):
    """A tensor of the simulated device around its values, `inner`."""

    inner: Tensor

    @staticmethod
    def __new__(cls: type[Self], inner: Tensor) -> Self:
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        device = torch.device(DEVICE, 0)
        return Tensor._make_wrapper_subclass(cls, inner.size(), device=device, requires_grad=False, **layout)

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    def __repr__(self) -> str:
        return f"sim({self.inner!r})"

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: tuple[type, ...], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _run(func, args, kwargs or {})


_active: list[Tally] = []


@contextmanager
def simulated_device() -> Iterator[Tally]:
    """Context in which tensors can be moved to `sim:0`; yields what is counted. Contexts do not nest.

    Gradients need that the first was entered before the process's first backward pass, which counts the devices.
    """
    _register()
    tally = Tally()
    _active.append(tally)
    try:
        with _Literals(), _Dispatch(), patch.object(Tensor, "pin_memory", _pinned):
            yield tally
    finally:
        _active.pop()


def _pinned(tensor: Tensor) -> Tensor:
    """A copy that counts as page-locked."""
    tensor = tensor.clone()
    tensor.pinned = True
    return tensor


def host_values(value: Any) -> Any:
    """The CPU tensors inside nested containers of simulated ones."""
    return tree_map(lambda x: x.inner if isinstance(x, SimTensor) else x, value)


def count_launch(name: str, *tensors: Any) -> None:
    """Count the launch of a kernel that torch does not dispatch."""
    if _active:
        tally = _active[-1]
        tally.launches[(name, caller())] += 1
        tally.dispatches += 1
        tally.sequence.append((name, *(_described(x) for x in tensors)))


def caller() -> str:
    """The innermost line of src outside the benchmark that is running."""
    frame = sys._getframe(1)
    while frame is not None:
        place = frame.f_code.co_filename.partition("/src/")[2]
        if place and not place.startswith("benchmark/"):
            return f"{place}:{frame.f_lineno}"
        frame = frame.f_back
    return BACKWARD


_registered = False


def _register() -> None:
    global _registered
    if not _registered:
        module = _DummyBackendModule()
        module.get_amp_supported_dtype = lambda: [torch.bfloat16, torch.float16]
        module.is_autocast_enabled = lambda: False
        _setup_privateuseone_for_python_backend(DEVICE, backend_module=module)
        _registered = True


def _is_sim(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE


def _described(value: Any) -> Any:
    return (tuple(value.shape), str(value.dtype)) if isinstance(value, Tensor) else value


def _run(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Check, count and compute one operation."""
    name = func._schema.name.split("::")[-1]
    leaves = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
    sims = [x for x in leaves if isinstance(x, SimTensor)]
    device = kwargs.get("device")
    on_sim = bool(sims) if device is None else _is_sim(device)
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if name == "copy_" and leaves != sims:
        on_sim = isinstance(args[0], SimTensor)
    if _active and (sims or on_sim):
        _count(_active[-1], name, args, kwargs, leaves, on_sim)
    out = func(*host_values(args), **host_values(kwargs))
    if func._schema.is_mutable and name.endswith("_") and isinstance(args[0], SimTensor):
        return args[0]
    if kwargs.get("out") is not None:
        return kwargs["out"]
    if on_sim and name not in HOST_VALUES:
        return tree_map(lambda x: SimTensor(x) if isinstance(x, Tensor) else x, out)
    return out


def _count(
    tally: Tally, name: str, args: tuple[Any, ...], kwargs: dict[str, Any], leaves: list[Tensor], on_sim: bool
) -> None:
    sims = [x for x in leaves if isinstance(x, SimTensor)]
    hosts = [x for x in leaves if not isinstance(x, SimTensor) and x.dim() > 0]
    place = caller()
    tally.dispatches += 1
    tally.sequence.append((name, *(_described(x) for x in tree_leaves(args))))
    if name in ("_to_copy", "copy_") and (hosts or (sims and not on_sim)):
        if not on_sim:
            tally.waits["copy to host", place] += 1
            return
        blocking = not (kwargs.get("non_blocking") or True in args[2:]) or not getattr(hosts[0], "pinned", False)
        tally.uploads["upload", place] += 1
        if blocking:
            tally.waits["blocking upload", place] += 1
        return
    if sims and hosts:
        if name in INDEXING and isinstance(args[0], SimTensor):  # torch uploads indices by itself
            tally.uploads["indices", place] += 1
            tally.waits["blocking upload", place] += 1
        else:
            tally.mixed[name, place] += 1
    if name == "_to_copy" and not sims:  # a scalar of the host
        tally.uploads["scalar", place] += 1
        tally.waits["blocking upload", place] += 1
    elif name in WAITS and (name != "repeat_interleave" or kwargs.get("output_size") is None):
        tally.waits[name, place] += WAITS[name]
    elif name in INDEXING:
        masks = sum(isinstance(x, Tensor) and x.dtype == torch.bool for x in args[1] or ())
        if masks:
            tally.waits["index by mask", place] += masks
    if name not in FREE:
        tally.launches[name, place] += 1


class _Dispatch(TorchDispatchMode):
    def __torch_dispatch__(
        self, func: Any, types: tuple[type, ...], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        return _run(func, args, kwargs or {})


class _Literals(TorchFunctionMode):
    """Python values that torch turns into tensors outside of dispatch are made on the CPU and moved."""

    def __torch_function__(
        self, func: Any, types: tuple[type, ...], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and _is_sim(kwargs.get("device")):
            device = kwargs.pop("device")
            return func(*args, **kwargs).to(device)
        if func is Tensor.new_tensor and isinstance(args[0], SimTensor):
            return args[0].inner.new_tensor(*args[1:], **kwargs).to(args[0].device)
        if func in (Tensor.tolist, Tensor.item) and isinstance(args[0], SimTensor):
            if _active:
                _active[-1].waits[func.__name__, caller()] += 1
            return func(args[0].inner)
        if func in (Tensor.__getitem__, Tensor.__setitem__) and isinstance(args[0], SimTensor):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(i, list) for i in index):
                index = tuple(torch.tensor(i).to(args[0].device) if isinstance(i, list) else i for i in index)
                args = (args[0], index, *args[2:])
        return func(*args, **kwargs)
