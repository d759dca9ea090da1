"""One's own sensors: the frame equals what the reader makes of the same raw data; inputs are checked by name."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from src.data.cache import load_index
from src.data.compensation import ego_motion
from src.data.pcd import read_lidar_points, read_radar_points
from src.data.schema import CHANNELS
from src.data.sensors import Camera, LidarSweep, RadarSweep, frame_from_sensors
from src.errors import DataError
from src.structures.taxonomy import CAMERAS, RADARS
from tests.data.tiny_set import INTRINSICS, LIDAR_CHANNELS, VERSION, ego_pose, mount, reader_settings

SAMPLE = 1


@pytest.fixture(scope="module")
def index(data_set):
    return load_index(data_set.root, VERSION, None)


@pytest.fixture(scope="module")
def raw(index):
    """Time, pose, cameras and radar sweeps of one frame, straight from the files and the analytic world."""
    cameras, radars = {}, {}
    for channel in (*CAMERAS, *RADARS):
        row = int(index.key_data[SAMPLE, CHANNELS.index(channel)])
        if channel in CAMERAS:
            image = np.asarray(Image.open(index.root / index.filename(row)).convert("RGB"))
            pose = ego_pose(1e-6 * index.data_times_us[row])
            cameras[channel] = Camera(
                image=image, intrinsics=INTRINSICS, ego_from_camera=mount(channel), global_from_ego=pose
            )
            continue
        sweeps = radars.setdefault(channel, [])
        while row >= 0:
            time_us = index.data_times_us[row : row + 1]
            pose = ego_pose(1e-6 * time_us[0])
            velocity, rate = ego_motion(index, time_us, pose[None, :3, :3])
            points = read_radar_points(index.root / index.filename(row))
            sweeps.append(
                RadarSweep(
                    points=points, ego_from_sensor=mount(channel), timestamp_s=1e-6 * time_us[0],
                    ego_velocity_mps=velocity[0], ego_rate_radps=rate[0], global_from_ego=pose,
                )
            )  # fmt: skip
            row = int(index.data_previous[row])
        sweeps.reverse()  # as a ring buffer is filled, oldest first
    time_s = 1e-6 * index.frame_times_us[SAMPLE]
    return {"timestamp_s": time_s, "global_from_ego": ego_pose(time_s), "cameras": cameras, "radars": radars}


@pytest.mark.parametrize("changes", [{}, {"propagate_points": True, "num_sweeps": 3}, {"test_resize_offset": 0.05}])
def test_a_frame_equals_what_the_reader_makes_of_the_same_files(data_set, raw, changes):
    expected = data_set.reader(**changes).read(SAMPLE, None)
    made = frame_from_sensors(**raw, settings=reader_settings(**changes))
    assert torch.equal(made.images, expected.images) and torch.equal(made.image_valid, expected.image_valid)
    torch.testing.assert_close(made.pix_from_aug, expected.pix_from_aug, rtol=1e-5, atol=1e-3)
    assert len(made.radar_points) == len(expected.radar_points) > 300
    torch.testing.assert_close(made.radar_points, expected.radar_points, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(made.global_from_ego, expected.global_from_ego, rtol=0, atol=1e-6)
    torch.testing.assert_close(made.timestamps_s, expected.timestamps_s, rtol=0, atol=1e-6)
    assert torch.equal(made.aug_from_ego, expected.aug_from_ego) and made.boxes is None


def test_missing_cameras_are_masked_and_missing_radars_give_no_points(raw):
    cameras = {CAMERAS[0]: raw["cameras"][CAMERAS[0]], CAMERAS[1]: None}
    frame = frame_from_sensors(**(raw | {"cameras": cameras, "radars": {}}), settings=reader_settings())
    assert frame.image_valid.tolist() == [[True, False, False, False]]
    assert frame.images[0, 1:].sum() == 0 and len(frame.radar_points) == 0
    empty = {"front": [sweep(raw, points=np.zeros((0, 7)))]}
    frame = frame_from_sensors(**(raw | {"radars": empty}), settings=reader_settings())
    assert frame.radar_points.shape == (0, 7)


def test_a_model_without_images_needs_no_camera(raw):
    frame = frame_from_sensors(**(raw | {"cameras": {}}), settings=reader_settings(image_size_px=None))
    assert frame.images is None and len(frame.radar_points) > 0


def test_a_sweep_without_a_pose_is_where_the_vehicle_was_by_its_own_speed(raw):
    at = np.array([[20.0, 3.0, 1.0, 0.0, 0.0, 0.0, 5.0]])
    own = RadarSweep(
        points=at, ego_from_sensor=np.eye(4), timestamp_s=raw["timestamp_s"] - 0.05, ego_velocity_mps=[10.0, 0.0, 0.0]
    )
    frame = frame_from_sensors(**(raw | {"radars": {"roof": [own]}}), settings=reader_settings())
    unit = at[0, :3] / np.linalg.norm(at[0, :3])
    ground = 10.0 * unit[0] * unit  # a Doppler of zero: it moves away as fast as the sensor follows
    expected = [19.5, 3.0, 1.0, 5.0, ground[0], ground[1], 0.05]
    np.testing.assert_allclose(frame.radar_points[0].numpy(), expected, atol=1e-5)
    # A quarter turn to the left in one second, on a circle of radius 10: what was ahead is now to the right.
    turning = {"ego_velocity_mps": [5.0 * np.pi, 0.0, 0.0], "ego_rate_radps": [0.0, 0.0, 0.5 * np.pi]}
    own = replace(own, timestamp_s=raw["timestamp_s"] - 1.0, **turning)
    frame = frame_from_sensors(**(raw | {"radars": {"roof": [own]}}), settings=reader_settings())
    np.testing.assert_allclose(frame.radar_points[0, :3].numpy(), [3.0 - 10.0, -20.0 + 10.0, 1.0], atol=1e-4)


def test_in_a_driven_world_poses_and_speeds_place_sweeps_alike(raw):
    blind = {name: [replace(sweep, global_from_ego=None) for sweep in sweeps] for name, sweeps in raw["radars"].items()}
    settings = reader_settings()
    stated = frame_from_sensors(**raw, settings=settings).radar_points
    derived = frame_from_sensors(**(raw | {"radars": blind}), settings=settings).radar_points
    assert stated[:, 6].max() > 0.3  # sweeps of several tenths of a second ago, metres away
    np.testing.assert_allclose(derived[:, :3].numpy(), stated[:, :3].numpy(), atol=0.2)


def sweep(raw, **changes):
    return replace(raw["radars"][RADARS[0]][-1], **changes)


def camera(raw, **changes):
    return replace(raw["cameras"][CAMERAS[0]], **changes)


MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
BAD_SWEEPS = {
    "points .* shape .'n', 7., but got .5, 6.": {"points": np.zeros((5, 6))},
    "points .* entry .2, 1. is not": {"points": np.where(np.arange(35).reshape(5, 7) == 15, np.nan, 9.0)},
    "points .* array of numbers": {"points": [["a"] * 7]},
    "ego_from_sensor must be a rotation": {"ego_from_sensor": MIRROR},
    "ego_from_sensor must have the shape": {"ego_from_sensor": np.eye(3)},
    "ego_velocity_mps must be below 100": {"ego_velocity_mps": [300.0, 0.0, 0.0]},
    "ego_rate_radps must be finite": {"ego_rate_radps": [0.0, 0.0, np.inf]},
    "s older than its frame": {"timestamp_s": 0.0},
}
BAD_CAMERAS = {
    "image must be an array .H, W, 3. uint8": {"image": np.zeros((4, 4, 3), np.float32)},
    "but got .4, 4. uint8": {"image": np.zeros((4, 4), np.uint8)},
    "must have 1 to": {"image": np.zeros((0, 4, 3), np.uint8)},
    "intrinsics must be .*positive fx": {"intrinsics": np.zeros((3, 3))},
    "ego_from_camera must be a rotation": {"ego_from_camera": np.diag([2.0, 2.0, 2.0, 1.0])},
    "global_from_ego is float32": {"global_from_ego": ego_pose(0.0).astype(np.float32)},
}


def test_what_is_no_list_of_sweeps_is_named_and_none_is_no_sweep(raw):
    without = raw | {"radars": {"front": None}}
    assert len(frame_from_sensors(**without, settings=reader_settings()).radar_points) == 0
    for wrong in (sweep(raw), [sweep(raw), None], 3):
        with pytest.raises(DataError, match="radar front: must be a list of RadarSweep"):
            frame_from_sensors(**(raw | {"radars": {"front": wrong}}), settings=reader_settings())


def test_float32_times_are_refused_where_they_round(raw):
    """Seconds since 1970 in float32 are two minutes apart."""
    with pytest.raises(DataError, match="timestamp_s of the frame is float32"):
        frame_from_sensors(**(raw | {"timestamp_s": np.float32(1.7e9), "radars": {}}), settings=reader_settings())
    with pytest.raises(DataError, match="radar front: timestamp_s is float32"):
        late = sweep(raw, timestamp_s=np.float32(1.7e9))
        frame_from_sensors(**(raw | {"radars": {"front": [late]}}), settings=reader_settings())
    frame_from_sensors(**(raw | {"timestamp_s": np.float32(100.5), "radars": {}}), settings=reader_settings())


@pytest.mark.parametrize("message", BAD_SWEEPS)
def test_a_bad_sweep_is_named(raw, message):
    radars = {"front": [sweep(raw), sweep(raw, **BAD_SWEEPS[message])]}
    with pytest.raises(DataError, match=f"radar front, sweep 1.*{message}|radar front, sweep 0.*{message}"):
        frame_from_sensors(**(raw | {"radars": radars}), settings=reader_settings())


@pytest.mark.parametrize("message", BAD_CAMERAS)
def test_a_bad_camera_is_named(raw, message):
    cameras = raw["cameras"] | {CAMERAS[0]: camera(raw, **BAD_CAMERAS[message])}
    with pytest.raises(DataError, match=f"camera {CAMERAS[0]}: .*{message}"):
        frame_from_sensors(**(raw | {"cameras": cameras}), settings=reader_settings())


def test_a_bad_frame_is_named(raw):
    with pytest.raises(DataError, match="camera 'FRONT': must be one of CAMERA_LEFT_FRONT"):
        frame_from_sensors(**(raw | {"cameras": {"FRONT": None}}), settings=reader_settings())
    with pytest.raises(DataError, match="global_from_ego of the frame must be a rotation"):
        frame_from_sensors(**(raw | {"global_from_ego": np.zeros((4, 4))}), settings=reader_settings())
    with pytest.raises(DataError, match="timestamp_s of the frame must be finite"):
        frame_from_sensors(**(raw | {"timestamp_s": float("nan")}), settings=reader_settings())


# -------------------------------------------------------------------- LiDAR


@pytest.fixture(scope="module")
def lidars(lidar_set):
    """Time, pose and LiDAR sweeps of one frame, straight from the files and the analytic world."""
    index, lidars = load_index(lidar_set.root, VERSION, None), {}
    for channel in LIDAR_CHANNELS:
        row = int(index.key_data[SAMPLE, CHANNELS.index(channel)])
        while row >= 0:
            time_us = index.data_times_us[row : row + 1]
            pose = ego_pose(1e-6 * time_us[0])
            velocity, rate = ego_motion(index, time_us, pose[None, :3, :3])
            cloud = read_lidar_points(index.root / index.filename(row))
            lidars.setdefault(channel, []).append(
                LidarSweep(
                    points=cloud.points, point_times_s=1e-6 * cloud.times_us, ego_from_sensor=mount(channel),
                    timestamp_s=1e-6 * time_us[0], ego_velocity_mps=velocity[0], ego_rate_radps=rate[0],
                    global_from_ego=pose,
                )
            )  # fmt: skip
            row = int(index.data_previous[row])
    time_s = 1e-6 * index.frame_times_us[SAMPLE]
    return {"timestamp_s": time_s, "global_from_ego": ego_pose(time_s), "cameras": {}, "radars": {}, "lidars": lidars}


ONLY_LIDAR = {"image_size_px": None, "num_sweeps": 0, "num_lidar_sweeps": 3, "lidar_origins": True}


@pytest.mark.parametrize("changes", [{}, {"num_lidar_sweeps": 1, "deskew_lidar": False}, {"lidar_origins": False}])
def test_a_lidar_frame_equals_what_the_reader_makes_of_the_same_files(lidar_set, lidars, changes):
    expected = lidar_set.reader(**(ONLY_LIDAR | changes)).read(SAMPLE, None)
    made = frame_from_sensors(**lidars, settings=reader_settings(**(ONLY_LIDAR | changes)))
    assert made.radar_points is None and made.images is None and len(made.lidar_points) >= 40
    for name in ("lidar_points", "lidar_origins", "lidar_batch"):
        found, wanted = getattr(made, name), getattr(expected, name)
        if wanted is None:
            assert found is None
        else:
            torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-3)


def test_a_lidar_without_times_of_points_is_taken_as_one_moment(lidars):
    (newest, *_) = lidars["lidars"]["LIDAR_LEFT"]
    own = {"lidars": {"roof": [replace(newest, point_times_s=None)], "rear": None, "left": []}}
    frame = frame_from_sensors(**(lidars | own), settings=reader_settings(**ONLY_LIDAR))
    ego = newest.points[:, :3] @ mount("LIDAR_LEFT")[:3, :3].T + mount("LIDAR_LEFT")[:3, 3]
    np.testing.assert_allclose(frame.lidar_points[:, :3], ego, atol=1e-3)
    assert (frame.lidar_points[:, 4] == 0).all() and len(frame.lidar_points) == len(newest.points)
    nothing = frame_from_sensors(**(lidars | {"lidars": None}), settings=reader_settings(**ONLY_LIDAR))
    assert nothing.lidar_points.shape == (0, 5) and nothing.lidar_origins.shape == (0, 3)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"points": np.zeros((4, 3))}, r"points \(x, y, z, intensity\) must have the shape \['n', 4\], but got"),
        ({"points": np.full((1, 4), np.nan)}, "points .* must be finite"),
        ({"point_times_s": np.zeros(3)}, r"point_times_s must have the shape \[20\], but got \[3\]"),
        ({"point_times_s": np.zeros(20)}, "point_times_s must lie within 0.3 s of timestamp_s, but one is"),
        ({"point_times_s": np.full(20, 1.7e9, np.float32)}, "point_times_s is float32"),
        ({"ego_velocity_mps": [200.0, 0, 0]}, "ego_velocity_mps must be below 100 m/s"),
        ({"ego_from_sensor": np.zeros((4, 4))}, "ego_from_sensor must be a rotation"),
        ({"timestamp_s": 5.0}, "older than its frame"),
    ],
)
def test_wrong_lidar_input_is_named(lidars, change, words):
    (newest, *_) = lidars["lidars"]["LIDAR_LEFT"]
    wrong = lidars | {"lidars": {"roof": [replace(newest, **change)]}}
    with pytest.raises(DataError, match=f"lidar roof.*{words}"):
        frame_from_sensors(**wrong, settings=reader_settings(**ONLY_LIDAR))
    unread = frame_from_sensors(**wrong, settings=reader_settings(image_size_px=None))
    assert unread.lidar_points is None


def test_a_lidar_is_no_radar(lidars):
    settings = reader_settings(**(ONLY_LIDAR | {"num_sweeps": 1}))
    for name, kind in (("lidars", "LidarSweep"), ("radars", "RadarSweep")):
        with pytest.raises(DataError, match=f"{name[:-1]} roof: must be a list of {kind}, or None, but got list"):
            frame_from_sensors(**(lidars | {name: {"roof": [object()]}}), settings=settings)
