"""Ranges of the ray-cast lidars against geometry worked out by hand, and what comes back of them."""

import numpy as np
import pytest

from src.geometry.transforms import rotation_zyx
from src.structures.taxonomy import LIDARS
from src.world.lidar import Blocks, Lidars, cast_rays, detection_chance
from src.world.rig import LONG_LIDARS, SHORT_BEAMS
from src.world.road import END_M, START_M, Road
from src.world.scene_writer import SceneWriter
from src.world.simulate import make_scene
from src.world.solid import true_geometry

NOTHING = Blocks(
    middles=np.zeros((0, 3)), velocities=np.zeros((0, 3)), sizes=np.zeros((0, 3)), yaws=np.zeros(0),
    reflectivity=np.zeros(0),
)  # fmt: skip


def straight_road(slope):
    s = np.arange(START_M, END_M + 1.0)
    line = {"xy": np.stack([s, 0 * s], 1), "heading_rad": 0 * s, "z": slope * s}
    return Road(**line, lanes=2, side_road=0, apron=None, screen_m=0.0)


def one_block(middle, size, yaw, velocity=(0.0, 0.0, 0.0)):
    rows = {"middles": middle, "velocities": velocity, "sizes": size, "yaws": yaw, "reflectivity": 0.5}
    return Blocks(**{name: np.array([value], float) for name, value in rows.items()})


def points_on_sides(rng, size, count):
    """Points on the six sides of a cuboid about the origin, and the outward normals there."""
    points, normals = rng.uniform(-0.5, 0.5, (count, 3)), np.zeros((count, 3))
    axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    rows = np.arange(count)
    points[rows, axis], normals[rows, axis] = 0.5 * sign, sign
    return points * size, normals


def test_rays_to_known_points_of_a_driving_box_have_their_distance():
    rng = np.random.default_rng(0)
    size, yaw = np.array([8.0, 2.5, 3.0]), 0.7
    middle, velocity = np.array([60.0, 20.0, 30.0]), np.array([30.0, 9.0, 0.0])
    own, normals = points_on_sides(rng, size, 500)
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    after = rng.uniform(-0.05, 0.05, 500)
    points = own @ turn.T + middle + after[:, None] * velocity
    origins = rng.uniform(-1, 1, (500, 3)) + [0, 0, 30]
    away = np.linalg.norm(points - origins, axis=1)
    rays = (points - origins) / away[:, None]
    facing = -(rays * (normals @ turn.T)).sum(1)
    block = one_block(middle, size, yaw, velocity)
    ranges, echo, bright = cast_rays(origins, rays[:, None], after, block, straight_road(0.0), 0.0, 300.0)
    seen = facing > 1e-6
    assert seen.sum() > 100
    np.testing.assert_allclose(ranges[seen, 0], away[seen], atol=1e-4)
    np.testing.assert_allclose(echo[seen, 0], 0.5 * facing[seen], atol=1e-6)
    assert (ranges[~seen, 0] < away[~seen]).all() and (bright == 0.5).all()


@pytest.mark.parametrize("slope", [0.0, 0.016, -0.016])
def test_the_ground_of_a_sloped_road_is_met_where_the_plane_is(slope):
    azimuth, elevation = np.meshgrid(np.linspace(-3, 3, 60), np.radians(np.linspace(-40, 3, 50)), indexing="ij")
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    origins = np.tile([5.0, -3.0, 2.0 + 5.0 * slope], (60, 1))
    expected = 2.0 / np.maximum(slope * rays[..., 0] - rays[..., 2], 1e-9)
    ranges, _, _ = cast_rays(origins, rays, np.zeros(60), NOTHING, straight_road(slope), 0.0, 200.0)
    near = expected < 200
    np.testing.assert_allclose(ranges[near], expected[near], atol=1e-4)
    assert (ranges[~near] >= 200).all() and near.sum() > 500


def test_on_a_hilly_bend_rays_end_at_the_ground_and_not_before(config):
    scene = make_scene(config, 1)
    rotation, place = scene.ego.pose(0.0)
    azimuth, elevation = np.meshgrid(np.linspace(-3, 3, 40), np.radians(np.linspace(-20, -0.7, 25)), indexing="ij")
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    origins = np.tile(place + [0, 0, 2.5], (40, 1))
    ego_s = float(scene.ego.tracks.road_state(0.0)[0][0])
    ranges, _, _ = cast_rays(origins, rays, np.zeros(40), NOTHING, scene.road, ego_s, 150.0)
    met = ranges < 150

    def height(share):
        points = origins[:, None] + share * np.where(met, ranges, 1.0)[..., None] * rays
        nearest = np.argmin(np.linalg.norm(points[..., None, :2] - scene.road.xy[::10], axis=-1), -1) * 10.0 + START_M
        return points[..., 2] - scene.road.height_at(scene.road.along(points[..., :2], nearest))

    assert met.mean() > 0.8
    assert np.abs(height(1.0)[met]).max() < 1e-6  # 1e-4 m along a ray that sinks by a hundredth
    for share in (0.2, 0.5, 0.8, 0.95):
        assert (height(share)[met] > 0).all()


def test_one_look_up_gives_what_the_road_is_at_a_place(config):
    road = make_scene(config, 0).road
    s = np.random.default_rng(0).uniform(START_M + 2, END_M - 2, 200)
    (x, y, heading, height, slope), gain = road.profile_at(s)
    np.testing.assert_allclose(np.stack([x, y, height], 1), road.place(s, 0 * s), atol=1e-9)
    np.testing.assert_allclose([heading, slope], [road.heading_at(s), road.slope_at(s)], atol=1e-12)
    np.testing.assert_allclose(gain[2], np.diff(road.heading_rad)[np.floor(s - START_M).astype(int)])


def test_what_stands_behind_something_is_not_seen():
    rays = np.array([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    wall, hidden = one_block([20, 0, 2], [1, 4, 4], 0.0), one_block([50, 0, 2], [4, 4, 4], 0.0)
    both = Blocks(**{name: np.concatenate([getattr(b, name) for b in (hidden, wall)]) for name in vars(wall)})
    ranges, _, _ = cast_rays(np.array([[0.0, 0.0, 2.0]]), rays, np.zeros(1), both, straight_road(0.0), 0.0, 200.0)
    assert ranges[0, 0] == pytest.approx(19.5) and ranges[0, 1] == np.inf


def test_among_many_blocks_around_a_tilted_sensor_no_hit_is_lost():
    rng = np.random.default_rng(1)
    count, after = 80, np.linspace(-0.05, 0.05, 90)
    bearing, away = rng.uniform(-np.pi, np.pi, count), rng.uniform(0, 60, count)
    blocks = Blocks(
        middles=np.stack([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(100, 130, count)], 1),
        velocities=rng.normal(0, 15, (count, 3)), sizes=rng.uniform(0.05, 9, (count, 3)),
        yaws=rng.uniform(-np.pi, np.pi, count), reflectivity=rng.uniform(0, 1, count),
    )  # fmt: skip
    azimuth, elevation = np.meshgrid(np.linspace(-3, 3, 90), np.radians(np.linspace(-45, 45, 24)), indexing="ij")
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    rays = np.stack(rays, -1) @ rotation_zyx(0.4, 0.3, -0.2).T
    origins = np.stack([25.0 * after, 0 * after, 115.0 + 0 * after], 1)
    ranges, echo, _ = cast_rays(origins, rays, after, blocks, straight_road(0.0), 0.0, 80.0)

    turn = rotation_zyx(blocks.yaws, 0 * away, 0 * away)  # every ray against every block
    offset = origins[:, None] - blocks.middles - after[:, None, None] * blocks.velocities
    start = np.einsum("nji,anj->ani", turn, offset)[:, None]
    heading = np.einsum("nji,aej->aeni", turn, rays)
    one, two = (-0.5 * blocks.sizes - start) / heading, (0.5 * blocks.sizes - start) / heading
    enter, leave = np.minimum(one, two).max(-1), np.maximum(one, two).min(-1)
    enter[(enter >= leave) | (enter <= 0)] = np.inf
    nearest = enter.min(-1)
    hit = np.isfinite(nearest) & (nearest < ranges + 1e-6)
    assert 300 < hit.sum() < 0.9 * hit.size
    np.testing.assert_allclose(ranges[hit], nearest[hit], atol=1e-9)
    assert not (nearest < ranges - 1e-6).any() and (ranges[~hit] > 100).all()


@pytest.fixture(scope="module")
def scanned(make_config, tmp_path_factory):
    writer = SceneWriter(make_config(lidar=True), 0, tmp_path_factory.mktemp("lidar"))
    mounts = [writer.rig[name] for name in LIDARS]
    lidars = Lidars(writer.config, writer.scene, mounts, np.random.default_rng(0))
    return writer, lidars.sweep(0.3, 300_000)


def test_two_lidars_see_far_and_four_near(scanned):
    _, clouds = scanned
    for name, cloud in clouds.items():
        reach = np.sqrt(cloud["x"] ** 2 + cloud["y"] ** 2 + cloud["z"] ** 2).max()
        assert 100 < reach < 200.2 if name in LONG_LIDARS else 20 < reach < SHORT_BEAMS.reach_m + 0.2, name
        times = cloud["timestamp"].astype(int)
        assert len(cloud) > 1000 and np.ptp(times) > 70_000 and np.abs(times - 300_000).max() <= 50_000


def test_echoes_fade_with_reflectivity_slant_and_the_square_of_the_range():
    ranges = np.array([200.0, 199.99, 100.0, 100.0, 199.99, np.inf])
    echoes = np.array([0.1, 0.1, 0.1, 0.025, 0.025, 0.0])
    np.testing.assert_allclose(
        detection_chance(echoes, ranges, 200.0), [0, 0.9, 1 - 1e-4, 0.9, 1 - 0.1**0.25, 0], atol=1e-4
    )


def in_world(writer, channel, cloud):
    """Points [n, 3] in global coordinates and their times since the scene's start, us."""
    points = np.stack([cloud["x"], cloud["y"], cloud["z"]], 1)
    times_us = cloud["timestamp"].astype(np.int64)
    return writer._to_local(writer.rig[channel], points, 1e-6 * times_us) + writer.scene.utm_offset, times_us


def test_every_return_lies_on_the_true_geometry(scanned):
    writer, clouds = scanned
    geometry = true_geometry(writer.scene, writer.config.duration_s, 0)
    for channel, cloud in clouds.items():
        points, times_us = in_world(writer, channel, cloud)
        above = points[:, 2] - geometry.ground_height(points)
        on_box = geometry._boxes_of(points - geometry.origin, times_us, 0.1) >= 0
        assert (on_box | (np.abs(above) < 0.1)).all(), channel
        sensor = writer._to_local(writer.rig[channel], np.zeros((len(points), 3)), 1e-6 * times_us)
        rays = points - writer.scene.utm_offset - sensor
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        seen = above < 50
        before, behind = points - 0.3 * rays, points + 0.02 * rays
        inside = geometry.solid(behind[seen], times_us[seen])
        assert geometry.solid(before, times_us).mean() < 0.03, channel
        assert 0.6 < inside.mean(), channel  # half the noise of 0.02 m, thin slats
