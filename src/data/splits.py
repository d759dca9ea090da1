"""Which scenes belong to a split: the data set's own `splits.json`, else the official lists."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from src.data.schema import DatasetIndex
from src.errors import DataError

OFFICIAL_LISTS = Path(__file__).with_name("truckscenes_splits.json")

_SPLITS = TypeAdapter(dict[str, list[str]])
_log = logging.getLogger(__name__)


def split_samples(index: DatasetIndex, split: str) -> np.ndarray:  # [n] int64
    """Sample rows of a split, in table order.

    Raises DataError for a split that does not exist for this release or has no scene in it.
    """
    splits, source = _read_splits(index)
    if split not in splits:
        raise DataError(f"split {split!r}: {source} has the splits {sorted(splits)} for {index.version}")
    names = set(splits[split])
    if not names:
        raise DataError(f"split {split!r} of {source} has no scene; choose another split, or make data that have one")
    found = names.intersection(index.scene_names.tolist())
    if not found:
        raise DataError(
            f"split {split!r}: none of its {len(names)} scenes is in {index.root / index.version}; "
            f"choose another split or unpack the release that holds them"
        )
    if len(found) < len(names):
        _log.warning("split %r: %d of %d scenes are in %s", split, len(found), len(names), index.root / index.version)
    return index.samples_of(found)


def first_scenes(
    index: DatasetIndex,
    samples: np.ndarray,  # [n] int64, ascending
    most: int | None,  # None: all
) -> np.ndarray:  # [m] int64
    """The samples of the first `most` scenes among these, in table order. Raises DataError where there are fewer."""
    if most is None:
        return samples
    scenes = index.sample_scenes[samples]
    names = np.unique(scenes)
    if most > len(names):
        raise DataError(f"data.train_scenes={most}: the split has only {len(names)} scenes; lower it, or null for all")
    return samples[np.isin(scenes, names[:most])]


def _read_splits(index: DatasetIndex) -> tuple[dict[str, list[str]], Path]:
    for folder in (index.root / index.version, index.root):
        path = folder / "splits.json"
        if path.is_file():
            return _checked(path), path
    lists = json.loads(OFFICIAL_LISTS.read_text(encoding="utf-8"))
    # Official splits overlap by name (mini_train is part of train), so the release decides which exist.
    fitting = {name for name, ending in lists["version_ending"].items() if index.version.endswith(f"-{ending}")}
    return {name: scenes for name, scenes in lists["splits"].items() if name in fitting}, OFFICIAL_LISTS


def _checked(path: Path) -> dict[str, list[str]]:
    try:
        return _SPLITS.validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise DataError(
            f'{path}: expected JSON of {{"split": [scene names], ...}} ({reason}); restore or delete it'
        ) from None
