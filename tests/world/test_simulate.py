"""Roads, traffic and motion of a scene."""

import numpy as np
import pytest

from src.errors import ConfigError
from src.world.camera_render import actor_mesh
from src.world.labels import visibility_level
from src.world.road import LANE_M, make_road
from src.world.simulate import make_scene
from src.world.traffic import STEP_S, Vehicle, simulate_traffic
from src.world.world_config import WorldConfig


@pytest.mark.parametrize("seed", range(4))
def test_roads_are_gentle_and_measure_their_own_length(seed, config):
    road = make_road(config, np.random.default_rng(seed))
    s = np.arange(-400.0, 900.0, 5.0)
    places = road.place(s, np.zeros_like(s))
    np.testing.assert_allclose(np.linalg.norm(np.diff(places[:, :2], axis=0), axis=1), 5.0, rtol=1e-3)
    assert np.abs(road.curvature_at(s)).max() <= 1 / config.least_radius_m
    assert np.abs(road.slope_at(s)).max() < 0.02
    left = road.place(s, np.full_like(s, 10.0))
    np.testing.assert_allclose(np.linalg.norm(left - places, axis=1), 10.0, rtol=1e-6)
    assert 2 <= road.lanes <= 4
    assert road.lane_centre(1, 0) - road.lane_centre(1, 1) == pytest.approx(LANE_M)
    assert road.lane_centre(-1, 0) > 0 > road.lane_centre(1, 0)


def test_a_faster_car_brakes_behind_a_slower_one_or_passes_it(config):
    road = make_road(config, np.random.default_rng(0))
    road.lanes = 2
    for may_change in (False, True):
        fleet = [
            Vehicle("car", 1, 1, 60.0, 20.0, 5.0, may_change=False),
            Vehicle("car", 1, 1, 0.0, 35.0, 5.0, may_change=may_change),
        ]
        s, rate, d, _ = simulate_traffic(fleet, road, 400, np.random.default_rng(5))
        same_lane = np.abs(d[0] - d[1]) < 1.5
        assert ((s[0] - s[1])[same_lane & (s[0] > s[1])] > 5.0).all()
        assert (s[1, -1] > s[0, -1]) == may_change
        np.testing.assert_allclose(np.diff(s, axis=1), 0.5 * (rate[:, 1:] + rate[:, :-1]) * STEP_S, atol=1e-9)


@pytest.mark.parametrize("index", [0, 2])
def test_velocities_and_rates_are_the_derivatives_of_the_poses(config, index):
    scene = make_scene(config, index)
    h = 1e-3
    for now in (0.313, 1.477):
        before, after = (scene.tracks.state(now + sign * h)[0] for sign in (-1, 1))
        velocity = scene.tracks.state(now)[1]
        np.testing.assert_allclose((after - before) / (2 * h), velocity, atol=0.12)
        r0, t0 = scene.ego.pose(now - h)
        r1, t1 = scene.ego.pose(now + h)
        r, _ = scene.ego.pose(now)
        (linear,), (angular,) = scene.ego.rates(np.array([now]))
        np.testing.assert_allclose(r @ linear, (t1 - t0) / (2 * h), atol=0.05)
        np.testing.assert_allclose(
            r @ np.cross(angular, [5.0, 1.0, 2.0]), (r1 - r0) @ [5.0, 1.0, 2.0] / (2 * h), atol=0.02
        )
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)


def test_the_truck_drives_60_to_90_kmh_and_traffic_stays_below_180(config):
    for index in range(config.num_scenes):
        scene = make_scene(config, index)
        assert 40 < np.linalg.norm(scene.ego.rates(np.array([0.5]))[0]) * 3.6 < 92
        assert np.linalg.norm(scene.tracks.state(0.5)[1], axis=1).max() * 3.6 < 182


def test_vehicles_on_the_road_do_not_stand_in_one_another(config):
    for index in range(config.num_scenes):
        scene = make_scene(config, index)
        moving = np.array([actor.kind.klass in ("car", "bus", "truck") and not actor.parked for actor in scene.actors])
        for now in (0.0, 1.0, 2.0):
            places, _, yaws = scene.tracks.state(now)
            offset = places[moving][None] - places[moving][:, None]
            turn = yaws[moving][:, None]
            along = np.abs(np.cos(turn) * offset[..., 0] + np.sin(turn) * offset[..., 1])
            across = np.abs(np.cos(turn) * offset[..., 1] - np.sin(turn) * offset[..., 0])
            length = scene.sizes[moving, 0]
            touching = (along < 0.45 * (length[:, None] + length)) & (across < 1.4)
            np.fill_diagonal(touching, False)
            assert not touching.any()


def test_labelled_objects_lie_inside_their_boxes(config):
    for actor in make_scene(config, 0).actors:
        corners = actor_mesh(actor).corners.reshape(-1, 3)
        if actor.kind.category is None or actor.kind.klass == "traffic_sign":
            continue  # poles reach below the sign
        slack = 0.16
        assert (np.abs(corners[:, :2]) <= 0.5 * actor.size[:2] + slack).all(), actor.name
        assert corners[:, 2].min() >= -0.01 and corners[:, 2].max() <= actor.size[2] + 0.1, actor.name


@pytest.mark.parametrize(("seen", "level"), [(0, 1), (39, 1), (40, 2), (60, 3), (79, 3), (80, 4), (100, 4)])
def test_visibility_levels(seen, level):
    assert visibility_level(100, seen) == level


def test_places_outside_every_image_are_of_the_lowest_level_as_in_the_released_tables():
    assert visibility_level(0, 0) == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("key_frames_per_scene", 0),
        ("camera_fov_deg", 170.0),
        ("returns_density", -1.0),
        ("doppler_noise_mps", float("nan")),
        ("radar_sweeps_per_key_frame", 11),
        ("lidar_sweeps_per_key_frame", 6),
        ("image_width_px", 8),
        ("jpeg_quality", 100),
    ],
)
def test_impossible_worlds_are_refused_by_name(default_values, name, value):
    with pytest.raises(ConfigError, match=f"{name} must be"):
        WorldConfig(**(default_values | {name: value}))


def test_a_world_needs_a_scene(default_values):
    with pytest.raises(ConfigError, match="needs a scene"):
        WorldConfig(**(default_values | {"num_train_scenes": 0, "num_val_scenes": 0}))
