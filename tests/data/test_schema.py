"""Every way in which tables can be wrong, and what the error has to say."""

import json
import shutil

import numpy as np
import pytest

from src.data.schema import CHANNELS, build_index
from src.errors import DataError
from tests.data.tiny_set import START_S, TARGET_VELOCITY, VERSION, token


def build(data_set):
    return build_index(data_set.root, VERSION)


def test_links_of_the_intact_set(data_set):
    index = build(data_set)
    assert len(index) == 6 and index.annotated
    key = index.key_data[1]
    assert (key[: len(CHANNELS) - 6] >= 0).all()
    lidar = key[CHANNELS.index("LIDAR_LEFT")]
    assert index.frame_times_us[1] == index.data_times_us[lidar] == int(START_S * 1e6) + 500_000
    radar = key[CHANNELS.index("RADAR_LEFT_SIDE")]
    before = index.data_previous[radar]
    assert index.data_times_us[radar] - index.data_times_us[before] == 50_000
    assert index.filename(before).startswith("sweeps/RADAR_LEFT_SIDE/")
    np.testing.assert_array_equal(index.pose_times_us[index.data_poses], index.data_times_us)
    assert np.diff(index.box_starts).tolist() == [2, 2, 1, 2, 2, 1]  # car and sign | car and rack | car
    np.testing.assert_allclose(index.box_velocities[0], TARGET_VELOCITY, atol=1e-6)
    assert np.isnan(index.box_velocities[1]).all()  # one annotation only


def test_order_of_the_file_table_means_nothing(broken_tables):
    """Sweeps name the following sample: only the key-frame flag tells them from its key frame."""
    before = build(broken_tables)
    broken_tables.table("sample_data").write_text(json.dumps(broken_tables.records("sample_data")[::-1]))
    after = build(broken_tables)
    known = before.key_data >= 0
    np.testing.assert_array_equal(after.key_data >= 0, known)
    names = [[index.filename(row) for row in index.key_data[known]] for index in (before, after)]
    assert names[0] == names[1] and all(name.startswith("samples/") for name in names[0])


def test_velocities_are_known_up_to_the_devkits_intervals(broken_tables):
    """1.5 s to one neighbour, 3 s from the previous to the next."""
    start = int(START_S * 1e6)
    for row, seconds in ((1, 1.6), (2, 2.9)):
        broken_tables.edit("sample", row, timestamp=start + round(seconds * 1e6))
    index = build(broken_tables)
    cars = index.box_velocities[[0, 2, 4]]  # in samples 0, 1 and 2
    assert np.isnan(cars[0]).all()
    np.testing.assert_allclose(cars[1], TARGET_VELOCITY / 2.9, atol=1e-6)  # 1 s of driving between first and last
    np.testing.assert_allclose(cars[2], TARGET_VELOCITY / 2.6, atol=1e-6)


def case(table, row, change, *words, name):
    return pytest.param(table, row, change, words, id=name)


@pytest.mark.parametrize(
    "table, row, change, words",
    [
        case("sample", 1, {"scene_token": "f" * 32}, "f" * 32, "scene", name="dangling"),
        case("sample_data", 3, {"sample_token": token("sensor", "LIDAR_LEFT")}, "table sample", name="foreign-key"),
        case("sample", 1, {"token": token("sample", "train-0")}, "token of its own", name="duplicate-token"),
        case("sample", 1, {"token": ""}, "not empty", name="empty-token"),
        case("sample", 1, {"timestamp": int(START_S * 1e6)}, "earlier", name="equal-times"),
        case("sample", 2, {"timestamp": int(START_S * 1e6) - 5}, "earlier", name="reversed-times"),
        case("sample", 1, {"timestamp": 1.5}, "1.5", "int", name="float-time"),
        case("sample", 1, {"timestamp": 10**30}, "64 bits", name="huge-time"),
        case("ego_pose", 0, {"rotation": [2.0, 0, 0, 0]}, "[2.0, 0.0", "length 1", name="not-unit"),
        case("ego_pose", 0, {"rotation": [float("nan"), 0, 0, 0]}, "nan", "finite", name="nan-rotation"),
        case("ego_pose", 0, {"translation": [1.0, 2.0]}, "3 numbers", name="short-vector"),
        case("ego_pose", 0, {"translation": ["1", "2", "3"]}, "3 numbers", name="text-vector"),
        case("calibrated_sensor", 0, {"camera_intrinsic": [[0] * 3] * 3}, "invertible", name="singular"),
        case("calibrated_sensor", 0, {"camera_intrinsic": []}, "3x3", name="no-intrinsics"),
        case("category", 0, {"name": "vehicle.ufo"}, "vehicle.ufo", "27", name="unknown-category"),
        case("attribute", 0, {"name": "vehicle.flying"}, "vehicle.flying", name="unknown-attribute"),
        case("sample_annotation", 0, {"attribute_tokens": [token("attribute", "vehicle.moving")] * 2}, "at most one",
             name="two-attributes"),
        case("sample_annotation", 1, {"prev": token("sample_annotation", "train", "sign", 0)}, "same instance",
             name="chain-of-another"),
        case("sample_data", 0, {"filename": "/etc/passwd"}, "/etc/passwd", "outside the dataset", name="absolute"),
        case("sample_data", 0, {"filename": "samples/../../x"}, "outside the dataset", name="parent"),
        case("sample_data", 0, {"width": 0}, "pixels", name="no-width"),
        case("sample_data", 0, {"width": 120}, "[120, 114]", "principal point", name="calibration-of-another-size"),
        case("sample_data", 30, {"prev": token("sample_data", "CAMERA_LEFT_FRONT", int(START_S * 1e6) + 19_000)},
             "same channel", name="file-chain-of-another"),
        case("scene", 1, {"name": "scene-train-0"}, "of its own", name="same-scene-name"),
        case("scene", 1, {"name": "../../x"}, "'../../x'", "without '/'", name="scene-name-that-leads-out"),
        case("scene", 1, {"name": ".."}, "not '..'", name="scene-name-of-a-folder"),
        case("scene", 1, {"name": "x" * 256}, "at most 255 characters", name="long-name"),
        case("scene", 1, {"description": "x" * 10_001}, "at most 10000 characters", name="long-description"),
        case("scene", 1, {"name": "\ud800"}, "hex escape", "line 1", name="half-a-character"),
        case("sample_data", 0, {"filename": "\ud800.jpg"}, "hex escape", name="half-a-character-of-a-path"),
        case("sample", 1, {"token": "a\0"}, "without NUL", name="nul"),
        case("sample", 1, {"timestamp": 10**16}, "below 10000000000000000", name="time-of-the-far-future"),
        case("ego_pose", 0, {"translation": [1e300, 0, 0]}, "1e+300", "at most 1e+08", name="far-away"),
        case("ego_pose", 0, {"translation": [10**400, 0, 0]}, "3 numbers", name="beyond-floats"),
        case("sample_annotation", 0, {"num_radar_pts": 2**40}, "a number of points", name="more-points-than-int32"),
        case("sample_annotation", 0, {"num_lidar_pts": 2**62}, "a number of points", name="more-points-than-int64"),
        case("sample_annotation", 0, {"num_lidar_pts": -7}, "a number of points", name="negative-points"),
    ],
)  # fmt: skip
def test_bad_values_are_named(broken_tables, table, row, change, words):
    broken_tables.edit(table, row, **change)
    with pytest.raises(DataError) as error:
        build(broken_tables)
    text = str(error.value)
    assert f"{table}.json" in text and "restore the file" in text
    for word in words:
        assert word in text


@pytest.mark.parametrize(
    "change",
    [
        {"size": [1.0, 0.0, 1.0]},
        {"size": [1.0, -2.0, 1.0]},
        {"translation": [float("nan"), 0, 0]},
        {"size": [1.0, 1e30, 1.0]},
        {"translation": [1e300, 0, 0]},
    ],
    ids=["zero-size", "negative-size", "nan-centre", "huge-size", "far-centre"],
)
def test_boxes_that_cannot_be_are_left_out_and_counted(broken_tables, caplog, change):
    record = broken_tables.edit("sample_annotation", 0, **change)
    index = build(broken_tables)
    assert np.diff(index.box_starts).tolist() == [1, 2, 1, 2, 2, 1]
    assert "1 annotations" in caplog.text and record["token"] in caplog.text
    assert np.isfinite(index.box_centers).all() and (index.box_sizes > 0).all()


def test_a_box_that_jumps_has_no_velocity_and_spoils_none(broken_tables):
    """The car's three boxes: beyond the Earth in the middle, then a thousand kilometres further within a second."""
    cars = [row for row, record in enumerate(broken_tables.records("sample_annotation"))
            if record["size"] == [1.9, 4.6, 1.6]][:3]  # fmt: skip
    where = broken_tables.records("sample_annotation")[cars[1]]["translation"]
    broken_tables.edit("sample_annotation", cars[1], translation=[1e300, 0.0, 0.0])
    first = build(broken_tables)
    assert np.isnan(first.box_velocities[first.box_starts[0]]).all()  # towards the one that is left out
    broken_tables.edit("sample_annotation", cars[1], translation=[where[0] + 1e6, *where[1:]])
    again = build(broken_tables)
    assert np.isnan(again.box_velocities[again.box_starts[0]]).all()
    assert len(again.box_labels) == len(first.box_labels) + 1
    np.testing.assert_array_equal(again.box_velocities[again.box_starts[2]], first.box_velocities[first.box_starts[2]])


def test_sweeps_of_another_scene_are_not_linked(broken_tables):
    """A chain across scenes would mix radar sweeps of two drives."""
    records = broken_tables.records("sample_data")
    name = "RADAR_LEFT_SIDE"
    of_channel = [row for row, record in enumerate(records) if f"/{name}/" in record["filename"]]
    starts = [row for row in of_channel if not records[row]["prev"]]
    last_of_first = of_channel[of_channel.index(starts[1]) - 1]
    broken_tables.edit("sample_data", starts[1], prev=records[last_of_first]["token"])
    with pytest.raises(DataError, match="same channel and scene"):
        build(broken_tables)


def test_equal_times_of_samples_that_are_not_linked(broken_tables):
    broken_tables.edit("sample", 0, next="")
    broken_tables.edit("sample", 1, prev="", timestamp=int(START_S * 1e6))
    with pytest.raises(DataError, match=f"another time than sample '{token('sample', 'train-0')}'"):
        build(broken_tables)


def test_error_names_the_record(broken_tables):
    record = broken_tables.edit("ego_pose", 7, rotation=[0.0, 0.0, 0.0, 0.0])
    with pytest.raises(DataError, match=f"ego_pose '{record['token']}'.*record 7.*rotation"):
        build(broken_tables)


@pytest.mark.parametrize(
    "content, words",
    [
        ('[\n{"token": "a"},\n{"tok', "line 3"),
        ("", "line 1"),
        ('{"token": "a"}', "list of records"),
        ("[1, 2]", "record 0 must be an object"),
        ('[{"name": "x"}]', "no field 'token'"),
        (b"\xff\xfe\x00", "line 1 column 1"),
        ("[" * 100_000, "not a table"),
    ],
    ids=["truncated", "empty", "object", "numbers", "no-token", "binary", "nested"],
)
def test_files_that_are_no_tables(broken_tables, content, words):
    path = broken_tables.table("sensor")
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError, match="sensor.json") as error:
        build(broken_tables)
    assert words in str(error.value)


def test_missing_field(broken_tables):
    records = broken_tables.records("sample_data")
    del records[4]["ego_pose_token"]
    broken_tables.table("sample_data").write_text(json.dumps(records))
    with pytest.raises(DataError, match="record 4.*no field 'ego_pose_token'"):
        build(broken_tables)


def test_missing_table_version_and_root(broken_tables):
    with pytest.raises(DataError, match=rf"data.version='v1.0-mini'.*{VERSION}"):
        build_index(broken_tables.root, "v1.0-mini")
    with pytest.raises(DataError, match="data.version='..'"):
        build_index(broken_tables.root, "..")
    with pytest.raises(DataError, match="data.root=.*no such folder"):
        build_index(broken_tables.root / "nowhere", VERSION)
    broken_tables.table("sample_data").unlink()
    with pytest.raises(DataError, match="missing tables.*sample_data"):
        build(broken_tables)


def test_tables_without_records_are_named(broken_tables):
    broken_tables.table("sample_data").write_text("[]")
    with pytest.raises(DataError, match="sample_data.json: no sensor file at all; unpack the release again"):
        build(broken_tables)


def test_weather_may_be_missing(broken_tables):
    broken_tables.table("weather_annotation").unlink()
    assert len(build(broken_tables)) == 6


def test_test_release_has_no_boxes(broken_tables):
    folder = broken_tables.root / "v1.2-test"
    shutil.move(broken_tables.root / VERSION, folder)
    for name in ("sample_annotation", "instance"):
        (folder / f"{name}.json").unlink()
    index = build_index(broken_tables.root, "v1.2-test")
    assert not index.annotated and index.box_starts.tolist() == [0] * 7


def test_sample_without_reference_uses_the_closest_pose(broken_tables, caplog):
    records = [r for r in broken_tables.records("sample_data") if "LIDAR_LEFT" not in r["filename"]]
    broken_tables.table("sample_data").write_text(json.dumps(records))
    index = build(broken_tables)
    assert "no LIDAR_LEFT key frame" in caplog.text
    assert (np.abs(index.pose_times_us[index.frame_poses] - index.frame_times_us) <= 10_000).all()
