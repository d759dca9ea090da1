"""Stands for `python -m src.sweep` over fake runs: the real plan, study, runner and record, no torch."""

import ctypes
import json
import logging
import signal
import sys
from collections import Counter
from pathlib import Path

from src.errors import HorizonError
from src.report.sweep_file import DimensionConfig, RowConfig, SweepConfig
from src.sweep.launcher import Launcher
from src.sweep.plan import make_plan, without_published
from src.sweep.record_writer import RecordWriter
from src.sweep.runner import Runner
from src.sweep.search import Search
from src.sweep.sweep_study import SweepStudy, default_storage
from tests.sweep.fake_train import identify

ROOT = Path(__file__).resolve().parents[2]


def make_sweep(rows=None, space=None, **more):
    """A sweep over `rows` = {label: overrides}, or a search over `space`."""
    rows = [RowConfig(label=label, overrides=list(overrides)) for label, overrides in (rows or {}).items()]
    space = {key: DimensionConfig(**dimension) for key, dimension in (space or {}).items()}
    return SweepConfig(name="fake", title="t", question="q", rows=rows, space=space, **more)


def make_runner(
    folder, sweep, seeds=(0,), common=(), workers=1, storage=None, publish=None, results=(), published=False
):
    outputs, reports = Path(folder) / "outputs", Path(folder) / "reports"
    common = [*common, f"paths.outputs={outputs}"]
    plan = without_published(make_plan(sweep, common, list(seeds), identify), results, training=workers > 0)
    definition = {"format": 1, "kind": "search" if sweep.is_search else "rows"}
    study = SweepStudy(outputs, plan.study, storage or default_storage(outputs), definition)
    writer = RecordWriter(plan, study, "the command", outputs, reports, published)
    prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else lambda *_: None
    command = [sys.executable, "-m", "tests.sweep.fake_train"]
    launcher = Launcher(command, study.folder, workers, [], in_child=lambda: prctl(1, signal.SIGTERM))
    parts = (plan, study, writer, launcher, publish or (lambda path: None))
    return Search(*parts, common=common, identify=identify) if sweep.is_search else Runner(*parts)


def trained(folder, what="end"):
    """How often each run began or came to an end, by name."""
    path = Path(folder) / "outputs" / "trained.txt"
    lines = path.read_text().splitlines() if path.exists() else []
    return Counter(line.split()[1] for line in lines if line.startswith(what))


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    what = json.loads(sys.argv[1])
    rows = what.pop("rows", None)
    if what.pop("barrier", False):
        print("ready", flush=True)
        sys.stdin.readline()
    try:
        runner = make_runner(sweep=make_sweep(rows, what.pop("space", None), **what.pop("sweep", {})), **what)
        record = runner.run()
    except HorizonError as error:
        print(error, file=sys.stderr)
        sys.exit(error.exit_code)
    sys.exit(6 if runner.stop.requested else int(record.count("failed") > 0))
