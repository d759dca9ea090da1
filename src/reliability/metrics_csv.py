"""metrics.csv: one row per logged step or epoch, continued rather than replaced when a run resumes."""

from __future__ import annotations

import csv
import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.utilities import rank_zero_only

from src.files.atomic_write import replacing
from src.reliability.checkpoints import sync_folder

logger = logging.getLogger(__name__)


class MetricsCSV(Logger):
    """A Lightning logger over one CSV file.

    Lightning's own deletes the file of an earlier start; this one keeps the rows of the `resume_step` steps (counted
    from 0) that the checkpoint has behind it, so the file of an interrupted run equals that of an uninterrupted one. A
    row of a step or epoch that is repeated takes the place of the first.

    Rows that a full or vanished disk refuses end no training: they are written with the first that it takes.
    """

    def __init__(self, path: Path, resume_step: int) -> None:
        super().__init__()
        self._path = path
        self.rows: list[dict[str, str]] = []  # of the file, oldest first, without empty cells
        self._columns: list[str] = ["step", "epoch"]
        self._refused = False
        if path.is_file():
            self._read(resume_step)

    def _read(self, resume_step: int) -> None:
        """The rows to continue; where the file is damaged, those before the damage, with a warning."""
        try:
            with self._path.open(newline="") as file:
                for row in csv.DictReader(file):
                    step = row.get("step") or ""
                    if step.isascii() and step.isdigit() and int(step) < resume_step:
                        cells = {key: value for key, value in row.items() if key and value}
                        for value in cells.values():
                            float(value)  # ValueError where it is no number
                        self._add(cells)
        except (OSError, ValueError, csv.Error) as error:
            kept = f"resuming from the {len(self.rows)} rows before that"
            logger.warning("%s: damaged (%s: %s); %s", self._path, type(error).__name__, error, kept)

    def _add(self, row: dict[str, str]) -> None:
        for number in range(len(self.rows) - 1, -1, -1):
            earlier = self.rows[number]
            if earlier["step"] != row.get("step"):
                break
            if earlier.keys() == row.keys():
                self.rows[number] = row
                return
        self._columns += sorted(key for key in row if key not in self._columns)
        self.rows.append(row)

    @property
    def name(self) -> str:
        """Name in Lightning's bookkeeping."""
        return "metrics_csv"

    @property
    def version(self) -> str:
        """There is one version per run folder."""
        return ""

    def log_hyperparams(self, *args: Any, **kwargs: Any) -> None:
        """Nothing: config.yaml has them."""

    @rank_zero_only
    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Append one row."""
        row = {key: f"{float(value):.8g}" for key, value in metrics.items() if key != "epoch"}
        row["step"] = str(step if step is not None else len(self.rows))
        if "epoch" in metrics:
            row["epoch"] = str(int(metrics["epoch"]))
        self._add(row)
        try:
            self._write_rows()
        except OSError as error:
            if not self._refused:
                logger.warning("%s could not be written (%s); its rows are kept for later", self._path, error.strerror)
            self._refused = True

    def sync(self) -> None:
        """Put the rows onto the disk: no checkpoint shall outlive a power failure without the rows before it."""
        with suppress(OSError), self._path.open("rb") as file:
            os.fsync(file.fileno())
        sync_folder(self._path.parent)

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """At the end, write what the disk has refused so far. Raises OSError when it still does."""
        if status == "success" and self._refused:
            self._write_rows()

    def _write_rows(self) -> None:
        """Put a file with all rows in the place of the one before, so that none is ever cut short."""
        with replacing(self._path, newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(self.rows)
        self._refused = False
