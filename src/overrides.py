"""Overrides as they stand after a command, `key=value`: what each sets, and which say nothing of what a run is."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterable
from typing import Any

OUTSIDE_IDENTITY = (
    "paths",
    "logger",
    "trainer",
    "resume",
    "checkpoint",
    "predictions",
    "out",
    "scene",
    "preview",
    "suite",
    "phase.train_missing",
    "data.num_workers",
    "data.root",
    "data.world.num_workers",
)
"""Keys that cannot change the result of a run: where and how it computes, and what other commands are told.

They are left out of its identity, of its result, and of what a sweep notes of it.
"""


def key_of(override: str) -> str:
    """The dotted key that an override sets."""
    return override.lstrip("+").partition("=")[0]


def is_of(override: str, keys: Iterable[str]) -> bool:
    """Whether an override sets one of these keys or something below it."""
    name = key_of(override)
    return any(name == key or name.startswith(f"{key}.") for key in keys)


def digest_of(changes: list[str]) -> str:
    """8 hex that tell sets of overrides apart, in whatever order they are given."""
    return hashlib.sha256(json.dumps(sorted(changes)).encode()).hexdigest()[:8]


def without_keys(tree: dict[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """A copy of a configuration without these dotted keys, where it has them."""
    tree = copy.deepcopy(tree)
    for key in keys:
        *parents, leaf = key.split(".")
        node: Any = tree
        for parent in parents:
            node = node.get(parent) if isinstance(node, dict) else None
        if isinstance(node, dict):
            node.pop(leaf, None)
    return tree
