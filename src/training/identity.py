"""What identifies a run: its overrides, `key=value`, and digests of all that can change a result (no torch here)."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import re
import shlex
from collections.abc import Iterable
from decimal import Decimal
from typing import Any

OF_A_CALL = ("paths", "resume", "checkpoint", "predictions", "out", "scene", "preview", "compare", "suite", "oracle")
"""Keys of one call of a command: where it reads and writes, how it begins, and options of other commands."""

OUTSIDE_IDENTITY = (
    *OF_A_CALL,
    "logger",
    "trainer",
    "phase.train_missing",
    "data.num_workers",
    "data.root",
    "data.world.num_workers",
)
"""Keys that cannot change the result of a run: where and how it computes, and options of other commands.

They are left out of its identity, of its result, and of what a sweep records of it.
"""


TEMPORAL_DATA_KEYS = ("groups_per_scene", "stream_sets", "past_frames", "past_window_s", "sensor_dropout")
"""Keys of `data` that change nothing in a phase without memory."""

LEGACY_DEFAULTS = {
    "data.timeline": None,
    "data.train_scenes": None,
    "data.past_window_s": None,
    "phase.long_range": None,
    "model.radar_encoder.pruning_ratio": 0.0,
    "model.kggi.num_radar_peaks": 0,
    "model.neck_channels": [],
    "model.doppler.in_losses": True,
    "model.doppler.along_heading": False,
    "model.dptf.gaussian_path.forget_refuted": False,
    "model.loss.ray_range_power": 0.0,
    "model.measured_motion": False,
    "model.neck.finest_scale": 4,
    "model.decoder.num_radar_cells": None,
}
"""Keys that runs were made without, with the value that does what was done then.

At this value a key is no part of an identity, and a checkpoint without the key has it.
"""

GONE_DEFAULTS = {"model.doppler.withheld": 0.0}
"""Keys that older runs have and today's do not, with the value that does what is done now: no part of an identity."""


_NUMBER = re.compile(r"(?<![\w.+-])[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?(?![\w.+-])")
"""A number that is not part of a word, such as a run id."""

RUN_ID = re.compile(r"(?P<model>[a-z0-9_]+)-(?P<phase>[a-z0-9_]+)-(?P<scale>[a-z0-9_]+)-(?P<digest>[0-9a-f]{8})")
"""What `run_identity` returns."""


def key_of(override: str) -> str:
    """The dotted key that an override sets."""
    return override.lstrip("+").partition("=")[0]


def canonical(override: str) -> str:
    """An override with its numbers spelled in one way: `1e-4`, `1.0e-4` and `0.0001` are one setting."""
    key, equals, value = override.partition("=")
    return f"{key}{equals}{_NUMBER.sub(_spelled, value)}"


def _spelled(number: re.Match[str]) -> str:
    value = float(number[0])
    if value.is_integer() and abs(value) < 1e15:
        return str(int(value))
    if abs(value) >= 1e-3:
        return repr(value) if math.isfinite(value) else number[0]
    digits, exponent = f"{Decimal(repr(value)).normalize():E}".split("E")
    return f"{digits if '.' in digits else f'{digits}.0'}e{int(exponent):+d}"  # YAML 1.1 takes no 6e-5 for a number


def train_command(overrides: Iterable[str]) -> str:
    """The command line of a shell that trains with them."""
    return shlex.join(["python", "-m", "src.train", *overrides])


def is_of(override: str, keys: Iterable[str]) -> bool:
    """Whether an override sets one of these keys or something below it."""
    name = key_of(override)
    return any(name == key or name.startswith(f"{key}.") for key in keys)


def digest_of(changes: list[str]) -> str:
    """8 hex digits of a set of overrides, in whatever order they are given."""
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


def leaves(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of a configuration by dotted key, in its order; an empty node has none."""
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def _value_at(tree: dict[str, Any], key: str) -> Any:
    """What stands at a dotted key; None where there is nothing."""
    node: Any = tree
    for name in key.split("."):
        node = node.get(name) if isinstance(node, dict) else None
    return node


def without_legacy_defaults(tree: dict[str, Any]) -> dict[str, Any]:
    """A copy of a configuration without the keys, younger or gone, whose value changes nothing."""
    neutral = LEGACY_DEFAULTS | GONE_DEFAULTS
    return without_keys(tree, [key for key, value in neutral.items() if _value_at(tree, key) == value])


def digest_of_changes(overrides: list[str]) -> str:
    """`-` and 8 hex digits of what the command line changes of a checkpoint's configuration; empty for no change.

    What cannot change a result does not count, but other data and an oracle do.
    """
    besides = set(OUTSIDE_IDENTITY) - {"data.root", "oracle"}
    changes = [change for change in overrides if not is_of(change, besides)]
    return f"-{digest_of(changes)}" if changes else ""


def run_identity(tree: dict[str, Any], source: str | None = None) -> str:
    """`<model>-<phase>-<scale>-<8 hex>`: the hex is a digest of all that can change the result of a run.

    `source` identifies the weights that the run starts from, None for fresh ones.
    """
    tree = without_keys(tree, OUTSIDE_IDENTITY)
    if source is not None:
        tree["phase"]["init_from"] = source
    if not tree["phase"]["temporal"]:
        for key in TEMPORAL_DATA_KEYS:
            tree["data"].pop(key, None)
    tree = without_legacy_defaults(tree)
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:8]
    return f"{tree['model']['name']}-{tree['phase']['name']}-{tree['scale']}-{digest}"
