"""A task besides detection, from training to result, sweep, table, page and dashboard; it only counts frames."""

import json
import logging
import shutil

import pytest

from src import train
from src.dashboard.board import BoardReader
from src.dashboard.render import Renderer
from src.report import __main__ as report
from src.report.results import read_result, result_path
from src.sweep import __main__ as sweep
from src.sweep import sweep_files
from src.training.evaluator import Evaluator
from src.training.phases import EVALUATORS

SWEEP = """title: Frames
question: How many frames are there?
task: counting
overrides: [phase=phase1, phase.task=counting, phase.monitor=val/frames]
tables: [{name: frames, title: Frames, columns: [frames, latency.total]}]
plots: [{metric: frames, label: row}]
rows: [{label: as it is}]
"""
OVERRIDES = ["phase=phase1", "phase.task=counting", "phase.monitor=val/frames"]


class FrameCount(Evaluator):
    headline = "frames"
    monitored = ("frames",)

    @classmethod
    def of(cls, datamodule):
        return cls()

    def reset(self):
        self.tokens = []

    def update(self, model, output, batch):
        self.tokens += batch.tokens

    def compute(self):
        return {"frames": float(len(self.tokens)), "per_batch": 2.0}

    def as_dict(self):
        return {**self.compute(), "tokens": dict.fromkeys(self.tokens, 1)}

    @staticmethod
    def describe(metrics):
        return f"{metrics['frames']:.0f} frames counted"


@pytest.fixture
def root_logger():
    """Lets go of the log files that trainings in this process open."""
    handlers = list(logging.getLogger().handlers)
    yield
    for handler in [handler for handler in logging.getLogger().handlers if handler not in handlers]:
        logging.getLogger().removeHandler(handler)
        handler.close()


@pytest.mark.slow
@pytest.mark.usefixtures("root_logger")
def test_a_run_without_map_is_finished_tabled_and_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(EVALUATORS, "counting", FrameCount)
    shutil.copytree(sweep_files.SWEEPS, tmp_path / "sweeps")  # claims name them
    (tmp_path / "sweeps" / "frames.yaml").write_text(SWEEP)
    monkeypatch.setattr(sweep_files, "SWEEPS", tmp_path / "sweeps")
    outputs, reports = tmp_path / "outputs", tmp_path / "reports"
    places = ["scale=debug", f"paths.outputs={outputs}", f"paths.reports={reports}"]

    train.main([*OVERRIDES, "seed=0", *places])
    (folder,) = outputs.glob("horizon3d-phase1-debug-*")
    frames = json.loads((folder / "metrics.json").read_text())["frames"]
    record = json.loads((folder / "run.json").read_text())
    assert (record["task"], record["headline"]) == ("counting", "frames") and frames > 0
    assert f"{frames:.0f} frames counted" in capsys.readouterr().out

    report.main(["phase=phase1", *places])
    page = (reports / "phase1_counting_debug.md").read_text()
    assert f"| {frames:.3f} | 2.000 |" in page and "mAP" not in page and not (reports / "phase1_debug.md").exists()

    sweep.main(["+sweep=frames", *places])  # trains nothing, as the run is done
    result = read_result(result_path(reports, folder.name))
    cost = {"cost.parameters": record["parameters"], "cost.training": record["seconds"]["all"]}
    assert result.metrics == {"frames": frames, "per_batch": 2.0} | cost
    table = (reports / "tables" / "frames_debug.md").read_text()
    assert f"| as it is | {frames:.3f} | – |" in table
    report.main(["phase=phase1", *places])

    board = BoardReader(reports, outputs).read()[0]
    assert not board.broken
    shown = Renderer(lambda kind, name="": f"/{kind}/{name}", lambda picture: picture.name, live=True)
    for page in (shown.run(board, board.runs[folder.name]), shown.sweep(board, board.sweep("frames_debug"))):
        assert "frames" in page.content and "cannot be shown" not in page.content
        assert "frames while training" in page.content and "By distance" not in page.content
