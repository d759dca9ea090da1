"""One frame: radar compensation, projection under augmentation, boxes, bad files (method 15, points 5 to 7)."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from src.data.augment import AugmentationConfig, BevAugmentationConfig, ImageAugmentationConfig
from src.data.cache import load_index
from src.data.compensation import Sweeps, compensate_clouds, ego_motion
from src.data.pcd import read_radar_points
from src.data.point_tensors import radar_tensors
from src.data.reader import FrameReader
from src.data.sensor_files import OnBadFile
from src.errors import DataError
from src.geometry.transforms import invert_rigid, quaternion_to_matrix, rigid
from src.structures.taxonomy import CAMERAS, CLASSES, RADARS
from tests.data.tiny_set import (
    BLOB,
    START_S,
    STATIC,
    TARGET_VELOCITY,
    VERSION,
    ego_pose,
    mount,
    pcd_bytes,
    project,
    reader_settings,
)

REAL = Path(__file__).resolve().parents[3] / "shared/real/truckscenes_radar"
AUGMENTATION = AugmentationConfig(
    image=ImageAugmentationConfig(resize=[-0.06, 0.11], rotation_deg=5.4, flip_probability=0.5),
    bev=BevAugmentationConfig(scale=[0.95, 1.05], rotation_rad=0.3925, flip_probability=0.5),
)
KEY_S = START_S + 0.5  # of sample 1
TARGET_RCS = len(STATIC)


def apply(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.fixture(scope="module")
def frame(data_set):
    return data_set.reader().read(1, None)


def split_points(frame):
    points = frame.radar_points.double().numpy()
    moving = points[:, 3] == TARGET_RCS
    return points[~moving], points[moving]


def test_static_points_stand_still_and_coincide(frame):
    """Seen by six turned and tilted mounts, one upside down, on a truck that drives a curve."""
    static, _ = split_points(frame)
    assert len(static) == 6 * 10 * len(STATIC)
    assert np.abs(static[:, 4:6]).max() < 5e-3  # the truck does 20 m/s
    truth = apply(invert_rigid(ego_pose(KEY_S)), STATIC)
    np.testing.assert_allclose(static[:, :3], truth[static[:, 3].astype(int)], atol=2e-3)


def test_moving_target_keeps_its_radial_velocity(frame):
    _, moving = split_points(frame)
    ego_from_global = invert_rigid(ego_pose(KEY_S))
    for k, channel in enumerate(RADARS):
        for row in moving[10 * k : 10 * (k + 1)]:
            sensor = apply(ego_from_global, (ego_pose(KEY_S - row[6]) @ mount(channel))[:3, 3])
            unit = (row[:3] - sensor) / np.linalg.norm(row[:3] - sensor)
            truth = (TARGET_VELOCITY @ ego_from_global[:3, :3].T) @ unit * unit
            np.testing.assert_allclose(row[4:6], truth[:2], atol=0.01)
    assert np.linalg.norm(moving[:, 4:6], axis=1).max() > 10


def test_age_of_sweeps_is_signed(frame):
    ages = frame.radar_points[:, 6].double().numpy().reshape(6, 10, -1)[:, :, 0]
    np.testing.assert_allclose(np.diff(ages, axis=1), 0.05, atol=1e-6)
    np.testing.assert_allclose(ages[:, 0], np.array([-7, -4, -1, 2, 5, 8]) / 1000, atol=1e-6)  # late files are negative


def test_sweeps_end_where_the_scene_begins(data_set):
    frame = data_set.reader(num_sweeps=15, image_size_px=None).read(0, None)
    assert len(frame.radar_points) == 6 * 11 * 21 and frame.images is None


def test_moved_points_meet_the_target(data_set):
    """The target drives nearly straight away from the sensors, so radial propagation undoes most of the smear."""
    spread = {}
    for moved in (False, True):
        _, target = split_points(data_set.reader(propagate_points=moved, image_size_px=None).read(1, None))
        spread[moved] = np.ptp(target[:10, :2], axis=0).max()
    assert spread[False] > 4 and spread[True] < 0.6 * spread[False]


@pytest.mark.parametrize("propagate_points", [False, True])
def test_compensation_is_that_of_one_point_after_the_other(propagate_points):
    rng = np.random.default_rng(0)
    turns = quaternion_to_matrix(rng.normal(size=(2, 4, 4)))
    mounts = rigid(turns[0], rng.normal(size=(4, 3)))
    key_from_sweep = rigid(turns[1], rng.normal(scale=5, size=(4, 3)))
    velocity, rate, elapsed_s = rng.normal(size=(4, 3)) * 20, rng.normal(size=(4, 3)), rng.uniform(0, 0.5, 4)
    clouds = [rng.normal(scale=4, size=(n, 7)).astype(np.float32) for n in (5, 0, 40, 1)]
    clouds[2][3, :3] = 0
    settings = {"propagate_points": propagate_points, "min_distance_m": 2.0}
    sweeps = Sweeps(clouds=clouds, ego_from_sensor=mounts, global_from_ego=key_from_sweep, velocity=velocity, rate=rate)
    found = compensate_clouds(sweeps, np.eye(4), elapsed_s, **settings)
    expected = []
    for cloud, mount_, motion, v, w, lag in zip(clouds, mounts, key_from_sweep, velocity, rate, elapsed_s, strict=True):
        for point in cloud.astype(np.float64):
            if (np.abs(point[:2]) < 2.0).all():
                continue
            ray = point[:3] / np.linalg.norm(point[:3])
            ray_ego = mount_[:3, :3] @ ray
            speed = point[3:6] @ ray + (v + np.cross(w, mount_[:3, 3])) @ ray_ego
            ground = speed * (motion[:3, :3] @ ray_ego)[:2]
            place = apply(motion @ mount_, point[:3])
            place[:2] += ground * lag if propagate_points else 0
            expected.append([*place, point[6], *ground, lag])
    assert found.dtype == np.float64 and 20 < len(expected) < 45
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
    second = Sweeps(**{field.name: getattr(sweeps, field.name)[1:2] for field in fields(sweeps)})
    nothing = compensate_clouds(second, np.eye(4), np.zeros(1), **settings)
    assert nothing.shape == (0, 7)


def test_near_points_are_dropped(data_set, broken_files):
    index = load_index(broken_files.root, VERSION, None)
    cloud = np.zeros((4, 7))
    cloud[:, :3] = [[0.9, -0.9, 3], [0.9, 1.1, 0], [1.1, 0.2, 0], [0, 0, 0]]
    row = index.key_data[1, len(CAMERAS)]
    (broken_files.root / index.filename(row)).write_bytes(pcd_bytes(cloud))
    frame = broken_files.reader(num_sweeps=1, image_size_px=None).read(1, None)
    assert int((frame.radar_points[:, 6] == frame.radar_points[0, 6]).sum()) == 2


def test_ego_motion_on_the_circle(data_set):
    index = load_index(data_set.root, VERSION, None)
    times = index.data_times_us[:40]
    rotations = quaternion_to_matrix(index.pose_rotations[index.data_poses[:40]])
    velocity, rate = ego_motion(index, times, rotations)
    for row, time in enumerate(times):
        pose = ego_pose(1e-6 * time)
        heading = 0.3 + 0.2 * (1e-6 * time - START_S)
        global_velocity = 20 * np.array([np.cos(heading), np.sin(heading), 0])
        np.testing.assert_allclose(velocity[row], global_velocity @ pose[:3, :3], atol=0.3)  # one-sided at the ends
        np.testing.assert_allclose(rate[row], [0, 0, 0.2] @ pose[:3, :3], atol=1e-3)


def test_jumping_and_sparse_poses_are_refused(broken_tables):
    index = load_index(broken_tables.root, VERSION, None)
    stamp, rotations = index.data_times_us[:1], np.eye(3)[None]
    jump = index.pose_translations.copy()
    jump[index.pose_times_us > stamp[0]] += 100
    with pytest.raises(DataError, match="ego_pose.json.*m/s"):
        ego_motion(replace(index, pose_translations=jump), stamp, rotations)
    with pytest.raises(DataError, match="fewer than two ego poses"):
        ego_motion(replace(index, pose_times_us=index.pose_times_us * 100), stamp * 100, rotations)


def with_poses_moved(index, poses):
    """The index with these rows of the pose table half a kilometre off."""
    translations = index.pose_translations.copy()
    translations[poses] += [500.0, 0.0, 0.0]
    return replace(index, pose_translations=translations)


def files_of(index, sample, poses):
    """Files that a frame of ten sweeps reads and that have one of these poses."""
    rows = [int(row) for row in index.key_data[sample, : len(CAMERAS)]]
    for row in index.key_data[sample, len(CAMERAS) : len(CAMERAS) + len(RADARS)]:
        for _ in range(10):
            rows.append(int(row))
            row = index.data_previous[row]
    return sorted(index.filename(row) for row in rows if index.data_poses[row] in poses)


def test_files_whose_pose_no_truck_can_have_stop_or_are_counted(data_set):
    """A past sweep of one radar, the picture of one camera, and what was recorded at the same moments."""
    index = load_index(data_set.root, VERSION, None)
    sweep = int(index.data_previous[index.key_data[1, len(CAMERAS) + 2]])
    picture = int(index.key_data[1, 1])
    moved = with_poses_moved(index, index.data_poses[[sweep, picture]])
    for settings in ({"image_size_px": None}, {"num_sweeps": 0}):
        with pytest.raises(DataError, match="ego_pose.json: from the pose of s.*data.on_bad_file=skip"):
            FrameReader(moved, reader_settings(**settings)).read(1, None)
    whole = data_set.reader().read(1, None)
    frame = FrameReader(moved, reader_settings(on_bad_file=OnBadFile.skip)).read(1, None)
    affected = files_of(index, 1, index.data_poses[[sweep, picture]])
    also = set(frame.bad_files) - set(affected)  # sweeps 0.1 s from a wrong pose, which would get a wrong velocity
    assert set(affected) <= set(frame.bad_files) and len(affected) >= 2 and len(also) <= 4
    assert not any(name.startswith("samples/CAMERA") for name in also)
    assert sum(frame.skipped.values()) == len(frame.bad_files) and frame.skipped[f"{CAMERAS[1]} (ego pose)"] == 1
    sweeps = sum(name.endswith(".pcd") for name in frame.bad_files)
    assert len(whole.radar_points) - len(frame.radar_points) == sweeps * (len(STATIC) + 1)
    assert not frame.image_valid[0, 1] and not frame.images[0, 1].any() and frame.image_valid[0, 0]
    assert len(frame.boxes[0]) == len(whole.boxes[0]) > 0


def test_a_key_frame_of_a_wrong_pose_shows_and_teaches_nothing(data_set):
    index = load_index(data_set.root, VERSION, None)
    pose = index.frame_poses[1]
    moved = with_poses_moved(index, [pose])
    frame = FrameReader(moved, reader_settings(on_bad_file=OnBadFile.skip)).read(1, None)
    shared = files_of(index, 1, [pose])  # wrong in the same way, so it seems to be right
    assert len(frame.bad_files) == 6 * 10 + len(CAMERAS) - len(shared)
    assert len(frame.radar_points) == sum(name.endswith(".pcd") for name in shared) * (len(STATIC) + 1)
    assert len(frame.boxes[0]) == 0
    following = FrameReader(moved, reader_settings(on_bad_file=OnBadFile.skip)).read(2, None)
    assert len(following.radar_points) > 0 and len(following.boxes[0]) > 0


def test_sweeps_where_the_poses_jump_are_skipped(data_set):
    """All poses after the key frame are 30 m on: its newest sweeps would have a speed of more than 100 m/s."""
    index = load_index(data_set.root, VERSION, None)
    translations = index.pose_translations.copy()
    translations[index.pose_times_us > index.frame_times_us[1]] += [30.0, 0.0, 0.0]
    jumped = replace(index, pose_translations=translations)
    with pytest.raises(DataError, match="ego_pose.json"):
        FrameReader(jumped, reader_settings()).read(1, None)
    whole = data_set.reader().read(1, None)
    frame = FrameReader(jumped, reader_settings(on_bad_file=OnBadFile.skip)).read(1, None)
    assert 0 < len(frame.radar_points) < len(whole.radar_points) and set(frame.skipped) >= {
        "RADAR_LEFT_FRONT (ego pose)"
    }
    old = whole.radar_points[whole.radar_points[:, 6] > 0.15]
    torch.testing.assert_close(frame.radar_points[frame.radar_points[:, 6] > 0.15], old)


def test_real_sweep_is_explained_by_one_speed(data_set):
    if not REAL.is_dir():
        pytest.skip(f"{REAL} is not there")
    (path,) = REAL.glob("*.pcd")
    times = START_S * 1e6 + np.arange(-20, 21) * 10_000
    index = load_index(data_set.root, VERSION, None)
    turn = np.deg2rad(-19.6) / 2
    index = replace(
        index,
        pose_times_us=times.astype(np.int64),
        pose_translations=np.stack([23.8 * (1e-6 * times - START_S), *np.zeros((2, 41))], axis=1),
        pose_rotations=np.tile([1.0, 0, 0, 0], (41, 1)),
    )
    velocity, rate = ego_motion(index, np.array([START_S * 1e6]).astype(np.int64), np.eye(3)[None])
    mounts = rigid(quaternion_to_matrix([np.cos(turn), 0, 0, np.sin(turn)]), [5.26, 1.23, 2.01])[None]
    sweeps = Sweeps(clouds=[read_radar_points(path)], ego_from_sensor=mounts, global_from_ego=np.eye(4)[None],
                    velocity=velocity, rate=rate)  # fmt: skip
    how = (reader_settings().min_distance_m, False)
    points = radar_tensors(sweeps, np.zeros(1), np.eye(4), np.eye(4), *how)["radar_points"].numpy()
    slow = np.linalg.norm(points[:, 4:6], axis=1) < 0.6
    assert len(points) == 612 and slow.sum() >= 535


@pytest.mark.parametrize("image", [True, False])
def test_projection_follows_the_picture_under_augmentation(data_set, image):
    """The spot painted at BLOB appears where P_n maps the augmented 3D point."""
    augmentation = AUGMENTATION if image else replace(AUGMENTATION, image=None)
    reader = data_set.reader(image_size_px=(76, 160))
    frames = [reader.read(sample, augmentation, 0, epoch) for epoch in range(8) for sample in (0, 1)]
    found = sum(spots_in_place(frame) for frame in frames)
    assert found >= (12 if image else 16)  # a strong crop may cut the spot off


def spots_in_place(frame):
    """Number of views that show the whole spot; it must lie where the projection says."""
    aug_from_global = frame.aug_from_ego[0].double().numpy() @ invert_rigid(frame.global_from_ego[0].numpy())
    found = 0
    for view in range(4):
        picture = frame.images[0, view, 0].numpy().astype(float)
        if picture.max() < 150:
            continue
        pixel, depth = project(apply(aug_from_global, BLOB), frame.pix_from_aug[0, view].double().numpy())
        picture[picture < 50] = 0
        y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
        centroid = np.array([(picture * x).sum(), (picture * y).sum()]) / picture.sum()
        if 6 < centroid[0] < 154 and 6 < centroid[1] < 70:
            np.testing.assert_allclose(pixel, centroid, atol=0.35)
            assert 15 < depth < 45
            found += 1
    return found


def test_augmentation_moves_points_and_boxes_together(data_set):
    reader = data_set.reader(image_size_px=None)
    plain, turned = reader.read(1, None), reader.read(1, AUGMENTATION, 0, 3)
    matrix = turned.aug_from_ego[0].double().numpy()
    assert not np.allclose(matrix, np.eye(4))
    before, after = plain.radar_points.double().numpy(), turned.radar_points.double().numpy()
    np.testing.assert_allclose(after[:, :3], apply(matrix, before[:, :3]), atol=1e-4)
    np.testing.assert_allclose(after[:, 4:6], before[:, 4:6] @ matrix[:2, :2].T, atol=1e-5)
    np.testing.assert_array_equal(after[:, [3, 6]], before[:, [3, 6]])
    old, new = plain.boxes[0], turned.boxes[0]
    np.testing.assert_allclose(new.centers, apply(matrix, old.centers.double().numpy()), atol=1e-4)
    np.testing.assert_allclose(new.sizes, old.sizes * abs(np.cbrt(np.linalg.det(matrix))), rtol=1e-5)


def test_draws_depend_on_seed_epoch_and_token_alone(data_set):
    reader = data_set.reader()
    first = reader.read(2, AUGMENTATION, 5, 1)
    reader.read(0, AUGMENTATION, 5, 1)
    again = data_set.reader().read(2, AUGMENTATION, 5, 1)
    assert torch.equal(first.images, again.images) and torch.equal(first.radar_points, again.radar_points)
    for seed, epoch in ((5, 2), (6, 1)):
        assert not torch.equal(first.aug_from_ego, reader.read(2, AUGMENTATION, seed, epoch).aug_from_ego)
    other = reader.read(1, AUGMENTATION, 5, 1)
    assert not torch.equal(first.aug_from_ego, other.aug_from_ego)
    matrices = first.pix_from_aug[0]
    assert not torch.allclose(matrices[0, :, :3], matrices[1, :, :3])


def test_boxes_in_ego(frame, data_set):
    boxes = frame.boxes[0]  # rack and stroller are left out
    assert [CLASSES[label] for label in boxes.labels] == ["car"] and boxes.num_points.tolist() == [6]
    np.testing.assert_allclose(boxes.sizes[0], [4.6, 1.9, 1.6])
    rotation = invert_rigid(ego_pose(KEY_S))[:3, :3]
    np.testing.assert_allclose(boxes.velocities[0], (rotation @ TARGET_VELOCITY)[:2], atol=1e-4)
    assert float(boxes.yaws[0]) == pytest.approx(2.1 - 0.3 - 0.1, abs=2e-3)  # heading is 0.3 + 0.2 * 0.5
    first = data_set.reader(image_size_px=None).read(0, None).boxes[0]
    assert torch.isnan(first.velocities[1]).all() and first.attributes[1] >= 0


def radar_path(data_set):
    index = load_index(data_set.root, VERSION, None)
    return data_set.root / index.filename(index.key_data[1, len(CAMERAS)]), str(index.sample_tokens[1])


def test_bad_files_stop_or_are_counted(broken_files, caplog):
    radar, token = radar_path(broken_files)
    radar.write_bytes(radar.read_bytes()[:-5])
    index = load_index(broken_files.root, VERSION, None)
    camera = broken_files.root / index.filename(index.key_data[1, 2])
    camera.unlink()
    with pytest.raises(DataError, match=f"{radar.name}.*{token}.*data.on_bad_file=skip"):
        broken_files.reader().read(1, None)
    reader = broken_files.reader(on_bad_file=OnBadFile.skip)
    for _ in range(2):
        frame = reader.read(1, None)
        assert frame.skipped == {RADARS[0]: 1, CAMERAS[2]: 1}
        assert frame.bad_files == [str(path.relative_to(broken_files.root)) for path in (radar, camera)]
        assert frame.image_valid.tolist() == [[True, True, False, True]] and not frame.images[0, 2].any()
        assert len(frame.radar_points) == (60 - 1) * 21
    assert caplog.text.count(radar.name) == 1  # reported once


def test_link_out_of_the_data_set_is_refused(broken_files, tmp_path_factory):
    radar, _ = radar_path(broken_files)
    outside = tmp_path_factory.mktemp("outside") / "x.pcd"
    radar.rename(outside)
    radar.symlink_to(outside)
    with pytest.raises(DataError, match="outside the dataset folder"):
        broken_files.reader().read(1, None)


def test_links_within_the_data_set_are_followed_and_folders_that_lead_out_are_not(broken_files, tmp_path_factory):
    radar, _ = radar_path(broken_files)
    expected = broken_files.reader().read(1, None).radar_points
    radar.rename(broken_files.root / "kept.pcd")
    radar.symlink_to(broken_files.root / "kept.pcd")
    assert torch.equal(broken_files.reader().read(1, None).radar_points, expected)
    outside = tmp_path_factory.mktemp("outside") / "radar"
    radar.parent.rename(outside)
    radar.parent.symlink_to(outside)
    with pytest.raises(DataError, match=f"{radar.parent.name}.*outside the dataset folder"):
        broken_files.reader().read(0, None)


def test_sensors_that_were_not_recorded_are_masked(broken_files):
    gone = (CAMERAS[1], RADARS[3])
    records = [r for r in broken_files.records("sample_data") if r["filename"].split("/")[1] not in gone]
    broken_files.table("sample_data").write_text(json.dumps(records))
    frame = broken_files.reader().read(1, None)
    assert frame.image_valid.tolist() == [[True, False, True, True]]
    assert frame.skipped == {f"{name} (not recorded)": 1 for name in gone} and frame.bad_files == []
    assert torch.linalg.inv(frame.pix_from_aug).isfinite().all()


def test_nothing_at_all_is_a_frame(broken_files):
    records = [r for r in broken_files.records("sample_data") if "LIDAR" in r["filename"]]
    broken_files.table("sample_data").write_text(json.dumps(records))
    broken_files.table("sample_annotation").write_text("[]")
    broken_files.table("instance").write_text("[]")
    frame = broken_files.reader().read(1, AUGMENTATION)
    assert frame.radar_points.shape == (0, 7) and len(frame.boxes[0]) == 0 and not frame.image_valid.any()


def test_devkit_agrees(data_set):
    """Positions and lags of the devkit's multi-sweep reader, boxes and velocities of its evaluation."""
    devkit = pytest.importorskip("truckscenes", reason="devkit not installed")
    from truckscenes.utils.data_classes import RadarPointCloud

    scenes = devkit.TruckScenes(VERSION, str(data_set.root), verbose=False)
    reader = FrameReader(load_index(data_set.root, VERSION, None), reader_settings(num_sweeps=7, image_size_px=None))
    for row, sample in enumerate(scenes.sample):
        frame = reader.read(row, None)
        clouds, lags = [], []
        for channel in RADARS:
            cloud, lag = RadarPointCloud.from_file_multisweep(scenes, sample, channel, "LIDAR_LEFT", 7)
            clouds.append(apply(mount("LIDAR_LEFT"), cloud.points[:3].T))
            lags.append(lag[0])
        np.testing.assert_allclose(frame.radar_points[:, :3], np.concatenate(clouds), atol=2e-3)
        np.testing.assert_allclose(frame.radar_points[:, 6], np.concatenate(lags), atol=1e-6)
        pose = ego_pose(1e-6 * sample["timestamp"])
        category = {token: scenes.get("sample_annotation", token)["category_name"] for token in sample["anns"]}
        kept = [token for token, name in category.items() if name in ("vehicle.car", "static_object.traffic_sign")]
        truth = np.array([scenes.box_velocity(t) for t in kept]) @ pose[:3, :3]
        np.testing.assert_allclose(frame.boxes[0].velocities, truth[:, :2], atol=1e-4)
        centres = np.array([scenes.get_box(t).center for t in kept])
        np.testing.assert_allclose(frame.boxes[0].centers, apply(invert_rigid(pose), centres), atol=1e-4)
