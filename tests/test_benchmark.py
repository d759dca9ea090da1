"""`python -m src.benchmark suite=model`: every part of a step is in the table, with a full memory."""

import json

import pytest

from src.benchmark import main


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


def measured(outputs, tmp_path, *own):
    main(["suite=model", "scale=debug", f"paths.outputs={outputs}", f"out={tmp_path}", "trainer=cpu", *own])
    return json.loads((tmp_path / "model_debug.json").read_text())["result"]


def test_the_memory_is_full_and_measured(outputs, tmp_path):
    result = measured(outputs, tmp_path, "phase=phase2", "model.dptf.bev_path.memory_threshold=0")
    parts = ("radar_encoder", "image_encoder", "kggi", "ocsf", "head")
    wanted = [f"{part} forward" for part in parts] + [f"dptf {part}" for part in ("recall", "aggregate", "remember")]
    assert set(wanted) <= set(result["seconds"])
    assert result["state"]["remembered_cells"] > 1000 and result["state"]["gaussians_history"] == 16  # 2 frames of 8
    assert "| dptf aggregate |" in (tmp_path / "model_debug.md").read_text()


def test_a_model_of_single_frames_has_no_memory_to_measure(outputs, tmp_path):
    result = measured(outputs, tmp_path, "phase=phase1")
    assert not [name for name in result["seconds"] if name.startswith("dptf")] and result["seconds"]["kggi forward"] > 0
