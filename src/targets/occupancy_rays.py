"""Occupied and free places along LiDAR rays: what supervises occupancy and radial velocity (lrs 6.2)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from src.errors import ConfigError, require_least
from src.geometry.bounds import Bounds
from src.structures.ray_bundle import RayBundle
from src.structures.tensor_fields import TensorFields

BALANCE_M = (50.0, 150.0)
"""Ranges that bound the three shares of `ray_balance`."""


class FreePlaces(Enum):
    """Where on rays the free places lie."""

    along_rays = "along_rays"  # uniform between the sensor and the return: far away most places drawn are occupied
    at_return_ranges = "at_return_ranges"  # at every range as many as occupied ones


@dataclass(kw_only=True)
class RaySampling:
    """How places are drawn along rays (`model.loss.sampling`). Raises ConfigError for values that cannot work."""

    min_free_m: float  # eps: free from here on, as seen from the sensor
    depth_m: float  # delta: occupied so far behind the return
    num_queries: int  # of each sample and target time, half of them occupied
    free_places: FreePlaces
    ray_balance: bool  # equal mass to returns nearer than 50 m, 50 to 150 m and beyond; else rays uniform over returns

    def __post_init__(self) -> None:
        require_least(self, "model.loss.sampling", {"min_free_m": 0, "num_queries": 2})
        if not self.depth_m > 0:
            raise ConfigError(f"model.loss.sampling.depth_m={self.depth_m}: must be above 0, or nothing is occupied")
        if self.num_queries % 2:
            raise ConfigError(
                f"model.loss.sampling.num_queries={self.num_queries}: must be even, half of them are occupied"
            )


@dataclass
class OccupancyQueries(TensorFields):
    """Q places at times, each in the (augmented) ego frame of its sample, and what is there."""

    points: Tensor  # [Q, 3] m
    times_s: Tensor  # [Q] after the sample's frame, the return's own
    occupied: Tensor  # [Q] bool
    speeds: Tensor  # [Q] m/s along the ray: the return's where occupied, NaN if unknown; 0 where free (lrs 2.5)
    steps: Tensor  # [Q] int64, target time
    batch: Tensor  # [Q] int64, sample


def sample_queries(
    rays: RayBundle,
    bounds: Bounds,
    sampling: RaySampling,
    generator: torch.Generator | None = None,  # on the rays' device
) -> OccupancyQueries:
    """Q+ and Q- of every sample and target time, `num_queries` of each pair that has both (lrs 6.2).

    With o a ray's origin, r its direction and d its range: Q+ are o + s r with s ~ U(d, d + delta), Q- with
    s ~ U(eps, d), both cut to the bounds; what lies behind d + delta is unknown and never drawn. Rays are drawn with
    replacement among those that have such a stretch inside, so a return beyond the bounds still says what is free. With
    `at_return_ranges` the s of Q- are those of Q+, each on a ray that goes on further.
    """
    enter, leave = clip_rays(rays, bounds)
    stretches = (
        (torch.maximum(rays.ranges, enter), torch.minimum(rays.ranges + sampling.depth_m, leave)),
        (enter.clamp(min=sampling.min_free_m), torch.minimum(rays.ranges, leave)),
    )
    usable = [high > low for low, high in stretches]
    groups, group = torch.unique(_group(rays), return_inverse=True)
    bins = torch.zeros_like(group)
    if sampling.ray_balance:
        bins = torch.bucketize(rays.ranges, torch.tensor(BALANCE_M, device=bins.device), right=True)
    num_bins = len(BALANCE_M) + 1
    counts = [
        torch.bincount((group * num_bins + bins)[rows], minlength=len(groups) * num_bins).view(-1, num_bins)
        for rows in usable
    ]
    whole = (counts[0].sum(1) > 0) & (counts[1].sum(1) > 0)
    parts, along, num_each = [], rays.ranges[:0], sampling.num_queries // 2
    for occupied, (low, high), rows, count in zip((True, False), stretches, usable, counts, strict=True):
        matched = not occupied and sampling.free_places is FreePlaces.at_return_ranges
        if matched:
            owners = whole.nonzero().squeeze(1).repeat_interleave(num_each)
            drawn = _draw_longer(group, high, rows, owners, along, generator)
        else:
            drawn = _draw_rows(group * num_bins + bins, rows, count, whole, num_each, generator)
        share = torch.rand(len(drawn), generator=generator, device=drawn.device)
        spread = low[drawn] + share * (high[drawn] - low[drawn])
        # Beyond the furthest ray none goes on: there, as without matching, anywhere along it.
        along = torch.where(along < high[drawn], along.maximum(low[drawn]), spread) if matched else spread
        parts.append(
            OccupancyQueries(
                points=rays.origins[drawn] + along[:, None] * rays.directions[drawn],
                times_s=rays.times_s[drawn],
                occupied=torch.full((len(drawn),), occupied, device=drawn.device),
                speeds=rays.speeds[drawn] if occupied else torch.zeros_like(along),
                steps=rays.steps[drawn],
                batch=rays.batch[drawn],
            )
        )
    return OccupancyQueries.concatenate(parts, dim=0)


def clip_rays(
    rays: RayBundle,
    bounds: Bounds,
) -> tuple[Tensor, Tensor]:  # [R] m each
    """Distances at which each ray comes into the bounds (0 for one that begins inside) and leaves them.

    A ray that misses them leaves before it comes in.
    """
    low, high = torch.tensor(bounds, dtype=rays.origins.dtype, device=rays.origins.device).unbind(1)
    heading = torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
    one, two = (low - rays.origins) / heading, (high - rays.origins) / heading
    return torch.minimum(one, two).amax(1).clamp(min=0), torch.maximum(one, two).amin(1)


def _draw_rows(
    keys: Tensor,  # [R] int64, group * bins + bin
    usable: Tensor,  # [R] bool
    counts: Tensor,  # [G, bins] int64, usable rays
    whole: Tensor,  # [G] bool, groups that are drawn from
    count: int,
    generator: torch.Generator | None,
) -> Tensor:  # [drawn groups * count] int64, rows of rays
    """`count` rows of each group: a bin that holds some, each as likely, then a ray of it, each as likely."""
    order = torch.where(usable, keys, keys.new_full((), counts.numel())).argsort(stable=True)
    starts = (counts.flatten().cumsum(0) - counts.flatten()).view_as(counts)[whole]
    counts = counts[whole]
    draws = torch.rand(2, len(counts), count, generator=generator, device=keys.device, dtype=torch.float64)
    filled = counts > 0
    nth = (draws[0] * filled.sum(1, keepdim=True)).long()  # of the bins that hold some
    chosen = torch.searchsorted(filled.cumsum(1), nth + 1)
    within = (draws[1] * counts.gather(1, chosen)).long()
    return order[(starts.gather(1, chosen) + within).flatten()]


def _draw_longer(
    group: Tensor,  # [R] int64
    ends: Tensor,  # [R] m, how far the ray is free
    usable: Tensor,  # [R] bool
    owners: Tensor,  # [n] int64, group of each draw; all hold a usable ray
    ranges: Tensor,  # [n] m
    generator: torch.Generator | None,
) -> Tensor:  # [n] int64, rows of rays
    """A ray of the group that is free beyond the range, each as likely; the group's longest where none is."""
    span = (float(ends.max()) if len(ends) else 0.0) + 1.0
    place = group * span + ends.double()
    order = usable.nonzero().squeeze(1)
    order = order[place[order].argsort(stable=True)]
    last = torch.searchsorted(place[order], (owners + 1) * span)
    first = torch.searchsorted(place[order], owners * span + ranges.double(), right=True).minimum(last - 1)
    draws = torch.rand(len(owners), generator=generator, device=owners.device, dtype=torch.float64)
    return order[first + (draws * (last - first)).long()]


def draw_rays(
    rays: RayBundle,
    bounds: Bounds,
    count: int,
    generator: torch.Generator | None = None,  # on the rays' device
    range_power: float = 0.0,
) -> RayBundle:
    """Up to `count` rays of every sample and target time that end in the bounds, without replacement, in order.

    Each has a chance in proportion to its range to `range_power`, one after the other among those that are left.
    """
    low, high = torch.tensor(bounds, dtype=rays.origins.dtype, device=rays.origins.device).unbind(1)
    ends = rays.points
    rows = ((ends >= low) & (ends < high)).all(1).nonzero().squeeze(1)
    # The first of exponential times at rates w is each with chance w / sum(w); then the same among the rest.
    times = -torch.log1p(-torch.rand(len(rows), generator=generator, device=rows.device))
    rows = rows[(times / rays.ranges[rows] ** range_power).argsort()]
    rows = rows[_group(rays)[rows].argsort(stable=True)]
    _, sizes = torch.unique_consecutive(_group(rays)[rows], return_counts=True)
    starts = sizes.cumsum(0) - sizes
    place = torch.arange(len(rows), device=rows.device) - starts.repeat_interleave(sizes)
    return rays[rows[place < count].sort().values]


def _group(rays: RayBundle) -> Tensor:  # [R] int64
    """A number for each pair of sample and target time, ascending with both."""
    span = (rays.steps.max() - rays.steps.min() + 1) if len(rays) else 1
    return rays.batch * span + rays.steps
