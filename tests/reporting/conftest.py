"""Runs as `src.train` leaves them, made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from src.reporting.tables import RANGES, SPEEDS

CLASSES = ("car", "truck")


@pytest.fixture
def write_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes run.json and metrics.json of one run; every score is `value`, with `speeds` also by speed class."""

    def write(
        name: str,
        overrides: list[str],
        seed: int,
        value: float,
        root: str = "world",
        scale: str = "mini",
        phase: str = "phase1",
        epochs: int = 6,
        speeds: bool = False,
    ) -> Path:
        folder = tmp_path / f"horizon3d-{phase}-{scale}-{name}"
        folder.mkdir(parents=True)
        record = {
            "run_id": folder.name, "overrides": overrides, "scale": scale, "seed": seed, "parameters": 2_500_000,
            "data": {"name": "synthetic highway", "root": root}, "seconds": {"all": 12.0}, "epochs": epochs,
            "peak_memory_mib": {"process": 900},
        }  # fmt: skip
        metrics = {
            "mAP": value, "NDS": value, "mAVE": 2 - value, "classes": {c: {"AP": value} for c in CLASSES},
            "ranges": {r: {"mAP": value} for r in RANGES},
        }  # fmt: skip
        if speeds:
            classes = {c: {"AP": value, "AVE": 2 - value, "num_gt": 10} for c in CLASSES}
            classes["car"]["num_gt"] = 3
            part = {"mAP_present": value, "mAVE_present": 2 - value, "classes": classes}
            metrics["speeds"] = {s: part for s in SPEEDS}
        (folder / "run.json").write_text(json.dumps(record))
        (folder / "metrics.json").write_text(json.dumps(metrics))
        return folder

    return write
