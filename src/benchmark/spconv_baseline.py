"""Our sparse networks built from layers of the public library spconv: a baseline where it is installed."""

from __future__ import annotations

import copy
import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

from src.models.backbones.sparse_voxel import RadarEncoder
from src.models.layers.sparse import SparseKernel, SubmanifoldConv
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseMap


def load_spconv(device: torch.device) -> ModuleType | None:
    """spconv.pytorch made to run on this device, None where it is not installed or is of the wrong kind.

    Its CPU build asks for the current CUDA stream on the way back, which torch without CUDA refuses.
    """
    try:
        spconv = importlib.import_module("spconv.pytorch")
        operations = importlib.import_module("spconv.pytorch.ops")
    except (ImportError, OSError):
        return None
    if device.type == "cpu":
        operations.get_current_stream = lambda: 0
    return spconv


def build_layer(spconv: ModuleType, kernel: SparseKernel, key: str) -> nn.Module:
    """spconv's layer with the weights of ours. Ours are [K, in, out], spconv's [out, *k, in]."""
    weight, ndim = kernel.weight, kernel.ndim
    algorithm = importlib.import_module("spconv.core").ConvAlgo.Native if weight.device.type == "cpu" else None
    shared = {"bias": kernel.bias is not None, "indice_key": key, "algo": algorithm}
    sizes = (kernel.in_channels, kernel.out_channels, kernel.kernel_size)
    if isinstance(kernel, SubmanifoldConv):
        layer = getattr(spconv, f"SubMConv{ndim}d")(*sizes, **shared)
    else:
        layer = getattr(spconv, f"SparseConv{ndim}d")(*sizes, stride=kernel.stride, padding=kernel.padding, **shared)
    layer = layer.to(weight.device)
    with torch.no_grad():
        cube = weight.view(*kernel.kernel_size, *weight.shape[1:])
        layer.weight.copy_(cube.permute(-1, *range(ndim), -2))
        if kernel.bias is not None:
            layer.bias.copy_(kernel.bias)
    return layer


def sparse_tensor(spconv: ModuleType, x: SparseMap) -> Any:
    """A map as spconv's tensor; nothing is cached on it yet."""
    return spconv.SparseConvTensor(x.features, x.indices.int(), list(x.sites.shape[1:]), x.batch_size)


def sorted_map(y: Any) -> SparseMap:
    """spconv's tensor with its rows in our order."""
    sites, order = Sites.from_indices(y.indices.long(), (y.batch_size, *y.spatial_shape))
    return SparseMap(sites, y.features.index_select(0, order))


@dataclass
class SpconvMap:
    """spconv's tensor where our blocks expect a sparse map."""

    tensor: Any

    @property
    def features(self) -> Tensor:  # [M, C]
        """Features of the sites, in spconv's order."""
        return self.tensor.features

    def with_features(self, features: Tensor) -> SpconvMap:
        """The same sites carrying other features."""
        return SpconvMap(self.tensor.replace_feature(features))


class SpconvLayer(nn.Module):
    """spconv's layer in the place of one of ours."""

    relu = False  # our blocks ask: merged for inference, ours apply it themselves

    def __init__(self, spconv: ModuleType, kernel: SparseKernel, key: str) -> None:
        super().__init__()
        self.spconv, self.layer = spconv, build_layer(spconv, kernel, key)

    def forward(self, x: SparseMap | SpconvMap) -> SpconvMap:
        return SpconvMap(self.layer(x.tensor if isinstance(x, SpconvMap) else sparse_tensor(self.spconv, x)))


def spconv_encoder(spconv: ModuleType, encoder: RadarEncoder) -> RadarEncoder:
    """The radar backbone in spconv's layers, with the weights and norms of an encoder of ours; it makes a SpconvMap."""
    twin = copy.deepcopy(encoder)
    twin.compress = lambda stages: encoder.compress([sorted_map(stage.tensor) for stage in stages])
    for name, kernel in encoder.named_modules():
        if isinstance(kernel, SparseKernel):
            # One key per set of sites; a strided layer makes a new one.
            scope = ".".join(name.split(".")[: 2 if name.startswith("stages") else 1])
            subm = isinstance(kernel, SubmanifoldConv)
            if scope == "conv_input":
                scope = "stages.0"
            elif scope == "shared_conv" and isinstance(encoder.conv_out.conv, SubmanifoldConv):
                scope = "conv_out"
            twin.set_submodule(name, SpconvLayer(spconv, kernel, f"{'subm' if subm else 'down'} {scope}"))
    return twin


def largest_difference(ours: list[Tensor], theirs: list[Tensor]) -> float:
    """Largest difference over pairs of tensors, each relative to the largest number in ours."""
    return max(
        float((a.detach() - b.detach()).abs().max() / a.detach().abs().max().clamp(min=1e-30))
        for a, b in zip(ours, theirs, strict=True)
    )
