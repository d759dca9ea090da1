"""The linked tables kept on disk, so that only the first start reads the JSON."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import zipfile
from dataclasses import fields
from pathlib import Path

import numpy as np

from src.data.schema import TABLES, DatasetIndex, build_index, version_folder

FORMAT = 3  # raise it when DatasetIndex or a check changes: older caches are then built again

_log = logging.getLogger(__name__)
_PLAIN = ("root", "version", "annotated")


def load_index(root: str | Path, version: str, cache_folder: str | Path | None) -> DatasetIndex:
    """The checked tables of `root/version`, from the cache where the table files have not changed.

    A cache that cannot be read is built again, one that cannot be written is done without; the log says so.
    Raises DataError as `build_index`.
    """
    root = Path(root).absolute()
    folder = version_folder(root, version)
    if cache_folder is None:
        return build_index(root, version)
    path = Path(cache_folder) / f"tables-{version}-{_digest(folder)}.npz"
    if path.is_file():
        try:
            return _read(path, root, version)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            _log.warning("%s: the table cache is broken (%s); building it again", path, error)
    index = build_index(root, version)
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
    with np.load(path, allow_pickle=False) as arrays:
        columns = {f.name: arrays[f.name] for f in fields(DatasetIndex) if f.name not in _PLAIN}
        return DatasetIndex(root=root, version=version, annotated=bool(arrays["annotated"]), **columns)


def _write(path: Path, index: DatasetIndex) -> None:
    """Write beside the target and rename, so that two starts at once and a full disk leave no half file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    columns = {f.name: getattr(index, f.name) for f in fields(index) if f.name not in _PLAIN}
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.stem, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, annotated=np.array(index.annotated), **columns)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
