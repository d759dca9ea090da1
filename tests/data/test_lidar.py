"""LiDAR of one frame: every point by its own time, on a truck that drives a curve."""

import numpy as np
import pytest
import torch

from src.data.augment import AugmentationConfig, BevAugmentationConfig
from src.data.cache import load_index
from src.data.compensation import deskew
from src.data.pcd import read_lidar_points
from src.data.reader import FrameReader
from src.data.schema import CHANNELS
from src.data.sensor_files import OnBadFile
from src.errors import DataError
from src.geometry.transforms import invert_rigid, rigid
from src.structures.taxonomy import LIDARS
from src.world.write import ensure_world
from tests.data.tiny_set import (
    FIVE_HERTZ,
    LIDAR_CHANNELS,
    LIDAR_STEP_US,
    START_S,
    STATIC,
    VERSION,
    ego_pose,
    lidar_bytes,
    mount,
    reader_settings,
    rotation,
)
from tests.world.conftest import small_config

ONLY_LIDAR = {"image_size_px": None, "num_sweeps": 0, "num_lidar_sweeps": 3}
BEV = BevAugmentationConfig(scale=[1.1, 1.2], rotation_rad=1.0, flip_probability=0.5)
TURNED = AugmentationConfig(image=None, bev=BEV)
KEY_S = START_S + 0.5  # of sample 1
AFTER_US = LIDAR_STEP_US * np.arange(-10, len(STATIC) - 10)  # the points of a sweep after the sweep's own time


NOT_RECORDED = {f"{channel} (not recorded)": 1 for channel in LIDARS if channel not in LIDAR_CHANNELS}


def apply(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def test_every_point_is_where_it_stands_and_began_where_the_sensor_was(lidar_set):
    frame = lidar_set.reader(**ONLY_LIDAR, lidar_origins=True).read(1, None)
    assert frame.radar_points is None and frame.radar_batch is None and frame.images is None
    points, origins = frame.lidar_points.double().numpy(), frame.lidar_origins.double().numpy()
    assert len(points) == len(origins) == 2 * 3 * len(STATIC) and frame.lidar_points.dtype == torch.float32
    ego_from_global, at = invert_rigid(ego_pose(KEY_S)), 0
    for order, channel in enumerate(LIDAR_CHANNELS):
        shift = 0 if channel == "LIDAR_LEFT" else 19_000 - 3_000 * (10 + order)
        for sweep in range(3):
            rows = slice(at, at + len(STATIC))
            at = rows.stop
            after_s = 1e-6 * (AFTER_US + shift) - 0.1 * sweep  # the points' times after the key frame's
            np.testing.assert_allclose(points[rows, :3], apply(ego_from_global, STATIC), atol=2e-3)
            np.testing.assert_array_equal(points[rows, 3], np.arange(len(STATIC)))
            np.testing.assert_allclose(points[rows, 4], -after_s, atol=1e-6)
            sensor = [(ego_from_global @ ego_pose(KEY_S + t) @ mount(channel))[:3, 3] for t in after_s]
            np.testing.assert_allclose(origins[rows], sensor, atol=2e-3)
            rays = points[rows, :3] - origins[rows]
            raw = read_lidar_points(lidar_path(lidar_set, channel, sweep)).points[:, :3]
            np.testing.assert_allclose(np.linalg.norm(rays, axis=1), np.linalg.norm(raw, axis=1), atol=4e-3)
    assert np.linalg.norm(origins[0] - origins[len(STATIC) - 1]) > 1.8  # 20 m/s for 0.095 s


def lidar_path(data_set, channel, sweep=0):
    index = load_index(data_set.root, VERSION, None)
    row = int(index.key_data[1, CHANNELS.index(channel)])
    for _ in range(sweep):
        row = int(index.data_previous[row])
    return data_set.root / index.filename(row)


def test_without_deskewing_a_sweep_stays_as_it_was_measured(lidar_set):
    one = ONLY_LIDAR | {"num_lidar_sweeps": 1}
    frame = lidar_set.reader(**one, deskew_lidar=False, lidar_origins=True).read(1, None)
    raw = read_lidar_points(lidar_path(lidar_set, "LIDAR_LEFT")).points[:, :3]
    left = slice(0, len(STATIC))
    np.testing.assert_allclose(frame.lidar_points[left, :3], apply(mount("LIDAR_LEFT"), raw), atol=1e-4)
    assert (frame.lidar_points[left, 4] == 0).all()
    np.testing.assert_allclose(frame.lidar_origins[left], np.tile(mount("LIDAR_LEFT")[:3, 3], (20, 1)), atol=1e-6)
    assert lidar_set.reader(**ONLY_LIDAR).read(1, None).lidar_origins is None


def test_fewer_sweeps_at_a_scenes_start_and_near_points_are_dropped(lidar_set, broken_lidar):
    frame = lidar_set.reader(**(ONLY_LIDAR | {"num_lidar_sweeps": 9})).read(0, None)
    assert len(frame.lidar_points) == 2 * 6 * len(STATIC)
    path = lidar_path(broken_lidar, "LIDAR_LEFT")
    cloud = np.zeros((5, 4))
    cloud[:, :3] = [[0.9, -0.9, 3], [0.9, 1.1, 0], [1.1, 0.2, 0], [0, 0, 0], [np.nan, np.nan, np.nan]]
    path.write_bytes(lidar_bytes(cloud, np.full(5, int(KEY_S * 1e6))))
    one = {"num_lidar_sweeps": 1}
    assert len(broken_lidar.reader(**(ONLY_LIDAR | one)).read(1, None).lidar_points) == 2 + len(STATIC)
    everything = broken_lidar.reader(**(ONLY_LIDAR | one | {"min_distance_m": 0.0})).read(1, None)
    assert len(everything.lidar_points) == 3 + len(STATIC)  # but what was measured at no distance


def test_augmentation_moves_points_and_origins(lidar_set):
    reader = lidar_set.reader(**ONLY_LIDAR, lidar_origins=True)
    before, after = reader.read(1, None), reader.read(1, TURNED, 0, 3)
    matrix = after.aug_from_ego[0].double().numpy()
    assert not np.allclose(matrix, np.eye(4), atol=0.05)
    points, moved = before.lidar_points.double().numpy(), after.lidar_points.double().numpy()
    np.testing.assert_allclose(moved[:, :3], apply(matrix, points[:, :3]), atol=1e-3)
    np.testing.assert_array_equal(moved[:, 3:], points[:, 3:])
    origins = before.lidar_origins.double().numpy()
    np.testing.assert_allclose(after.lidar_origins, apply(matrix, origins), atol=1e-3)


def test_reading_lidar_changes_no_draw(lidar_set):
    alone = lidar_set.reader(num_lidar_sweeps=0).read(1, TURNED, 4, 2)
    timed = lidar_set.reader(num_lidar_sweeps=1, timeline=FIVE_HERTZ, num_future_frames=2)
    both = timed.read(1, TURNED, 4, 2, None, [-1], [0, 1])
    assert torch.equal(alone.radar_points, both.radar_points) and torch.equal(alone.images, both.images)
    assert torch.equal(alone.pix_from_aug, both.pix_from_aug) and alone.lidar_points is None and alone.rays is None


def damage(path, fault):
    points, times = read_lidar_points(path)
    if fault == "cut":
        path.write_bytes(path.read_bytes()[:-7])
    elif fault == "gone":
        path.unlink()
    else:
        path.write_bytes(lidar_bytes(points, times + 37_000_000))  # another clock, as of atomic time


@pytest.mark.parametrize(
    "fault, words",
    [
        ("cut", "the compressed data end at byte"),
        ("gone", "no such file"),
        ("clock", "measured at .* more than 0.3 s from its sweep.*data.deskew_lidar=false"),
    ],
)
def test_bad_files_stop_or_are_counted(broken_lidar, fault, words):
    path = lidar_path(broken_lidar, "LIDAR_REAR", 1)
    damage(path, fault)
    with pytest.raises(DataError, match=f"{path.name}: .*{words}.*data.on_bad_file=skip"):
        broken_lidar.reader(**ONLY_LIDAR).read(1, None)
    frame = broken_lidar.reader(**ONLY_LIDAR, on_bad_file=OnBadFile.skip).read(1, None)
    assert frame.skipped == NOT_RECORDED | {"LIDAR_REAR": 1}
    assert frame.bad_files == [str(path.relative_to(broken_lidar.root))]
    assert len(frame.lidar_points) == 5 * len(STATIC)
    if fault == "clock":
        frame = broken_lidar.reader(**ONLY_LIDAR, deskew_lidar=False).read(1, None)
        assert len(frame.lidar_points) == 6 * len(STATIC)


def test_deskewing_is_the_motion_of_a_constant_twist():
    rng = np.random.default_rng(0)
    points = rng.uniform(-150, 150, (40, 3)).astype(np.float32)
    offsets = rng.uniform(-0.1, 0.1, 40).astype(np.float32)
    velocity, yaw_rate = np.array([25.0, -0.5, 0.2]), 0.5
    found = deskew(points.T, offsets, velocity, np.array([0.0, 0.0, yaw_rate])).T
    assert found.dtype == np.float32
    for point, t, place in zip(points, offsets, found, strict=True):
        angle = yaw_rate * t
        s, c = np.sin(angle) / yaw_rate, (1 - np.cos(angle)) / yaw_rate  # the arc that the origin drives
        drive = np.array([s * velocity[0] - c * velocity[1], c * velocity[0] + s * velocity[1], t * velocity[2]])
        np.testing.assert_allclose(place, apply(rigid(rotation(2, angle), drive), point), atol=5e-3)
    np.testing.assert_array_equal(deskew(points.T, np.zeros(40, np.float32), velocity, np.ones(3)), points.T)


@pytest.mark.slow
def test_the_worlds_own_lidars_give_the_points_that_its_rays_met(tmp_path):
    """Six rolling scans of a truck on bad suspension, of which the tables know only poses a hundredth apart."""
    from src.world.scene_writer import SceneWriter

    config = small_config(
        num_train_scenes=1, num_val_scenes=0, key_frames_per_scene=2, lidar=True, lidar_sweeps_per_key_frame=3,
        radar_sweeps_per_key_frame=1,
    )  # fmt: skip
    root = ensure_world(config, tmp_path / "world", progress=False)
    index = load_index(root, VERSION, None)
    writer = SceneWriter(config, 0, root)
    frame = FrameReader(index, reader_settings(**ONLY_LIDAR, min_distance_m=0.0)).read(1, None)
    ego_from_global = invert_rigid(frame.global_from_ego[0].numpy())
    at = 0
    for channel in LIDARS:
        row = int(index.key_data[1, CHANNELS.index(channel)])
        for sweep in range(3):
            raw, times_us = read_lidar_points(root / index.filename(row))
            assert abs(int(index.frame_times_us[1] - index.data_times_us[row]) - 100_000 * sweep) < 10_000
            rotations, translations = writer.scene.ego.poses(1e-6 * (times_us - writer.start_us))
            own = writer.rig[channel]
            in_ego = raw[:, :3].astype(np.float64) @ own.rotation.T + own.translation
            places = np.einsum("pij,pj->pi", rotations, in_ego) + translations + writer.scene.utm_offset
            expected = apply(ego_from_global, places)
            found = frame.lidar_points[at : at + len(raw), :3].double().numpy()
            away = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1).clip(20)
            assert away.max() < 5e-4, (channel, sweep, away.max())
            at, row = at + len(raw), int(index.data_previous[row])
    assert at == len(frame.lidar_points) > 50_000
