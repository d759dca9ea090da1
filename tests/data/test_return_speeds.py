"""Speeds of LiDAR returns: by the radar return beside them, and by the true motion of the world."""

import json
from dataclasses import replace

import numpy as np
import pytest

from src.data.cache import load_index
from src.data.rays import radar_speeds
from src.data.reader import FrameReader
from src.data.schema import CHANNELS
from src.data.sensor_files import OnBadFile
from src.data.timeline import RadialSpeeds
from src.errors import DataError
from src.world.write import ensure_world
from tests.data.tiny_set import FIVE_HERTZ, VERSION, reader_settings
from tests.ray_bundles import rays_to
from tests.world.conftest import small_config

ONLY_LIDAR = {"image_size_px": None, "num_sweeps": 0, "num_lidar_sweeps": 1}


def test_a_radar_return_beside_a_ray_tells_its_speed():
    ends = [[30, 0, 1], [30, 0, 1], [30, 3.1, 1], [0, 50, 1], [0, 80, 1], [30, 0, 0.2]]  # the last on the road
    rays = rays_to(ends, times_s=[0.0, 0.2, 0.0, 0.0, 0.0, 0.0])
    radar = np.zeros((5, 7))  # x, y, z, rcs, vx, vy, dt
    radar[0, [0, 1, 4]] = [31.5, 0, 12.0]
    radar[1, [0, 1, 4]] = [30, 1.2, -7.0]  # nearer
    radar[2, [0, 1, 5]] = [0, 51, 61.0]  # ambiguous
    radar[3, [0, 1, 2, 5]] = [0, 81, 9, 5.0]  # the radar's height does not count
    radar[4, [0, 1, 4, 6]] = [30, 0.1, 99, 0.061]  # too fast and of another time
    expected = [-7 * 30 / np.hypot(30, 1), np.nan, -7 * 30 / rays.ranges[2], np.nan, 5 * 80 / np.hypot(80, 1), np.nan]
    np.testing.assert_allclose(radar_speeds(rays, radar), expected, rtol=1e-5)


def inputs_have_the_speeds_of_their_rays(frame, rays):
    """Of one moment; rays leave out what ends on the truck itself."""
    assert len(frame.lidar_speeds) == len(frame.lidar_points) >= len(rays)
    assert frame.lidar_speeds.isfinite().sum() >= rays.speeds.isfinite().sum() > 0
    ends = dict(zip(map(tuple, rays.points.round(decimals=2).tolist()), rays.speeds.tolist(), strict=True))
    places = map(tuple, frame.lidar_points[:, :3].round(decimals=2).tolist())
    both = [
        (ends[place], speed) for place, speed in zip(places, frame.lidar_speeds.tolist(), strict=True) if place in ends
    ]
    wanted, found = np.array(both).T
    same = np.isclose(wanted, found, atol=1e-3) | (np.isnan(wanted) & np.isnan(found))
    assert len(both) > 0.5 * len(rays) and same.mean() > 0.999  # two points of a centimetre may differ


def test_a_damaged_radar_file_is_counted_once_in_a_frame(broken_lidar):
    """Although it tells the speeds of the input, of the past and of the rays."""
    timeline = replace(FIVE_HERTZ, radial_speeds=RadialSpeeds.radar)
    reader = broken_lidar.reader(**ONLY_LIDAR, timeline=timeline, num_future_frames=1, on_bad_file=OnBadFile.skip)
    row = int(reader.index.key_data[1, CHANNELS.index("RADAR_LEFT_SIDE")])
    name = reader.index.filename(row)
    (broken_lidar.root / name).write_bytes(b"junk")
    frame = reader.read(1, None, history=[-1], targets=[0])
    assert frame.bad_files == [name] and frame.skipped["RADAR_LEFT_SIDE"] == 1
    assert frame.lidar_speeds.isfinite().any() and frame.rays.speeds.isfinite().any()


@pytest.mark.slow
def test_in_the_world_true_speeds_are_those_of_the_motion_and_radar_says_the_same(tmp_path):
    """On moving matter alone; what stands has none."""
    world = small_config(
        num_train_scenes=1, num_val_scenes=0, key_frames_per_scene=3, lidar=True, lidar_sweeps_per_key_frame=5,
        radar_sweeps_per_key_frame=10, aliased_fraction=0.0, ghost_fraction=0.0, mirror_fraction=0.0,
        lidar_step_deg=0.8,
    )  # fmt: skip
    root = ensure_world(world, tmp_path / "world", progress=False)
    index, speeds = load_index(root, VERSION, None), {}
    for source in (RadialSpeeds.exact, RadialSpeeds.radar):
        timeline = replace(FIVE_HERTZ, radial_speeds=source)
        settings = reader_settings(**ONLY_LIDAR, timeline=timeline, num_future_frames=2)
        frame = FrameReader(index, settings).read(1, None, history=[-2], targets=[-2, 0, 2])
        rays = frame.rays
        speeds[source] = rays.speeds.numpy()
        inputs_have_the_speeds_of_their_rays(frame, rays[rays.steps == 0])
        fast, past = (rays.speeds[rays.steps == -2].abs() > 5).sum(), frame.past[0].lidar_speeds.abs() > 5
        assert past.sum() > 0.9 * fast > 0  # "0.3 m above the ground" is another in another ego frame
    exact, radar = speeds.values()
    assert not np.isnan(exact).any() and 0.02 < (np.abs(exact) > 1).mean() < 0.5 and (exact == 0).mean() > 0.5
    both = ~np.isnan(radar)
    still, moving = both & (exact == 0), both & (np.abs(exact) > 5)
    assert np.median(np.abs(radar[still])) < 0.3  # lrs 2.5
    assert moving.sum() > 50 and np.median(np.abs(radar[moving] - exact[moving])) < 1.0
    assert json.loads((root / "world.json").read_text())["generator"].endswith("lidar-3")
    (root / "truth" / f"{index.scene_names[0]}.npz").unlink()
    exact_settings = replace(settings, timeline=replace(FIVE_HERTZ, radial_speeds=RadialSpeeds.exact))
    with pytest.raises(DataError, match="only a synthetic world"):
        FrameReader(index, exact_settings).read(1, None, targets=[0])
