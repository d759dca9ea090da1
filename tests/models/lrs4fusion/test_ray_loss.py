"""Losses from LiDAR rays by hand, and what the model learns from them."""

from dataclasses import replace

import pytest
import torch

from src.errors import ConfigError
from src.models.lrs4fusion.ray_loss import occupancy_objective, range_objective
from src.targets.occupancy_rays import draw_rays
from tests.models.lrs4fusion.lrs_frames import cloud, lidar_frame, lrs_config, lrs_model
from tests.ray_bundles import rays_to

BOUNDS = ((-50.0, 50.0), (-50.0, 50.0), (-5.0, 5.0))


def rays_along_x(ranges, speeds=0.0, steps=0, batch=0):
    ends = [[length, 0.0, 0.0] for length in ranges]
    return rays_to(ends, times_s=0.2 * torch.as_tensor(steps), speeds=speeds, steps=steps, batch=batch)


def settings(**changes):
    return replace(lrs_config().model.loss, **changes)


def perfect(speed):
    """A wall from 20 m on whose every place moves at one speed."""
    return lambda queries, batch: (torch.where(queries[:, 0] > 20, 9.0, -9.0), torch.full_like(queries[:, 0], speed))


def test_terms_are_weighted_means_over_queries():
    terms, counts = occupancy_objective(perfect(2.0), rays_along_x([20.0] * 8, 3.0), BOUNDS, settings())
    assert terms["occupancy"] == pytest.approx(10 * 1.234e-4, rel=1e-2)  # log(1 + e^-9)
    assert terms["velocity"] == pytest.approx(0.5 * (3 - 2) + 0.5 * 2)  # half the queries are free
    assert counts["iou"] == 1 and counts["known_speeds"] == 1


def test_small_errors_of_speed_count_by_their_square():
    changed = settings(velocity_beta_mps=1.5)
    terms, _ = occupancy_objective(perfect(2.0), rays_along_x([20.0] * 8, 3.0), BOUNDS, changed)
    assert terms["velocity"] == pytest.approx(0.5 * 1**2 / (2 * 1.5) + 0.5 * (2 - 0.5 * 1.5))


def test_unknown_speeds_count_neither_as_error_nor_in_the_mean():
    rays = rays_along_x([20.0] * 8, torch.tensor([3.0, float("nan")] * 4))
    torch.manual_seed(0)
    terms, counts = occupancy_objective(perfect(1.0), rays, BOUNDS, settings())
    known, free = 256 * counts["known_speeds"], 256
    assert terms["velocity"] == pytest.approx(float((2 * known + free) / (known + free)))


def test_what_moves_has_its_own_weight_within_the_mean():
    rays = rays_along_x([20.0] * 8, torch.tensor([3.0, 0.5] * 4))
    torch.manual_seed(0)
    counted = occupancy_objective(perfect(1.0), rays, BOUNDS, settings(moving_weight=1.0))[0]["velocity"]
    torch.manual_seed(0)
    found = occupancy_objective(perfect(1.0), rays, BOUNDS, settings(moving_weight=9.0))[0]["velocity"]
    # Errors: 2 of n that move, 0.5 of 256 - n that crawl, 1 of 256 free ones.
    n = (512 * float(counted) - 256 * 1.5) / 1.5
    assert n == pytest.approx(round(n), abs=1e-2) and 90 < n < 166
    assert found == pytest.approx((9 * 2 * n + 0.5 * (256 - n) + 256) / (512 + 8 * n), rel=1e-4)


def test_free_space_alone_teaches_no_speed():
    speed = torch.tensor(2.0, requires_grad=True)
    answer = lambda queries, batch: (queries[:, 0], speed.expand(len(queries)))  # noqa: E731
    terms, _ = occupancy_objective(answer, rays_along_x([20.0] * 8, float("nan")), BOUNDS, settings())
    terms["velocity"].backward()
    assert terms["velocity"] == 0 and speed.grad == 0


def test_terms_without_weight_or_rays():
    terms, _ = occupancy_objective(perfect(1.0), rays_along_x([20.0]), BOUNDS, settings(velocity_weight=None))
    assert set(terms) == {"occupancy"}
    terms, counts = occupancy_objective(perfect(1.0), rays_along_x([20.0])[:0], BOUNDS, settings())
    assert terms["occupancy"] == terms["velocity"] == counts["iou"] == 0
    assert range_objective(lambda rays: rays.ranges, rays_along_x([20.0])[:0], BOUNDS, settings()).terms["range"] == 0


def test_range_is_learnt_from_rays_that_end_inside():
    found = []

    def ranges(rays):
        found.append(rays)
        return rays.ranges + 3

    rays = rays_along_x([10.0, 20.0, 70.0] * 30, steps=torch.arange(90) % 2)
    terms, _ = range_objective(ranges, rays, BOUNDS, settings(rays_per_frame=20, range_weight=2.0))
    assert terms["range"] == 6 and found[0].steps.bincount().tolist() == [20, 20] and found[0].ranges.max() == 20


def test_rays_are_drawn_without_replacement_from_each_sample_and_time():
    rays = rays_along_x([float(n) for n in range(1, 41)], steps=torch.arange(40) % 2 - 1, batch=torch.arange(40) // 20)
    first, second = (draw_rays(rays, BOUNDS, 4, torch.Generator().manual_seed(seed)) for seed in (0, 1))
    for drawn in (first, second):
        assert len(drawn.ranges.unique()) == 16 and (drawn.batch.diff() >= 0).all()
        assert {(b, s): 4 for b in (0, 1) for s in (-1, 0)} == {
            (b, s): int(((drawn.batch == b) & (drawn.steps == s)).sum()) for b in (0, 1) for s in (-1, 0)
        }
    assert not torch.equal(first.ranges, second.ranges)
    assert torch.equal(draw_rays(rays, BOUNDS, 99).ranges, rays.ranges)


def test_far_rays_are_drawn_more_often_by_a_power_of_their_range():
    """One ray in ten ends three times as far: by the square it is drawn first as often as the other nine."""
    many = rays_along_x(([10.0] * 9 + [30.0]) * 2000, steps=torch.arange(20_000) // 10)
    generator = torch.Generator().manual_seed(0)
    shares = [(draw_rays(many, BOUNDS, 1, generator, power).ranges > 20).float().mean() for power in (0.0, 2.0)]
    assert shares[0] == pytest.approx(0.1, abs=0.02) and shares[1] == pytest.approx(0.5, abs=0.03)
    pairs = draw_rays(many, BOUNDS, 2, generator, 2.0)
    assert torch.equal(pairs.steps.bincount(), torch.full((2000,), 2))
    drawn = []
    torch.manual_seed(0)
    chosen = settings(rays_per_frame=1, ray_range_power=2.0)
    range_objective(lambda rays: drawn.append(rays) or rays.ranges, many, BOUNDS, chosen)
    assert (drawn[0].ranges > 20).float().mean() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("ray_range_power=-1", r"model.loss.ray_range_power"),
        ("rays_per_frame=0", r"model.loss.rays_per_frame"),
        ("moving_weight=0.5", r"model.loss.moving_weight"),
        ("velocity_beta_mps=-1", r"model.loss.velocity_beta_mps"),
        ("sampling.num_queries=3", r"model.loss.sampling.num_queries=3: must be even"),
        ("sampling.depth_m=0", r"model.loss.sampling.depth_m=0.0: must be above 0"),
    ],
)
def test_sampling_that_cannot_be(change, message):
    with pytest.raises(ConfigError, match=message):
        lrs_config(f"model.loss.{change}")


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "term"), [("occupancy", "occupancy"), ("forecast", "range")])
def test_a_stage_learns_from_rays(stage, term):
    model = lrs_model(f"phase.options.stage={stage}").train()
    batch = lidar_frame([cloud(300)])
    with pytest.raises(ValueError, match="FrameBatch.rays is None, but phase.options.stage=.*num_future_frames=2"):
        model.loss(model(batch)[0], batch)
    batch = replace(batch, rays=rays_along_x([20.0, 25.0] * 50))
    optimizer = torch.optim.Adam([p for p in model.parameters() if p.requires_grad], lr=1e-2)
    values = []
    for _ in range(12):
        terms = model.loss(model(batch)[0], batch).terms
        optimizer.zero_grad()
        terms["total"].backward()
        optimizer.step()
        values.append(float(terms[term].detach()))
    assert values[-1] < 0.6 * values[0]


@pytest.mark.slow
def test_the_last_transition_is_learnt_through_and_none_before_it():
    frames = tuple(lidar_frame([cloud(300, seed)], 0.2 * seed) for seed in range(3))
    model = lrs_model("phase.options.stage=occupancy", "phase.options.train_last_transition=true").train()
    memory = model.transition(frames[1], model(frames[0])[1])
    features = memory.frames[0].voxels.features
    assert features.requires_grad and model.trains_last_transition
    features.sum().backward()
    assert model.pointnet.linear.weight.grad.abs().sum() > 0
    assert not lrs_model("phase.options.train_last_transition=false").trains_last_transition
