"""Runs as `src.train` leaves them, results and records of sweeps, made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from src.report.metric_names import RANGES, SPEEDS
from src.report.results import RunResult, publish_result, result_path
from src.report.sweep_file import PaperRowConfig, RowConfig, SweepConfig, TableConfig
from src.report.sweep_record import RunState, SweepRecord

CLASSES = ("car", "truck")


@pytest.fixture
def write_run(tmp_path: Path) -> Callable[..., Path]:
    """Writes the folder of one finished run; every score is `value`, with `speeds` also by speed class."""

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
        source: str | None = None,  # id of the run that it was told to start from
    ) -> Path:
        folder = tmp_path / f"horizon3d-{phase}-{scale}-{name}"
        folder.mkdir(parents=True)
        told = {"init_from": source} if source else {}
        overrides = [*overrides, *(f"phase.{key}={value}" for key, value in told.items())]
        record = {
            "run_id": folder.name, "overrides": overrides, "scale": scale, "seed": seed, "commit": "0123456789abcdef",
            "data": {"name": "synthetic highway", "version": "v1.2-trainval", "train_split": "train", "split": "val",
                     "root": root},
            "initialized_from": None, "epochs": epochs, "steps": 10, "parameters": 2_500_000, "resumed": False,
            "seconds": {"fit": 10.0, "all": 12.0}, "peak_memory_mib": {"process": 900, "largest_worker": 100},
            "skipped_files": {}, "device": "cpu", "processes": 1, "threads": 1, "versions": {"torch": "2"},
        }  # fmt: skip
        classes = {c: {"AP": value, "AVE": 2 - value, "num_gt": 10} for c in CLASSES}
        metrics = {
            "mAP": value, "NDS": value, "mAVE": 2 - value, "classes": classes,
            "ranges": {r: {"mAP": value, "NDS": value, "classes": classes} for r in RANGES},
            "tags": {"weather.rain": {"mAP": value}},
        }  # fmt: skip
        if speeds:
            part = {"mAP_present": value, "mAVE_present": 2 - value, "classes": classes | {
                "car": {"AP": value, "AVE": 2 - value, "num_gt": 3}}}  # fmt: skip
            metrics["speeds"] = {s: part for s in SPEEDS}
        model = {
            "name": "horizon3d", "ocsf": {"margin_m": 4.8}, "doppler": {"in_losses": False, "along_heading": True}
        }  # fmt: skip
        config = {"model": model, "phase": {"name": phase} | told, "seed": seed,
                  "data": {"root": str(tmp_path), "version": "v1.2-trainval"},
                  "backbone": {"file": f"{tmp_path}/r50.pth"},
                  "paths": {"outputs": str(tmp_path)}, "out": None}  # fmt: skip
        curves = "step,epoch,loss/total,val/mAP,lr\n4,0,5.5,,0.1\n4,0,,0.1,\n9,1,4.5,,0.1\n9,1,,0.2,\n"
        (folder / "run.json").write_text(json.dumps(record))
        (folder / "metrics.json").write_text(json.dumps(metrics))
        (folder / "config.yaml").write_text(yaml.safe_dump(config))
        (folder / "metrics.csv").write_text(curves)
        return folder

    return write


@pytest.fixture
def publish_all(tmp_path: Path) -> Callable[[], None]:
    """Publishes every run under `tmp_path` to `tmp_path / "reports"`."""

    def publish() -> None:
        for record in sorted(tmp_path.glob("*/run.json")):
            publish_result(record.parent, tmp_path / "reports")

    return publish


@pytest.fixture
def make_result() -> Callable[..., RunResult]:
    """One result with these metrics, as `src.report.results` reads it; `changes` are other fields."""

    def make(run_id: str, metrics: dict[str, float | None], seed: int = 0, **changes: Any) -> RunResult:
        fields: dict[str, Any] = {
            "run_id": run_id, "model": "horizon3d", "phase": "phase1", "scale": "mini", "seed": seed, "overrides": [],
            "data": {"name": "synthetic highway", "root": "world", "split": "val"}, "commit": "0123456789abcdef",
            "versions": {}, "device": "cpu", "processes": 1, "threads": 2, "initialized_from": None, "epochs": 6,
            "steps": 10, "parameters": 2_500_000, "resumed": False, "seconds": {"all": 12.0},
            "peak_memory_mib": {"process": 900}, "skipped_files": {}, "config": {}, "metrics": metrics, "curves": {},
            "latency": None,
        }  # fmt: skip
        return RunResult(**(fields | changes))

    return make


@pytest.fixture
def write_result(tmp_path: Path) -> Callable[[RunResult], Path]:
    """Writes a result under `tmp_path / "reports"`, with the metrics that the tables of a page need."""

    def write(result: RunResult) -> Path:
        metrics = {"mAP": 0.3, "NDS": 0.3, "mAVE": 1.0, "classes": {"car": {"AP": 0.3}}, "ranges": {}}
        metrics |= {name: value for name, value in result.metrics.items() if "." not in name}
        path = result_path(tmp_path / "reports", result.run_id)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"format": 1} | vars(result) | {"metrics": metrics}))
        return path

    return write


@pytest.fixture
def make_record() -> Callable[..., SweepRecord]:
    """The record of a sweep: `rows` is paper numbers by label; run ids are `horizon3d-phase1-<scale>-<row><seed>`.

    `states` are those that are not done, by run id's end (`b1` is the second row's second seed), each a RunState's
    changed fields.
    """

    def make(
        rows: dict[str, dict[str, float]],
        seeds: int = 3,
        columns: tuple[str, ...] = ("mAP", "NDS"),
        baseline: str | None = None,
        states: dict[str, dict[str, Any]] | None = None,
        paper_rows: dict[str, dict[str, float]] | None = None,
        scale: str = "mini",
        name: str = "epsilon",
    ) -> SweepRecord:
        sweep = SweepConfig(
            title="Margin", question="How far?", name=name, baseline=baseline,
            tables=[TableConfig(name=f"table_{name}", title="Margin", columns=list(columns))],
            rows=[RowConfig(label=label, overrides=[f"x={label}"], paper=paper, x=float(place))
                  for place, (label, paper) in enumerate(rows.items())],
            paper_rows=[PaperRowConfig(label=label, paper=paper) for label, paper in (paper_rows or {}).items()],
        )  # fmt: skip
        planned, runs = {}, {}
        for place, label in enumerate(rows):
            for seed in range(seeds):
                end = f"{chr(97 + place)}{seed}"
                run_id = f"horizon3d-phase1-{scale}-{end}"
                planned.setdefault(label, {})[seed] = run_id
                state = {"state": "done"} | (states or {}).get(end, {})
                runs[run_id] = RunState(run_id=run_id, overrides=[f"x={label}"], seed=seed, label=label, **state)
        return SweepRecord(
            sweep=sweep, scale=scale, command="python -m src.sweep", seeds=list(range(seeds)), rows=planned, runs=runs,
            study="s", storage="sqlite",
        )  # fmt: skip

    return make
