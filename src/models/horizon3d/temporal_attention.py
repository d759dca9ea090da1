"""Temporal self-attention: current and history Gaussians attend to one another (method 6.3)."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from src.models.horizon3d.time_embedding import TimeEmbedding
from src.structures.gaussians import GaussianSet


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
    ) -> Tensor:  # [B, G, C], to be added to the features
        """q = k = f + e + time(dt), v = f; the time of the current frame counts as zero, not as an embedded zero."""
        x = self.norm(features)
        past = (gaussians.elapsed_s > 0)[..., None]
        position = x + embedding + self.time(gaussians.elapsed_s) * past
        query, key = self.query_key(position).chunk(2, dim=-1)
        split = (self.num_heads, -1)
        heads = [part.unflatten(-1, split).transpose(1, 2) for part in (query, key, self.value(x))]  # [B, H, G, C/H]
        # A sample without valid Gaussians attends to padding, whose result is unused: a softmax over nothing is NaN.
        keys = gaussians.valid | ~gaussians.valid.any(dim=1, keepdim=True)
        attended = F.scaled_dot_product_attention(*heads, attn_mask=keys[:, None, None, :])
        return self.output(attended.transpose(1, 2).flatten(2))
