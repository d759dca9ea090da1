"""Sort keys of (cell, class) pairs, group by group, and the pairs of chosen keys."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.constants import arange, constant, where_scalar
from src.ops.backend import implementation
from src.ops.nms import maxpool_peaks
from src.ops.sites import Sites

PLACE_BITS = 31
ClassGroups = tuple[tuple[int, ...], ...]
"""Classes of every group, as many of each; where it has less, the number of all classes."""


@torch.no_grad()
def candidate_sort_keys(
    logits: Tensor,  # [M, classes]
    sites: Sites,  # M sites in 2D, in fixed shapes
    groups: ClassGroups,
    peaks: bool,  # only local maxima have a score, see `maxpool_peaks`
) -> Tensor:  # [groups, M * classes of a group] int64
    """The bits of each score, which are in their order as none is negative, less the place, so that the first leads.

    Padding and what no class is have score 0. Without gradient.
    """
    return implementation(candidate_sort_keys_reference)(logits, sites, groups, peaks)


def candidate_sort_keys_reference(logits: Tensor, sites: Sites, groups: ClassGroups, peaks: bool) -> Tensor:
    """Plain torch form."""
    scores = logits.sigmoid()
    if peaks:
        scores = scores * maxpool_peaks(scores, sites)
    scores = where_scalar((sites.keys < sites.end)[:, None], scores, 0.0)  # padding may hold what is not finite
    return sort_keys_of_scores(scores, groups)


def sort_keys_of_scores(
    scores: Tensor,  # [M, classes]
    groups: ClassGroups,
) -> Tensor:  # [groups, M * classes of a group] int64
    """See `candidate_sort_keys`."""
    table = constant(groups, torch.int64, scores.device)
    by_group = F.pad(scores.float(), (0, 1)).index_select(1, table.flatten())  # [M, groups * classes of a group]
    by_group = by_group.unflatten(1, table.shape).transpose(0, 1).flatten(1)
    place = arange(by_group.shape[1], torch.int64, scores.device)
    return (by_group.contiguous().view(torch.int32).long() << PLACE_BITS) - place


@torch.no_grad()
def unpack_candidates(
    sort_keys: Tensor,  # [groups, n] int64
    groups: ClassGroups,
    num_classes: int,
) -> tuple[Tensor, Tensor, Tensor]:  # [groups, n] each: float32; int64, row; int64, class
    """Score, row and class of each key."""
    return implementation(unpack_candidates_reference)(sort_keys, groups, num_classes)


def unpack_candidates_reference(
    sort_keys: Tensor, groups: ClassGroups, num_classes: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Plain torch form."""
    table = constant(groups, torch.int64, sort_keys.device)
    places = -sort_keys & (2**PLACE_BITS - 1)
    scores = ((sort_keys + places) >> PLACE_BITS).int().view(torch.float32)
    rows = torch.div(places, table.shape[1], rounding_mode="floor")
    return scores, rows, table.gather(1, places - rows * table.shape[1]).clamp(max=num_classes - 1)
