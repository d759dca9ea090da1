"""A trained detector made ready for inference: the same function up to rounding, with fewer and larger operations.

Batch norms go into the convolutions and linear layers before them, parallel branches become one product, history keeps
a fixed number of places, and nothing records gradients. What only a module knows of itself it declares, each optional:

- `norm_pairs`: pairs of names of its submodules, a layer and the batch norm that directly follows it;
- `merge_for_inference()`: merges what lies side by side, once norms are folded;
- `full_precision_parts`: names of submodules ("" for itself) that compute in float32 whatever autocast says;
- `static_parts`: names of submodules whose shapes never change (see `deploy/static_parts.py`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from src.models.detector import Detector
from src.models.layers.merging import with_relu
from src.models.layers.sparse import SparseKernel
from src.ops.precision import Precision

Linear = nn.Conv2d | nn.ConvTranspose2d | nn.Linear | SparseKernel
"""Layers that a norm behind them can go into."""


def prepare_for_inference(model: Detector, precision: str = Precision.FULL) -> Detector:
    """A copy of the model in evaluation mode that gives the same outputs up to rounding, faster.

    With bf16-mixed the weights that autocast would round in every frame are rounded once, so the copy runs under
    bfloat16 autocast only. Parts that the copy does not know are left as they are. `loss` and `train` are of no use
    with it. Raises ValueError for a model that is prepared already.
    """
    if model.prepared_for is not None:
        raise ValueError("the model is prepared for inference already; prepare the trained one")
    with torch.inference_mode(False), torch.no_grad():
        model = copy.deepcopy(model).eval()
        model.zero_grad(set_to_none=True)
        model.requires_grad_(False)
        _fold_norms(model)
        for module in list(model.modules()):
            if hasattr(module, "merge_for_inference"):
                module.merge_for_inference()
        _merge_relus(model)
        if precision == Precision.MIXED:
            _round_weights(model)
        for value in model.parameters():
            if value.dim() == 4:
                value.data = value.data.contiguous(memory_format=torch.channels_last)
            value.requires_grad_(False)
    model.prepared_for = precision
    return model


def fold_norm(layer: Linear, norm: _BatchNorm) -> None:
    """Put a batch norm's running statistics and affine map into the layer before it, computed in float64."""
    scale = norm.weight.double() * (norm.running_var.double() + norm.eps).rsqrt()
    shift = norm.bias.double() - norm.running_mean.double() * scale
    axis = 1 if isinstance(layer, nn.ConvTranspose2d) else 2 if isinstance(layer, SparseKernel) else 0
    shape = [-1 if number == axis else 1 for number in range(layer.weight.dim())]
    weight = layer.weight.double() * scale.view(shape)
    if layer.bias is not None:
        shift = shift + layer.bias.double() * scale
    layer.weight.data = weight.to(layer.weight.dtype)
    layer.bias = nn.Parameter(shift.to(layer.weight.dtype), requires_grad=False)


def _fold_norms(model: nn.Module) -> None:
    for module in model.modules():
        for layer, norm in getattr(module, "norm_pairs", ()):
            fold_norm(module.get_submodule(layer), module.get_submodule(norm))
            module.set_submodule(norm, nn.Identity())
        if isinstance(module, nn.Sequential):
            for number, (layer, norm) in enumerate(zip(module[:-1], module[1:], strict=True)):
                if isinstance(layer, Linear) and isinstance(norm, _BatchNorm):
                    fold_norm(layer, norm)
                    module[number + 1] = nn.Identity()


def _merge_relus(model: nn.Module) -> None:
    """Let each linear layer of a sequence apply the ReLU behind it."""
    for module in model.modules():
        if isinstance(module, nn.Sequential):
            for number, (layer, behind) in enumerate(zip(module[:-1], module[1:], strict=True)):
                if type(layer) is nn.Linear and layer.bias is not None and isinstance(behind, nn.ReLU):
                    module[number], module[number + 1] = with_relu(layer), nn.Identity()


def _round_weights(model: nn.Module) -> None:
    """Round weights to bfloat16, except where the model computes in float32 whatever autocast says."""
    exact = {id(module) for part in declared_parts(model, "full_precision_parts") for module in part.modules()}
    for module in model.modules():
        if isinstance(module, Linear) and id(module) not in exact:
            module.to(torch.bfloat16)


def declared_parts(model: nn.Module, member: str) -> Iterator[nn.Module]:
    """The submodules that the modules of a model list by name in `member`, a class attribute."""
    for module in model.modules():
        for name in getattr(module, member, ()):
            yield module.get_submodule(name)
