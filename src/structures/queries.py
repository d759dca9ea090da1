"""Object queries: what a set-prediction detector asks about each sample."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from src.structures.taxonomy import CLASSES
from src.structures.tensor_fields import TensorFields

UNKNOWN_LOGIT = -4.6
"""Where scores of queries start of which nothing is known: probability 0.01."""


@dataclass
class Queries(TensorFields):
    """Q queries of each of B samples, in the augmented ego frame; padding is not `valid`, but finite."""

    features: Tensor  # [B, Q, C]
    centers: Tensor  # [B, Q, 3] m, where each looks and what its box is relative to
    velocities: Tensor  # [B, Q, 2] m/s over ground, likewise
    logits: Tensor  # [B, Q, 12] what is known of its class before it has looked, columns as taxonomy.CLASSES
    valid: Tensor  # [B, Q] bool
    groups: Tensor | None = None  # [B, Q] int64, who sees whom (`seen`); None: all are of group 0

    def __len__(self) -> int:
        return self.valid.shape[1]

    @classmethod
    def unknown(cls, features: Tensor, centers: Tensor, valid: Tensor) -> Queries:  # [B, Q, C], [B, Q, 3], [B, Q]
        """Queries of no known class that stand still."""
        logits = centers.new_full((*valid.shape, len(CLASSES)), UNKNOWN_LOGIT)
        return cls(features, centers, torch.zeros_like(centers[..., :2]), logits, valid)

    def beside(self, others: Queries) -> Queries:
        """These queries, all in group 0, followed by others that have groups."""
        own = replace(self, groups=torch.zeros_like(self.valid, dtype=torch.int64))
        return Queries.concatenate([own, others], dim=1)

    def seen(
        self,
        past: Tensor | None = None,  # [B, n] bool, which further ones are valid; all are of group 0
    ) -> Tensor:  # [B, Q + n] bool, or with groups [B, Q, Q + n]
        """Which queries each may look at: valid ones of group 0 and of its own."""
        valid = self.valid if past is None else torch.cat([self.valid, past], dim=1)
        if self.groups is None:
            return valid
        groups = F.pad(self.groups, (0, valid.shape[1] - len(self)))[:, None]
        return valid[:, None] & ((groups == 0) | (groups == self.groups[..., None]))
