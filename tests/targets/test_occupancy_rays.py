"""Places along rays, by hand and by their distribution."""

from dataclasses import replace

import pytest
import torch

from src.errors import ConfigError
from src.targets.occupancy_rays import FreePlaces, RaySampling, clip_rays, sample_queries
from tests.ray_bundles import rays_to

BOUNDS = ((-100.0, 250.0), (-100.0, 100.0), (-12.0, 12.0))  # lrs 2.1
SAMPLING = RaySampling(
    min_free_m=1.5, depth_m=0.1, num_queries=2000, free_places=FreePlaces.along_rays, ray_balance=False
)


def rays_from_above(ends, times_s=None, origin=(0.0, 0.0, 2.0), **known):
    """By its time one knows of which ray a query is."""
    return rays_to(ends, origin=origin, times_s=torch.arange(len(ends)) * 0.1 if times_s is None else times_s, **known)


def seeded(number=0):
    return torch.Generator().manual_seed(number)


def distances(queries, rays, row):
    """How far along ray `row`, to which all of them belong, the queries lie."""
    away = queries.points - rays.origins[row]
    torch.testing.assert_close(
        away / away.norm(dim=1)[:, None], rays.directions[row].expand_as(away), atol=1e-4, rtol=0
    )
    return away.norm(dim=1)


def test_free_from_eps_to_the_return_and_occupied_just_behind_it():
    rays = rays_from_above([[30.0, 10.0, 1.0]], speeds=[7.0], times_s=[0.43])
    queries = sample_queries(rays, BOUNDS, SAMPLING, seeded())
    along, d = distances(queries, rays, 0), float(rays.ranges)
    occupied = along[queries.occupied]
    assert len(occupied) == 1000 and len(along) == 2000
    assert d - 1e-4 <= occupied.min() < d + 0.002 and d + 0.098 < occupied.max() <= d + 0.1 + 1e-4
    free = along[~queries.occupied]
    assert 1.5 <= free.min() < 1.6 and d - 0.3 < free.max() <= d + 1e-4
    assert float(free.mean()) == pytest.approx(0.5 * (1.5 + d), abs=1.0)  # uniform
    assert (queries.times_s == rays.times_s[0]).all()
    assert (queries.speeds[queries.occupied] == 7).all() and (queries.speeds[~queries.occupied] == 0).all()


def test_what_is_not_known_has_no_speed():
    queries = sample_queries(rays_from_above([[30.0, 0, 1]]), BOUNDS, SAMPLING, seeded())
    assert queries.speeds[queries.occupied].isnan().all() and (queries.speeds[~queries.occupied] == 0).all()


def test_both_are_cut_to_the_bounds():
    rays = rays_from_above([[400.0, 0.0, 2.0], [50.0, 0.0, 2.0]])
    queries = sample_queries(rays, BOUNDS, SAMPLING, seeded())
    assert queries.points[:, 0].max() <= 250 + 1e-3 and queries.occupied.sum() == 1000
    assert (queries.points[queries.occupied, 0] < 50.2).all()  # the return at 400 m lies outside
    assert (queries.points[~queries.occupied, 0] > 60).any()  # but says that the way there is free
    edge = rays_from_above([[249.95, 0.0, 2.0]])
    inside = sample_queries(edge, BOUNDS, SAMPLING, seeded())
    assert inside.points[inside.occupied, 0].max() <= 250 + 1e-3
    enter, leave = clip_rays(rays_from_above([[0.0, 0.0, 2.0]], origin=(-150.0, 0.0, 2.0)), BOUNDS)
    assert (float(enter), float(leave)) == (50.0, 400.0)
    enter, leave = clip_rays(rays_from_above([[0.0, 0.0, 40.0]], origin=(0.0, 0.0, 20.0)), BOUNDS)
    assert leave < enter


def test_a_return_nearer_than_eps_is_occupied_and_leaves_nothing_free():
    near = rays_from_above([[1.0, 0.0, 2.0], [20.0, 0.0, 2.0]])
    queries = sample_queries(near, BOUNDS, SAMPLING, seeded())
    assert (queries.times_s[~queries.occupied] == near.times_s[1]).all()
    assert 400 < (queries.times_s[queries.occupied] == near.times_s[0]).sum() < 600
    for ends in ([[1.0, 0.0, 2.0]], [[400.0, 0.0, 2.0]]):  # nothing free, nothing occupied: no pair, no query
        assert len(sample_queries(rays_from_above(ends), BOUNDS, SAMPLING, seeded()).points) == 0
    for places in FreePlaces:
        sampling = replace(SAMPLING, free_places=places)
        assert len(sample_queries(near[torch.tensor([], dtype=torch.int64)], BOUNDS, sampling).points) == 0


def test_samples_and_times_have_their_own_share_and_never_mix():
    rays = rays_from_above(
        [[10.0, 0, 2], [20.0, 0, 2], [30.0, 0, 2], [1.0, 0, 2], [40.0, 0, 2]],
        steps=[-1, 0, 0, 3, 0], batch=[0, 0, 0, 0, 1],
    )  # fmt: skip
    queries = sample_queries(rays, BOUNDS, SAMPLING, seeded())
    for batch, step, count in ((0, -1, 1000), (0, 0, 1000), (0, 3, 0), (1, 0, 1000)):
        rows = (queries.batch == batch) & (queries.steps == step)
        assert (rows & queries.occupied).sum() == (rows & ~queries.occupied).sum() == count
        ends = rays.points[(rays.batch == batch) & (rays.steps == step), 0]
        nearest = (queries.points[rows & queries.occupied, :1] - ends).abs().amin(1)
        assert count == 0 or nearest.max() <= 0.1 + 1e-4


@pytest.mark.parametrize("balanced, shares", [(False, [0.9, 0.08, 0.02]), (True, [1 / 3] * 3)])
def test_rays_are_uniform_or_balanced_over_distance(balanced, shares):
    ends = [[10.0 + 0.1 * n, 5.0, 2.0] for n in range(90)] + [[100.0 + n, 5.0, 2.0] for n in range(8)]
    rays = rays_from_above(ends + [[200.0, 5.0, 2.0], [210.0, 5.0, 2.0]])
    sampling = RaySampling(**(vars(SAMPLING) | {"ray_balance": balanced, "num_queries": 20_000}))
    queries = sample_queries(rays, BOUNDS, sampling, seeded())
    away = (queries.points[queries.occupied] - rays.origins[0]).norm(dim=1)
    found = torch.histogram(away, torch.tensor([0.0, 50.0, 150.0, 300.0])).hist / len(away)
    torch.testing.assert_close(found, torch.tensor(shares), atol=0.02, rtol=0)
    far_alone = sample_queries(rays[rays.ranges > 150], BOUNDS, sampling, seeded())  # empty bins get nothing
    assert far_alone.occupied.sum() == 10_000


def test_free_places_at_the_ranges_of_returns():
    """As many as occupied ones at every range, on rays that go on; the furthest ray itself is free all along."""
    ends = [[10.0, 0, 2]] * 60 + [[40.0, 0, 2]] * 30 + [[0.0, 80.0, 2]] * 10
    ends, batch = ends + [[30.0, 0, 2]] * 2 + [[60.0, 0, 2]], [0] * 100 + [1] * 3
    rays = rays_from_above(ends, batch=batch, times_s=[0.01 * row for row in range(103)])
    changes = {"free_places": FreePlaces.at_return_ranges, "num_queries": 20_000}
    queries = sample_queries(rays, BOUNDS, RaySampling(**(vars(SAMPLING) | changes)), seeded())
    along = (queries.points - rays.origins[0]).norm(dim=1)
    free = (queries.batch == 0) & ~queries.occupied
    assert free.sum() == 10_000 and (along[free] < 80.0).all()
    for d, share in ((10.0, 0.6), (40.0, 0.3)):
        near = free & (along > d - 1e-3) & (along < d + 0.1 + 1e-3)
        assert float(near.sum()) / 10_000 == pytest.approx(share, abs=0.03)
        own = (queries.times_s[near] * 100).round().long()
        assert (rays.ranges[own] > d + 0.1).all()  # not the rays that end there
        longer = int((rays.ranges[:100] > d + 0.1).sum())
        assert len(own.unique()) == longer
    rest = along[free & (along > 1.0) & (along < 9.9)]
    assert 0 < len(rest) < 400  # the share of the furthest, spread
    other = (queries.batch == 1) & ~queries.occupied
    assert float((along[other].sub(30.05).abs() < 0.06).float().mean()) == pytest.approx(2 / 3, abs=0.03)


def test_the_seed_decides():
    rays = rays_from_above([[30.0, 10.0, 1.0], [60.0, 1.0, 2.0]])
    one, same, other = (sample_queries(rays, BOUNDS, SAMPLING, seeded(number)).points for number in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"depth_m": 0.0}, "depth_m"),
        ({"num_queries": 3}, "even"),
        ({"min_free_m": -1.0}, "min_free_m"),
        ({"num_queries": 0}, "num_queries"),
    ],
)
def test_what_cannot_be_drawn(changes, words):
    with pytest.raises(ConfigError, match=words):
        RaySampling(**(vars(SAMPLING) | changes))
