"""The same sparse networks from layers of the public library spconv, where it is installed: an optional baseline."""

from __future__ import annotations

import copy
import importlib
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.backbones.sparse_voxel import RadarEncoder
from src.models.layers.sparse import ConvNormReLU, ResidualBlock, SparseKernel, SubmanifoldConv
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV, SparseMap


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


def build_layer(spconv: ModuleType, kernel: SparseKernel, stride: Any, padding: Any, key: str) -> nn.Module:
    """spconv's layer with the weights of ours. Ours are [K, in, out], spconv's [out, *k, in]."""
    weight, ndim = kernel.weight, kernel.ndim
    algorithm = importlib.import_module("spconv.core").ConvAlgo.Native if weight.device.type == "cpu" else None
    shared = {"bias": kernel.bias is not None, "indice_key": key, "algo": algorithm}
    sizes = (kernel.in_channels, kernel.out_channels, kernel.kernel_size)
    if isinstance(kernel, SubmanifoldConv):
        layer = getattr(spconv, f"SubMConv{ndim}d")(*sizes, **shared)
    else:
        layer = getattr(spconv, f"SparseConv{ndim}d")(*sizes, stride=stride, padding=padding, **shared)
    layer = layer.to(weight.device)
    with torch.no_grad():
        cube = weight.view(*(kernel.kernel_size,) * ndim, *weight.shape[1:])
        layer.weight.copy_(cube.permute(-1, *range(ndim), -2))
        if kernel.bias is not None:
            layer.bias.copy_(kernel.bias)
    return layer


def sparse_tensor(spconv: ModuleType, x: SparseMap) -> Any:
    """A map as spconv's tensor; nothing is cached on it yet."""
    return spconv.SparseConvTensor(x.features, x.indices.int(), list(x.sites.shape[1:]), x.batch_size)


def sorted_map(y: Any, shape: tuple[int, ...]) -> tuple[Sites, Tensor]:
    """spconv's tensor with its rows in our order."""
    sites, order = Sites.from_indices(y.indices.long(), shape)
    return sites, y.features.index_select(0, order)


class SpconvEncoder(nn.Module):
    """The radar backbone in spconv's layers, with the weights and norms of an encoder of ours."""

    def __init__(self, spconv: ModuleType, encoder: RadarEncoder) -> None:
        super().__init__()
        self.spconv, self.ours = spconv, [encoder]  # in a list: no part of this module
        self.layers = nn.ModuleDict()
        for name, module in encoder.named_modules():
            if isinstance(module, SparseKernel):
                scope = name.split(".")[0:2] if name.startswith("stages") else name.split(".")[:1]
                # One key per set of sites; a strided layer makes a new one.
                subm = isinstance(module, SubmanifoldConv)
                key = ("subm " if subm else "down ") + ".".join(scope)
                if name.startswith("conv_input"):
                    key = "subm stages.0"
                elif subm and scope[0] == "shared_conv" and isinstance(encoder.conv_out.conv, SubmanifoldConv):
                    key = "subm conv_out"
                stride, padding = (1, 1) if subm else (module.stride, module.padding)
                self.layers[name.replace(".", "/")] = build_layer(spconv, module, stride, padding, key)
            elif isinstance(module, nn.BatchNorm1d):
                self.layers[name.replace(".", "/")] = copy.deepcopy(module)

    def forward(self, voxels: SparseMap) -> tuple[Sites, Tensor]:
        """F_R: sites and features in our order."""
        encoder = self.ours[0]
        x = self._norm_relu("conv_input", sparse_tensor(self.spconv, voxels), encoder.conv_input)
        stages = []
        for number, stage in enumerate(encoder.stages):
            for place, block in enumerate(stage):
                x = self._block(f"stages.{number}.{place}", x, block)
            stages.append(x)
        kept = stages[encoder.bev_stage :]
        batch = voxels.batch_size
        maps = [SparseMap(*sorted_map(stage, (batch, *stage.spatial_shape))) for stage in kept]
        x = sparse_tensor(self.spconv, encoder.compress(maps))
        x = self._norm_relu("conv_out", x, encoder.conv_out)
        x = self._norm_relu("shared_conv", x, encoder.shared_conv)
        return sorted_map(x, (batch, *x.spatial_shape))

    def _layer(self, name: str) -> nn.Module:
        return self.layers[name.replace(".", "/")]

    def _block(self, name: str, x: Any, block: nn.Module) -> Any:
        if isinstance(block, ConvNormReLU):
            return self._norm_relu(name, x, block)
        assert isinstance(block, ResidualBlock)
        y = self._layer(f"{name}.conv1")(x)
        y = y.replace_feature(F.relu(self._layer(f"{name}.bn1")(y.features)))
        y = self._layer(f"{name}.conv2")(y)
        return y.replace_feature(F.relu(self._layer(f"{name}.bn2")(y.features) + x.features))

    def _norm_relu(self, name: str, x: Any, block: ConvNormReLU) -> Any:
        y = self._layer(f"{name}.conv")(x)
        return y.replace_feature(F.relu(self._layer(f"{name}.norm")(y.features)))


def uncached(x: SparseMap) -> SparseMap:
    """The same map without kernel maps."""
    kind = SparseBEV if isinstance(x, SparseBEV) else SparseMap
    return kind(Sites(x.sites.shape, x.sites.keys), x.features)


def largest_difference(ours: list[Tensor], theirs: list[Tensor]) -> float:
    """Of any two numbers, relative to the largest of ours."""
    return max(
        float((a.detach() - b.detach()).abs().max() / a.detach().abs().max().clamp(min=1e-30))
        for a, b in zip(ours, theirs, strict=True)
    )
