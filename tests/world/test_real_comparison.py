"""Tables beside the real ones, of counts made by hand."""

import numpy as np
import pytest
import yaml

from src.structures.taxonomy import CLASSES
from src.world.dataset_statistics import DatasetCounts
from src.world.real_comparison import REAL_STATISTICS, FigureTable, compare


def counts_of(tracks, frames=12):
    """Tracks of one scene of `frames` key frames, each (class, speed, {frame: (distance, radar, accumulated)})."""
    rows = [
        (klass, speed, number, frame, *values)
        for number, (klass, speed, seen) in enumerate(tracks)
        for frame, values in seen.items()
    ]
    classes, speeds, instances, of_frame, distance, radar, accumulated = zip(*rows, strict=True)
    n = len(rows)
    return DatasetCounts(
        classes=np.array(classes),
        frames=np.array(of_frame),
        instances=np.array(instances),
        distance_m=np.array(distance, dtype=float),
        ahead=np.ones(n, dtype=bool),
        speed_mps=np.array(speeds, dtype=float),
        levels=np.ones(n, dtype=int),
        radar=np.array(radar),
        radar_grown=np.array(radar) + 1,
        accumulated=np.array(accumulated),
        lidar=np.ones(n, dtype=int),
        scenes=np.zeros(frames, dtype=int),
        descriptions=np.array(["weather.rain;area.highway"] * frames),
        times_s=0.5 * np.arange(frames),
        points=np.full(frames, 4),
        ego_speed_mps=np.full(frames, 20.0),
        ego_yaw_rad=np.radians(0.5) * np.arange(frames),
        channels=np.repeat(np.arange(4), frames),
        range_m=np.full(4 * frames, 60.0),
        planar_m=np.full(4 * frames, 60.0),
        elevation_rad=np.zeros(4 * frames),
        rcs_db=np.zeros(4 * frames),
    )


def tables_of(*tracks):
    return {table.name: table for table in compare(counts_of(tracks), num_sweeps=5)}


def test_shares_are_of_the_boxes_of_a_class_and_band():
    tables = tables_of(
        ("car", 30.0, {0: (10, 1, 1), 1: (10, 0, 0), 2: (24.9, 3, 3), 3: (25.0, 0, 0)}),
        ("truck", 20.0, {0: (160, 0, 0)}),
    )
    support = tables["support"].world
    assert support["car"] == {"0-25": (pytest.approx(200 / 3), 3), "25-50": (0.0, 1)}
    assert support["truck"] == {"150+": (0.0, 1)} and support["bus"] == {}
    assert tables["support_of_three"].world["car"]["0-25"][0] == pytest.approx(100 / 3)
    assert tables["support_grown"].world["car"]["0-50"] == (100.0, 4)
    assert tables["hidden"].world["all"]["100+"] == (100.0, 1) and tables["clear"].world["car"]["0-25"][0] == 0.0
    assert tables["points_on_boxes"].world["all"]["share"][0] == pytest.approx(100 * 4 / 48)
    assert tables["boxes"].world["this data set"]["per frame"][0] == pytest.approx(5 / 12)
    assert tables["ego"].world["change of heading in 3 s"]["p50"][0] == pytest.approx(3.0)
    assert tables["ego"].world["speed"]["mean"][0] == pytest.approx(72.0)
    assert tables["weather"].world["car, rain"]["0-25"][1] == 3 and tables["weather"].world["car, clear"] == {}


def test_runs_end_at_a_miss_and_at_a_gap_in_the_track():
    seen = {0: 1, 1: 1, 2: 0, 3: 1, 4: 1, 5: 1, 7: 1}  # 2, 3 and, after the gap at frame 6, 1
    tables = tables_of(
        ("car", 0.0, {frame: (10, points, points) for frame, points in seen.items()}),
        ("car", 0.0, {0: (10, 0, 0)}),
    )
    runs = tables["runs"].world["radar >= 1"]
    assert runs["mean run"][0] == pytest.approx(2.0) and runs["tracks with three in a row %"][0] == 50.0
    assert tables["runs"].world["radar >= 3"] == {}


def test_remembered_are_fast_boxes_in_range_that_were_seen_within_four_seconds():
    tables = tables_of(
        ("car", 30.0, {0: (60, 3, 3), 1: (60, 0, 2), 8: (60, 0, 2), 9: (60, 0, 2)}),
        ("car", 5.0, {0: (60, 9, 9), 1: (60, 0, 0)}),  # too slow
        ("car", 30.0, {0: (100, 9, 9), 1: (160, 0, 0)}),  # the second is out of range
    )
    rows = tables["remembered"].world
    few = rows["fewer than 3 points"]
    assert few["now %"] == (pytest.approx(60.0), 5)  # three of five
    assert few["seen with 3 in the last 4 s %"] == (pytest.approx(40.0), 5)  # not the one 4.5 s later
    assert rows["fewer than 1 points"]["now %"] == (0.0, 5)


def test_only_real_figures_on_enough_boxes_are_held_against_a_data_set():
    table = FigureTable(
        name="support", title="", unit="", sources=[], trust="", allowed=15, allowed_heavy=10,
        world={"car": {"0-25": (50.0, 9), "25-50": (50.0, 9)}, "truck": {"0-25": (50.0, 9)}},
        real={
            "car": {"0-25": (66.0, 50), "25-50": (99.0, 49), "150+": (0.0, 500)},
            "truck": {"0-25": (61.0, 60)}, "bus": {"0-25": (1.0, 60)},
        },
    )  # fmt: skip
    assert table.compared() == 2
    assert table.beyond() == [("car", "0-25", 50.0, 66.0), ("truck", "0-25", 50.0, 61.0)]
    assert table.columns() == ["0-25", "25-50", "150+"] and table.groups() == ["car", "truck", "bus"]


def test_every_real_figure_names_its_source_and_is_measured():
    known = yaml.safe_load(REAL_STATISTICS.read_text(encoding="utf-8"))
    tables = tables_of(("car", 30.0, {0: (60, 3, 3), 1: (60, 0, 2)}))
    assert list(tables) == [*known, "remembered"]
    for name, table in known.items():
        assert table["source"] and table["trust"] and table["unit"], name
        assert tables[name].real and tables[name].columns(), name
    assert set(known["support"]["rows"]) == set(CLASSES)
    for table in ("support", "hidden", "support_grown"):
        for row in known[table]["rows"].values():
            assert all(0 <= value <= 100 and boxes > 0 for value, boxes in row.values())
