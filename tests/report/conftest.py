"""Runs as `src.train` leaves them, results and records of sweeps, made up."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from src.report.metric_names import SPEEDS
from src.report.results import RunResult, publish_result, result_path
from src.report.sweep_file import PaperRowConfig, RowConfig, SweepConfig, TableConfig
from src.report.sweep_record import RunState, SweepRecord
from tests import finished_runs


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
        run_id, told = f"horizon3d-{phase}-{scale}-{name}", {"init_from": source} if source else {}
        record = finished_runs.run_json(
            run_id, seed, root, scale=scale, epochs=epochs,
            overrides=[*overrides, *(f"phase.{key}={value}" for key, value in told.items())],
        )  # fmt: skip
        metrics = finished_runs.metrics_json(value, speeds=SPEEDS if speeds else ())
        model = {
            "name": "horizon3d", "ocsf": {"margin_m": 4.8}, "doppler": {"in_losses": False, "along_heading": True}
        }  # fmt: skip
        config = {"model": model, "phase": {"name": phase} | told, "seed": seed,
                  "data": {"root": str(tmp_path), "version": "v1.2-trainval"},
                  "backbone": {"file": f"{tmp_path}/r50.pth"},
                  "paths": {"outputs": str(tmp_path)}, "out": None}  # fmt: skip
        return finished_runs.write_run(tmp_path / run_id, record, metrics, config)

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

    return finished_runs.result


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
