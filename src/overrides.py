"""Overrides as they stand after a command, `key=value`: what each sets, and which say nothing of what a run is."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Iterable
from typing import Any

MAX_LEVELS = 30
"""Of a stored configuration, whose readers follow each level with a call of their own; a run's has six."""
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


def fault_of_tree(tree: Any) -> str | None:
    """What a configuration that somebody else stored holds besides plain values, with its place; None for a sound one.

    `${` would be filled in when the tree is read, with environment variables too. A part that stands in two places is
    walked through twice by whoever reads it, so that a few nested ones are more than a machine can hold.
    """
    seen: set[int] = set()
    parts: list[tuple[str, Any]] = [("", tree)]
    while parts:
        where, part = parts.pop()
        if isinstance(part, str):
            if "${" in part:
                return f"{where} is {part!r:.80}, which refers to something else"
        elif isinstance(part, dict | list):
            if where.count(".") >= MAX_LEVELS:
                return f"{where:.80} has more than {MAX_LEVELS} levels"
            if id(part) in seen:
                return f"{where} stands in two places"
            seen.add(id(part))
            items = part.items() if isinstance(part, dict) else enumerate(part)
            for name, value in items:
                if isinstance(part, dict) and not isinstance(name, str):
                    return f"a key of {where or 'it'} is {name!r:.80}, which is not a text"
                parts.append((f"{where}.{name}" if where else str(name), value))
                parts.append((f"the key {where}.{name}", str(name)))
        elif not isinstance(part, (bool, int, float, type(None))):
            return f"{where} is a {type(part).__name__}"
    return None
