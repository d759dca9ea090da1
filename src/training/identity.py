"""What tells runs, and results of one checkpoint, apart: digests of all that can change them."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from src.overrides import OUTSIDE_IDENTITY, digest_of, is_of, without_keys


def digest_of_changes(overrides: list[str]) -> str:
    """`-` and 8 hex that tell apart results of one checkpoint by what the command line changes; empty for no change.

    What only says where from, where to and on what machine does not count.
    """
    besides = ("checkpoint", "predictions", "out", "scene", "paths", "trainer", "logger", "data.num_workers")
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
        for key in ("groups_per_scene", "lane_sets", "silent_frames"):
            tree["data"].pop(key)
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:8]
    return f"{tree['model']['name']}-{tree['phase']['name']}-{tree['scale']}-{digest}"
