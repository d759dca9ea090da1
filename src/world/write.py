"""A whole world on disk in the TruckScenes layout: made once, complete or not at all."""

from __future__ import annotations

import fcntl
import json
import logging
import multiprocessing
import os
import shutil
import uuid
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

from tqdm import tqdm

from src.data.schema import TABLES
from src.data.true_geometry import TRUTH_FOLDER
from src.errors import ConfigError, DataError
from src.structures.taxonomy import CAMERAS, LIDARS, RADARS, REFERENCE_CHANNEL
from src.world.rig import sensor_rig
from src.world.scene_writer import write_scene
from src.world.table_rows import Tables, shared_tables
from src.world.world_config import WorldConfig, stored_config

logger = logging.getLogger(__name__)

VERSION = "v1.2-trainval"
CONFIG_FILE = "world.json"
SPLITS_FILE = "splits.json"
PARTIAL, LOCK_FILE = "partial", ".lock"
"""Of the name of a folder that is being filled, and the file in it that its writer has locked."""


def ensure_world(config: WorldConfig, root: Path, progress: bool = True) -> Path:
    """The world of this config at `root`, written now unless it is there already.

    Everything goes into a hidden folder beside `root` that is renamed at the end, so an interrupted run leaves no
    `root`; while another process writes it, it is waited for. The bytes depend on the config alone, not on
    `num_workers`. Raises ConfigError if the world at `root` has another config, DataError if `root` holds something
    else or half of a world, or cannot be written.
    """
    root = Path(root)
    if not _is_there(root):
        _wait_for_others(root)
    if _is_there(root):
        _check_stored(config, root)
        return root
    partial_root = root.parent / f".{root.name}.{PARTIAL}-{uuid.uuid4().hex[:8]}"
    try:
        partial_root.mkdir(parents=True)
        with open(partial_root / LOCK_FILE, "w") as lock:  # until it is moved: who gets the lock removes what lies here
            fcntl.flock(lock, fcntl.LOCK_EX)
            _fill(config, partial_root, progress)
            _move(config, partial_root, root)
    except OSError as error:
        raise DataError(
            f"{root}: the world could not be written ({error.strerror or error}); make room, or choose another "
            "data.root or paths.outputs"
        ) from error
    finally:
        shutil.rmtree(partial_root, ignore_errors=True)
    return root


def _move(config: WorldConfig, partial_root: Path, root: Path) -> None:
    """Give the finished world its name, unless another process has finished the same one."""
    try:
        os.replace(partial_root, root)
    except OSError as error:
        if not root.exists():
            raise DataError(f"{root}: the finished world could not be moved here: {error}") from error
        _check_stored(config, root)
    else:
        (root / LOCK_FILE).unlink(missing_ok=True)


def _is_there(root: Path) -> bool:
    """Whether anything is; an empty folder is nothing."""
    return root.exists() and (not root.is_dir() or any(root.iterdir()))


def _wait_for_others(root: Path) -> None:
    """Wait while other processes write this world; what killed ones have left of it is removed."""
    for other in root.parent.glob(f".{root.name}.{PARTIAL}-*"):
        try:
            lock = open(other / LOCK_FILE)
        except OSError:  # it is not locked yet, or has been moved away by now
            continue
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                logger.info("another process is writing the world %s; waiting for it", root)
                fcntl.flock(lock, fcntl.LOCK_EX)
            shutil.rmtree(other, ignore_errors=True)  # of whoever ended without moving it away


def _check_stored(config: WorldConfig, root: Path) -> None:
    """Refuse what lies at `root` unless it is the whole world of this config."""
    stored = _read_stored(root)
    wanted = json.loads(json.dumps(stored_config(config)))
    if stored != wanted:
        differing = sorted(k for k in stored.keys() | wanted.keys() if stored.get(k) != wanted.get(k))
        pairs = ", ".join(f"{k}: stored {stored.get(k)!r}, asked {wanted.get(k)!r}" for k in differing)
        raise ConfigError(f"{root} holds a world of another config ({pairs}); choose another folder or remove this one")


def _read_stored(root: Path) -> dict[str, object]:
    try:
        stored = json.loads((root / CONFIG_FILE).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise DataError(
            f"{root}: not a complete synthetic world: it has no {CONFIG_FILE}; for recorded data give data=truckscenes "
            "(or data.world=null), for a new world a folder that does not exist yet"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(
            f"{root}: not a complete synthetic world ({CONFIG_FILE}: {error}); remove the folder or choose another"
        ) from error
    if not isinstance(stored, dict):
        raise DataError(
            f"{root / CONFIG_FILE}: expected an object, but found {type(stored).__name__}; remove the folder"
        )
    files = [*(f"{VERSION}/{name}.json" for name in TABLES), SPLITS_FILE]
    missing = [name for name in files if not (root / name).is_file()]
    if missing:
        raise DataError(f"{root}: a synthetic world without {', '.join(missing)}; remove the folder to make it again")
    return stored


def _fill(config: WorldConfig, folder: Path, progress: bool) -> None:
    """Write every file of the world below `folder`; the config comes last."""
    for channel in (*CAMERAS, *RADARS, *(LIDARS if config.lidar else (REFERENCE_CHANNEL,))):
        (folder / "samples" / channel).mkdir(parents=True)
        if channel not in LIDARS or (config.lidar and config.lidar_sweeps_per_key_frame > 1):
            (folder / "sweeps" / channel).mkdir(parents=True)
    if config.lidar:
        (folder / TRUTH_FOLDER).mkdir()
    tables: Tables = {name: [] for name in TABLES} | shared_tables(config.seed, sensor_rig(config))
    names = []
    bar = tqdm(total=config.num_scenes, desc="writing the synthetic world", unit="scene", disable=not progress)
    with bar:
        for rows in _scenes(config, folder):
            for name, more in rows.items():
                tables[name].extend(more)
            names.append(str(rows["scene"][0]["name"]))
            bar.update()
    (folder / VERSION).mkdir()
    for name, table in tables.items():
        (folder / VERSION / f"{name}.json").write_text(json.dumps(table, separators=(",", ":")), encoding="utf-8")
    splits = {"train": names[: config.num_train_scenes], "val": names[config.num_train_scenes :]}
    (folder / SPLITS_FILE).write_text(json.dumps(splits, indent=1), encoding="utf-8")
    (folder / CONFIG_FILE).write_text(json.dumps(stored_config(config), indent=1), encoding="utf-8")


def _scenes(config: WorldConfig, folder: Path) -> Iterator[Tables]:
    """Rows of all scenes in order, written by `num_workers` processes.

    Raises DataError when one of them is killed.
    """
    work = partial(write_scene, config, folder=folder)
    workers = min(config.num_workers, config.num_scenes)
    if workers < 2:
        yield from map(work, range(config.num_scenes))
        return
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield from pool.map(work, range(config.num_scenes))
    except BrokenProcessPool as error:
        raise DataError(
            f"{folder}: a process that writes the world was killed, as Linux does where memory is short; give the "
            f"command again, with fewer than data.world.num_workers={workers}"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)
