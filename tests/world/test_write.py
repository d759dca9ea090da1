"""The world as a data set: complete, linked, the same every time, never half there."""

import hashlib
import json
import multiprocessing
import os
import signal
import time
from collections import Counter, defaultdict

import numpy as np
import pytest
from PIL import Image

from src.errors import ConfigError, DataError
from src.structures.taxonomy import CAMERAS, CATEGORY_TO_CLASS, CLASSES, LIDARS, RADARS
from src.world import write
from src.world.scene_writer import SceneWriter
from src.world.simulate import make_scene
from src.world.world_config import world_digest
from src.world.write import VERSION, ensure_world

TINY = {
    "num_train_scenes": 1,
    "num_val_scenes": 1,
    "key_frames_per_scene": 2,
    "image_width_px": 64,
    "image_height_px": 32,
}


def fingerprint(root):
    """Digest of every file below a folder, by name."""
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.mark.slow
def test_every_table_is_there_with_its_rows(world, config):
    frames = config.num_scenes * config.key_frames_per_scene
    counts = {name: len(table) for name, table in world.tables.items()}
    expected = {"scene": 3, "sample": frames, "category": 27, "attribute": 11, "visibility": 4, "sensor": 18}
    assert len(counts) == 14
    assert expected.items() <= counts.items()
    assert counts["calibrated_sensor"] == 18
    assert counts["weather_annotation"] == 3
    assert counts["sample_data"] == frames * (6 * 3 + 4 + 1)
    assert counts["ego_motion_cabin"] == counts["ego_motion_chassis"] > 100


def test_tokens_are_unique_and_every_link_leads_somewhere(world):
    targets = {
        "sample_token": "sample",
        "ego_pose_token": "ego_pose",
        "calibrated_sensor_token": "calibrated_sensor",
        "sensor_token": "sensor",
        "instance_token": "instance",
        "category_token": "category",
        "scene_token": "scene",
        "visibility_token": "visibility",
        "first_sample_token": "sample",
        "last_sample_token": "sample",
        "first_annotation_token": "sample_annotation",
        "last_annotation_token": "sample_annotation",
        "weather_annotation_token": "weather_annotation",
    }
    for name, table in world.tables.items():
        assert len(world.rows[name]) == len(table), name
        for row in table:
            assert len(row["token"]) == 32 and int(row["token"], 16) >= 0
            for field, target in targets.items():
                if row.get(field):
                    assert row[field] in world.rows[target], (name, field)
            for field in ("prev", "next"):
                assert row.get(field, "") == "" or row[field] in world.rows[name]
    attributes = Counter(len(row["attribute_tokens"]) for row in world["sample_annotation"])
    assert set(attributes) <= {0, 1}


def test_chains_run_forward_in_time_within_a_scene_and_channel(world):
    chains = defaultdict(list)
    for row in world["sample_data"]:
        scene = world.rows["sample"][row["sample_token"]]["scene_token"]
        chains[scene, world.channel(row)].append(row)
    assert len(chains) == 3 * 11
    for rows in chains.values():
        rows.sort(key=lambda row: row["timestamp"])
        assert [row["prev"] for row in rows] == [""] + [row["token"] for row in rows[:-1]]
        assert [row["next"] for row in rows] == [row["token"] for row in rows[1:]] + [""]
        assert len({row["timestamp"] for row in rows}) == len(rows)
    first = world.rows["sample"][world["scene"][0]["first_sample_token"]]
    key = next(
        r
        for r in world["sample_data"]
        if r["sample_token"] == first["token"] and r["is_key_frame"] and world.channel(r) == RADARS[0]
    )
    assert key["prev"] != ""  # sweeps exist before the first key frame


def test_sweeps_belong_to_the_following_key_frame_and_times_agree(world):
    for row in world["sample_data"]:
        sample = world.rows["sample"][row["sample_token"]]
        lag = (sample["timestamp"] - row["timestamp"]) * 1e-6
        assert abs(lag) < 0.03 if row["is_key_frame"] else 0.0 < lag < 0.5
        assert str(row["timestamp"]) in row["filename"]
        assert world.rows["ego_pose"][row["ego_pose_token"]]["timestamp"] == row["timestamp"]
    stamps = [row["timestamp"] for row in world["sample"]][:5]
    np.testing.assert_allclose(np.diff(stamps) * 1e-6, 0.5, atol=0.005)


def test_files_are_what_the_tables_say(world, config):
    for row in world["sample_data"]:
        path = world.root / row["filename"]
        if world.channel(row) in CAMERAS:
            with Image.open(path) as image:
                assert image.size == (row["width"], row["height"]) == (config.image_width_px, config.image_height_px)
        elif world.channel(row) in RADARS:
            assert len(world.radar(row)) == row["width"] <= 800
        else:
            assert row["width"] == 0 and b"binary_compressed" in path.read_bytes()
    on_disk = {
        str(p.relative_to(world.root)) for kind in ("samples", "sweeps") for p in (world.root / kind).rglob("*.*")
    }
    assert on_disk == {row["filename"] for row in world["sample_data"]}


@pytest.mark.slow
def test_annotated_velocity_is_that_of_the_motion(world, config):
    for index in range(config.num_scenes):
        scene = make_scene(config, index)
        token = world["scene"][index]["token"]
        samples = [row for row in world["sample"] if row["scene_token"] == token]
        start = samples[0]["timestamp"]
        tokens = {row["token"] for row in samples}
        checked = 0
        for row in world["sample_annotation"]:
            if row["sample_token"] not in tokens or not (row["prev"] and row["next"]):
                continue
            before, after = (world.rows["sample_annotation"][row[name]] for name in ("prev", "next"))
            times = [world.rows["sample"][r["sample_token"]]["timestamp"] for r in (before, row, after)]
            step = np.subtract(after["translation"], before["translation"])[:2]
            difference = step / ((times[2] - times[0]) * 1e-6)
            instants = [(moment - start) * 1e-6 for moment in times]
            ground, _, _ = scene.tracks.state(instants[1])
            place = np.array(row["translation"]) - scene.utm_offset
            nearest = np.argmin(np.linalg.norm((ground - place)[:, :2], axis=1))
            assert np.linalg.norm((ground[nearest] - place)[:2]) < 0.2
            path = [scene.tracks.state(now)[1][nearest, :2] for now in np.linspace(instants[0], instants[2], 41)]
            np.testing.assert_allclose(difference, np.mean(path, axis=0), atol=0.1)
            checked += 1
        assert checked > 20


def test_all_classes_and_few_tricks_appear(world):
    classes = Counter(CATEGORY_TO_CLASS[world.category(row)] for row in world["sample_annotation"])
    assert set(classes) <= set(CLASSES) and len(classes) >= 10
    unseen = [row for row in world["sample_annotation"] if row["num_radar_pts"] == 0 and row["num_lidar_pts"] > 0]
    assert len(unseen) > 20  # the evaluation keeps objects that no radar point hits
    assert all(row["translation"][1] > 5.2e6 and row["translation"][0] > 6.5e5 for row in world["sample_annotation"])


def test_splits_share_no_scene_and_no_road(world):
    splits = json.loads((world.root / "splits.json").read_text())
    assert (len(splits["train"]), len(splits["val"])) == (2, 1)
    assert not set(splits["train"]) & set(splits["val"])
    assert {row["name"] for row in world["scene"]} == {*splits["train"], *splits["val"]}
    drives = [row["name"].split("-")[1] for row in world["scene"]]
    assert len(set(drives)) == 3
    starts = [world.rows["sample"][row["first_sample_token"]] for row in world["scene"]]
    poses = [min(world["ego_pose"], key=lambda p, s=start: abs(p["timestamp"] - s["timestamp"])) for start in starts]
    places = np.array([pose["translation"][:2] for pose in poses])
    assert np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(3, 1)].min() > 100


def test_scene_tags_are_one_of_each_group(world):
    groups = ["weather", "area", "daytime", "season", "lighting", "structure", "construction"]
    for row in world["scene"]:
        assert [tag.split(".")[0] for tag in row["description"].split(";")] == groups


def test_chassis_speed_reads_zero_now_and_then_while_the_cabin_moves(make_config):
    silent = []
    for index in range(3):
        tables = SceneWriter(make_config(), index, None)._motion_tables()
        speed = {name: np.array([row["vx"] for row in rows]) for name, rows in tables.items()}
        assert (speed["ego_motion_cabin"] > 10).all()
        silent.append((speed["ego_motion_chassis"] == 0).mean())
    assert 0 < np.mean(silent) < 0.8


@pytest.mark.slow
def test_same_bytes_with_one_and_two_workers(tmp_path, make_config):
    one = ensure_world(make_config(**TINY, num_workers=1), tmp_path / "one", progress=False)
    two = ensure_world(make_config(**TINY, num_workers=2), tmp_path / "two", progress=False)
    assert fingerprint(one) == fingerprint(two)
    assert world_digest(make_config(num_workers=1)) == world_digest(make_config(num_workers=2))


def test_another_seed_is_another_world(make_config):
    assert world_digest(make_config()) != world_digest(make_config(seed=4))


@pytest.mark.slow
def test_ensure_reuses_the_same_world_and_refuses_another(tmp_path, make_config):
    config = make_config(**TINY)
    root = ensure_world(config, tmp_path / "w", progress=False)
    stamp = (root / "world.json").stat().st_mtime_ns
    assert ensure_world(config, root, progress=False) == root
    assert (root / "world.json").stat().st_mtime_ns == stamp
    with pytest.raises(ConfigError, match="seed"):
        ensure_world(make_config(**TINY, seed=99), root)
    (root / VERSION / "sample.json").unlink()
    (root / "splits.json").unlink()
    with pytest.raises(DataError, match=f"without {VERSION}/sample.json, splits.json;"):
        ensure_world(config, root)
    (root / "world.json").unlink()
    with pytest.raises(DataError, match="not a complete"):
        ensure_world(config, root)


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch, make_config):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(write, "shared_tables", fail)
    with pytest.raises(DataError, match="disk full.*make room"):
        ensure_world(make_config(**TINY), tmp_path / "w", progress=False)
    assert list(tmp_path.iterdir()) == []


def killed(config, index, folder):
    """Stands for `write_scene` in a process that the system kills."""
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_killed_writer_ends_the_command(tmp_path, monkeypatch, make_config):
    monkeypatch.setattr(write, "write_scene", killed)
    with pytest.raises(DataError, match="was killed.*fewer than data.world.num_workers=2"):
        ensure_world(make_config(**TINY, num_workers=2), tmp_path / "w", progress=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_killed_write_leaves_nothing_that_looks_complete(tmp_path, make_config):
    root = tmp_path / "w"
    child = multiprocessing.get_context("spawn").Process(
        target=ensure_world, args=(make_config(key_frames_per_scene=20), root, False)
    )
    child.start()
    end = time.monotonic() + 30
    while not list(tmp_path.rglob("*.jpg")) and time.monotonic() < end:
        time.sleep(0.02)
    os.kill(child.pid, signal.SIGKILL)
    child.join()
    assert not root.exists()
    assert not list(tmp_path.rglob("world.json"))
    assert ensure_world(make_config(**TINY), root, progress=False) == root
    assert list(tmp_path.iterdir()) == [root] and not (root / ".lock").exists(), "what was left is gone"


@pytest.mark.slow
def test_two_processes_write_a_world_once(tmp_path, make_config, caplog):
    root, config = tmp_path / "w", make_config(key_frames_per_scene=20)
    child = multiprocessing.get_context("spawn").Process(target=ensure_world, args=(config, root, False))
    child.start()
    end = time.monotonic() + 60
    while not list(tmp_path.rglob("*.jpg")) and time.monotonic() < end:
        time.sleep(0.02)
    (writing,) = tmp_path.iterdir()
    with caplog.at_level("INFO"):
        ensure_world(config, root, progress=False)
    child.join()
    assert child.exitcode == 0 and not writing.exists() and list(tmp_path.iterdir()) == [root]
    assert f"another process is writing the world {root}; waiting for it" in caplog.text


@pytest.mark.slow
def test_camera_sweeps_fill_the_time_between_key_frames(tmp_path, make_config, stored_world):
    values = TINY | {"num_val_scenes": 0, "camera_sweeps": True, "radar_sweeps_per_key_frame": 1}
    world = stored_world(ensure_world(make_config(**values), tmp_path / "w", progress=False))
    rows = [row for row in world["sample_data"] if world.channel(row) == CAMERAS[0]]
    assert [row["is_key_frame"] for row in rows] == [False, False, False, False, True] * 2
    np.testing.assert_allclose(np.diff([row["timestamp"] for row in rows]) * 1e-6, 0.1, atol=0.02)


@pytest.mark.slow
def test_lidar_sweeps_are_a_tenth_of_a_second_apart(make_config, stored_world, tmp_path):
    changes = {"num_train_scenes": 1, "num_val_scenes": 0, "key_frames_per_scene": 2, "radar_sweeps_per_key_frame": 1}
    config = make_config(**changes, lidar=True, lidar_sweeps_per_key_frame=5, lidar_step_deg=4.0)
    world = stored_world(ensure_world(config, tmp_path / "lidar", progress=False))
    chains = defaultdict(list)
    for row in world["sample_data"]:
        if world.channel(row) in LIDARS:
            chains[world.channel(row)].append(row)
            folder = "samples" if row["is_key_frame"] else "sweeps"
            assert row["filename"].startswith(folder) and (world.root / row["filename"]).is_file()
    assert sorted(chains) == sorted(LIDARS)
    for rows in chains.values():
        rows.sort(key=lambda row: row["timestamp"])
        assert [row["is_key_frame"] for row in rows] == 2 * [False, False, False, False, True]
        assert [row["prev"] for row in rows] == ["", *(row["token"] for row in rows[:-1])]
        np.testing.assert_allclose(np.diff([row["timestamp"] for row in rows]), 100_000, atol=5_000)
        assert all(row["width"] > 50 for row in rows)
    alone = make_config(**changes, lidar=True, lidar_step_deg=4.0)
    keys = stored_world(ensure_world(alone, tmp_path / "keys", progress=False))
    assert not any((keys.root / "sweeps").glob("LIDAR*")) and len(keys["sample"]) == 2


@pytest.mark.slow
def test_lidar_does_not_change_what_other_sensors_see(make_config, tmp_path):
    changes = {"num_train_scenes": 1, "num_val_scenes": 0, "key_frames_per_scene": 1, "radar_sweeps_per_key_frame": 1}
    with_lidar = ensure_world(make_config(**changes, lidar=True, lidar_step_deg=8.0), tmp_path / "a", progress=False)
    without = ensure_world(make_config(**changes), tmp_path / "b", progress=False)
    seen = [{name: made for name, made in fingerprint(root).items() if "CAMERA" in name or "RADAR" in name}
            for root in (with_lidar, without)]  # fmt: skip
    assert seen[0] == seen[1] and len(seen[0]) == 10
