"""The official devkit as an independent reader of the world."""

import warnings

import numpy as np
import pytest
from PIL import Image

from src.structures.taxonomy import CAMERAS, RADARS
from src.world.world_config import RADAR_RATE_HZ

truckscenes = pytest.importorskip("truckscenes", reason="truckscenes-devkit is not installed")


@pytest.fixture(scope="module")
def devkit(world):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return truckscenes.TruckScenes("v1.2-trainval", str(world.root), verbose=False)


def test_devkit_loads_and_links_the_tables(devkit, world):
    assert len(devkit.scene) == 3 and len(devkit.sample) == 15
    for sample in devkit.sample:
        assert set(sample["data"]) == {*CAMERAS, *RADARS, "LIDAR_LEFT"}
        assert len(sample["anns"]) > 5


def test_multisweep_gathers_the_stored_sweeps(devkit):
    from truckscenes.utils.data_classes import RadarPointCloud

    sample = devkit.sample[3]
    single, _ = RadarPointCloud.from_file_multisweep(devkit, sample, RADARS[0], "LIDAR_LEFT", nsweeps=1)
    several, _ = RadarPointCloud.from_file_multisweep(devkit, sample, RADARS[0], "LIDAR_LEFT", nsweeps=3)
    assert single.points.shape[0] == 7
    assert several.points.shape[1] > 2 * single.points.shape[1] > 40
    rows = [devkit.get("sample_data", sample["data"][RADARS[0]])]
    rows.append(devkit.get("sample_data", rows[0]["prev"]))
    assert abs((rows[0]["timestamp"] - rows[1]["timestamp"]) * 1e-6 * RADAR_RATE_HZ - 1) < 0.1


def test_empty_lidar_cloud_is_read_as_empty(devkit):
    from truckscenes.utils.data_classes import LidarPointCloud

    cloud = LidarPointCloud.from_file(devkit.get_sample_data_path(devkit.sample[0]["data"]["LIDAR_LEFT"]))
    assert cloud.points.shape == (4, 0)


def test_stored_point_counts_are_those_of_the_devkit(devkit):
    from truckscenes.utils.data_classes import RadarPointCloud
    from truckscenes.utils.geometry_utils import points_in_box

    sample = devkit.sample[7]
    points = []
    for name in RADARS:
        row = devkit.get("sample_data", sample["data"][name])
        cloud = RadarPointCloud.from_file(devkit.get_sample_data_path(row["token"])).points[:3]
        for table, token in (
            ("calibrated_sensor", row["calibrated_sensor_token"]),
            ("ego_pose", row["ego_pose_token"]),
        ):
            place = devkit.get(table, token)
            turn = truckscenes.utils.data_classes.Quaternion(place["rotation"]).rotation_matrix
            cloud = turn @ cloud + np.array(place["translation"])[:, None]
        points.append(cloud)
    points = np.concatenate(points, axis=1)
    counts = {token: int(points_in_box(devkit.get_box(token), points).sum()) for token in sample["anns"]}
    stored = {token: devkit.get("sample_annotation", token)["num_radar_pts"] for token in sample["anns"]}
    differing = [token for token in counts if counts[token] != stored[token]]
    assert sum(stored.values()) > 20
    assert len(differing) <= 1  # a point on a border may fall to either side


def test_projected_boxes_meet_what_the_image_shows(devkit, world):
    """Traffic cones are the one bright orange thing in daylight: it must lie in their boxes, projected by hand."""
    shares, beside = [], []
    for sample in devkit.sample[:5]:
        boxes = [devkit.get_box(token) for token in sample["anns"]]
        for name in CAMERAS:
            row = devkit.get("sample_data", sample["data"][name])
            intrinsic = np.array(devkit.get("calibrated_sensor", row["calibrated_sensor_token"])["camera_intrinsic"])
            camera_from_global = np.linalg.inv(world.global_from_sensor(row))
            pixels = np.asarray(Image.open(world.root / row["filename"])).astype(float)
            orange = (pixels[..., 0] > 1.5 * pixels[..., 2]) & (pixels[..., 0] > 1.3 * pixels[..., 1])
            for box in boxes:
                corners = camera_from_global[:3, :3] @ box.corners() + camera_from_global[:3, 3:]
                # Farther cones are five pixels high, and JPEG halves the resolution of colour.
                if box.name != "movable_object.trafficcone" or corners[2].min() < 2 or corners[2].max() > 13:
                    continue
                u, v = (intrinsic @ corners)[:2] / corners[2]
                left, right, top, bottom = (int(round(x)) for x in (u.min(), u.max(), v.min(), v.max()))
                wide = right - left + 1
                if min(left - 2 * wide, top) < 0 or right >= pixels.shape[1] or bottom >= pixels.shape[0]:
                    continue
                shares.append(orange[top : bottom + 1, left : right + 1].mean())
                beside.append(orange[top : bottom + 1, left - 2 * wide : left - wide].mean())
    assert len(shares) >= 4
    assert np.mean(np.array(shares) > 0.04) > 0.8
    assert np.mean(shares) > 0.1 > 3 * np.mean(beside)


def test_devkit_projects_boxes_into_the_images(devkit):
    for name in CAMERAS:
        _, boxes, intrinsic = devkit.get_sample_data(devkit.sample[2]["data"][name])
        assert intrinsic.shape == (3, 3)
        assert all(box.center[2] > 0 for box in boxes)
    front = devkit.get_sample_data(devkit.sample[2]["data"][CAMERAS[0]])[1]
    assert len(front) > 3


def test_box_velocity_of_the_devkit_is_finite_and_plausible(devkit):
    speeds = np.array([np.linalg.norm(devkit.box_velocity(row["token"])[:2]) for row in devkit.sample_annotation])
    assert np.isnan(speeds).mean() < 0.1
    assert np.nanmax(speeds) < 52
    cars = np.array(["vehicle.car" == row["category_name"] for row in devkit.sample_annotation])
    assert np.nanmedian(speeds[cars]) > 28


def test_scene_tags_are_known_to_the_devkit(devkit):
    from truckscenes.eval.common.constants import TAG_NAMES

    for scene in devkit.scene:
        assert set(scene["description"].split(";")) <= set(TAG_NAMES)


@pytest.mark.slow
def test_lidar_world_is_read_with_times_and_hits_boxes(make_config, tmp_path):
    from truckscenes.utils.data_classes import LidarPointCloud

    from src.world.write import ensure_world

    config = make_config(
        num_train_scenes=1, num_val_scenes=0, key_frames_per_scene=2, lidar=True, radar_sweeps_per_key_frame=1
    )
    root = ensure_world(config, tmp_path / "lidar", progress=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        devkit = truckscenes.TruckScenes("v1.2-trainval", str(root), verbose=False)
    sample = devkit.sample[1]
    row = devkit.get("sample_data", sample["data"]["LIDAR_TOP_FRONT"])
    cloud = LidarPointCloud.from_file(str(root / row["filename"]))
    assert cloud.points.shape[1] == row["width"] > 500
    stamps = cloud.timestamps.ravel()
    assert abs(stamps.mean() - row["timestamp"]) < 60_000 and np.ptp(stamps) > 10_000
    assert sum(devkit.get("sample_annotation", token)["num_lidar_pts"] for token in sample["anns"]) > 100
