"""A trained detector made ready for inference: the same function up to rounding, with fewer and larger operations.

Batch norms go into the convolutions and linear layers before them, parallel branches become one product, history keeps
a fixed number of places, and nothing records gradients.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from src.losses.normalizers import full_precision
from src.models.backbones.resnet import BasicBlock, Bottleneck, ResNet
from src.models.backbones.vovnet import ConvNorm
from src.models.dense_bev.pillars import PillarEncoder
from src.models.dense_bev.temporal_fusion import TemporalFusion
from src.models.detector import Detector
from src.models.heads.branches import Branches
from src.models.heads.center_head import CenterHead
from src.models.horizon3d.bev_path import BEVPath
from src.models.horizon3d.gaussian_encoder import AnchorEncoder, Refinement
from src.models.horizon3d.gaussian_path import GaussianPath
from src.models.horizon3d.kggi import KGGI
from src.models.horizon3d.sparse_fusion import SparseFusion
from src.models.horizon3d.time_embedding import TimeEmbedding
from src.models.layers.dense import DenseConvNormReLU
from src.models.layers.sparse import ConvNormReLU, ResidualBlock, SparseKernel, SubmanifoldConv

CPU_CHUNK = 512
"""Rows at a time through a wide hidden layer, so that it stays in the cache."""

Linear = nn.Conv2d | nn.ConvTranspose2d | nn.Linear | SparseKernel
"""Layers that a norm behind them can go into."""

PAIRS: dict[type[nn.Module], tuple[tuple[str, str], ...]] = {
    ConvNorm: (("conv", "bn"),),
    ResNet: (("conv1", "bn1"),),
    BasicBlock: (("conv1", "bn1"), ("conv2", "bn2")),
    Bottleneck: (("conv1", "bn1"), ("conv2", "bn2"), ("conv3", "bn3")),
    ConvNormReLU: (("conv", "norm"),),
    ResidualBlock: (("conv1", "bn1"), ("conv2", "bn2")),
    DenseConvNormReLU: (("conv", "norm"),),
    TemporalFusion: (("refine", "norm"),),
    SparseFusion: (("conv1", "norm1"), ("conv2", "norm2")),
    Branches: (("hidden", "norm"),),
}
"""Where a norm directly follows a layer, by the names of both. Others, as the norms before a union, stay."""


def prepare_for_inference(model: Detector, bf16: bool = False) -> Detector:
    """A copy of the model in evaluation mode that gives the same outputs up to rounding, faster.

    With `bf16` the weights that autocast would round in every frame are rounded once, so the copy runs under bfloat16
    autocast only. Parts that the copy does not know are left as they are. `loss` and `train` are of no use with it.
    Raises ValueError for a model that is prepared already.
    """
    if model.prepared_bf16 is not None:
        raise ValueError("the model is prepared for inference already; prepare the trained one")
    with torch.inference_mode(False), torch.no_grad():
        model = copy.deepcopy(model).eval()
        model.zero_grad(set_to_none=True)
        model.requires_grad_(False)
        _fold_norms(model)
        for module in list(model.modules()):
            if isinstance(module, CenterHead):
                _merge_head(module)
            elif isinstance(module, BEVPath):
                _merge_cell_heads(module)
            elif isinstance(module, GaussianPath):
                module.fixed_capacity = True
        if bf16:
            _round_weights(model)
        for value in model.parameters():
            if value.dim() == 4:
                value.data = value.data.contiguous(memory_format=torch.channels_last)
            value.requires_grad_(False)
    model.prepared_bf16 = bf16
    return model


def fold_norm(layer: Linear, norm: _BatchNorm) -> None:
    """Put a batch norm's running statistics and affine map into the layer before it, computed in float64."""
    if norm.running_mean is None or norm.running_var is None:
        raise ValueError(f"{norm}: a batch norm without running statistics cannot be folded")
    scale = (norm.running_var.double() + norm.eps).rsqrt()
    if norm.weight is not None:
        scale = scale * norm.weight.double()
    shift = -norm.running_mean.double() * scale
    if norm.bias is not None:
        shift = shift + norm.bias.double()
    axis = {nn.ConvTranspose2d: 1, nn.Conv2d: 0, nn.Linear: 0}.get(type(layer), 2)
    shape = [-1 if number == axis else 1 for number in range(layer.weight.dim())]
    weight = layer.weight.double() * scale.view(shape)
    if layer.bias is not None:
        shift = shift + layer.bias.double() * scale
    layer.weight.data = weight.to(layer.weight.dtype)
    layer.bias = nn.Parameter(shift.to(layer.weight.dtype), requires_grad=False)


class MergedBranches(nn.Module):
    """All branches of several `Branches` on the same input: one product to all hidden layers, one from them."""

    def __init__(self, branches: Sequence[Branches]) -> None:
        super().__init__()
        hidden = [part.hidden for part in branches]
        outputs = [output for part in branches for output in part.outputs]
        self.hidden = _linear(torch.cat([x.weight for x in hidden]), torch.cat([x.bias for x in hidden]))
        self.outputs = _block_diagonal(outputs)

    def forward(
        self,
        x: Tensor,  # [n, C]
    ) -> Tensor:  # [n, sum of widths] float32
        """Outputs of all branches side by side."""
        parts = [x] if x.device.type != "cpu" else x.split(CPU_CHUNK)
        return full_precision(torch.cat([self.outputs(self.hidden(part).relu_()) for part in parts]))


def _fold_norms(model: nn.Module) -> None:
    for module in model.modules():
        for layer, norm in PAIRS.get(type(module), ()):
            fold_norm(getattr(module, layer), getattr(module, norm))
            setattr(module, norm, nn.Identity())
        if isinstance(module, nn.Sequential):
            for number, (layer, norm) in enumerate(zip(module[:-1], module[1:], strict=True)):
                if isinstance(layer, Linear) and isinstance(norm, _BatchNorm):
                    fold_norm(layer, norm)
                    module[number + 1] = nn.Identity()
        elif isinstance(module, BEVPath | PillarEncoder):
            layers = module.convs if isinstance(module, BEVPath) else module.layers
            for number, (layer, norm) in enumerate(zip(layers, module.norms, strict=True)):
                fold_norm(layer, norm)
                module.norms[number] = nn.Identity()


def _merge_head(head: CenterHead) -> None:
    """Heat maps of all groups are asked for in every cell, codes of one group where it has candidates."""
    if all(isinstance(part, Branches) for part in (*head.heatmaps, *head.regressions)):
        head.heatmaps = nn.ModuleList([MergedBranches(list(head.heatmaps))])
        head.regressions = nn.ModuleList(MergedBranches([part]) for part in head.regressions)


def _merge_cell_heads(path: BEVPath) -> None:
    """Occupancy and velocity read the same cells: one convolution and one linear layer for both."""
    (occupancy, first), (velocity, second) = path.occupancy, path.velocity
    occupancy.conv = _merged([occupancy.conv, velocity.conv])
    path.occupancy = nn.ModuleList([occupancy, _block_diagonal([first, second])])
    path.velocity = None


def _merged(convs: Sequence[SubmanifoldConv]) -> SubmanifoldConv:
    """One convolution with the outputs of all side by side."""
    first, widths = convs[0], [conv.out_channels for conv in convs]
    merged = SubmanifoldConv(first.in_channels, sum(widths), first.kernel_size, first.ndim, bias=True)
    merged.weight.data = torch.cat([conv.weight for conv in convs], dim=2)
    merged.bias.data = torch.cat([conv.bias for conv in convs])
    return merged.requires_grad_(False).eval()


def _block_diagonal(layers: Sequence[nn.Linear]) -> nn.Linear:
    """One layer that maps the inputs of all, side by side, to the outputs of all."""
    return _linear(torch.block_diag(*(x.weight for x in layers)), torch.cat([x.bias for x in layers]))


def _linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
    layer.weight, layer.bias = (nn.Parameter(value, requires_grad=False) for value in (weight, bias))
    return layer


def _round_weights(model: nn.Module) -> None:
    """To bfloat16, except where the model computes in float32 whatever autocast says."""
    exact = {id(module) for part in _exact_parts(model.modules()) for module in part.modules()}
    for module in model.modules():
        if isinstance(module, Linear) and id(module) not in exact:
            module.to(torch.bfloat16)


def _exact_parts(modules: Iterable[nn.Module]) -> Iterator[nn.Module]:
    for module in modules:
        if isinstance(module, AnchorEncoder | TimeEmbedding | PillarEncoder):
            yield module
        elif isinstance(module, Refinement):
            yield module.output
        elif isinstance(module, KGGI) and hasattr(module, "property_heads"):
            yield module.property_heads
        elif isinstance(module, BEVPath):
            yield module.occupancy[1]
