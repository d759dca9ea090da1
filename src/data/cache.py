"""The linked tables kept on disk, so that only the first start reads the JSON."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import fields
from pathlib import Path

import numpy as np

from src.data.schema import (
    CHANNELS,
    LABEL_RACK,
    MAX_BOX_SPEED_MPS,
    MAX_POINTS_OF_BOX,
    TABLES,
    DatasetIndex,
    build_index,
    version_folder,
)
from src.data.tables import LARGEST, LAST_TIME_US
from src.files.atomic_write import replacing
from src.structures.taxonomy import ATTRIBUTES, CLASSES

FORMAT = 6  # raise it when DatasetIndex or a check changes: older caches are then built again

_log = logging.getLogger(__name__)
_PLAIN = ("root", "version", "annotated")
_OWNERS = {"scene": "scene_names", "sample": "sample_tokens", "frame": "sample_tokens", "key": "sample_tokens",
           "data": "data_times_us", "pose": "pose_times_us", "box": "box_labels", "ego": "ego_from_sensor",
           "intrinsics": "ego_from_sensor"}  # fmt: skip
"""Of the columns by the first word of their names: the column that has as many records."""
_TEXTS = {"scene_names": "U", "scene_descriptions": "U", "sample_tokens": "U", "data_filenames": "S"}
_FLOATS = {
    "ego_from_sensor": (4, 4), "intrinsics": (3, 3), "pose_translations": (3,), "pose_rotations": (4,),
    "box_centers": (3,), "box_sizes": (3,), "box_rotations": (4,), "box_velocities": (3,),
}  # fmt: skip
_MAY_BE_NAN = ("intrinsics", "box_velocities")
_WIDE = {"key_data": (len(CHANNELS),), "data_sizes": (2,)}
"""The other columns hold whole numbers, one of each record but for these."""


def load_index(root: str | Path, version: str, cache_folder: str | Path | None, labels: bool = True) -> DatasetIndex:
    """The checked tables of `root/version`, from the cache where the table files have not changed.

    Without `labels` annotations are not touched.

    A cache that cannot be read is built again, without one that cannot be written it works too; both are logged.
    Raises DataError as `build_index`.
    """
    root = Path(root).absolute()
    folder = version_folder(root, version)
    if cache_folder is None:
        return build_index(root, version, labels)
    kind = "tables" if labels else "unlabelled"
    path = Path(cache_folder) / f"{kind}-{version}-{_digest(folder)}.npz"
    if path.is_file():
        try:
            return _read(path, root, version)
        except Exception as error:  # whatever is wrong with it, the tables hold everything
            _log.warning("%s: the table cache is broken (%s); building it again", path, error)
    index = build_index(root, version, labels)
    try:
        _write(path, index)
    except OSError as error:
        _log.warning("%s: the table cache cannot be written (%s); the next start reads the tables again", path, error)
    return index


def _digest(folder: Path) -> str:
    """Names the state of the tables: folder, file sizes and times, and the cache's format."""
    state = [str(FORMAT), str(folder)]
    for name in TABLES:
        path = folder / f"{name}.json"
        if path.is_file():
            status = path.stat()
            state.append(f"{name}:{status.st_size}:{status.st_mtime_ns}")
    return hashlib.sha256("\n".join(state).encode()).hexdigest()[:16]


def _read(path: Path, root: Path, version: str) -> DatasetIndex:
    """Raises all kinds of exceptions for what is not a whole cache, ValueError where its arrays do not fit."""
    size = path.stat().st_size
    with np.load(path, allow_pickle=False) as arrays:
        if sum(member.file_size for member in arrays.zip.infolist()) > size:
            raise ValueError("its arrays are larger than the file")
        columns = {f.name: arrays[f.name] for f in fields(DatasetIndex) if f.name not in _PLAIN}
        index = DatasetIndex(root=root, version=version, annotated=bool(arrays["annotated"]), **columns)
    _check(index)
    return index


def _check(index: DatasetIndex) -> None:
    """The tables were checked when the cache was written; this is about files that were not written so."""
    for field in fields(DatasetIndex):
        name = field.name
        if name in _PLAIN:
            continue
        column = getattr(index, name)
        count = len(getattr(index, _OWNERS[name.partition("_")[0]]))
        kind = _TEXTS.get(name, "f" if name in _FLOATS else "i")
        shape = (count, *_FLOATS.get(name, _WIDE.get(name, ())))
        if name == "box_starts":
            shape = (len(index.sample_tokens) + 1,)
        if column.shape != shape or column.dtype.kind != kind or not column.dtype.isnative:
            raise ValueError(f"{name} is {list(column.shape)} {column.dtype}, expected {list(shape)} of kind {kind!r}")
        if kind == "f":
            sizes = np.abs(column if name not in _MAY_BE_NAN else np.nan_to_num(column, posinf=np.inf, neginf=-np.inf))
            if not (sizes <= LARGEST).all():  # NaN is not
                raise ValueError(f"{name} holds what is no number of at most {LARGEST:g} in size")
        if kind == "U":
            "".join(column.tolist()).encode()  # ValueError for code points that are none
    files, poses = len(index.data_times_us), len(index.pose_times_us)
    bounds = {
        "sample_scenes": (0, len(index.scene_names)), "data_scenes": (0, len(index.scene_names)),
        "frame_poses": (0, poses), "key_data": (-1, files),
        "data_channels": (-1, len(CHANNELS)), "data_poses": (0, poses), "data_previous": (-1, files),
        "data_calibrations": (0, len(index.ego_from_sensor)), "box_labels": (LABEL_RACK, len(CLASSES)),
        "box_attributes": (-1, len(ATTRIBUTES)), "box_points": (-2, 2 * MAX_POINTS_OF_BOX + 1),
        "box_instances": (0, 2**31),
        **{f"{name}_times_us": (1, LAST_TIME_US) for name in ("frame", "data", "pose")},
    }  # fmt: skip
    for name, (low, high) in bounds.items():
        column = getattr(index, name)
        if column.size and not low <= column.min() <= column.max() < high:
            raise ValueError(f"{name} must hold whole numbers from {low} to {high - 1}")
    if not (index.box_sizes > 0).all() or (np.abs(index.box_velocities) > MAX_BOX_SPEED_MPS).any():
        raise ValueError("box_sizes must be above 0, box_velocities those of things that drive")
    starts = index.box_starts
    if starts[0] != 0 or starts[-1] != len(index.box_labels) or (np.diff(starts) < 0).any():
        raise ValueError("box_starts must ascend from 0 to the number of boxes")


def _write(path: Path, index: DatasetIndex) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {f.name: getattr(index, f.name) for f in fields(index) if f.name not in _PLAIN}
    with replacing(path, "wb") as file:
        np.savez(file, annotated=np.array(index.annotated), **columns)
