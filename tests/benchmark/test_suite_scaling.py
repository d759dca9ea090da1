"""Growth ratios by hand, scenes that begin alike, and settings that vary one thing at a time."""

import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from src.benchmark import suite_scaling
from src.benchmark.cases import CELLS_PER_VEHICLE
from src.benchmark.scenes import ROADS, Highway, highway_frame, highway_points, lidar_frame
from src.benchmark.suite_scaling import (
    NOMINAL_M,
    RANGES_M,
    Point,
    case_at,
    configs_of,
    growth_rows,
    settings_at,
    sweeps_of,
)
from src.config import compose_config

ROAD = Highway(background=400, num_vehicles=20, points_per_vehicle=10, reach_m=150.0)


def row(sweep, x, model, milliseconds, added, remembered):
    work = 2.0 * milliseconds if model == "horizon3d" else 3.0 * milliseconds
    return {sweep: x, "model": model, "ms": milliseconds, "added MiB": added, "remembered MiB": remembered} | {
        "GFLOP": work
    }


def test_growth_is_from_the_nominal_range_and_else_from_the_first_point():
    ranged, objects = "range, fixed scene", "objects"
    measured = {
        ranged: [
            row(ranged, 75.0, "horizon3d", 8.0, 5.0, 1.0), row(ranged, 75.0, "dense_bev", 10.0, 10.0, 0.0),
            row(ranged, 150.0, "horizon3d", 10.0, 8.0, 2.0), row(ranged, 150.0, "dense_bev", 50.0, 30.0, 10.0),
            row(ranged, 600.0, "horizon3d", 12.0, 9.0, 3.0), row(ranged, 600.0, "dense_bev", 800.0, 480.0, 160.0),
        ],
        objects: [
            row(objects, 0, "horizon3d", 10.0, None, 0.0), row(objects, 0, "dense_bev", 40.0, None, 0.0),
            row(objects, 80, "horizon3d", 15.0, None, 0.0), row(objects, 80, "dense_bev", 40.0, None, 0.0),
        ],
    }  # fmt: skip
    first, second = growth_rows(measured)
    assert (first["from"], first["to"]) == (150.0, 600.0)
    assert (first["horizon3d time x"], first["dense_bev time x"]) == (1.2, 16.0)
    assert (first["horizon3d memory x"], first["dense_bev memory x"]) == (1.2, 16.0)
    assert (first["dense_bev / horizon3d at from"], first["dense_bev / horizon3d at to"]) == (5.0, 800.0 / 12.0)
    assert first["GFLOP dense_bev / horizon3d at from"] == 1.5 * first["dense_bev / horizon3d at from"]
    assert (second["from"], second["horizon3d time x"], second["dense_bev time x"]) == (0, 1.5, 1.0)
    assert "horizon3d memory x" not in second  # not known there


def test_a_longer_road_begins_as_the_shorter_one():
    short, long = highway_points(ROAD), highway_points(replace(ROAD, reach_m=600.0))
    assert torch.equal(long[: len(short)], short) and torch.equal(highway_points(ROAD), short)
    beyond = long[len(short) :, 0].abs()
    assert beyond.min() > 130.0 and 300.0 < beyond.max() < 640.0  # noise and the length of a truck cross the line
    assert short[:, 0].abs().max() < 170.0 and len(beyond) < len(short)  # few returns come from far away


def test_twice_the_traffic_gives_twice_its_returns():
    numbers = [len(highway_points(replace(ROAD, num_vehicles=number))) for number in (0, 20, 40)]
    assert numbers[0] == 400 and abs(numbers[1] - 600) <= 2 and abs(numbers[2] - 800) <= 2


def test_lidar_rays_end_on_the_road_and_what_stands_beside_it():
    road = replace(ROAD, lidar_returns=2000, reach_m=100.0)
    frame = lidar_frame(road)
    points, rays = frame.lidar_points[:, :3], frame.rays
    assert len(points) == 2000 and torch.equal(points, rays.points)
    assert torch.equal(lidar_frame(road).rays.ranges, rays.ranges)
    torch.testing.assert_close(rays.directions.norm(dim=1), torch.ones(2000))
    assert points[:, :2].abs().max() < 100.5 and points[:, 1].abs().max() < 30.1 and points[:, 2].min() > -0.1
    ground, beside = points[:, 2] < 0.1, (points[:, 1].abs() - 13.0).abs() < 0.1
    assert ground.float().mean() > 0.3 and (beside & ~ground).sum() > 50
    on_vehicles = ~ground & (points[:, 1].abs() < 12.0)
    empty = lidar_frame(replace(road, num_vehicles=0)).lidar_points
    assert on_vehicles.sum() > 50 and not ((empty[:, 2] > 0.2) & (empty[:, 1].abs() < 12.0)).any()
    assert rays.steps.bincount().tolist() == [500] * 4


def test_a_region_reaches_so_far_in_whole_voxels_of_the_coarsest_level():
    settings = compose_config(["scale=paper", "data=synthetic", "model=lrs4fusion", "phase=lrs_occupancy"])[0].model
    roi = settings.at_range(100.0).roi
    assert roi.upper_m[:2] == [100.0, 100.0] and roi.lower_m == [-100.0, -100.0, -12.0]
    assert 300.0 <= settings.at_range(300.0).roi.upper_m[0] < 302.0
    settings.at_range(300.0).roi.build(5)  # or an error


def test_a_point_ahead_of_a_camera_is_seen_where_it_should_be():
    frame = highway_frame(highway_points(ROAD), (256, 864))
    ahead_left = frame.pix_from_aug[0, 0] @ torch.tensor([20.0, 20.0, 2.2, 1.0])  # the first looks at 45 degrees
    assert torch.allclose(ahead_left[:2] / ahead_left[2], torch.tensor([432.0, 128.0]), atol=1e-3)
    assert abs(float(ahead_left[2]) - 800**0.5) < 1e-3
    left_of_it = frame.pix_from_aug[0, 0] @ torch.tensor([15.0, 25.0, 2.2, 1.0])
    assert left_of_it[0] / left_of_it[2] < 432.0


def test_only_the_ranges_reach_beyond_the_nominal_one():
    for name, points in sweeps_of(ROADS["paper"], RANGES_M["paper"], temporal=True, occupied_cells=9).items():
        beyond = [point for point in points if max(point.range_m, point.road.reach_m) > NOMINAL_M]
        assert bool(beyond) == name.startswith("range"), name
    assert "memory frames" not in sweeps_of(ROADS["paper"], RANGES_M["paper"], temporal=False, occupied_cells=9)


def test_a_point_changes_what_it_names():
    config, _ = compose_config(["scale=debug", "phase=phase2"])
    point = Point(1.0, NOMINAL_M, ROAD, gaussians=0.5, memory_frames=5)
    settings = settings_at(config, point)
    assert (settings.kggi.num_radar_keypoints, settings.kggi.num_camera_keypoints) == (16, 8)
    assert settings.dptf.bev_path.num_frames == 5 and settings.dptf.gaussian_path.num_frames == 2
    assert settings.dptf.bev_path.max_cells_per_frame == 20 * CELLS_PER_VEHICLE["debug"]
    twice_as_far = replace(point, road=replace(ROAD, reach_m=300.0))
    assert settings_at(config, twice_as_far).dptf.bev_path.max_cells_per_frame == 40 * CELLS_PER_VEHICLE["debug"]
    assert settings_at(config, replace(point, memory_frames=0)).dptf is None
    assert config.model.kggi.num_radar_keypoints == 32 and config.model.dptf.bev_path.num_frames == 2

    assert settings_at(config, replace(point, pruning_ratio=0.5)).radar_encoder.pruning_ratio == 0.5
    assert settings.radar_encoder == config.model.radar_encoder

    configs = configs_of(config)
    assert [*configs] == ["horizon3d", "dense_bev"]
    assert configs["horizon3d"].model == config.model
    dense = configs["dense_bev"]
    assert settings_at(dense, point).temporal.num_frames == 5 and dense.grid == config.grid
    assert settings_at(dense, replace(point, memory_frames=0)).temporal is None
    assert settings_at(dense, replace(point, pruning_ratio=0.5)) == settings_at(dense, point)


@pytest.mark.parametrize("cells", [0, 600, 10**6])
def test_gaussians_occupy_as_many_cells_as_trained_ones(cells):
    config, _ = compose_config(["scale=debug", "phase=phase2"])
    point = Point(1.0, NOMINAL_M, ROAD)
    fresh, _ = case_at(config, point, torch.device("cpu"))
    case, _ = case_at(config, replace(point, occupied_cells=cells), torch.device("cpu"))
    every, found = (len(one.infer()[0].ocsf.splat.bev) for one in (fresh, case))
    assert every > 700
    if cells < every:
        assert abs(found - cells) <= 70  # a Gaussian more or less
    else:
        assert found > 700  # all are opaque


class Slow(nn.Module):
    """Its first call takes longest."""

    called = False

    def forward(self):
        time.sleep(0.01 if self.called else 0.2)
        self.called = True


class OfOnePart(nn.Module):
    benchmark_parts = {}

    def __init__(self):
        super().__init__()
        self.part = Slow()


def test_parts_are_of_the_calls_that_count(monkeypatch):
    monkeypatch.setattr(suite_scaling, "ROUNDS", 2)
    model = OfOnePart()
    case = SimpleNamespace(device=torch.device("cpu"), prepared=model, infer=lambda: model.part())
    seconds, parts = suite_scaling.measure_cases({"ours": case})
    assert len(parts["ours"]["part"]) == len(seconds["ours"]) == 2 and max(parts["ours"]["part"]) < 0.15
