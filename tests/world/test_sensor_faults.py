"""Outages, dirt, and mounts that differ from their calibration."""

import io

import numpy as np
import pytest
from PIL import Image

from src.geometry.transforms import rotation_vector
from src.structures.taxonomy import CAMERAS, RADARS
from src.world.rig import sensor_rig
from src.world.scene_writer import SceneWriter
from src.world.sensor_faults import OUTAGE_S, SensorFaults


@pytest.fixture(scope="module")
def faults(make_config):
    """A thousand scenes' worth of faults of a rig."""
    config = make_config(key_frames_per_scene=15)
    rig = sensor_rig(config)
    return rig, [SensorFaults(config, rig, np.random.default_rng(seed)) for seed in range(200)]


def test_sensors_fail_for_the_stated_share_of_the_time(faults):
    times = np.arange(0.0, 7.0, 0.05)
    out = np.array([[one.is_out(name, t) for t in times] for one in faults[1] for name in RADARS])
    assert abs(out.mean() - 0.08) < 0.015
    begins = np.diff(out.astype(int), axis=1) == 1
    lengths = [
        0.05 * (np.argmin(row[start:]) or 1000)
        for row, starts in zip(out, begins, strict=True) for start in np.flatnonzero(starts) + 1
    ]  # fmt: skip
    whole = np.array([length for length in lengths if length < 50])
    assert whole.min() > OUTAGE_S[0] - 0.06 and whole.max() < OUTAGE_S[1] + 0.06


def test_mounts_differ_from_the_calibration_by_the_stated_angle_in_each_scene(faults):
    rig, scenes = faults
    errors = np.stack([rotation_vector(rig[n].rotation.T @ s.mounts[n].rotation) for s in scenes for n in s.mounts])
    assert np.abs(np.degrees(errors.std(0)) - 0.3).max() < 0.03 and np.abs(np.degrees(errors.mean(0))).max() < 0.03
    assert set(scenes[0].mounts) == {*CAMERAS, *RADARS}
    assert all((s.mounts[n].translation == rig[n].translation).all() for s in scenes[:3] for n in s.mounts)


def test_dirt_lies_on_one_camera_of_a_fifth_of_the_scenes(faults):
    soiled = [one.soiled for one in faults[1]]
    assert 0.12 < np.mean([name is not None for name in soiled]) < 0.28
    dirty = next(one for one in faults[1] if one.soiled)
    white = np.full((*dirty.dirt.shape, 3), 255, dtype=np.uint8)
    clean = next(name for name in CAMERAS if name != dirty.soiled)
    assert (dirty.soil(clean, white) == 255).all()
    shown = dirty.soil(dirty.soiled, white)
    assert shown.dtype == np.uint8 and 0.1 < (shown[..., 0] < 160).mean() < 0.8 and (shown[..., 0] > 230).mean() > 0.1


def test_without_faults_everything_works(make_config):
    config = make_config(mount_error_deg=0.0, outage_fraction=0.0, soiled_fraction=0.0)
    rig = sensor_rig(config)
    none = SensorFaults(config, rig, np.random.default_rng(0))
    assert none.soiled is None and not any(none.is_out(name, t) for name in RADARS for t in (0.0, 1.0, 2.0))
    assert all((none.mounts[name].rotation == rig[name].rotation).all() for name in none.mounts)


def test_a_sensor_that_is_out_gives_an_empty_cloud_or_a_black_image(make_config, tmp_path):
    for kind in ("samples", "sweeps"):
        for name in (*CAMERAS, *RADARS):
            (tmp_path / kind / name).mkdir(parents=True)
    config = make_config(outage_fraction=0.5, radar_sweeps_per_key_frame=1, image_width_px=64, image_height_px=32)
    writer = SceneWriter(config, 0, tmp_path)
    writer._write_radars()
    writer._write_cameras()
    kept = {True: [], False: []}
    for time, channel, row in writer.data:
        content = (tmp_path / row["filename"]).read_bytes()
        if channel in RADARS:
            size = row["width"]
            assert f"POINTS {size}\n".encode() in content
        else:
            size = np.asarray(Image.open(io.BytesIO(content))).max()
        kept[writer.faults.is_out(channel, time)].append(size)
    assert len(kept[True]) > 5 and max(kept[True]) <= 2 and min(kept[False]) > 2
