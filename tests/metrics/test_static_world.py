"""The world that stands still: what a scan says of rays of other times, by hand and on the synthetic highway."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from src.data.cache import load_index
from src.data.reader import FrameReader
from src.data.timeline import RadialSpeeds
from src.metrics.static_world import aggregated_scan, look_up_ranges, static_world, unseen
from src.structures.batch import FrameBatch
from src.structures.ray_bundle import RayBundle
from src.world.write import VERSION, ensure_world
from tests.data.tiny_set import FIVE_HERTZ, reader_settings
from tests.models.moving import bda
from tests.ray_bundles import rays_to
from tests.world.conftest import small_config

BOUNDS = ((-100.0, 250.0), (-100.0, 100.0), (-12.0, 12.0))


def wall(x):
    y, z = np.meshgrid(np.arange(-20.0, 20.0, 0.1), np.arange(0, 4, 0.1))
    return np.stack([np.full(y.size, x), y.ravel(), z.ravel()], 1)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_rays_of_a_truck_that_drove_on_meet_the_wall_where_it_stands():
    rng = np.random.default_rng(0)
    ends = np.stack([np.full(200, 50.0), rng.uniform(-15, 15, 200), rng.uniform(0.5, 3.5, 200)], 1)
    origins = np.stack([rng.uniform(8, 12, 200), rng.uniform(-1, 1, 200), np.full(200, 2.0)], 1)
    found = look_up_ranges(wall(50.0), origins, unit(ends - origins), 300.0)
    away = np.linalg.norm(ends - origins, axis=1)
    assert np.abs(found - away).max() < 0.2 and np.median(np.abs(found - away)) < 0.03
    directions = unit(ends - origins)
    road = np.where(directions[:, 2] < 0, 2 / np.abs(directions[:, 2]), np.inf).clip(max=300)
    np.testing.assert_allclose(look_up_ranges(np.zeros((0, 3)), origins, directions, 300.0), road)


def test_the_first_point_in_a_ray_of_growing_width_is_met_else_the_road():
    points = np.array([[100.0, 0.0, 5.0], [20.0, 0.1, 5.0], [40.0, 9.0, 5.0]])  # the second 0.29 degrees aside
    directions = unit(np.array([[1.0, 0, 0], [1.0, 0.003, 0], [40.0, 10.0, 0], [40.0, 11.5, 0], [40.0, -8.0, -4.0]]))
    found = look_up_ranges(points, np.array([[0.0, 0, 5.0]]).repeat(5, 0), directions, 300.0)
    # the narrowest width that holds a point decides before what is nearest: 0 degrees, then 0.11
    np.testing.assert_allclose(found, [100, 20, 41, 300, np.sqrt(50**2 + 10**2 + 5**2)], atol=0.05)
    within_a_beam = np.array([[100.0, 0.0, 5.0], [20.0, 0.05, 5.0]])  # both within 0.25 degrees: the far one is hidden
    ahead = look_up_ranges(within_a_beam, np.array([[0.0, 0, 5.0]]), np.array([[1.0, 0, 0]]), 300.0)
    assert ahead == pytest.approx(20, abs=0.01)
    level, up = look_up_ranges(points[:0], np.full((2, 3), 2.0), unit(np.array([[0.0, 1, -0.001], [0, 1, 1]])), 300.0)
    assert (level, up) == (300.0, 300.0)  # the road 2 km away, and none


def frame(points, at=0.0, **rest):
    """A truck at x = `at`, in whose frame the points lie."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = at
    points = torch.tensor(points, dtype=torch.float32).reshape(-1, 3)
    return FrameBatch(
        tokens=[f"at {at}"], timestamps_s=torch.tensor([at], dtype=torch.float64), global_from_ego=pose[None],
        aug_from_ego=torch.eye(4)[None], lidar_points=torch.nn.functional.pad(points, (0, 2)),
        lidar_batch=torch.zeros(len(points), dtype=torch.int64),
        lidar_origins=torch.zeros_like(points), **rest,
    )  # fmt: skip


def test_past_scans_are_moved_by_the_ego():
    past = frame([[30.0, 5.0, 0.0]], at=10.0)
    batch = frame([[50.0, 0.0, 0.0]], at=12.0, past=(past,), rays=rays_to([[28.0, 5.0, 0], [60.0, 0, 0]]))
    points, owners = aggregated_scan(batch)
    torch.testing.assert_close(points, torch.tensor([[50.0, 0, 0], [28.0, 5, 0]]))
    assert owners.tolist() == [0, 0]
    assert static_world(batch, 300.0).tolist() == pytest.approx([np.hypot(28, 5), 50])
    assert static_world(replace(batch, past=()), 300.0).tolist() == [300.0, 50.0]  # 10 degrees aside
    with pytest.raises(ValueError, match="FrameBatch.rays"):
        static_world(past, 300.0)
    assert static_world(replace(frame(np.zeros((0, 3))), rays=batch.rays), 300.0).tolist() == [300.0, 300.0]


def test_the_truck_itself_does_not_stand_where_it_was():
    """Its own returns are known in the ego frame of their time, whatever the augmentation."""
    own, others = [[-9.0, 0.0, 2.0], [5.0, 1.0, 1.0]], [[-9.0, 2.0, 2.0], [-9, 0, 0.1], [-13, 0, 2], [7, 0, 1]]
    past = frame(own + others, at=10.0)
    batch = frame(own + others, at=20.0, past=(past,))
    kept = torch.tensor(others)
    expected = torch.cat([kept, kept - torch.tensor([10.0, 0, 0])])
    torch.testing.assert_close(aggregated_scan(batch)[0], expected)
    assert aggregated_scan(batch)[1].tolist() == [0] * 8
    trailer = frame([], at=20.0, past=(frame(own, at=10.0),), rays=rays_to([[-38.0, 0, 4]]))  # through (-19, 0, 2)
    assert static_world(trailer, 300.0) == 300

    turned = torch.tensor([[0.0, -1.05, 0, 0], [1.05, 0, 0, 0], [0, 0, 1.05, 0], [0, 0, 0, 1]])
    block = torch.block_diag(turned[:3, :3].T, torch.eye(2))
    past, batch = (
        replace(one, aug_from_ego=turned[None], lidar_points=one.lidar_points @ block) for one in (past, batch)
    )
    found, _ = aggregated_scan(replace(batch, past=(past,)))
    torch.testing.assert_close(found, expected @ turned[:3, :3].T)


def test_autocast_rounds_no_scan():
    past = frame([[187.3, -57.77, 1.03]], at=10.0)
    batch = frame([[50.3, 0.0, 0.0]], at=12.0, past=(past,))
    with torch.autocast("cpu", torch.bfloat16):
        points, _ = aggregated_scan(batch)
    torch.testing.assert_close(points, torch.tensor([[50.3, 0, 0], [185.3, -57.77, 1.03]]))


def test_samples_do_not_mix_and_augmentation_changes_no_range():
    """A truck that came 2 m and one that came 3 m; the second is mirrored, its past frame as well."""
    clouds = [[[30.0, 5.0, 0.0], [50.0, 0, 0]], [[31.0, -6.0, 0.0]]]
    ends = [[[28.0, 5.0, 0.0], [48.0, 0, 0], [60, -9, 0]], [[28.0, -6.0, 0.0], [28.0, 5.0, 0.0]]]
    mirror = bda(flip_y=True)
    alone, pairs = [], []
    for cloud, own, at in zip(clouds, ends, (12.0, 13.0), strict=True):
        past = frame(cloud, at=10.0)
        alone.append(frame(np.zeros((0, 3)), at=at, past=(past,), rays=rays_to(own)))
        pairs.append((past, alone[-1]))
    expected = [static_world(one, 300.0).tolist() for one in alone]
    assert expected == [pytest.approx([np.hypot(28, 5), 48, 300]), pytest.approx([np.hypot(28, 6), 300])]

    def both(first, second, **rest):
        augs = torch.stack([torch.eye(4), mirror])
        points = torch.cat([first.lidar_points, second.lidar_points * torch.tensor([1.0, -1, 1, 1, 1])])
        owners = torch.tensor([0] * len(first.lidar_points) + [1] * len(second.lidar_points), dtype=torch.int64)
        return replace(
            first, tokens=["a", "b"], timestamps_s=torch.cat([first.timestamps_s, second.timestamps_s]),
            global_from_ego=torch.cat([first.global_from_ego, second.global_from_ego]), aug_from_ego=augs,
            lidar_points=points, lidar_batch=owners, lidar_origins=torch.zeros(len(points), 3), **rest,
        )  # fmt: skip

    first, second = (one.rays for one in alone)
    rays = RayBundle.concatenate([first, second], dim=0)
    rays.directions[3:, 1] *= -1
    rays.batch[3:] = 1
    batch = both(alone[0], alone[1], past=(both(pairs[0][0], pairs[1][0]),), rays=rays)
    assert static_world(batch, 300.0).tolist() == pytest.approx(sum(expected, []))


def test_unseen_is_what_no_ray_of_the_input_reached():
    past = frame([[60.0, 30.0, 0.0]], at=-2.0)
    ends = [[15.0, 0, 0], [19.0, 0, 0], [30.0, 0, 0], [29.0, 15.0, 0.0], [300.0, 0, 0]]
    batch = frame([[20.5, 0.0, 0.0]], past=(past,), rays=rays_to(ends))
    assert unseen(batch, BOUNDS).tolist() == [False, False, True, False, False]
    assert unseen(replace(batch, past=()), BOUNDS).tolist() == [False, False, True, True, False]
    with pytest.raises(ValueError, match="data.lidar_origins=true"):
        unseen(replace(batch, lidar_origins=None), BOUNDS)


@pytest.mark.slow
def test_on_the_highway_it_is_right_about_what_stands_and_wrong_about_what_drives(tmp_path):
    world = small_config(
        num_train_scenes=1, num_val_scenes=0, key_frames_per_scene=3, lidar=True, lidar_sweeps_per_key_frame=5,
        lidar_step_deg=0.8, radar_sweeps_per_key_frame=1,
    )  # fmt: skip
    root = ensure_world(world, tmp_path / "world", progress=False)
    timeline = replace(FIVE_HERTZ, radial_speeds=RadialSpeeds.exact)
    settings = reader_settings(
        image_size_px=None, num_sweeps=0, num_lidar_sweeps=1, timeline=timeline, num_future_frames=1, lidar_origins=True
    )
    batch = FrameReader(load_index(root, VERSION, None), settings).read(0, None, history=[-2], targets=[0, 5])
    rays, found = batch.rays, static_world(batch, 300.0)
    errors = (found - rays.ranges).abs()
    still, moving = rays.speeds == 0, rays.speeds.abs() > 5
    assert errors[rays.steps == 0].median() < 0.02  # its own scan
    assert errors[(rays.steps == 5) & still].median() < 0.5
    assert errors[(rays.steps == 5) & moving].median() > 1.0
    share = unseen(batch, BOUNDS)[rays.steps == 5].float().mean()
    assert 0.005 < share < 0.5
