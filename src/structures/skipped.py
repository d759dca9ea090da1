"""Sensor files that could not be read, counted over many frames and reported at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from src.structures.batch import FrameBatch

MAX_NAMES, SHOWN_NAMES = 1000, 10
"""Names kept in a record, and of these on a line; the counts are of all."""


class SkippedFiles:
    """How many of each channel's files were skipped, and which."""

    def __init__(self) -> None:
        self.channels: Counter[str] = Counter()
        self.files: Counter[str] = Counter()  # relative to the data set's root

    def __bool__(self) -> bool:
        return bool(self.channels)

    def add(self, batch: FrameBatch) -> None:
        """Count the skipped files of a batch and of its past."""
        for frame in (batch, *batch.past):
            self.channels.update(frame.skipped)
            self.files.update(frame.bad_files)

    def clear(self) -> None:
        """Forget everything."""
        self.channels.clear()
        self.files.clear()

    def state(self) -> dict[str, dict[str, int]]:
        """The counts as plain values, for a checkpoint."""
        return {"channels": dict(self.channels), "files": dict(self.files)}

    def restore(self, states: Iterable[dict[str, Any]]) -> None:
        """Add the counts of earlier `state` calls, of this rank or of several."""
        for state in states:
            self.channels.update(state["channels"])
            self.files.update(state["files"])

    def names(self) -> list[str]:
        """Up to MAX_NAMES files, in the order of their names."""
        return sorted(self.files)[:MAX_NAMES]

    def text(self) -> str:
        """Counts and first names on one line."""
        counts = ", ".join(f"{count} of {channel}" for channel, count in sorted(self.channels.items()))
        names, more = sorted(self.files)[:SHOWN_NAMES], len(self.files) - SHOWN_NAMES
        listed = f": {', '.join(names)}{f' and {more} more' if more > 0 else ''}" if names else ""
        return f"{counts} ({len(self.files)} unreadable files{listed})"
