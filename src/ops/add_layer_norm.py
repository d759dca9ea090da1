"""LayerNorm with what stands around it: a sum before it, a ReLU, a sum behind it; on a GPU without gradient at once."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.ops.backend import implementation

Affine = tuple[Tensor, Tensor]
"""Scale and shift [C] of a norm."""


def add_layer_norm(
    x: Tensor,  # [..., C]
    affine: Affine,
    eps: float,
    added: Tensor | None = None,  # [..., C]
    relu: bool = False,
    then: Tensor | None = None,  # [..., C]
    aged: tuple[Tensor, Tensor] | None = None,  # [..., C], ages [...]: added too where the age is above 0
) -> tuple[Tensor, Tensor | None]:  # [..., C] each
    """Norm of x, or of its sum with `added`, with a ReLU if asked for; and that plus `then`, None without it."""
    fused_elsewhere = torch.is_grad_enabled() or torch.compiler.is_compiling()
    form = add_layer_norm_reference if fused_elsewhere else implementation(add_layer_norm_reference)
    return form(x, affine, eps, added, relu, then, aged)


def add_layer_norm_reference(
    x: Tensor, affine: Affine, eps: float, added: Tensor | None = None, relu: bool = False, then: Tensor | None = None,
    aged: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor | None]:  # fmt: skip
    """Plain torch form."""
    normed = F.layer_norm(x if added is None else x + added, x.shape[-1:], *affine, eps)
    if relu:
        normed = normed.relu()
    if then is None:
        return normed, None
    behind = normed + then
    if aged is not None:
        behind = behind + aged[0] * (aged[1] > 0)[..., None]
    return normed, behind


@torch.no_grad()
def relu_norm_columns(
    hidden: Tensor,  # [K, n, C], may be overwritten
    eps: float,
) -> Tensor:  # [n, K * C]
    """Norm, without scale and shift, of the positive part of each row; the K rows side by side. Without gradient."""
    if torch.compiler.is_compiling():
        return relu_norm_columns_reference(hidden, eps)
    return implementation(relu_norm_columns_reference)(hidden, eps)


def relu_norm_columns_reference(hidden: Tensor, eps: float) -> Tensor:
    """Plain torch form."""
    return F.layer_norm(hidden.relu_(), hidden.shape[-1:], eps=eps).transpose(0, 1).flatten(1)
