"""The TruckScenes tables of one release, checked, linked and packed into arrays."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from src.data.tables import LARGEST, MAX_DESCRIPTION, Table
from src.errors import DataError
from src.geometry.transforms import pose_matrix
from src.structures.taxonomy import (
    ATTRIBUTES,
    BICYCLE_RACK,
    CAMERAS,
    CATEGORY_TO_CLASS,
    CLASSES,
    IGNORED_CATEGORIES,
    LIDARS,
    RADARS,
    REFERENCE_CHANNEL,
)

Array = np.ndarray

CHANNELS = (*CAMERAS, *RADARS, *LIDARS)
TABLES = (
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_motion_cabin",
    "ego_motion_chassis",
    "ego_pose",
    "instance",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
    "weather_annotation",
)
OPTIONAL_TABLES = ("weather_annotation",)  # came with v1.1
LABEL_IGNORED, LABEL_RACK = -1, -2
MAX_SPEED_INTERVAL_S = 1.5
"""Devkit rule: neighbours further apart give no velocity; twice that when both neighbours exist."""
MAX_BOX_SIZE_M = 1000.0
MAX_BOX_SPEED_MPS = 1000.0
MAX_POINTS_OF_BOX = 100_000_000
"""Beyond these a number is damage: the box is left out, its velocity unknown, the table refused."""

_log = logging.getLogger(__name__)


@dataclass
class DatasetIndex:
    """All links of one release as arrays; rows of samples are in table order, which is scoring order.

    Row numbers are -1 where there is no such record. Poses and boxes are global and float64.
    """

    root: Path
    version: str
    annotated: bool  # False for test releases, and where labels were left unread
    # Scenes
    scene_names: Array  # [S] str
    scene_descriptions: Array  # [S] str, tags joined by ';'
    # Key frames
    sample_tokens: Array  # [N] str
    sample_scenes: Array  # [N] int32
    frame_times_us: Array  # [N] int64, time of the LIDAR_LEFT key frame
    frame_poses: Array  # [N] int32, its ego pose
    key_data: Array  # [N, 16] int32, sensor file of each of CHANNELS
    # Sensor files
    data_scenes: Array  # [D] int32
    data_channels: Array  # [D] int8, index into CHANNELS, -1 for others
    data_times_us: Array  # [D] int64
    data_poses: Array  # [D] int32
    data_calibrations: Array  # [D] int32
    data_previous: Array  # [D] int32
    data_sizes: Array  # [D, 2] int32 (height, width) of images, 0 for others
    data_filenames: Array  # [D] bytes, relative to root
    # Calibrations
    ego_from_sensor: Array  # [K, 4, 4]
    intrinsics: Array  # [K, 3, 3], NaN for sensors other than cameras
    # Ego poses, ascending in time
    pose_times_us: Array  # [E] int64
    pose_translations: Array  # [E, 3]
    pose_rotations: Array  # [E, 4] (w, x, y, z), global_from_ego
    # Annotations by sample (stable in table order): the 12 classes and bicycle racks
    box_starts: Array  # [N + 1] int64, rows of sample i are box_starts[i]:box_starts[i + 1]
    box_labels: Array  # [A] int8, index into CLASSES or LABEL_RACK
    box_centers: Array  # [A, 3]
    box_sizes: Array  # [A, 3] (width, length, height)
    box_rotations: Array  # [A, 4] (w, x, y, z), global_from_box
    box_velocities: Array  # [A, 3] m/s, NaN where unknown
    box_attributes: Array  # [A] int8, index into ATTRIBUTES, -1 for none
    box_points: Array  # [A] int32, lidar + radar returns
    box_instances: Array  # [A] int32, row of the object that was annotated

    def __len__(self) -> int:
        return len(self.sample_tokens)

    def filename(self, data_row: int) -> str:
        """Path of a sensor file relative to the root."""
        # What no table gives comes from a damaged cache, and there is no file of that name then.
        return self.data_filenames[data_row].decode(errors="replace").replace("\0", "\ufffd")

    def samples_of(self, scene_names: set[str]) -> Array:  # [n] int64
        """Rows of the samples whose scene is named, in table order."""
        wanted = np.array([name in scene_names for name in self.scene_names], bool)
        return np.flatnonzero(wanted[self.sample_scenes])


def build_index(root: Path, version: str, labels: bool = True) -> DatasetIndex:
    """Read, check and link the 14 tables of `root/version`; without `labels` annotations need not even be there.

    Raises DataError (table, record, value, remedy) for anything missing, contradictory or out of range.
    """
    folder = version_folder(root, version)
    without_boxes = version.endswith("-test") or not labels
    optional = OPTIONAL_TABLES + (("sample_annotation", "instance") if without_boxes else ())
    missing = [name for name in TABLES if name not in optional and not (folder / f"{name}.json").is_file()]
    if missing:
        raise DataError(f"{folder}: missing tables {missing}; unpack the release again (its tables are {list(TABLES)})")
    for name in ("ego_motion_cabin", "ego_motion_chassis", "visibility"):
        Table(folder / f"{name}.json")  # not used, but a broken release should not look whole

    scenes = Table(folder / "scene.json")
    samples = Table(folder / "sample.json")
    if not (len(scenes) and len(samples)):
        raise DataError(f"{folder}: the tables scene and sample hold no records; unpack the release again")
    parts = _scene_columns(scenes, samples)
    calibrations = _calibration_columns(folder, parts)
    data_samples, data_key = _data_columns(folder, samples, calibrations, parts)
    _frame_columns(samples, data_samples, data_key, parts)
    annotations, instances = (
        Table(folder / f"{name}.json", without_boxes, labels) for name in ("sample_annotation", "instance")
    )
    annotated = bool(len(annotations)) or not without_boxes
    _box_columns(folder, samples, annotations, instances, parts)
    del parts["sample_times_us"]
    return DatasetIndex(root=root, version=version, annotated=annotated, **parts)


def version_folder(root: Path, version: str) -> Path:
    """The folder of a release's tables; raises DataError naming the releases there are."""
    if not root.is_dir():
        raise DataError(f"data.root={root}: no such folder; set it to the folder that holds samples/ and the tables")
    folder = root / version
    if version in ("", ".", "..") or "/" in version or not folder.is_dir():
        found = sorted(path.parent.name for path in root.glob("*/scene.json"))
        raise DataError(f"data.version={version!r}: no such folder of tables in {root}; there are {found}")
    return folder


def _scene_columns(scenes: Table, samples: Table) -> dict[str, Array]:
    """Scenes and the order of their samples."""
    names = scenes.values("name")
    of_files = np.array([name not in ("", ".", "..") and "/" not in name for name in names], bool)
    scenes.check(of_files, "name", names, "a name that files can have, without '/' and not '..'")
    first = {name: row for row, name in reversed(list(enumerate(names)))}
    scenes.check(np.array([first[name] == row for row, name in enumerate(names)]), "name", names, "a name of its own")
    scenes.links("first_sample_token", samples)
    scenes.links("last_sample_token", samples)

    times = samples.times()
    scene_rows = samples.links("scene_token", scenes)
    for field, sign in (("prev", 1), ("next", -1)):
        samples.chain(field, sign * times, scene_rows, "scene")
    order = np.lexsort((times, scene_rows))
    twins = (np.diff(times[order]) == 0) & (np.diff(scene_rows[order]) == 0)
    if twins.any():
        at = int(np.argmax(twins))
        other = samples.tokens[order[at]]
        samples.fail(int(order[at + 1]), "timestamp", int(times[order[at]]), f"another time than sample {other!r}")
    return {
        "scene_names": np.array(names),
        "scene_descriptions": np.array(scenes.values("description", most=MAX_DESCRIPTION)),
        "sample_tokens": np.array(samples.tokens),
        "sample_scenes": scene_rows.astype(np.int32),
        "sample_times_us": times,
    }


def _calibration_columns(folder: Path, parts: dict[str, Array]) -> tuple[Table, Array]:
    """Mounts and camera matrices; also the table and the channel of each record."""
    sensors, table = Table(folder / "sensor.json"), Table(folder / "calibrated_sensor.json")
    sensor_rows = table.links("sensor_token", sensors)
    channel_of = np.array([CHANNELS.index(c) if c in CHANNELS else -1 for c in sensors.values("channel")], np.int8)
    channels = channel_of[sensor_rows]
    parts["ego_from_sensor"] = pose_matrix(table.rotations(), table.vectors("translation", 3))
    is_camera = (channels >= 0) & (channels < len(CAMERAS))
    parts["intrinsics"] = table.intrinsics(is_camera)
    return table, channels


def _data_columns(
    folder: Path, samples: Table, calibrations: tuple[Table, Array], parts: dict[str, Array]
) -> tuple[Array, Array]:
    """Sensor files and ego poses; also each file's sample row [D] and whether it is a key frame [D]."""
    poses = Table(folder / "ego_pose.json")
    if not len(poses):
        raise DataError(f"{poses.path}: no ego pose at all; unpack the release again")
    times = poses.times()
    order = np.argsort(times, kind="stable")
    parts["pose_times_us"] = times[order]
    parts["pose_translations"] = poses.vectors("translation", 3)[order]
    parts["pose_rotations"] = poses.rotations()[order]
    sorted_row = np.empty(len(order), np.int32)
    sorted_row[order] = np.arange(len(order))

    table = Table(folder / "sample_data.json")
    if not len(table):
        raise DataError(f"{table.path}: no sensor file at all; unpack the release again")
    data_samples = table.links("sample_token", samples)
    scenes = parts["data_scenes"] = parts["sample_scenes"][data_samples]
    parts["data_poses"] = sorted_row[table.links("ego_pose_token", poses)]
    rows = table.links("calibrated_sensor_token", calibrations[0])
    parts["data_calibrations"] = rows.astype(np.int32)
    channels = parts["data_channels"] = calibrations[1][rows]
    stamps = parts["data_times_us"] = table.times()
    previous = table.chain("prev", stamps, scenes * (len(CHANNELS) + 1) + channels, "channel and scene")
    table.links("next", table, optional=True)
    parts["data_previous"] = previous.astype(np.int32)

    cameras = np.flatnonzero((channels >= 0) & (channels < len(CAMERAS)))
    sizes = parts["data_sizes"] = np.zeros((len(table), 2), np.int32)
    for column, field in enumerate(("height", "width")):
        values = [record.get(field) for record in table.records]
        good = np.ones(len(table), bool)
        good[cameras] = [type(values[row]) is int and 0 < values[row] < 2**15 for row in cameras]
        table.check(good, field, values, "the image's size in pixels, above 0")
        sizes[cameras, column] = [values[row] for row in cameras]
    # A calibration of images of another size has its principal point near or beyond this image's edge.
    centres = parts["intrinsics"][rows, :2, 2]
    centred = np.ones(len(table), bool)
    centred[cameras] = ((centres > 0) & (centres < sizes[:, ::-1]))[cameras].all(axis=1)
    table.check(centred, "width, height", sizes[:, ::-1], "an image that holds its camera's principal point")

    names = table.values("filename")
    inside = np.array([_stays_inside(name) for name in names], bool)
    table.check(inside, "filename", names, "a relative path without '..'; this one is outside the dataset folder")
    parts["data_filenames"] = np.array([name.encode() for name in names])
    return data_samples, np.array(table.values("is_key_frame", bool), bool)


def _stays_inside(name: str) -> bool:
    unsafe = not name or name[0] in "/\\" or "\\" in name or "\0" in name or ":" in name[:3]
    return not unsafe and ".." not in name.split("/")


def _frame_columns(samples: Table, data_samples: Array, data_key: Array, parts: dict[str, Array]) -> None:
    """Key-frame files by channel, and the time and pose that define ego(t)."""
    key_data = np.full((len(samples), len(CHANNELS)), -1, np.int32)
    channels = parts["data_channels"]
    keys = np.flatnonzero(data_key & (channels >= 0))
    key_data[data_samples[keys], channels[keys]] = keys
    parts["key_data"] = key_data

    reference = key_data[:, CHANNELS.index(REFERENCE_CHANNEL)]
    known = reference >= 0
    sample_times, pose_times = parts["sample_times_us"], parts["pose_times_us"]
    after = np.searchsorted(pose_times, sample_times).clip(1, max(1, len(pose_times) - 1))
    after = np.minimum(after, len(pose_times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(pose_times[before] - sample_times) <= np.abs(pose_times[after] - sample_times)
    closest = np.where(nearer, before, after)
    if not known.all():
        _log.warning(
            "%d samples have no %s key frame; their frame is the ego pose closest in time (first: %s)",
            int((~known).sum()), REFERENCE_CHANNEL, samples.tokens[int(np.argmin(known))],
        )  # fmt: skip
    parts["frame_times_us"] = np.where(known, parts["data_times_us"][reference], sample_times)
    parts["frame_poses"] = np.where(known, parts["data_poses"][reference], closest).astype(np.int32)
    frame_times, scenes = parts["frame_times_us"], parts["sample_scenes"]
    order = np.lexsort((sample_times, scenes))
    advances = np.ones(len(samples), bool)
    advances[order[1:]] = (np.diff(frame_times[order]) > 0) | (np.diff(scenes[order]) > 0)
    expected = f"a {REFERENCE_CHANNEL} key frame that is later than the one of the scene's sample before"
    samples.check(advances, "timestamp", frame_times, expected)


def _box_columns(folder: Path, samples: Table, table: Table, instances: Table, parts: dict[str, Array]) -> None:
    """Annotations of the 12 classes and bicycle racks, with the devkit's finite-difference velocity."""
    categories, attributes = Table(folder / "category.json"), Table(folder / "attribute.json")
    sample_rows = table.links("sample_token", samples)
    instance_rows = table.links("instance_token", instances)
    table.links("visibility_token", Table(folder / "visibility.json"), optional=True)
    labels = _category_labels(categories)[instances.links("category_token", categories)[instance_rows]]

    centers = table.vectors("translation", 3, finite=False)
    sizes = table.vectors("size", 3, finite=False)
    attribute_ids = _box_attributes(table, attributes, labels >= 0)
    points = _box_points(table)
    velocities = _box_velocities(table, instance_rows, 1e-6 * parts["sample_times_us"][sample_rows], centers)
    rotations = table.rotations()

    sound = _is_place(centers) & ((sizes > 0) & (sizes <= MAX_BOX_SIZE_M)).all(axis=1)
    if not sound.all():
        _log.warning(
            "%s: %d annotations without a centre on Earth or a size above 0 and below a kilometre are left out "
            "(first: %s)",
            table.path, int((~sound).sum()), table.tokens[int(np.argmin(sound))],
        )  # fmt: skip
    kept = np.flatnonzero((labels != LABEL_IGNORED) & sound)
    kept = kept[np.argsort(sample_rows[kept], kind="stable")]
    parts["box_starts"] = np.searchsorted(sample_rows[kept], np.arange(len(samples) + 1))
    columns = {"labels": labels, "centers": centers, "sizes": sizes, "rotations": rotations}
    columns |= {"velocities": velocities, "attributes": attribute_ids, "points": points.astype(np.int32)}
    columns["instances"] = instance_rows.astype(np.int32)
    parts |= {f"box_{name}": column[kept] for name, column in columns.items()}


def _is_place(
    centers: Array,  # [n, 3] m
) -> Array:  # [n] bool
    return (np.abs(centers) <= LARGEST).all(axis=1)  # False for NaN too


def _box_points(table: Table) -> Array:  # [n] int64
    """Lidar and radar returns; -1 stands for unknown."""
    total = np.zeros(len(table), np.int64)
    for field in ("num_lidar_pts", "num_radar_pts"):
        counts = table.integers(field)
        expected = f"a number of points, at most {MAX_POINTS_OF_BOX}"
        table.check((counts >= -1) & (counts <= MAX_POINTS_OF_BOX), field, counts, expected)
        total += counts
    return total


def _category_labels(categories: Table) -> Array:  # [n] int8
    names = categories.values("name")
    known = np.array([name in CATEGORY_TO_CLASS or name in IGNORED_CATEGORIES for name in names], bool)
    categories.check(known, "name", names, "one of the 27 TruckScenes categories")
    ids = [LABEL_RACK if name == BICYCLE_RACK else LABEL_IGNORED for name in names]
    for row, name in enumerate(names):
        if name in CATEGORY_TO_CLASS:
            ids[row] = CLASSES.index(CATEGORY_TO_CLASS[name])
    return np.array(ids, np.int8)


def _box_attributes(table: Table, attributes: Table, evaluated: Array) -> Array:  # [n] int8
    """Attribute of each box of the 12 classes; two or more are refused, as by the official evaluation."""
    lists = table.values("attribute_tokens", list)
    counts = np.array([len(tokens) for tokens in lists], np.int64)
    table.check((counts <= 1) | ~evaluated, "attribute_tokens", lists, "at most one attribute")
    names = attributes.values("name")
    known = np.array([name in ATTRIBUTES for name in names], bool)
    attributes.check(known, "name", names, f"one of {list(ATTRIBUTES)}")
    ids = np.array([*(ATTRIBUTES.index(name) for name in names), -1], np.int8)
    first = [tokens[0] if tokens else "" for tokens in lists]
    table.check(np.array([type(token) is str for token in first], bool), "attribute_tokens", lists, "a list of tokens")
    return ids[table.lookup(first, "attribute_tokens", attributes, optional=True)]


def _box_velocities(
    table: Table,
    instance_rows: Array,  # [n]
    times_s: Array,  # [n] of the samples
    centers: Array,  # [n, 3] m
) -> Array:  # [n, 3] m/s
    """Difference from the previous to the next annotation of the instance, one-sided at the ends (devkit rule)."""
    rows = np.arange(len(table))
    ends = []
    for field, sign in (("prev", 1), ("next", -1)):
        links = table.chain(field, sign * times_s, instance_rows, "instance")
        ends.append(np.where(links >= 0, links, rows))
    first, last = ends
    elapsed = times_s[last] - times_s[first]
    limit = MAX_SPEED_INTERVAL_S * np.where((first != rows) & (last != rows), 2, 1)
    unknown = (elapsed <= 0) | (elapsed > limit)
    known = np.where(_is_place(centers)[:, None], centers, np.nan)
    velocities = (known[last] - known[first]) / np.where(unknown, 1.0, elapsed)[:, None]
    velocities[unknown | (np.abs(velocities) > MAX_BOX_SPEED_MPS).any(axis=1)] = np.nan
    return velocities
