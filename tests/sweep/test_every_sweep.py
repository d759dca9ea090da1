"""Every file of sweeps/ by its real command at debug scale: every row trained, every table complete (some minutes)."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from src.report.results import read_results
from src.report.sweep_record import read_record, record_path
from src.report.table_builder import sweep_tables
from src.sweep.sweep_files import sweep_files

ROOT = Path(__file__).resolve().parents[2]
PARTS_OF_SOME = ("image_encoder", "kggi", "ocsf", "gaussian_encoder", "dptf", "view_transform", "temporal_fusion")
"""Of Table 15: not every model has each of them."""
SELDOM = ("speeds.", "classes.", "lfcd", "cd_unseen")
"""The debug world lacks most of them: it is small, and so is what a forecast may miss there."""
FROM_FEW = ("measures.camera_velocity_error", "measures.history_velocity_error")
"""Of Gaussians within fast objects, and the debug world has few of both: there exactly where a run has met one."""
CAMERA_ONLY, OF_RADAR = ("PETR", "Far3D"), ("measures.hidden_recall", "latency.radar_encoder")
"""What hides from the radar is nothing to a model that reads none."""
OF_GAUSSIANS = {
    "measures.remembered_share": ("history",),
    "measures.history_near": ("history",),
    "measures.history_faint": ("history",),
    "measures.random_near": ("random",),
    "measures.random_faint": ("random",),
    "measures.occupied_share": ("radar", "camera", "random"),
}
"""There exactly where a model has Gaussians of one of these sources."""
pytestmark = [pytest.mark.slow, pytest.mark.exhaustive]  # test_sweep.py trains one with every other suite


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where all of them work: rows that are the same run are trained by the first that needs it."""
    return tmp_path_factory.mktemp("sweeps")


@pytest.mark.parametrize("name", sweep_files())
def test_a_sweep_ends_with_complete_tables(name, folder):
    reports = folder / "reports"
    places = (f"paths.outputs={folder / 'outputs'}", f"paths.reports={reports}", "trainer.num_pictures=0")
    fewer = ("trials=2",) if name == "tune" else ()
    result = subprocess.run(
        [sys.executable, "-m", "src.sweep", f"+sweep={name}", "scale=debug", *fewer, *places],
        cwd=ROOT, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-3000:]
    record = read_record(record_path(reports, name, "debug"))
    assert record.runs and {run.state for run in record.runs.values()} <= {"done", "pruned"}
    assert sum(run.state == "done" for run in record.runs.values()) >= max(1, len(record.rows))
    results, broken = read_results(reports, "debug")
    assert not broken
    tables = sweep_tables(record, results)
    assert len(tables) == len(record.sweep.tables) > 0
    for table in tables:
        assert (reports / "tables" / f"{table.name}_debug.md").is_file()
        for row in table.rows:
            assert row.state in ("done", "paper", "pruned"), row
        # What a table has columns for is there for every row that is trained, latencies included.
        trained = [row for row in table.rows if row.state == "done"]
        assert trained
        for place, column in enumerate(table.columns):
            asked = [row for row in trained if column.name not in OF_RADAR or row.label not in CAMERA_ONLY]
            if column.name in (*OF_GAUSSIANS, *FROM_FEW):
                asked, others = [], asked
                for row in others:
                    (run_id,) = record.rows[row.label].values()
                    measures = json.loads((folder / "outputs" / run_id / "metrics.json").read_text())["measures"]
                    if column.name in OF_GAUSSIANS:
                        is_there = any(measures.get(f"{source}_gaussians") for source in OF_GAUSSIANS[column.name])
                    else:  # a model with Gaussians has the measure, be it of none of them
                        assert "camera_gaussians" not in measures or column.name.removeprefix("measures.") in measures
                        is_there = measures.get(column.name.removeprefix("measures.")) is not None
                    if is_there:
                        asked.append(row)
                    else:
                        assert row.cells[place].mean is None, (table.name, column.name, row.label)
                assert asked or column.name in FROM_FEW, (table.name, column.name)
            if column.name.startswith("static_"):  # the static world's number is there exactly where the forecast's is
                forecast = [other.name for other in table.columns].index(column.name.removeprefix("static_"))
                asked, others = [], asked
                for row in others:
                    if row.cells[forecast].mean is not None:
                        asked.append(row)
                    else:
                        assert row.cells[place].mean is None, (table.name, column.name, row.label)
            shown = [row.cells[place].mean for row in asked]
            present_here = column.name.startswith(SELDOM)
            own = column.name.removeprefix("latency.") in PARTS_OF_SOME
            complete = any(value is not None for value in shown) if own else None not in shown
            assert present_here or complete, (table.name, column.name)
