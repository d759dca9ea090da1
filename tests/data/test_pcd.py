import struct
from pathlib import Path

import lzf
import numpy as np
import pytest

from src.data.pcd import LIDAR_FIELDS, RADAR_FIELDS, read_lidar_points, read_radar_points
from src.errors import DataError
from src.world.pcd_writer import LIDAR_TYPE, lidar_pcd
from tests.data.tiny_set import lidar_bytes, pcd_bytes

POINTS = np.random.default_rng(0).normal(size=(9, 7)).astype(np.float32)
REAL = Path(__file__).resolve().parents[3] / "shared/real/truckscenes_radar"


@pytest.fixture
def file(tmp_path):
    return tmp_path / "RADAR_1.pcd"


def test_binary_and_ascii(file):
    file.write_bytes(pcd_bytes(POINTS))
    np.testing.assert_array_equal(read_radar_points(file), POINTS)
    file.write_bytes(pcd_bytes(POINTS, data="ascii"))
    np.testing.assert_array_equal(read_radar_points(file), POINTS)
    file.write_bytes(pcd_bytes(POINTS[:1], data="ascii"))
    np.testing.assert_array_equal(read_radar_points(file), POINTS[:1])


def test_fields_are_taken_by_name(file):
    order = [6, 2, 0, 1, 5, 4, 3]
    file.write_bytes(pcd_bytes(POINTS[:, order], fields=" ".join(RADAR_FIELDS[i] for i in order)))
    np.testing.assert_array_equal(read_radar_points(file), POINTS)


def test_other_types_are_converted(file):
    content = pcd_bytes(POINTS).replace(b"TYPE F F F F F F F", b"TYPE F F F F F F I")
    rcs = np.arange(9, dtype="<i4").view("<f4")
    body = np.concatenate([POINTS[:, :6], rcs[:, None]], axis=1).astype("<f4").tobytes()
    file.write_bytes(content[: -len(body)] + body)
    assert read_radar_points(file)[:, 6].tolist() == list(range(9))


@pytest.mark.parametrize("data", ["binary", "ascii"])
def test_no_point_is_fine(file, data):
    file.write_bytes(pcd_bytes(POINTS[:0], data=data))
    assert read_radar_points(file).shape == (0, 7)


def replaced(old, new):
    return pcd_bytes(POINTS).replace(old, new)


@pytest.mark.parametrize(
    "content, words",
    [
        (pcd_bytes(POINTS)[:-40], "9 points end at byte 436, but the file has 396 bytes"),
        (pcd_bytes(POINTS)[:60], "no DATA line"),
        (b"", "no DATA line"),
        (b"hello\n", "no DATA line"),
        (bytes(range(256)) * 100, "no DATA line"),
        (pcd_bytes(POINTS, fields="x y z vrel_x vrel_y vrel_z snr"), r"\['rcs'\] are not in"),
        (replaced(b"HEIGHT 1", b"HEIGHT 2"), "WIDTH x HEIGHT"),
        (replaced(b"POINTS 9", b"POINTS 8"), "WIDTH x HEIGHT"),
        (replaced(b"WIDTH 9", b"WIDTH -9"), "WIDTH must be one whole number"),
        (replaced(b"WIDTH 9", b"WIDTH 4000000000").replace(b"POINTS 9", b"POINTS 4000000000"), "at most 1000000"),
        (replaced(b"SIZE 4 4", b"SIZE 4"), "one entry per field"),
        (replaced(b"SIZE 4", b"SIZE 3"), "SIZE 3, which is not supported"),
        (replaced(b"COUNT 1", b"COUNT 2"), "COUNT 1"),
        (replaced(b"DATA binary", b"DATA gzip"), "binary, ascii or binary_compressed"),
        (pcd_bytes(np.where(POINTS == POINTS[4, 2], np.nan, POINTS)), "point 4 is not finite"),
        (pcd_bytes(np.where(POINTS == POINTS[2, 5], np.inf, POINTS)), "point 2 is not finite"),
        (pcd_bytes(POINTS, data="ascii") + b"7 7", "9 points of 7 fields expected, but more numbers found"),
        (pcd_bytes(POINTS[:0], data="ascii").replace(b" 0\n", b" 1\n") + b"a b c d e f g", "not a number"),
    ],
)
def test_bad_files_name_file_and_fault(file, content, words):
    file.write_bytes(content)
    with pytest.raises(DataError, match=words) as error:
        read_radar_points(file)
    assert str(file) in str(error.value)


def test_a_header_met_before_serves_other_files_of_the_same_kind_only(tmp_path):
    """Files of one and the same header, of another number of points, of other fields, and damaged ones, in turns."""
    order = " ".join(RADAR_FIELDS[::-1])
    files = {
        "a": (pcd_bytes(POINTS), POINTS),
        "b": (pcd_bytes(POINTS + 1), POINTS + 1),
        "c": (pcd_bytes(POINTS[:4]), POINTS[:4]),
        "d": (pcd_bytes(POINTS[:, ::-1], fields=order), POINTS),
        "e": (pcd_bytes(POINTS).replace(b"VERSION", b"# first\nDATA_OF = truck\nVERSION"), POINTS),
        "f": (pcd_bytes(POINTS).replace(b"DATA binary", b"  DATA\tbinary"), POINTS),
        "short": (pcd_bytes(POINTS)[:-4], "9 points end at byte"),
        "long": (pcd_bytes(POINTS) + b"DATA", "9 points end at byte"),
        "fields": (pcd_bytes(POINTS, fields="x y z vrel_x vrel_y vrel_z snr"), "'rcs'"),
    }
    for name in 2 * [*files]:
        content, expected = files[name]
        (tmp_path / name).write_bytes(content)
        if isinstance(expected, str):
            with pytest.raises(DataError, match=f"{tmp_path / name}: .*{expected}"):
                read_radar_points(str(tmp_path / name))
        else:
            np.testing.assert_array_equal(read_radar_points(str(tmp_path / name)), expected)


def test_missing_file(file):
    with pytest.raises(DataError, match="no such file"):
        read_radar_points(file)


def test_real_sweep():
    if not REAL.is_dir():
        pytest.skip(f"{REAL} is not there")
    (path,) = REAL.glob("*.pcd")
    points = read_radar_points(path).astype(np.float64)
    assert points.shape == (612, 7)
    distance = np.linalg.norm(points[:, :3], axis=1)
    assert distance.min() > 9.8 and distance.max() < 190
    np.testing.assert_array_equal(points[:, 6], np.round(points[:, 6]))
    unit = points[:, :3] / distance[:, None]
    radial = (points[:, 3:6] * unit).sum(1, keepdims=True) * unit
    np.testing.assert_allclose(points[:, 3:6], radial, atol=1e-4)  # vrel is purely radial


def test_pypcd4_agrees(file):
    pypcd4 = pytest.importorskip("pypcd4", reason="comes with the devkit")
    cloud = pypcd4.PointCloud.from_points(POINTS, RADAR_FIELDS, (np.float32,) * 7)
    cloud.save(str(file), pypcd4.Encoding.BINARY)
    np.testing.assert_array_equal(read_radar_points(file), POINTS)


@pytest.mark.parametrize("data", ["binary", "ascii"])
@pytest.mark.parametrize("column, value", [(0, 1.1e4), (2, -3e38), (4, 2e3), (6, -1e9)])
def test_values_that_no_radar_gives_are_refused(file, data, column, value):
    points = POINTS.copy()
    points[3, column] = value
    file.write_bytes(pcd_bytes(points, data=data))
    with pytest.raises(DataError, match="point 3 is beyond .* more than any radar gives"):
        read_radar_points(file)


def test_doubles_beyond_float32_are_refused_without_a_warning(file, recwarn):
    points = np.full((2, 7), 1e300)
    header = pcd_bytes(POINTS[:2]).replace(b"SIZE" + b" 4" * 7, b"SIZE" + b" 8" * 7)
    file.write_bytes(header[: header.index(b"DATA binary\n") + 12] + points.astype("<f8").tobytes())
    with pytest.raises(DataError, match="point 0 is not finite"):
        read_radar_points(file)
    assert not recwarn.list


def test_declared_sizes_beyond_reason_are_refused_before_anything_is_made_of_them(file):
    digits = b"9" * 4500  # more than Python converts
    names = " ".join(f"f{at}" for at in range(200))
    wide = pcd_bytes(np.zeros((0, 200)), fields=f"x y z vrel_x vrel_y vrel_z rcs {names[:-24]}")
    for content, words in (
        (replaced(b"WIDTH 9", b"WIDTH " + digits[:3000]), "WIDTH must be one whole number"),
        (replaced(b"SIZE 4", b"SIZE " + digits[:3000]), "is not supported"),
        (b"VERSION 0.7\nWIDTH " + digits * 1000 + b"\n", "no DATA line"),
        (pcd_bytes(POINTS[:0], data="ascii") + b"1 " * 100_000, "0 points of 7 fields expected, but more numbers"),
        (wide.replace(b"WIDTH 0", b"WIDTH 900000").replace(b"POINTS 0", b"POINTS 900000"), "at most 8000000 numbers"),
    ):
        file.write_bytes(content)
        with pytest.raises(DataError, match=words):
            read_radar_points(file)


# -------------------------------------------------------------------- LiDAR

RETURNS = np.round(np.random.default_rng(1).normal(size=(300, 4)), 1).astype(np.float32)  # rounded, so that they pack
TIMES = 1_695_473_000_000_000 + 37 * np.arange(300)


def lidar_file(encoding, points=RETURNS, times=TIMES, order=LIDAR_FIELDS):
    """A LiDAR file in each encoding, with fields in any order."""
    columns = dict(zip(LIDAR_FIELDS, [*points.T, times], strict=True))
    kinds = {name: "<u8" if name == "timestamp" else "<f4" for name in order}
    table = np.zeros(len(points), [(name, kinds[name]) for name in order])
    for name in order:
        table[name] = columns[name]
    sizes, types = (" ".join(kinds[name][i].upper() for name in order) for i in (2, 1))
    head = f"VERSION 0.7\nFIELDS {' '.join(order)}\nSIZE {sizes}\nTYPE {types}\nCOUNT 1 1 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA {encoding}\n"
    if encoding == "ascii":
        body = "".join(" ".join(map(str, row.tolist())) + "\n" for row in table).encode()
    elif encoding == "binary":
        body = table.tobytes()
    else:
        data = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in order)
        packed = lzf.compress(data)
        assert len(packed) < 0.8 * len(data)
        body = struct.pack("<II", len(packed), len(data)) + packed
    return head.encode() + body


@pytest.mark.parametrize("order", [LIDAR_FIELDS, LIDAR_FIELDS[::-1]], ids=["usual", "reversed"])
@pytest.mark.parametrize("encoding", ["binary", "ascii", "binary_compressed"])
def test_lidar_in_every_encoding(file, encoding, order):
    file.write_bytes(lidar_file(encoding, order=order))
    cloud = read_lidar_points(file)
    np.testing.assert_array_equal(cloud.points, RETURNS)
    np.testing.assert_array_equal(cloud.times_us, TIMES)
    assert cloud.points.dtype == np.float32 and cloud.times_us.dtype == np.int64
    file.write_bytes(lidar_file("binary", RETURNS[:0], TIMES[:0]))
    assert [len(part) for part in read_lidar_points(file)] == [0, 0]


@pytest.mark.parametrize("count", [0, 1, 300])
def test_lidar_files_of_the_world(file, count):
    table = np.zeros(count, LIDAR_TYPE)
    for column, name in enumerate(LIDAR_FIELDS[:4]):
        table[name] = RETURNS[:count, column]
    table["timestamp"] = TIMES[:count]
    file.write_bytes(lidar_pcd(table))
    points, times = read_lidar_points(file)
    np.testing.assert_array_equal(points, RETURNS[:count])
    np.testing.assert_array_equal(times, TIMES[:count])


def test_pypcd4_writes_what_is_read(file):
    pypcd4 = pytest.importorskip("pypcd4", reason="comes with the devkit")
    kinds = (np.float32,) * 4 + (np.uint64,)
    cloud = pypcd4.PointCloud.from_points([*RETURNS.T, TIMES.astype(np.uint64)], LIDAR_FIELDS, kinds)
    for encoding in (pypcd4.Encoding.ASCII, pypcd4.Encoding.BINARY, pypcd4.Encoding.BINARY_COMPRESSED):
        cloud.save(str(file), encoding)
        found = read_lidar_points(file)
        np.testing.assert_allclose(found.points, RETURNS, atol=1e-5)
        np.testing.assert_array_equal(found.times_us, TIMES)
    file.write_bytes(lidar_bytes(RETURNS, TIMES))
    np.testing.assert_array_equal(pypcd4.PointCloud.from_path(str(file)).numpy(LIDAR_FIELDS[:4]), RETURNS)


def test_points_without_a_return_are_left_out(file):
    points = RETURNS.copy()
    points[[0, 7, 299], :3] = np.nan
    file.write_bytes(lidar_bytes(points, TIMES))
    found, times = read_lidar_points(file)
    kept = np.delete(np.arange(300), [0, 7, 299])
    np.testing.assert_array_equal(found, RETURNS[kept])
    np.testing.assert_array_equal(times, TIMES[kept])


def one_value(column, value):
    points = RETURNS.copy()
    points[5, column] = value
    return lidar_bytes(points, TIMES)


WHOLE = lidar_bytes(RETURNS, TIMES)
BODY = WHOLE.index(b"DATA binary_compressed\n") + 23
PACKED = len(WHOLE) - BODY - 8


def with_sizes(packed, unpacked, data=WHOLE[BODY + 8 :]):
    return WHOLE[:BODY] + struct.pack("<II", packed, unpacked) + data


@pytest.mark.parametrize(
    "content, words",
    [
        (WHOLE[:-1], "the compressed data end at byte"),
        (WHOLE + b"x", "the compressed data end at byte"),
        (WHOLE[: BODY + 5], "the sizes of compressed data end at byte"),
        (with_sizes(PACKED, 2**32 - 1), "300 points are 7200 bytes, but 4294967295 compressed ones are stated"),
        (with_sizes(2**32 - 1, 7200), "the compressed data end at byte"),
        (with_sizes(3, 7200, b"\xff\xff\xff"), "the compressed data are damaged"),
        (with_sizes(33, 7200, b"\x1f" + 32 * b"a"), "7200 bytes expected, but 32 found"),
        (with_sizes(303 * 33, 7200, 303 * (b"\x1f" + 32 * b"a")), "7200 bytes expected, but more found"),
        (with_sizes(0, 7200, b""), "the compressed data are damaged"),
        (WHOLE.replace(b"timestamp", b"ring"), r"a lidar file has the fields .* \['timestamp'\] are not in"),
        (one_value(1, np.nan), "point 5 is not finite"),
        (one_value(0, np.inf), "point 5 is not finite"),
        (one_value(3, np.nan), "point 5 is not finite"),
        (one_value(2, -1.1e4), "point 5 is beyond .* more than any lidar gives"),
        (one_value(3, 1e7), "point 5 is beyond .* more than any lidar gives"),
        (lidar_bytes(RETURNS, np.where(TIMES == TIMES[4], 0, TIMES)), "point 4 has the timestamp 0, expected micro"),
        (lidar_bytes(RETURNS, np.uint64(TIMES * 1000)), "point 0 has the timestamp 1695473000000000000, expected mic"),
        (lidar_bytes(RETURNS, np.full(300, 2**64 - 1, np.uint64)), "point 0 has the timestamp 18446744073709551615"),
        (WHOLE.replace(b"WIDTH 300", b"WIDTH 1000000").replace(b"POINTS 300", b"POINTS 1000000"), "24000000 bytes"),
        (b"", "no DATA line"),
    ],
)
def test_bad_lidar_files_name_file_and_fault(file, content, words):
    file.write_bytes(content)
    with pytest.raises(DataError, match=words) as error:
        read_lidar_points(file)
    assert str(file) in str(error.value)


def test_a_radar_may_be_compressed_and_is_no_lidar(file):
    columns = b"".join(np.ascontiguousarray(column).tobytes() for column in POINTS.T)
    packed = b"".join(bytes([len(run) - 1]) + run for run in (columns[at : at + 32] for at in range(0, 252, 32)))
    head = pcd_bytes(POINTS).split(b"DATA binary\n")[0] + b"DATA binary_compressed\n"
    file.write_bytes(head + struct.pack("<II", len(packed), len(columns)) + packed)
    np.testing.assert_array_equal(read_radar_points(file), POINTS)
    with pytest.raises(DataError, match=r"a lidar file has the fields .*\['intensity', 'timestamp'\] are not in"):
        read_lidar_points(file)
    file.write_bytes(WHOLE)
    with pytest.raises(DataError, match="a radar file has the fields"):  # the header was met before, as a LiDAR's
        read_radar_points(file)
