"""Counts of a data set: by hand, and against what the tables store."""

import json
import shutil

import numpy as np
import pytest

from src.data.cache import load_index
from src.structures.taxonomy import CATEGORY_TO_CLASS, RADARS
from src.world.dataset_statistics import count_dataset, count_inside
from src.world.write import VERSION

SWEEPS = 3


@pytest.fixture(scope="module")
def counts(world):
    return count_dataset(load_index(world.root, VERSION, None), SWEEPS)


def test_points_are_counted_in_turned_boxes_with_their_borders():
    centres, yaws = np.array([[10.0, 5.0, 1.0]]), np.array([np.pi / 2])
    points = np.array([[10.0, 7.0, 1.0], [11.0, 5.0, 0.0], [10.0, 7.1, 1.0], [12.0, 5.0, 1.0], [10.0, 5.0, 2.1]])
    half = 0.5 * np.array([[4.0, 2.0, 2.0]])
    assert count_inside(centres, half, yaws, points).tolist() == [2]
    assert count_inside(centres, half, yaws, np.zeros((0, 3))).tolist() == [0]


def test_counts_are_those_that_the_tables_store(world, counts):
    rows = world["sample_annotation"]
    assert counts.classes.tolist() == [CATEGORY_TO_CLASS[world.category(row)] for row in rows]
    stored = np.array([row["num_radar_pts"] for row in rows])
    assert stored.sum() > 100 and (counts.radar != stored).sum() <= 1  # a point on a border may fall to either side
    assert (counts.lidar == [row["num_lidar_pts"] for row in rows]).all()
    levels = [world.rows["visibility"][row["visibility_token"]]["level"] for row in rows]
    assert (counts.levels == levels).all()
    assert (counts.radar_grown >= counts.radar).all() and counts.radar_grown.sum() > 1.1 * counts.radar.sum()
    files = [row for row in world["sample_data"] if row["is_key_frame"] and world.channel(row) in RADARS]
    assert counts.points.sum() == len(counts.range_m) == sum(row["width"] for row in files)
    assert counts.range_m.max() <= 190 and np.abs(counts.planar_m - counts.range_m).max() < 15


def test_the_order_of_the_tables_does_not_matter(world, counts, tmp_path):
    for path in world.root.iterdir():
        (tmp_path / path.name).symlink_to(path)
    (tmp_path / VERSION).unlink()
    shutil.copytree(world.root / VERSION, tmp_path / VERSION)
    rows = [world["sample"][row] for row in np.random.default_rng(0).permutation(len(world["sample"]))]
    assert rows != world["sample"]
    (tmp_path / VERSION / "sample.json").write_text(json.dumps(rows))
    others = count_dataset(load_index(tmp_path, VERSION, None), SWEEPS)
    for name, column in vars(counts).items():
        np.testing.assert_array_equal(getattr(others, name), column, err_msg=name)
    assert (np.diff(counts.times_s)[np.diff(counts.scenes) == 0] > 0).all() and np.isfinite(counts.ego_speed_mps).any()


def test_accumulated_points_lie_in_the_box_where_it_was_at_the_time_of_their_sweep(world, counts):
    """Recounted box by box for the fast ones of one key frame, from the stored tables alone."""
    sample = world["sample"][2]
    rows = [n for n, row in enumerate(world["sample_annotation"]) if row["sample_token"] == sample["token"]]
    reference = next(
        row["timestamp"] for row in world["sample_data"]
        if row["sample_token"] == sample["token"] and world.channel(row) == "LIDAR_LEFT"
    )  # fmt: skip
    sweeps = []
    for row in world["sample_data"]:
        if row["sample_token"] == sample["token"] and world.channel(row) in RADARS:
            matrix = world.global_from_sensor(row)
            sweeps.append((row["timestamp"], world.radar(row)[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]))
    assert len(sweeps) == 6 * SWEEPS
    moved = 0
    for n in rows:
        row = world["sample_annotation"][n]
        if not (row["prev"] and row["next"]):
            continue
        ends = [world.rows["sample_annotation"][row[name]] for name in ("prev", "next")]
        times = [1e-6 * world.rows["sample"][end["sample_token"]]["timestamp"] for end in ends]
        velocity = np.subtract(ends[1]["translation"], ends[0]["translation"]) / (times[1] - times[0])
        width, length, height = row["size"]
        axes = world.matrix(row)[:3, :3]
        total = 0
        for stamp, points in sweeps:
            centre = np.array(row["translation"]) + 1e-6 * (stamp - reference) * velocity
            offset = np.abs((points - centre) @ axes)
            total += int((offset <= 0.5 * np.array([length, width, height])).all(1).sum())
        assert abs(counts.accumulated[n] - total) <= 1
        moved += total if np.linalg.norm(velocity) > 20 else 0
    assert moved > 10
