"""What lies in the run folders of paths.outputs: pictures, logs, learning curves so far. Reads, never writes.

Names that come from an address are looked up among what a folder lists, never joined to a path unchecked, and a link
that leads out of its folder counts as missing.
"""

from __future__ import annotations

import csv
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from PIL import Image

from src.report.plain_yaml import load_plain_yaml
from src.report.results import is_finished, without_local_paths
from src.report.run_curves import Point, read_curves

TAIL_BYTES = 24_000
CONFIG_BYTES = 1_000_000
"""A larger config.yaml is not a run's."""
ALIVE_S = 300.0
"""A run folder without a result counts as running as long as something was written in it this recently."""

FRAME_KINDS = {
    "frame": "Cameras and bird's-eye view",
    "memory": "Memory",
    "film": "Forecast and true points, moment by moment",
    "forecast": "Forecast and true points",
    "occupancy": "Occupancy above the ground",
}
"""Pictures of a sample, in the order of pages; their names carry its number and the beginning of its token."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A PNG of a run."""

    run_id: str
    name: str
    path: Path
    width: int
    height: int

    @property
    def title(self) -> str:
        """What it shows, by its name: frames carry the beginning of their sample's token."""
        kind, _, rest = self.path.stem.partition("_")
        known = FRAME_KINDS | {"curves": "Learning curves", "horizons": "Scores over time and distance"}
        words = known.get(kind, self.path.stem.replace("_", " ").capitalize())
        return f"{words}, sample {rest.partition('_')[2]}" if kind in FRAME_KINDS and rest else words

    @property
    def order(self) -> tuple[int, str]:
        """Frames first, charts (which pages draw themselves) last."""
        kinds = list(FRAME_KINDS)
        return kinds.index(self.kind) if self.kind in kinds else len(kinds), self.name

    @property
    def kind(self) -> str:
        """`frame`, `memory`, `curves`, `scores`, ..."""
        return self.path.stem.partition("_")[0]


class RunFolders:
    """The folders of runs under one outputs folder; everything is empty where there is no such folder."""

    def __init__(self, outputs: Path | None) -> None:
        self.outputs = outputs.resolve() if outputs is not None and outputs.is_dir() else None

    def names(self) -> list[str]:
        """Run ids with a folder, without those a restart moved aside."""
        if self.outputs is None:
            return []
        return sorted(name for name in os.listdir(self.outputs) if _is_run(name) and self._has_config(name))

    def find(self, run_id: str) -> Path | None:
        """The folder of a run that there is."""
        if self.outputs is None or not _is_run(run_id):
            return None
        folder = self.outputs / run_id
        return folder if self._has_config(run_id) and folder.resolve().parent == self.outputs else None

    def pictures(self, run_id: str) -> list[Picture]:
        """Whole PNG files of a run, frames first; a file still being written is left out."""
        folder = self.find(run_id)
        if folder is None or not (folder / "pictures").is_dir():
            return []
        found = []
        for path in (folder / "pictures").glob("*.png"):
            inside = _NAME.fullmatch(path.name) and path.is_file() and path.resolve().is_relative_to(folder)
            size = _png_size(path) if inside else None
            if size is not None:
                found.append(Picture(run_id=run_id, name=path.name, path=path, width=size[0], height=size[1]))
        return sorted(found, key=lambda picture: picture.order)

    def picture(self, run_id: str, name: str) -> Picture | None:
        """One picture by the name its folder lists."""
        return next((picture for picture in self.pictures(run_id) if picture.name == name), None)

    def log_tail(self, relative: str) -> str | None:
        """The end of a text file inside outputs; None where it is not inside, or not there."""
        path = self._inside(relative)
        if path is None:
            return None
        try:
            with path.open("rb") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(max(0, size - TAIL_BYTES))
                text = file.read().decode(errors="replace")
        except OSError:
            return None
        if size > TAIL_BYTES:
            text = f"[the last lines of {size // 1000} kB]\n{text.partition(chr(10))[2]}"
        for place in (f"{self.outputs}/", f"{Path.cwd()}/"):  # an exported file must not show local paths
            text = text.replace(place, "")
        # A progress bar rewrites its line: what stands after the last carriage return is what a terminal shows.
        return "\n".join(line.rstrip("\r").rpartition("\r")[2] for line in text.split("\n")).strip()

    def curves(self, run_id: str) -> dict[str, list[Point]]:
        """Losses and scores so far, from metrics.csv; empty if unreadable."""
        path = self._file_of(run_id, "metrics.csv")
        try:
            return read_curves(path, live=True) if path is not None else {}
        except (OSError, csv.Error, UnicodeDecodeError):
            return {}

    def config(self, run_id: str) -> dict[str, Any]:
        """The configuration of a run that has no result yet, without what concerns the machine; empty if unreadable."""
        path = self._file_of(run_id, "config.yaml")
        if path is None or path.stat().st_size > CONFIG_BYTES:
            return {}
        try:
            tree = load_plain_yaml(path.read_text())
        except (OSError, ValueError, yaml.YAMLError):
            return {}
        return without_local_paths(tree) if isinstance(tree, dict) else {}

    def written(self, run_id: str, log: str | None = None) -> float | None:
        """When a run last wrote numbers, a checkpoint or a line of a log; seconds since 1970, None without a trace."""
        folder = self.find(run_id)
        names = ("log.txt", "metrics.csv", "checkpoints", "config.yaml")
        paths = [folder / name for name in names] if folder is not None else []
        paths += [path] if log and (path := self._inside(log)) else []
        times = []
        for path in paths:
            try:
                times.append(path.stat().st_mtime)
            except OSError:
                continue
        return max(times, default=None)

    def has_result(self, run_id: str) -> bool:
        """Whether the run has ended with numbers."""
        folder = self.find(run_id)
        return folder is not None and is_finished(folder)

    def _has_config(self, run_id: str) -> bool:
        return (self.outputs / run_id / "config.yaml").is_file()

    def _inside(self, relative: str) -> Path | None:
        """A log file that lies inside outputs, whether or not it is there."""
        if self.outputs is None:
            return None
        path = (self.outputs / relative).resolve()
        if not path.is_relative_to(self.outputs) or path.suffix not in (".txt", ".log"):
            return None
        return path if path.is_file() or not path.exists() else None  # reading a pipe would wait for ever

    def _file_of(self, run_id: str, name: str) -> Path | None:
        """A file of a run's folder, where it is one and lies in there."""
        folder = self.find(run_id)
        path = (folder / name).resolve() if folder is not None else None
        return path if path is not None and path.is_file() and path.is_relative_to(folder) else None


def _is_run(name: str) -> bool:
    """Whether a name is a run id, `<model>-<phase>-<scale>-<8 hex>`; a restart sets `<run_id>.before-<time>` aside."""
    return bool(_NAME.fullmatch(name)) and name.count("-") >= 3 and ".before-" not in name


def _png_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a whole PNG; None for anything else. Checksums are checked, nothing is decoded."""
    try:
        with Image.open(path, formats=("PNG",)) as image:
            image.verify()
            return image.size
    except Exception:  # Pillow's parsers of damaged files fail in many ways
        return None
