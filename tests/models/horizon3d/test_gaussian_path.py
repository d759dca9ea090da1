"""What the Gaussian path remembers and how it comes back (method 6.2, 6.4, 9)."""

import math
from dataclasses import fields, replace

import pytest
import torch

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory
from src.models.horizon3d.gaussian_path import (
    GaussianPath,
    GaussianPathConfig,
    Sampling,
    SelfAttentionConfig,
    VelocityFrom,
)
from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import Source
from tests.models.moving import UTM, bare_frame, bda, pose

CHANNELS = 6
GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
GEOMETRY = ("means", "scales", "directions", "velocities", "opacity_logits")


def make_path(**changes):
    values = {
        "num_frames": 4,
        "gaussians_per_frame": 5,
        "min_contribution": 0.0,
        "sampling": Sampling.farthest_point,
        "velocity_from": VelocityFrom.gaussian,
        "velocity_compensation": True,
        "forget_refuted": True,
        "self_attention": None,
    }
    torch.manual_seed(0)
    return GaussianPath(GaussianPathConfig(**(values | changes)), CHANNELS, GRID)


def make_gaussians(b=1, g=12, seed=0, spread_m=100.0, speed_mps=30.0, **changes):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator) * 2 - 1

    turn = draw(b, g) * math.pi
    values = {
        "means": draw(b, g, 2) * spread_m,
        "scales": 1.7 + 1.4 * draw(b, g, 2),
        "directions": torch.stack([turn.cos(), turn.sin()], dim=-1),
        "opacity_logits": draw(b, g) * 4,
        "velocities": draw(b, g, 2) * speed_mps,
        "features": draw(b, g, CHANNELS),
        "sources": torch.arange(g).remainder(4).expand(b, g).clone(),
        "elapsed_s": torch.zeros(b, g),
        "valid": torch.ones(b, g, dtype=torch.bool),
    }
    return GaussianSet(**(values | changes))


def make_frame(times, poses=None, augs=None):
    return bare_frame(times, poses or [pose()] * len(times), augs)


def remembered(frame, gaussians, present=None):
    """A memory of one frame that holds these Gaussians, in ego coordinates."""
    present = torch.ones(len(frame), dtype=torch.bool) if present is None else torch.tensor(present)
    return DPTFMemory((DPTFFrame(frame.timestamps_s, frame.global_from_ego, present, None, gaussians),))


def active_rows(path, gaussians, active, frame):
    """Which rows were stored, recognised by their features."""
    stored = path.store(gaussians, active, frame)
    rows = []
    for sample in range(len(frame)):
        found = stored.features[sample][stored.valid[sample]]
        rows.append([int((gaussians.features[sample] == one).all(1).nonzero()) for one in found])
    return rows, stored


def covariance(gaussians):
    along = gaussians.directions[..., None]  # [B, G, 2, 1]
    across = torch.stack([-gaussians.directions[..., 1], gaussians.directions[..., 0]], dim=-1)[..., None]
    first, second = gaussians.scales.square()[..., None, None].unbind(-3)
    return first * along @ along.mT + second * across @ across.mT


# ---------------------------------------------------------------- what is stored


@pytest.mark.parametrize("sampling", Sampling)
def test_only_active_and_valid_gaussians_of_any_source_are_stored(sampling):
    path, gaussians = make_path(sampling=sampling), make_gaussians()
    gaussians.valid[0, 8:] = False
    active = torch.zeros(1, 12, dtype=torch.bool)
    active[0, [1, 2, 3, 7, 9, 10, 11]] = True  # 9 to 11 are padding, whatever their flag says
    rows, stored = active_rows(path, gaussians, active, make_frame([3.0]))
    assert sorted(rows[0]) == [1, 2, 3, 7] and stored.valid.tolist() == [[True] * 4 + [False]]
    assert {int(gaussians.sources[0, row]) for row in rows[0]} == {1, 2, 3}  # camera, random, history
    for name in (field.name for field in fields(GaussianSet)):
        value = getattr(stored, name)
        assert value.shape[:2] == (1, 5) and not value.requires_grad, name
        if value.is_floating_point():
            assert value.isfinite().all(), name


@pytest.mark.parametrize("sampling", Sampling)
def test_nothing_active_stores_nothing(sampling):
    gaussians, nothing = make_gaussians(b=2), torch.zeros(2, 12, dtype=torch.bool)
    stored = make_path(sampling=sampling).store(gaussians, nothing, make_frame([1.0, 2.0]))
    assert len(stored) == 5 and not stored.valid.any()


def test_more_room_than_gaussians():
    for sampling in Sampling:
        path = make_path(sampling=sampling, gaussians_per_frame=20)
        stored = path.store(make_gaussians(), torch.ones(1, 12, dtype=torch.bool), make_frame([1.0]))
        assert len(stored) == 20 and int(stored.valid.sum()) == 12


def test_farthest_point_starts_at_the_highest_active_opacity_and_spreads():
    gaussians = make_gaussians(g=6)
    gaussians.means[0] = torch.tensor([[0.0, 0], [1, 0], [50, 0], [51, 0], [0, 80], [90, 90]])
    gaussians.opacity_logits[0] = torch.tensor([1.0, 2.0, 0.0, 0.5, -1.0, 9.0])
    active = torch.tensor([[True, True, True, True, True, False]])  # the most opaque one reaches no occupied cell
    rows, _ = active_rows(make_path(gaussians_per_frame=3), gaussians, active, make_frame([1.0]))
    assert rows == [[1, 4, 3]]


def test_top_opacity_takes_the_most_opaque():
    gaussians = make_gaussians()
    active = torch.ones(1, 12, dtype=torch.bool)
    active[0, int(gaussians.opacity_logits[0].argmax())] = False
    rows, _ = active_rows(make_path(sampling=Sampling.top_opacity), gaussians, active, make_frame([1.0]))
    order = gaussians.opacity_logits[0].argsort(descending=True)[1:6]
    assert rows == [order.tolist()]


def test_random_is_the_same_for_a_frame_and_another_for_the_next():
    path, gaussians = make_path(sampling=Sampling.random), make_gaussians()
    active = torch.ones(1, 12, dtype=torch.bool)
    stamps = [1_700_000_000.0 + 0.5 * i for i in range(200)]
    picks = [sorted(active_rows(path, gaussians, active, make_frame([stamp]))[0][0]) for stamp in stamps]
    torch.manual_seed(123)
    again = [sorted(active_rows(path, gaussians, active, make_frame([stamp]))[0][0]) for stamp in stamps[:5]]
    assert again == picks[:5] and len({tuple(pick) for pick in picks}) > 150
    counts = torch.bincount(torch.tensor(picks).flatten(), minlength=12)  # 5 of 12, 200 times: 83 each, sigma 7
    assert counts.min() > 55 and counts.max() < 112
    both, _ = active_rows(path, make_gaussians(b=2), active.expand(2, -1), make_frame(stamps[:2]))
    alone, _ = active_rows(path, make_gaussians(b=2).map(lambda v: v[1:]), active, make_frame(stamps[1:2]))
    assert both[1] == alone[0]  # whatever other frames are in the batch


@pytest.mark.parametrize("flip_x", [False, True])
@pytest.mark.parametrize("flip_y", [False, True])
def test_stored_as_if_never_augmented(flip_x, flip_y):
    """Everything that enters memory is in the ego frame (method 9)."""
    path, ego = make_path(gaussians_per_frame=12), make_gaussians()
    matrix = bda(0.37, 1.05, flip_x, flip_y)
    active = torch.ones(1, 12, dtype=torch.bool)
    plain = path.store(ego, active, make_frame([1.0]))
    linear = matrix[:2, :2]
    augmented = replace(
        ego,
        means=ego.means @ linear.T,
        scales=ego.scales * 1.05,
        directions=ego.directions @ linear.T / 1.05,
        velocities=ego.velocities @ linear.T,
    )
    stored = path.store(augmented, active, make_frame([1.0], augs=[matrix]))
    for name in ("means", "scales", "directions", "velocities", "opacity_logits", "features"):
        torch.testing.assert_close(getattr(stored, name), getattr(plain, name), atol=1e-4, rtol=1e-5)


def test_under_autocast_features_are_halved_and_geometry_is_not():
    path, gaussians = make_path(gaussians_per_frame=12), make_gaussians()
    active, matrix = torch.ones(1, 12, dtype=torch.bool), bda(0.2, 0.97)
    full = path.store(gaussians, active, make_frame([1.0], augs=[matrix]))
    with torch.autocast("cpu", torch.bfloat16):
        half = path.store(gaussians, active, make_frame([1.0], augs=[matrix]))
    assert half.features.dtype == torch.bfloat16 and full.features.dtype == torch.float32
    for name in GEOMETRY:
        assert torch.equal(getattr(half, name), getattr(full, name)), name


# ---------------------------------------------------------------- how it comes back


def test_recall_by_hand():
    """The truck drove 10 m and turned left by 90 degrees in half a second; the augmentation flips y and stretches."""
    path = make_path()
    past = make_gaussians(g=1)
    past.means[0, 0] = torch.tensor([30.0, 4.0])
    past.velocities[0, 0] = torch.tensor([20.0, -2.0])  # half a second later at (40, 3)
    past.directions[0, 0], past.scales[0, 0] = torch.tensor([1.0, 0.0]), torch.tensor([2.0, 1.0])
    then, now = make_frame([4.0]), make_frame(
        [4.5], [pose(10.0, 0.0, math.pi / 2)], [bda(scale=1.05, flip_y=True)]
    )  # fmt: skip
    found = path.recall(remembered(then, past), now, 6.0)
    # Relative to the truck: 30 m ahead of where it stands and 3 m to the side; turned, (3, -30); then y flips.
    torch.testing.assert_close(found.means[0, 0], 1.05 * torch.tensor([3.0, 30.0]))
    torch.testing.assert_close(found.velocities[0, 0], 1.05 * torch.tensor([-2.0, 20.0]), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(found.directions[0, 0].abs(), torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0)
    torch.testing.assert_close(found.scales[0, 0], torch.tensor([2.1, 1.05]))
    assert torch.equal(found.opacity_logits, past.opacity_logits)
    torch.testing.assert_close(found.features, past.features + path.time(torch.tensor([[0.5]])))
    assert found.sources.tolist() == [[int(Source.HISTORY)]] and found.elapsed_s.tolist() == [[0.5]]
    assert found.valid.all()


MOTIONS = {
    "straight": (pose(0.0, 0.0, 0.7, UTM), pose(12.0, 10.0, 0.7, UTM)),
    "turn": (pose(0.0, 0.0, 3.1, UTM), pose(-9.0, 3.0, -3.05, UTM)),
    "ramp": (pose(0.0, 0.0, -1.0, UTM, 0.05), pose(20.0, -25.0, -0.9, UTM, -0.06)),
    "still": (pose(0.0, 0.0, 2.0, UTM), pose(0.0, 0.0, 2.0, UTM)),
}


def in_present_ego(xy, before, after):
    """[G, 2] float64: places of the past ego frame, by way of the world, in the present ego frame."""
    homogeneous = torch.cat([xy.double(), torch.zeros(len(xy), 1), torch.ones(len(xy), 1)], dim=1)
    return (homogeneous @ before.T @ torch.linalg.inv(after).T)[:, :2]


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_static_world_stays_where_it_is(motion):
    before, after = MOTIONS[motion]
    past = make_gaussians(g=200, velocities=torch.zeros(1, 200, 2))
    found = make_path().recall(remembered(make_frame([5.0], [before]), past), make_frame([5.5], [after]), 6.0)
    expected = in_present_ego(past.means[0], before, after)
    assert found.valid.all() and (found.means[0].double() - expected).norm(dim=1).max() < 1e-3


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("elapsed", [0.47, 2.0])
def test_what_moves_with_its_velocity_is_met_where_it_is(motion, elapsed):
    before, after = MOTIONS[motion]
    past = make_gaussians(g=200, spread_m=60.0)
    found = make_path().recall(remembered(make_frame([5.0], [before]), past), make_frame([5.0 + elapsed], [after]), 6.0)
    expected = in_present_ego(past.means[0] + past.velocities[0] * elapsed, before, after)
    inside = GRID.contains(expected)
    assert inside.float().mean() > 0.8 and torch.equal(found.valid[0], inside)
    assert (found.means[0].double() - expected)[inside].norm(dim=1).max() < 1e-3
    ahead = in_present_ego(past.means[0] + past.velocities[0] * (elapsed + 1.0), before, after)
    assert (found.velocities[0].double() - (ahead - expected)).abs().max() < 1e-3


def test_without_compensation_only_the_ego_motion_counts():
    before, after = MOTIONS["turn"]
    past = make_gaussians(g=50)
    memory, now = remembered(make_frame([5.0], [before]), past), make_frame([5.5], [after])
    found = make_path(velocity_compensation=False).recall(memory, now, 6.0)
    assert (found.means[0].double() - in_present_ego(past.means[0], before, after)).norm(dim=1).max() < 1e-3
    moved = make_path().recall(memory, now, 6.0)
    for name in ("velocities", "directions", "scales", "features", "elapsed_s"):  # the velocities are still carried
        assert torch.equal(getattr(found, name), getattr(moved, name)), name


def test_what_is_slower_than_the_least_speed_stays():
    past = make_gaussians(g=3, velocities=torch.tensor([[[0.6, 0.7], [0.8, 0.7], [0.0, -20.0]]]))
    memory, now = remembered(make_frame([5.0]), past), make_frame([7.0])
    found = make_path().recall(memory, now, 6.0, min_speed_mps=1.0)
    moved = (found.means - past.means)[0]
    torch.testing.assert_close(moved, torch.tensor([[0.0, 0.0], [1.6, 1.4], [0.0, -40.0]]), atol=1e-4, rtol=0)
    torch.testing.assert_close(found.velocities, past.velocities)


@pytest.mark.parametrize("then_aug", [bda(0.3, 1.04, flip_x=True), bda(-0.39, 0.95)])
@pytest.mark.parametrize("now_aug", [bda(-0.2, 0.96, flip_y=True), bda(0.39, 1.05, True, True)])
def test_augmentation_changes_nothing_once_it_is_undone(then_aug, now_aug):
    """BDA on or off gives the same set after A^-1 (method 15.4), also with another A in each frame."""
    path, ego = make_path(gaussians_per_frame=30), make_gaussians(g=30)
    before, after = MOTIONS["turn"]
    active = torch.ones(1, 30, dtype=torch.bool)

    def through(first, second):
        then, now = make_frame([5.0], [before], [first]), make_frame([5.5], [after], [second])
        stored = path.store(ego.transform(first[None]), active, then)
        found = path.recall(remembered(then, stored), now, 6.0)
        return found.transform(second.inverse()[None])

    plain, augmented = through(torch.eye(4), torch.eye(4)), through(then_aug, now_aug)
    assert plain.valid.all() and augmented.valid.all()
    for name in ("means", "scales", "velocities", "features"):
        torch.testing.assert_close(getattr(augmented, name), getattr(plain, name), atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(covariance(augmented), covariance(plain), atol=1e-4, rtol=1e-4)


def test_what_leaves_the_grid_is_padding():
    past = make_gaussians(g=3, velocities=torch.zeros(1, 3, 2))
    past.means[0] = torch.tensor([[150.0, 0.0], [-150.0, 0.0], [0.0, 153.5]])
    past.valid[0, 2] = False  # and padding stays padding
    now = make_frame([1.5], [pose(12.0)])
    found = make_path().recall(remembered(make_frame([1.0]), past), now, 6.0)
    assert found.valid.tolist() == [[True, False, False]]
    torch.testing.assert_close(found.means, torch.tensor([[[138.0, 0.0], [0.0, 0.0], [0.0, 0.0]]]))


@pytest.mark.parametrize(
    ("elapsed", "metres", "present", "usable"),
    [
        (0.5, 10.0, True, True),
        (6.0, 10.0, True, True),
        (6.1, 10.0, True, False),  # too old
        (0.0, 0.0, True, False),  # the same frame twice
        (-0.5, 10.0, True, False),  # from the future
        (0.5, 51.0, True, False),  # faster than 100 m/s: the localisation jumped
        (0.5, 49.0, True, True),
        (0.5, 10.0, False, False),  # the stream began later
        (math.nan, 10.0, True, False),
        (0.5, math.nan, True, False),
        (0.5, 1e300, True, False),
    ],
)
def test_what_must_not_be_used_is_padding_and_finite(elapsed, metres, present, usable):
    past = make_gaussians(spread_m=50.0, speed_mps=10.0)
    now = make_frame([10.0 + elapsed], [pose(metres, 0.0, 0.1, UTM)])
    memory = remembered(make_frame([10.0], [pose(origin=UTM)]), past, [present])
    found = make_path().recall(memory, now, 6.0)
    assert found.valid.all() if usable else not found.valid.any()
    for field in fields(GaussianSet):
        value = getattr(found, field.name)
        assert not value.is_floating_point() or value.isfinite().all(), field.name
    assert (found.elapsed_s >= 0).all() and (found.elapsed_s[~found.valid] == 0).all() and (found.elapsed_s < 7).all()


def test_the_rule_of_the_benchmark_leaves_one_frame():
    frames = [make_frame([t]) for t in (9.5, 9.0, 8.5)]
    memory = DPTFMemory(tuple(remembered(frame, make_gaussians(spread_m=20.0)).frames[0] for frame in frames))
    found = make_path().recall(memory, make_frame([10.0]), 0.55)
    assert found.valid.tolist() == [[True] * 12 + [False] * 24]


def test_nothing_remembered():
    path = make_path()
    assert path.recall(DPTFMemory(()), make_frame([1.0]), 6.0) is None
    cells_only = DPTFFrame(torch.zeros(1).double(), torch.eye(4)[None].double(), torch.ones(1).bool(), None, None)
    assert path.recall(DPTFMemory((cells_only,)), make_frame([1.0]), 6.0) is None


def test_streams_do_not_mix():
    """Each stream has its own clock, pose, augmentation and past."""
    path, stored = make_path(), make_gaussians(b=3, seed=4)
    befores = [pose(origin=UTM), pose(0.0, 0.0, 2.0, UTM), pose(0.0, 0.0, -1.0)]
    afters = [pose(9.0, 0.0, 0.1, UTM), pose(-8.0, 9.0, 2.2, UTM), pose(500.0, 0.0, -1.0)]  # the third one jumps
    augs = [bda(0.3, 1.05), bda(-0.3, 0.95, flip_x=True), bda(flip_y=True)]
    times, later = [1.0, 77.0, 5.0], [1.5, 78.0, 5.5]
    together = path.recall(remembered(make_frame(times, befores), stored), make_frame(later, afters, augs), 6.0)
    assert together.valid.any(dim=1).tolist() == [True, True, False]
    for stream in range(3):
        past = remembered(
            make_frame(times[stream : stream + 1], [befores[stream]]), stored.map(lambda v, i=stream: v[i : i + 1])
        )
        alone = path.recall(past, make_frame(later[stream : stream + 1], [afters[stream]], [augs[stream]]), 6.0)
        for field in fields(GaussianSet):
            torch.testing.assert_close(getattr(together, field.name)[stream], getattr(alone, field.name)[0])


@pytest.mark.parametrize("fixed_capacity", [False, True])
def test_what_returned_and_is_not_active_any_more_does_not_return_again(fixed_capacity):
    path, earlier, now = make_path(num_frames=3), make_frame([0.0, 0.0]), make_frame([1.0, 1.0])
    path.fixed_capacity = fixed_capacity
    newer, older = (make_gaussians(b=2, g=5, seed=seed, speed_mps=0.0) for seed in (1, 2))
    older.means[1, 3] = torch.tensor([400.0, 0.0])  # outside the grid: not asked, so not refuted
    older.valid[1, 0] = False
    memory = DPTFMemory((*remembered(earlier, newer).frames, *remembered(earlier, older).frames))
    history = path.recall(memory, now, max_age_s=6.0)
    active = torch.zeros(2, 7 + history.valid.shape[1], dtype=torch.bool)
    active[:, :7] = True  # of the frame itself
    active[0, 7 + 2] = active[1, 7 + 5 + 4] = True  # of the newer frame, of the older one
    first, second = path.without_refuted(memory, history, active).frames
    assert first.gaussians.valid.tolist() == [[False, False, True, False, False], [False] * 5]
    assert second.gaussians.valid.tolist() == [[False] * 5, [False, False, False, True, True]]
    assert older.valid.sum() == 9, "a memory is a value: the one that was read stays"


def test_four_frames_of_256_are_the_papers_1024_newest_first():
    path = make_path(gaussians_per_frame=256)
    assert path.config.num_history_gaussians == 1024
    memory, active = DPTFMemory(()), torch.ones(1, 300, dtype=torch.bool)
    for step in range(6):
        frame = make_frame([0.5 * step], [pose(10.0 * step)])
        stored = path.store(make_gaussians(g=300, seed=step, spread_m=60.0, speed_mps=5.0), active, frame)
        present = torch.ones(1, dtype=torch.bool)
        memory = memory.push(DPTFFrame(frame.timestamps_s, frame.global_from_ego, present, None, stored), 0, 4)
    found = path.recall(memory, make_frame([3.0], [pose(60.0)]), 6.0)
    assert len(found) == 1024 and found.valid.all()
    assert found.elapsed_s[0, ::256].tolist() == [0.5, 1.0, 1.5, 2.0]


def test_autocast_does_not_round_positions_or_ages():
    path, past = make_path(), make_gaussians()
    before, after = MOTIONS["turn"]
    memory, now = remembered(make_frame([5.0], [before]), past), make_frame([5.5], [after], [bda(0.3, 1.05)])
    full = path.recall(memory, now, 6.0)
    with torch.autocast("cpu", torch.bfloat16):
        half = path.recall(memory, now, 6.0)
    for field in fields(GaussianSet):
        assert torch.equal(getattr(half, field.name), getattr(full, field.name)), field.name


def test_gradients_reach_the_time_embedding_only():
    path, past = make_path(), make_gaussians()
    past.features.requires_grad_(True)
    active = torch.ones(1, 12, dtype=torch.bool)
    stored = path.store(past, active, make_frame([1.0]))
    path.recall(remembered(make_frame([1.0]), stored), make_frame([1.5]), 6.0).features.sum().backward()
    assert past.features.grad is None
    assert all(p.grad is not None for p in path.parameters())


@pytest.mark.parametrize("name", ["num_frames", "gaussians_per_frame"])
def test_an_empty_memory_is_refused(name):
    with pytest.raises(ConfigError, match=f"gaussian_path.{name}=0.*gaussian_path=null"):
        make_path(**{name: 0})
    with pytest.raises(ConfigError, match="num_heads=0.*self_attention=null"):
        SelfAttentionConfig(num_heads=0)
