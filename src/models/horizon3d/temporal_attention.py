"""Temporal self-attention: current and history Gaussians attend to one another (method 6.3)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.horizon3d.time_embedding import TimeEmbedding
from src.ops.add_layer_norm import add_layer_norm
from src.structures.gaussians import GaussianSet

MASK_ALIGNMENT = 16
"""Values, of torch's memory-efficient attention."""


class TemporalSelfAttention(nn.Module):
    """Pre-norm multi-head attention over all valid Gaussians; adds exactly zero before it is trained."""

    static_parts = ("",)

    def __init__(self, channels: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.norm = nn.LayerNorm(channels)
        self.time = TimeEmbedding(channels)
        self.query_key = nn.Linear(channels, 2 * channels)
        self.value = nn.Linear(channels, channels)
        self.output = nn.Linear(channels, channels)
        for linear in (self.query_key, self.value):
            nn.init.xavier_uniform_(linear.weight)
            nn.init.zeros_(linear.bias)
        nn.init.zeros_(self.output.weight)
        nn.init.zeros_(self.output.bias)

    def forward(
        self,
        features: Tensor,  # [B, G, C]
        embedding: Tensor,  # [B, G, C] from the anchor encoder
        gaussians: GaussianSet,
        mask: Tensor | None = None,  # `attention_mask` of them, where the caller has it
    ) -> Tensor:  # [B, G, C], to be added to the features
        """q = k = f + e + time(dt), v = f; the time of the current frame counts as zero, not as an embedded zero."""
        norm, ages = self.norm, gaussians.elapsed_s
        affine, past = (norm.weight, norm.bias), (self.time(ages), ages)
        x, position = add_layer_norm(features, affine, norm.eps, then=embedding, aged=past)
        query, key = self.query_key(position).chunk(2, dim=-1)
        split = (self.num_heads, -1)
        heads = [part.unflatten(-1, split).transpose(1, 2) for part in (query, key, self.value(x))]  # [B, H, G, C/H]
        mask = attention_mask(gaussians.valid, x.dtype) if mask is None else mask
        attended = F.scaled_dot_product_attention(*heads, attn_mask=mask)
        return self.output(attended.transpose(1, 2).flatten(2))


def attention_mask(
    valid: Tensor,  # [B, G] bool
    dtype: torch.dtype,
) -> Tensor:  # [B, 1, 1, G]
    """What is added to the logits of all queries: -inf for keys that are padding.

    A sample without valid Gaussians attends to padding, whose result is unused: a softmax over nothing is NaN. Rows
    begin where a GPU's fused attention wants them, which would otherwise copy them.
    """
    keys = valid | ~valid.any(dim=1, keepdim=True)
    missing = -keys.shape[1] % MASK_ALIGNMENT
    mask = F.pad(keys.to(dtype).log_(), (0, missing))
    return mask[:, None, None, : keys.shape[1]]
