"""Matter of a scene worked out by hand: a box that drives and turns over a sloped ground."""

import io
import zipfile

import numpy as np
import pytest

from src.data.true_geometry import TRUTH_FOLDER, TrueGeometry
from src.errors import DataError

ORIGIN = np.array([7e5, 5.3e6, 10.0])
SPEED, RATE = np.array([20.0, 5.0, 0.0]), 0.4


def geometry():
    """Box 0 drives from (0, 0, 2) and turns, box 1 stands; the ground rises with x by a hundredth."""
    steps_s = 0.05 * np.arange(41)
    driven = np.array([0.0, 0.0, 2.0]) + steps_s[:, None] * SPEED
    middles = np.stack([driven, np.tile([50.0, 0.0, 2.0], (41, 1))], 1)
    x = np.arange(-100, 104, 4.0)
    return TrueGeometry(
        origin=ORIGIN, times_us=(1e6 * (100 + steps_s)).astype(np.int64), middles=middles.astype(np.float32),
        yaws=np.stack([RATE * steps_s, 0 * steps_s], 1).astype(np.float32),
        sizes=np.array([[6.0, 2.0, 2.0], [1.0, 1.0, 1.0]], np.float32),
        ground=np.tile(0.01 * x, (51, 1)).astype(np.float32), ground_corner=np.array([-100.0, -100.0]),
        ground_cell_m=np.array(4.0),
    )  # fmt: skip


def at(seconds):
    return int(1e6 * (100 + seconds))


def test_points_are_inside_a_box_at_its_time_and_under_the_ground():
    middle = np.array([0.0, 0.0, 2.0]) + 1.01 * SPEED
    along = np.array([np.cos(1.01 * RATE), np.sin(1.01 * RATE), 0.0])
    points = ORIGIN + [middle, middle + 2.9 * along, middle + 3.1 * along, middle, [50.4, 0, 2.4], [10, 0, 0.05],
                       [10, 0, 0.15]]  # fmt: skip
    times = np.array([at(1.01)] * 3 + [at(0.3)] + [at(1.01)] * 3)
    np.testing.assert_array_equal(geometry().solid(points, times), [True, True, False, False, True, True, False])
    assert geometry().solid(np.zeros((0, 3)), np.zeros(0, np.int64)).shape == (0,)


@pytest.mark.parametrize("seconds", [0.0, 0.513, 2.0])
def test_velocities_are_those_of_a_turning_body(seconds):
    arm = np.array([np.cos(RATE * seconds), np.sin(RATE * seconds), 0.0]) * 3.05  # just outside, where it is measured
    place = np.array([0.0, 0.0, 2.0]) + seconds * SPEED + arm
    points, times = ORIGIN + np.stack([place, place + [0, 0, 5], [50, 0, 2]]), np.full(3, at(seconds))
    found = geometry().velocities(points, times, 0.1)
    np.testing.assert_allclose(found[0], SPEED + np.cross([0, 0, RATE], arm), atol=5e-3)
    np.testing.assert_allclose(found[1:], 0, atol=1e-9)


def test_times_outside_the_scene_are_refused():
    with pytest.raises(ValueError, match="known from 100000000 to 102000000"):
        geometry().solid(ORIGIN[None], np.array([at(2.5)]))


def test_it_is_stored_whole_or_said_to_be_missing(tmp_path):
    (tmp_path / TRUTH_FOLDER).mkdir()
    geometry().write(tmp_path, "scene-a")
    first = (tmp_path / TRUTH_FOLDER / "scene-a.npz").read_bytes()
    found = TrueGeometry.read(tmp_path, "scene-a")
    for name, value in vars(geometry()).items():
        np.testing.assert_array_equal(getattr(found, name), value)
    geometry().write(tmp_path, "scene-a")
    assert (tmp_path / TRUTH_FOLDER / "scene-a.npz").read_bytes() == first
    with pytest.raises(DataError, match="only a synthetic world with data.world.lidar=true"):
        TrueGeometry.read(tmp_path, "scene-b")
    (tmp_path / TRUTH_FOLDER / "scene-a.npz").write_bytes(first[:-100])
    with pytest.raises(DataError, match="write the world again"):
        TrueGeometry.read(tmp_path, "scene-a")


def array_alone(whole):
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


def packed_otherwise(whole):
    """By a method that is none."""
    method = whole.index(b"PK\x01\x02") + 10
    return whole[:method] + b"\x63" + whole[method + 1 :]


def data_overwritten(whole):
    """In the middle of the largest array."""
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        largest = max(archive.infolist(), key=lambda member: member.compress_size)
    at = largest.header_offset + 60 + len(largest.filename)
    return whole[:at] + b"\xff" * 40 + whole[at + 40 :]


@pytest.mark.parametrize("damage", [array_alone, packed_otherwise, data_overwritten, lambda whole: b""])
def test_a_damaged_file_is_named(tmp_path, damage):
    (tmp_path / TRUTH_FOLDER).mkdir()
    geometry().write(tmp_path, "scene-a")
    path = tmp_path / TRUTH_FOLDER / "scene-a.npz"
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert path.read_bytes() != whole
    with pytest.raises(DataError, match="scene-a.npz: not the true geometry of a scene.*write the world again"):
        TrueGeometry.read(tmp_path, "scene-a")
