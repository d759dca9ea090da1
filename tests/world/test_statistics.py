"""The default world is held to the real figures that `python -m src.world compare=true` shows beside its own."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from src.data.cache import load_index
from src.structures.taxonomy import CLASS_RANGE_M, CLASSES
from src.world.dataset_statistics import count_dataset
from src.world.real_comparison import compare
from src.world.world_config import WorldConfig
from src.world.write import VERSION, ensure_world

REPOSITORY = Path(__file__).resolve().parents[2]
REAL_SWEEPS = REPOSITORY.parent / "shared" / "real" / "truckscenes_radar"
REAL_SWEEP = REAL_SWEEPS / "RADAR_LEFT_FRONT_1692868171703999.pcd"
SWEEPS = 5  # data.num_sweeps of scale=mini


@pytest.mark.slow
def test_a_small_world_is_like_the_real_data(make_config, tmp_path):
    config = make_config(
        num_train_scenes=6,
        num_val_scenes=0,
        key_frames_per_scene=8,
        image_width_px=96,
        image_height_px=46,
        radar_sweeps_per_key_frame=1,
        ego_rate_hz=10,
        seed=0,
    )
    root = ensure_world(config, tmp_path / "w", progress=False)
    counts = count_dataset(load_index(root, VERSION, None), 1)
    tables = {table.name: table for table in compare(counts, 1)}
    assert set(counts.classes) == set(CLASSES)
    assert 35 < tables["boxes"].world["this data set"]["per frame"][0] < 75
    assert 500 < tables["points_per_frame"].world["this data set"]["p50"][0] < 1400
    # All classes together, in bands of some hundred boxes.
    points = tables["points_per_box"]
    for band in ("0-50", "50-75", "75-100", "100-125", "125-150"):
        assert abs(points.world[band][">=1 %"][0] - points.real[band][">=1 %"][0]) < 15, band
        assert abs(points.world[band][">=3 %"][0] - points.real[band][">=3 %"][0]) < 15, band
    assert points.world["200-225"][">=1 %"][0] < 2
    assert abs(tables["hidden"].world["all"]["100+"][0] - tables["hidden"].real["all"]["100+"][0]) < 20
    assert tables["lidar_support"].world["all"]["share"][0] == 100.0


@pytest.fixture(scope="module")
def default_world(default_values, tmp_path_factory, stored_world):
    config = WorldConfig(**default_values)
    return config, stored_world(ensure_world(config, tmp_path_factory.mktemp("default") / "w", progress=False))


@pytest.mark.exhaustive
def test_the_ranges_of_the_default_world_are_those_of_the_real_sweep(default_world):
    if not REAL_SWEEP.is_file():
        pytest.skip(f"no real radar file at {REAL_SWEEP.name}")
    _, world = default_world
    rows = [row for row in world["sample_data"] if world.channel(row) == "RADAR_LEFT_FRONT"]
    real = np.frombuffer(REAL_SWEEP.read_bytes().split(b"DATA binary\n")[1], "<f4").reshape(-1, 7)
    here, there = (
        np.percentile(np.linalg.norm(points[:, :3], axis=1), [25, 50, 75, 90])
        for points in (np.concatenate([world.radar(row) for row in rows]), real)
    )
    np.testing.assert_allclose(here, there, atol=25.0)


@pytest.mark.exhaustive
def test_the_default_world_is_as_hard_as_the_real_data_and_holds_every_class(default_world):
    config, world = default_world
    counts = count_dataset(load_index(world.root, VERSION, None), SWEEPS)
    tables = {table.name: table for table in compare(counts, SWEEPS)}
    assert tables["support"].beyond() == []
    assert tables["points_on_boxes"].world["all"]["share"][0] < 10.0
    few = tables["remembered"].world["fewer than 3 points"]
    assert few["seen with 3 in the last 4 s %"][0] > 8.0
    assert tables["lidar_support"].world["all"]["share"][0] == 100.0
    limit = np.array([CLASS_RANGE_M[name] for name in counts.classes])
    val = np.array([row["token"] for row in world["scene"][config.num_train_scenes :]])
    tokens = np.array([row["token"] for row in world["scene"]])
    scored = (counts.distance_m < limit) & np.isin(tokens[counts.scenes[counts.frames]], val)
    boxes = Counter(counts.classes[scored])
    assert set(boxes) == set(CLASSES) and min(boxes.values()) >= 55, boxes
