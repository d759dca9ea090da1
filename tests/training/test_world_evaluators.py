"""Scores of a world model that knows the answers, and of one that is wrong by a known amount."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from src.data.true_geometry import TRUTH_FOLDER, TrueGeometry
from src.errors import ConfigError
from src.metrics.forecast_text import format_occupancy
from src.models.world_model import WorldModel
from src.report.metric_names import FORECASTS, FORECASTS_BY_TIME
from src.structures.ray_bundle import RayBundle
from src.training.world_evaluators import ForecastEvaluator, OccupancyEvaluator
from tests.data.tiny_set import FIVE_HERTZ
from tests.models.moving import bare_frame, bda, pose
from tests.ray_bundles import rays_to

WALL_M, SPEED_MPS, START_US = 20.0, 5.0, 100_000_000


class Wall(WorldModel):
    """A wall ahead that drives away: all beyond its face is matter."""

    def __init__(self, aside_m=0.0, speed_mps=SPEED_MPS, scale=1.0):
        self.aside_m, self.speed_mps, self.scale = aside_m, speed_mps, scale

    @property
    def bounds(self):
        return ((-40.0, 40.0), (-40.0, 40.0), (-3.0, 3.0))

    forecasts = True

    def face(self, times_s):
        return self.scale * (WALL_M + SPEED_MPS * times_s)

    def look_up(self, output, queries, batch):
        occupied = queries[:, 0] > self.face(queries[:, 3])
        return occupied.float(), torch.full((len(queries),), self.speed_mps)

    def forecast(self, output, rays):
        return self.face(rays.times_s) / rays.directions[:, 0].abs() + self.aside_m


def rays(times_s, model, samples):
    """Every second from 0 on a fan of rays that end on the wall."""
    fan = torch.stack([torch.ones(41), torch.linspace(-0.5, 0.5, 41).tan(), torch.zeros(41)], 1)
    parts = []
    for sample in range(samples):
        for step in times_s:
            parts.append(rays_to(model.face(0.2 * step) * fan, times_s=0.2 * step, steps=step, batch=sample))
    return RayBundle.concatenate(parts, dim=0)


def index_of(root):
    return SimpleNamespace(
        sample_tokens=np.array(["stream0", "stream1"]), sample_scenes=np.array([0, 1]), root=root,
        scene_names=np.array(["a", "b"]),
    )  # fmt: skip


def frames(model, augs=None):
    batch = bare_frame(START_US / 1e6, [pose(), pose()], augs)
    bundle = rays([0, 5, 15], model, 2)
    now = bundle[bundle.steps == 0]
    return replace(
        batch,
        rays=bundle,
        lidar_points=torch.cat([now.points, torch.zeros(len(now), 2)], 1),
        lidar_batch=now.batch,
        lidar_origins=now.origins,
    )


def write_truth(root):
    """The wall, ten metres thick, on level ground 1 m below the vehicle's origin, in the scenes a and b."""
    (root / TRUTH_FOLDER).mkdir()
    steps_s = np.arange(0, 41) * 0.1
    middles = np.zeros((41, 1, 3))
    middles[:, 0, 0] = WALL_M + 5 + SPEED_MPS * steps_s
    truth = TrueGeometry(
        origin=np.array([7e5, 5.3e6, 0.0]) * 0, times_us=START_US + (1e6 * steps_s).astype(np.int64),
        middles=middles.astype(np.float32), yaws=np.zeros((41, 1), np.float32),
        sizes=np.array([[10.0, 200.0, 20.0]], np.float32), ground=np.full((60, 60), -1.0, np.float32),
        ground_corner=np.array([-120.0, -120.0]), ground_cell_m=np.array(4.0),
    )  # fmt: skip
    for name in "ab":
        truth.write(root, name)


def timeline(rays):
    return replace(FIVE_HERTZ, scored_rays=rays, score_stride=5)


def scores_of(kind, model, batch, root):
    evaluator = kind(index_of(root), timeline(30))
    evaluator.reset()
    evaluator.update(model, None, batch)
    shown = evaluator.compute()
    return evaluator.as_dict(), shown, evaluator


def test_a_model_that_knows_is_right_at_every_time(tmp_path):
    found, shown, evaluator = scores_of(ForecastEvaluator, Wall(), frames(Wall()), tmp_path)
    assert found["iou"] == found["iou@0.0s"] == found["iou@1.0s"] == found["iou@3.0s"] == 1
    assert {*found} - {*FORECASTS, *FORECASTS_BY_TIME} == {"intervals"}  # each has a unit and a better direction
    assert found["cd_1s"] == pytest.approx(0, abs=1e-8) and found["l1_3s"] == pytest.approx(0, abs=1e-5)
    assert found["cd_gain_3s"] == pytest.approx(1) and list(shown)[0] == "cd_gain_3s"
    # The wall of the static world stays 5 m, then 15 m behind: the errors of both frames count alike.
    assert found["static_l1_1s"] == pytest.approx(5 * _mean_secant(), rel=0.02)
    assert found["static_l1_3s"] == pytest.approx(10 * _mean_secant(), rel=0.02)
    assert found["static_cd_1s"] < found["static_cd_3s"]
    assert found["cd_unseen_3s"] == pytest.approx(0, abs=1e-8)  # behind the wall nothing had been seen
    assert "velocity_error_moving" not in found and "cd_moving_3s" not in found  # nobody knows what moves
    assert found["intervals"]["scenes"] == 2 and found["intervals"]["bounds"]["cd_gain_3s"] == pytest.approx([1, 1])
    text = evaluator.describe(found)
    (unseen,) = [line for line in text.splitlines() if line.startswith("Chamfer, unseen")]
    assert unseen.split()[-3:] == ["100.0", "[100.0,", "100.0]"] and "below, % 1s" in text and "3.0s" in text


def _mean_secant():
    return float((1 / torch.linspace(-0.5, 0.5, 41).cos()).mean())


def test_errors_are_those_made(tmp_path):
    found, _, _ = scores_of(ForecastEvaluator, Wall(aside_m=2.0), frames(Wall()), tmp_path)
    assert found["l1_1s"] == found["l1_median_3s"] == pytest.approx(2, rel=1e-4)
    assert 0 < found["cd_3s"] < 4 and found["cd_gain_3s"] == pytest.approx(1 - found["cd_3s"] / found["static_cd_3s"])


def test_the_true_geometry_tells_what_moves_and_what_is_solid(tmp_path):
    write_truth(tmp_path)
    turned = [pose(3.0, -2.0, 0.0), pose()]
    model = Wall(speed_mps=4.0)
    batch = replace(frames(model), global_from_ego=torch.stack(turned))
    batch.global_from_ego[0, 0, 3] = 0.0  # the wall is where it is said to be
    found, _, _ = scores_of(ForecastEvaluator, model, batch, tmp_path)
    # Along a ray at an angle the wall's speed is its cosine's share; the lattice ends at the bounds, 40 m.
    bearings = torch.linspace(-0.5, 0.5, 41)
    assert found["velocity_error_moving"] == pytest.approx(float((5 * bearings.cos() - 4).abs().mean()), abs=0.05)
    assert found["velocity_error_standing"] is None
    # 20 to 40 m are said to be matter and 20 to 30 m are, but no ray tells of what lies deeper than a metre.
    assert found["slice_iou@0.0s"] == found["slice_iou@1.0s"] == 1
    early, _, _ = scores_of(OccupancyEvaluator, Wall(scale=0.8), batch, tmp_path)
    assert 0.05 < early["slice_iou@0.0s"] < 0.3  # 4 m of free space and 1 m of the wall
    assert found["cd_moving_3s"] == pytest.approx(0, abs=1e-8) and found["static_cd_moving_3s"] > 1


def test_speed_errors_are_told_by_time(tmp_path):
    write_truth(tmp_path)

    class Slowing(Wall):
        def look_up(self, output, queries, batch):
            occupied, _ = super().look_up(output, queries, batch)
            return occupied, -10.0 * queries[:, 3].round()  # 0 now, -10 m/s in a second

    batch = frames(Slowing())
    batch.global_from_ego[0, 0, 3] = 0.0
    found, _, _ = scores_of(OccupancyEvaluator, Slowing(), batch, tmp_path)
    # At the fan's half-way angle of 0.25 the true speed is 5 cos(0.25) = 4.84 m/s; steps of 0, 1 and 3 s.
    medians = [found[f"velocity_median_moving{time}"] for time in ("@0.0s", "@1.0s", "@3.0s", "")]
    assert medians == pytest.approx([4.84, 14.84, 34.84, 14.84], abs=0.1)
    text = [line.split() for line in format_occupancy(found).splitlines()]
    assert [line[-1] for line in text[2:]] == ["-"] * 3 + [f"{found['velocity_error_moving']:.3f}"]
    assert [line[-2] for line in text[2:]] == [f"{median:.3f}" for median in medians]
    assert "velocity" not in format_occupancy({"iou": 0.5, "iou@0.0s": 0.5, "velocity_median_moving": None})


def test_augmented_frames_are_brought_back(tmp_path):
    """A mirrored frame sees the wall behind; the truth lies ahead all the same."""
    write_truth(tmp_path)

    class Behind(Wall):
        def look_up(self, output, queries, batch):
            return super().look_up(output, queries * torch.tensor([-1.0, 1, 1, 1]), batch)

    batch = frames(Behind(), augs=[bda(flip_x=True)] * 2)
    mirrored = replace(batch.rays, directions=batch.rays.directions * torch.tensor([-1.0, 1, 1]))
    found, _, _ = scores_of(OccupancyEvaluator, Behind(), replace(batch, rays=mirrored), tmp_path)
    assert found["iou"] == 1 and found["slice_iou@3.0s"] == 1
    assert found["velocity_error_moving"] < 0.7


def test_a_sample_counts_once_and_rays_are_drawn_alike_in_any_batch(tmp_path):
    evaluator = OccupancyEvaluator(index_of(tmp_path), timeline(10))
    evaluator.reset()
    batch = frames(Wall())
    evaluator.update(Wall(scale=0.8), None, batch)
    whole = evaluator.compute()
    evaluator.update(Wall(scale=0.8), None, batch)
    assert evaluator.compute() == whole and 0 < whole["iou"] < 1
    first = {row: scores.sums for row, scores in evaluator.scores_by_sample.items()}
    one = replace(
        bare_frame(100.0, [pose()]),
        tokens=["stream1"],
        rays=replace(batch.rays[batch.rays.batch == 1], batch=torch.zeros(123, dtype=torch.int64)),
    )
    evaluator.reset()
    evaluator.update(Wall(scale=0.8), None, one)
    np.testing.assert_array_equal(evaluator.scores_by_sample[1].sums["iou"], first[1]["iou"])


def test_frames_without_rays_score_nothing(tmp_path):
    batch = frames(Wall())
    found, shown, evaluator = scores_of(ForecastEvaluator, Wall(), replace(batch, rays=batch.rays[:0]), tmp_path)
    assert np.isnan(shown["cd_gain_3s"]) and found["intervals"]["bounds"] == {}
    evaluator.describe(found)


def test_a_phase_of_rays_needs_them():
    config = SimpleNamespace(timeline=None, num_future_frames=2)
    with pytest.raises(ConfigError, match="data.timeline=null: this phase learns from the rays"):
        OccupancyEvaluator.of(SimpleNamespace(config=config))
