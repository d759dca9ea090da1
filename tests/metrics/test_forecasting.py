"""Scores of forecasts, worked out by hand and against all distances."""

import numpy as np
import pytest
import torch

from src.metrics.diagnostics import ratios
from src.metrics.forecasting import (
    ForecastScores,
    chamfer_distance,
    forecast_sums,
    keep_common_frames,
    median_errors,
    score_forecast,
)
from tests.ray_bundles import rays_to

BOUNDS = ((-100.0, 250.0), (-100.0, 100.0), (-12.0, 12.0))


def test_chamfer_distance_is_halved_and_squared():
    assert chamfer_distance(np.zeros((1, 3)), np.array([[3.0, 4.0, 0.0]])) == 25.0
    one_sided = chamfer_distance(np.zeros((1, 3)), np.array([[0.0, 0, 0], [2.0, 0, 0]]))
    assert one_sided == 0.5 * (0 + (0 + 4) / 2)
    assert np.isnan(chamfer_distance(np.zeros((0, 3)), np.zeros((1, 3))))


@pytest.mark.parametrize("spread", [1.0, 40.0])
def test_chamfer_distance_is_that_of_all_distances(spread):
    rng = np.random.default_rng(0)
    found, truth = rng.normal(0, spread, (300, 3)), rng.normal(3, spread, (500, 3))
    squared = ((found[:, None] - truth[None]) ** 2).sum(-1)
    expected = 0.5 * (squared.min(1).mean() + squared.min(0).mean())
    assert chamfer_distance(found, truth) == pytest.approx(expected, rel=1e-12)
    assert chamfer_distance(truth, found) == pytest.approx(expected, rel=1e-12)
    assert chamfer_distance(found, found[::-1]) == 0.0


def test_near_and_long_field_are_those_of_each_clouds_own_points():
    rays = rays_to([[40.0, 0, 0], [60.0, 0.0, 0.0], [0.0, 80.0, 0.0]], steps=1)
    found = torch.tensor([44.0, 45.0, 83.0])  # the second comes into the near field
    scores = score_forecast(rays, found, BOUNDS)
    assert scores.steps.tolist() == [1]
    near = 0.5 * ((16 + 25) / 2 + 16)
    far = 0.5 * (9 + ((60**2 + 83**2) + 9) / 2)
    assert scores.chamfer["nfcd"][0] == pytest.approx(near, rel=1e-5)
    assert scores.chamfer["lfcd"][0] == pytest.approx(far, rel=1e-5)
    np.testing.assert_allclose(scores.errors, [4, 15, 3], rtol=1e-5)


def test_clouds_are_cut_to_the_bounds_each_by_its_own_points():
    rays = rays_to([[100.0, 0, 0], [240.0, 0, 0], [0.0, 150.0, 0]], steps=1)
    scores = score_forecast(rays, torch.tensor([101.0, 260.0, 150.0]), BOUNDS)
    assert scores.chamfer["cd"][0] == pytest.approx(0.5 * (1 + (1 + 139**2) / 2), rel=1e-5)
    np.testing.assert_allclose(scores.errors, [1, 20])  # the third return lies outside
    nothing = score_forecast(rays[rays.ranges < 0], torch.zeros(0), BOUNDS)
    assert len(nothing.steps) == len(nothing.errors) == 0


def scored():
    """Two samples: the first at steps 0, 2, 5 and 15, one metre, 2 m, 3 m and 4 m wrong; the second at 5, 6 m wrong."""
    found = []
    for steps, off, moves in (((0, 2, 5, 15), (1.0, 2, 3, 4), True), ((5,), (6.0,), False)):
        rays = rays_to([[30.0, 0, 0], [0, 90.0, 0]] * len(steps), steps=np.repeat(steps, 2).tolist())
        moving = torch.tensor([moves, False] * len(steps))
        ranges = rays.ranges + torch.tensor(off).repeat_interleave(2)
        found.append(score_forecast(rays, ranges, BOUNDS, {"moving": moving}))
    return found


def test_means_over_the_horizon_frames_and_bins():
    by_sample = [forecast_sums(scores, 0.2) for scores in scored()]
    names = dict.fromkeys(name for sums in by_sample for name in sums)
    stacked = {name: np.stack([sums.get(name, np.zeros(2)) for sums in by_sample]) for name in names}
    means = {name: float(value[0]) for name, value in ratios(stacked, np.ones((1, 2))).items()}
    assert means["cd_1s"] == pytest.approx((4 + 9 + 36 - 0) / 3, rel=1e-5)
    assert means["cd_3s"] == pytest.approx((4 + 9 + 16 + 36) / 4, rel=1e-5)
    assert means["cd@0.4s"] == pytest.approx(4, rel=1e-5) and means["cd@0.0s"] == pytest.approx(1, rel=1e-5)
    assert means["cd_moving_3s"] == pytest.approx((4 + 9 + 16) / 3, rel=1e-5)  # the second sample has none
    assert means["l1_3s"] == pytest.approx((2 + 3 + 4 + 6) / 4, rel=1e-5)
    assert means["l1_50-150m_1s"] == pytest.approx((2 + 3 + 6) / 3, rel=1e-5)
    assert np.isnan(means["l1_150-250m_1s"])
    assert by_sample[1]["cd_1s"] == pytest.approx([36, 1], rel=1e-5) and by_sample[0]["cd_1s"][1] == 2
    medians = median_errors(ForecastScores.join(scored()), 0.2)
    assert medians["l1_median_1s"] == pytest.approx(3) and medians["l1_median_0-50m_3s"] == pytest.approx(3.5)
    assert np.isnan(medians["l1_median_150-250m_3s"])


def test_samples_join():
    one = scored()[0]
    both = ForecastScores.join([one, one])
    alone, twice = (forecast_sums(scores, 0.2) for scores in (one, both))
    assert alone.keys() == twice.keys() and all(np.array_equal(2 * alone[name], twice[name]) for name in alone)


def test_samples_join_where_one_does_not_know_a_subset():
    rays = rays_to([[3.0, 4, 0], [6.0, 8, 0]], steps=1)
    known = score_forecast(rays, rays.ranges + 1, BOUNDS, {"moving": torch.tensor([True, False])})
    unknown = score_forecast(rays, rays.ranges, BOUNDS)
    for parts, defined in (([known, unknown], [True, False]), ([unknown, known], [False, True])):
        joined = ForecastScores.join(parts)
        assert (~np.isnan(joined.chamfer["cd_moving"])).tolist() == defined
        assert joined.chamfer["cd_moving"][defined] == pytest.approx(1.0)
        assert joined.chamfer["cd"].shape == (2,)


def test_forecasts_are_compared_on_the_frames_in_which_both_have_points():
    """One loses all points of the second frame, the other all of the third."""
    rays = rays_to([[50.0, 0, 0]] * 3, steps=[1, 2, 3])
    one, other = (
        score_forecast(rays, torch.tensor(ranges), BOUNDS) for ranges in ([51.0, 9e3, 52.0], [51.0, 60.0, 9e3])
    )
    keep_common_frames(one, other)
    for scores in (one, other):
        assert scores.chamfer["cd"].tolist() == pytest.approx([0.5 * 2, np.nan, np.nan], nan_ok=True)


def test_a_negative_range_is_a_point_at_the_sensor():
    scores = score_forecast(rays_to([[3.0, 4, 0]], steps=1), torch.tensor([-2.0]), BOUNDS)
    assert scores.chamfer["cd"][0] == pytest.approx(25) and scores.errors[0] == pytest.approx(7)
