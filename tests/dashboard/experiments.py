"""A reports folder and an outputs folder with finished, failed, running and broken things, made up."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from PIL import Image

from src.dashboard.server import create_app
from src.report.results import publish_result
from src.report.sweep_file import PlotConfig, RowConfig, SweepConfig, TableConfig
from src.report.sweep_record import RunState, SweepRecord, record_path, write_record
from tests import finished_runs

EVIL = "<script>alert(1)</script> | 3.2 m"
"""The label of a row, as unkind as labels get."""
ROWS = {"0.8 m": (0.8, 0.30), EVIL: (3.2, 0.35), "4.8 m": (4.8, 0.40)}


@dataclass
class World:
    """Where it lies, and what is in it."""

    reports: Path
    outputs: Path

    @staticmethod
    def run_id(row: int, seed: int, scale: str = "mini") -> str:
        """Of the sweep epsilon's rows."""
        return f"horizon3d-phase1-{scale}-000000{row}{seed}"


def write_run(outputs: Path, run_id: str, seed: int, value: float, margin: float, pictures: bool = False) -> Path:
    """The folder of a finished run whose every score is `value`."""
    _, phase, scale, _ = run_id.rsplit("-", 3)
    overrides = [f"phase={phase}", f"model.ocsf.margin_m={margin}", f"scale={scale}", f"seed={seed}"]
    record = finished_runs.run_json(run_id, seed, overrides=overrides, scale=scale, epochs=2)
    metrics = finished_runs.metrics_json(value) | {
        "measures": {"moving_AP": value, "moving_boxes": 7, "history_near": None},
        "intervals": {"scenes": 20, "bounds": {"mAP": [value - 0.02, value + 0.03]}},
    }  # fmt: skip
    config = {"model": {"name": "horizon3d", "ocsf": {"margin_m": margin}}, "phase": {"name": phase}, "seed": seed,
              "data": {"root": "/nowhere", "sensor_dropout": None}, "paths": {"outputs": str(outputs)}}  # fmt: skip
    curves = "step,epoch,step/total,loss/total,val/mAP\n2,0,9.5,,\n4,0,,8.5,0.1\n9,1,,4.5,0.2\n"
    folder = finished_runs.write_run(outputs / run_id, record, metrics, config, curves)
    (folder / "log.txt").write_text(f"12:00 INFO run {run_id} in {folder}\nepoch 1\repoch 2\n12:01 INFO finished\n")
    if pictures:
        (folder / "pictures").mkdir()
        for name in ("frame_0_abc.png", "curves.png"):
            Image.new("RGB", (320, 240), (200, 30, 30)).save(folder / "pictures" / name)
    return folder


def epsilon(scale: str, states: dict[tuple[int, int], RunState] | None = None) -> SweepRecord:
    """The record of a sweep of three rows and two seeds."""
    sweep = SweepConfig(
        name="epsilon", title="Margin", question="How far beyond the boxes?", source="Table 12", baseline="4.8 m",
        tables=[TableConfig(name="table12_epsilon", title="Margin epsilon", columns=["mAP", "mAVE"])],
        plots=[PlotConfig(metric="mAP", label="margin, m")],
        rows=[RowConfig(label=label, x=x, paper={"mAP": 18.0 + x}) for label, (x, _) in ROWS.items()],
    )  # fmt: skip
    rows, runs = {}, {}
    for row, label in enumerate(ROWS):
        for seed in (0, 1):
            run_id = World.run_id(row, seed, scale)
            rows.setdefault(label, {})[seed] = run_id
            done = RunState(
                run_id=run_id, overrides=[], seed=seed, label=label, state="done", started=100.0, ended=160.0
            )
            runs[run_id] = (states or {}).get((row, seed), done)
    return SweepRecord(
        sweep=sweep, scale=scale, command="python -m src.sweep +sweep=epsilon seeds=2", seeds=[0, 1], rows=rows,
        runs=runs, study=f"epsilon_{scale}", storage="sqlite:////somewhere/sweeps.db", updated=time.time(),
    )  # fmt: skip


def build(folder: Path) -> World:
    """One finished sweep with a failed run, one finished run at another scale, and two files that cannot be read."""
    world = World(folder / "reports", folder / "outputs")
    for row, (x, value) in enumerate(ROWS.values()):
        for seed in (0, 1):
            if (row, seed) != (1, 1):
                run = write_run(
                    world.outputs, world.run_id(row, seed), seed, value + 0.02 * seed, x, pictures=seed == 0
                )
                publish_result(run, world.reports)
    publish_result(write_run(world.outputs, world.run_id(0, 0, "debug"), 0, 0.05, 0.8), world.reports)
    log = world.outputs / "sweeps" / "epsilon_mini" / "failed.log"
    log.parent.mkdir(parents=True)
    log.write_text(f"starts in {world.outputs}/x\nDivergedError: loss/total is nan\n")
    failed = RunState(
        run_id=world.run_id(1, 1), overrides=["phase=phase1", "seed=1"], seed=1, label=EVIL, state="failed",
        reason="loss/total is <nan>", log="sweeps/epsilon_mini/failed.log", started=200.0, ended=210.0,
    )  # fmt: skip
    write_record(record_path(world.reports, "epsilon", "mini"), epsilon("mini", {(1, 1): failed}))
    (world.reports / "results" / "horizon3d-phase1-mini-deadbeef.json").write_text('{"format": 1, "run_id": "hor')
    (world.reports / "sweeps" / "old_mini.json").write_text('{"format": 0}')
    (folder / "secret.txt").write_text("secret")
    return world


def serve(world: World) -> Iterator[str]:
    """Run the dashboard on a free port until the generator ends."""
    config = uvicorn.Config(create_app(world.reports, world.outputs), port=0, log_level="error", lifespan="off")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    deadline = time.monotonic() + 20
    while not server.started:
        assert time.monotonic() < deadline, "the server did not start"
        time.sleep(0.02)
    yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    server.should_exit = True
    thread.join(10)
