"""Fast forms of the sum of small MLPs that embeds a Gaussian's attributes (`gaussian_encoder.AnchorEncoder`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.layers.merging import LinearReLU, block_diagonal, joined_linear, with_relu
from src.ops.add_layer_norm import relu_norm_columns


@dataclass
class JoinedEmbeddings:
    """K `linear_relu_norm` of inputs side by side, for few launches: their weights, through which gradients pass."""

    eps: float
    first: tuple[Tensor, Tensor]  # [K * C, widths], [K * C]
    inner: tuple[Tensor, Tensor]  # scale and shift of the first norm, [K, C] each
    second: tuple[Tensor, Tensor]  # [K, C, C] in, out; [K, 1, C]
    outer: tuple[Tensor, Tensor]  # scale and shift of the second norm, [K, 1, C] each

    @classmethod
    def of(cls, parts: Sequence[nn.Sequential]) -> JoinedEmbeddings:
        """Join these networks, in the order of their inputs."""

        def stacked(number: int, name: str) -> Tensor:
            return torch.stack([getattr(part[number], name) for part in parts])

        return cls(
            parts[0][2].eps,
            (torch.block_diag(*(part[0].weight for part in parts)), stacked(0, "bias").flatten()),
            (stacked(2, "weight"), stacked(2, "bias")),
            (stacked(3, "weight").transpose(1, 2), stacked(3, "bias")[:, None]),
            (stacked(5, "weight")[:, None], stacked(5, "bias")[:, None]),
        )

    def __call__(
        self,
        x: Tensor,  # [B, G, widths]
    ) -> Tensor:  # [B, G, C]
        """Sum of what all make of their inputs."""
        parts, _, channels = self.second[0].shape
        hidden = F.linear(x.flatten(0, 1), *self.first).relu().view(-1, parts, channels)
        hidden = torch.addcmul(self.inner[1], F.layer_norm(hidden, (channels,), eps=self.eps), self.inner[0])
        hidden = torch.baddbmm(self.second[1], hidden.transpose(0, 1), self.second[0]).relu()  # [K, B * G, C]
        hidden = torch.addcmul(self.outer[1], F.layer_norm(hidden, (channels,), eps=self.eps), self.outer[0])
        return hidden.sum(0).view(*x.shape[:2], channels)


class MergedEmbeddings(nn.Module):
    """The sum of several `linear_relu_norm` of inputs side by side, through the linear layer and the ReLU behind it."""

    def __init__(self, parts: Sequence[nn.Sequential], behind: nn.Linear) -> None:
        super().__init__()
        self.eps = parts[0][2].eps
        self.first = with_relu(block_diagonal([part[0] for part in parts]))
        # A norm's scale and shift go into the layer behind it.
        weights = torch.stack([(part[3].weight * part[2].weight).t() for part in parts])  # [K, C, C]
        biases = torch.stack([part[3].bias + part[3].weight @ part[2].bias for part in parts])
        self.weights, self.biases = (nn.Parameter(x, requires_grad=False) for x in (weights, biases[:, None]))
        bias = behind.bias + sum(behind.weight @ part[5].bias for part in parts)
        self.behind = joined_linear(torch.cat([behind.weight * part[5].weight for part in parts], 1), bias, LinearReLU)

    def forward(
        self,
        x: Tensor,  # [B, G, widths]
    ) -> Tensor:  # [B, G, C]
        """Products over all parts at once."""
        parts, channels = self.weights.shape[:2]
        hidden = F.layer_norm(self.first(x).view(-1, parts, channels), (channels,), eps=self.eps)
        hidden = torch.baddbmm(self.biases, hidden.transpose(0, 1), self.weights)  # [K, B * G, C]
        return self.behind(relu_norm_columns(hidden, self.eps).unflatten(0, x.shape[:2]))
