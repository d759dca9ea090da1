"""`python -m src.benchmark`: every suite runs at debug scale and leaves a page that says what was measured on what."""

import json

import pytest
import torch

from src.benchmark import convolutions, machine, naive, suite_metric
from src.benchmark import operation_table as operations
from src.benchmark import suite_model as model
from src.benchmark import suite_scaling as scaling
from src.benchmark import suite_training as training
from src.benchmark.__main__ import main
from src.benchmark.scenes import Highway
from src.config import compose_config
from src.errors import ConfigError, DataError
from src.ops.products import prefers_onednn
from src.ops.sites import Sites


@pytest.fixture(scope="module")
def outputs(tmp_path_factory):
    return tmp_path_factory.mktemp("outputs")


@pytest.fixture
def without_profiler(monkeypatch):
    """Tables of operations have their own tests, and profiling takes as long as all else."""
    for module in (model, training):
        monkeypatch.setattr(module, "operation_table", lambda function, device: [{"operation": "none", "ms": 0.0}])


@pytest.fixture(autouse=True)
def in_a_hurry(monkeypatch):
    """Few rounds and a small roofline; what is measured stays the same. All operations are rows, not the longest."""
    monkeypatch.setattr(machine, "GEMM_SIZE", {"cpu": 128, "cuda": 128})
    monkeypatch.setattr(machine, "COPY_BYTES", {"cpu": 2**20, "cuda": 2**20})
    for module in (model, naive, scaling, convolutions):
        monkeypatch.setattr(module, "ROUNDS", 1)
    monkeypatch.setattr(operations, "NUM_ROWS", 1000)
    monkeypatch.setattr(training, "WARM_UP_STEPS", 1)
    monkeypatch.setattr(training, "MEASURED_STEPS", 3)


def measured(name, outputs, folder, *own):
    """Run one suite; its JSON result, after a look at the page."""
    main([*own, "scale=debug", f"paths.outputs={outputs}", f"out={folder}", "trainer=cpu"])
    page = json.loads((folder / f"{name}.json").read_text())
    assert page["machine"]["threads"] == torch.get_num_threads() and page["machine"]["processor"]
    text = (folder / f"{name}.md").read_text()
    assert f"`python -m src.benchmark {' '.join(own)} scale=debug" in text and "processor: " in text
    for key, rows in page["result"].items():
        if isinstance(rows, list) and key != "notes":
            assert f"## {key}" in text and rows
    return page["result"]


def column(rows, key, name):
    return {row[key]: row.get(name) for row in rows}


def test_the_naive_kernel_map_has_the_same_pairs():
    cells = torch.randperm(2 * 5 * 6 * 7)[:200].sort().values
    ours, naive_one = naive.map_candidates(Sites.from_linear(cells, (2, 5, 6, 7)))
    assert torch.equal(ours().long(), naive_one())


@pytest.mark.slow
@pytest.mark.usefixtures("without_profiler")
def test_model_with_a_full_memory(outputs, tmp_path):
    own = ["suite=model", "phase=phase2", "model.dptf.bev_path.memory_threshold=0"]
    result = measured("model_horizon3d_phase2_debug", outputs, tmp_path, *own)
    milliseconds = column(result["time by part"], "part", "forward ms")
    inner = {f"ocsf: {part}" for part in ("gaussian encoder", "splat", "gated fusion")}
    inner |= {f"dptf: {part}" for part in ("recall", "aggregate", "remember")}
    parts = {"radar_encoder", "image_encoder", "kggi", "ocsf", "dptf", "head", "head: decode"} | inner
    assert parts < set(milliseconds) and all(value > 0 for value in milliseconds.values())
    both = column(result["time by part"], "part", "f+b ms")
    assert both["ocsf"] > 0 and both["head: decode"] is None  # boxes are no part of a training step
    work = column(result["work by part"], "part", "forward GFLOP")
    counted = sum(value for part, value in work.items() if part in parts - inner)
    assert counted == pytest.approx(work["whole: frame to boxes, step to gradients"], rel=1e-6)
    inside = sum(work[part] for part in inner if part.startswith("ocsf"))
    assert inside == pytest.approx(work["ocsf"], rel=1e-6)
    assert result["state"]["remembered_cells"] > 1000 and result["state"]["gaussians_history"] == 16  # 2 frames of 8
    assert result["batch_size"] == 1


@pytest.mark.slow
@pytest.mark.usefixtures("without_profiler")
@pytest.mark.parametrize(
    ("own", "absent"), [(["phase=phase1"], "dptf"), (["model.kggi=null", "model.ocsf=null"], "image_encoder")]
)
def test_parts_that_a_model_lacks_are_left_out(outputs, tmp_path, own, absent):
    result = measured("model_horizon3d_phase1_debug", outputs, tmp_path, "suite=model", *own, "data.batch_size=2")
    parts = column(result["time by part"], "part", "forward ms")
    assert not [part for part in parts if part.startswith(absent)] and parts["radar_encoder"] > 0
    assert result["batch_size"] == 2


@pytest.mark.slow
@pytest.mark.usefixtures("without_profiler")
def test_model_of_the_dense_baseline(outputs, tmp_path):
    own = ["suite=model", "model=dense_bev", "phase=phase2"]
    result = measured("model_dense_bev_phase2_debug", outputs, tmp_path, *own)
    parts = column(result["time by part"], "part", "f+b ms")
    assert {"image_encoder", "radar_encoder", "view_transform", "fuser", "temporal", "decoder", "head"} < set(parts)
    assert result["state"]["remembered_frames"] == 2


@pytest.mark.slow
@pytest.mark.usefixtures("without_profiler")
def test_model_that_reads_lidar_alone(outputs, tmp_path):
    own = ["suite=model", "model=centerpoint", "phase=phase1", "data.world.lidar=true", "data.world.lidar_step_deg=2.0"]
    result = measured("model_centerpoint_phase1_debug", outputs, tmp_path, *own)
    parts = column(result["time by part"], "part", "f+b ms")
    assert {"lidar_encoder", "head"} < set(parts) and not any(part.startswith("radar") for part in parts)
    assert result["lidar_points"] > 0 and "radar_points" not in result


LRS = ("model=lrs4fusion", "phase=lrs_occupancy", "model.late_encoder.max_sites=[4000,2000,1000,500]")


@pytest.mark.slow
@pytest.mark.usefixtures("without_profiler")
def test_model_that_learns_from_rays_alone(outputs, tmp_path):
    """No world is written for it."""
    result = measured("model_lrs4fusion_lrs_occupancy_debug", outputs / "none", tmp_path, "suite=model", *LRS)
    parts = column(result["time by part"], "part", "f+b ms")
    whole = "whole: frame to answers, step to gradients"
    assert {"pointnet", "unet", "stem", "late_encoder", "temporal", "decoders", whole} <= set(parts)
    assert all(parts[name] > 0 for name in ("unet", "late_encoder", "decoders", whole)) and "neck" not in parts
    assert result["lidar_points"] == 1500 and result["state"]["sites_1"] > 0
    assert not list(outputs.glob("none/worlds/*"))


@pytest.mark.slow
def test_scaling_of_a_model_that_reads_lidar(outputs, tmp_path, monkeypatch):
    monkeypatch.setattr(scaling, "LIDAR_RANGES_M", (40.0, 80.0))
    result = measured("scaling_lrs4fusion_lrs_occupancy_debug", outputs, tmp_path, "suite=scaling", *LRS)
    rows = result["range, fixed scene"]
    assert [row["range, fixed scene"] for row in rows] == [40, 80] and {row["lidar points"] for row in rows} == {1500}
    assert {row["model"] for row in rows} == {"lrs4fusion"} and all(row["unet ms"] > 0 for row in rows)
    (growth,) = result["growth"]
    assert (growth["from"], growth["to"]) == (40, 80) and growth["lrs4fusion time x"] > 0
    assert (tmp_path / "scaling_lrs4fusion_lrs_occupancy_debug.png").is_file()


def test_a_suite_that_makes_no_sense_for_a_model_says_why():
    with pytest.raises(ConfigError, match="suite=ops .*centerpoint|suite=ops .*radar backbone"):
        main(["suite=ops", "scale=debug", "model=centerpoint", "phase=phase1", "data.world.lidar=true"])


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_training(outputs, tmp_path, phase, request):
    if phase == "phase2":
        request.getfixturevalue("without_profiler")
    result = measured(f"training_horizon3d_{phase}_debug", outputs, tmp_path, "suite=training", f"phase={phase}")
    rows = column(result["training step"], "batches", "frames/s")
    assert list(rows) == ["with loader", "loaded"] and min(rows.values()) > 0
    for row in result["training step"]:
        stages = ("wait", "forward", "loss", "backward", "optimiser", "bookkeeping")
        assert all(row[f"{stage} ms"] >= 0 for stage in stages)
    if phase == "phase1":
        assert "SparseConvFunctionBackward" in column(result["operations of a step"], "operation", "ms")


@pytest.mark.slow
def test_ops(outputs, tmp_path, monkeypatch):
    monkeypatch.setattr(convolutions, "DENSE_LIMIT_FLOPS", 1e9)
    result = measured("ops_debug", outputs, tmp_path, "suite=ops")
    layers = result["sparse convolution"]
    assert {row["mode"] for row in layers} == {"forward", "f+b"} and all(row["% of GEMM"] > 0 for row in layers)
    assert any(row.get("x faster than dense") for row in layers)
    assert any("x faster than dense" not in row for row in layers)  # too large
    other = "tiles" if prefers_onednn() else "blocks"
    assert all(row[f"x faster than {other}"] > 0 for row in layers)
    for row in [*layers, *result["radar backbone"]]:
        assert row.get("spconv differs by", 0.0) < 1e-5
    assert {row["mode"] for row in result["other operations"] if row["operation"] == "splat"} == {"forward", "f+b"}
    backward = column(result["operations of the backbone, f+b"], "operation", "ms")
    assert "SparseConvFunctionBackward" in backward
    assert "SparseConvFunctionBackward" not in column(result["operations of the backbone, forward"], "operation", "ms")
    others = {row["operation"] for row in result["other operations"]}
    assert {
        "splat",
        "segment sum",
        "bilinear sampling",
        "image attention",
        "farthest points",
        "box raster",
        "voxels",
        "kernel map",
    } == others


@pytest.mark.slow
@pytest.mark.exhaustive
def test_scaling(outputs, tmp_path, monkeypatch):
    monkeypatch.setattr(scaling, "ROADS", {"debug": Highway(100, 10, 5, 150.0)})
    monkeypatch.setattr(scaling, "RANGES_M", {"debug": (37.5, 75.0, 150.0)})
    monkeypatch.setattr(scaling, "NOMINAL_M", 75.0)
    monkeypatch.setattr(scaling, "MEMORY_FRAMES", (0, 2))
    monkeypatch.setattr(scaling, "FACTORS", {name: (0.5, 1.0) for name in scaling.FACTORS})
    own = ["suite=scaling", "phase=phase2", "grid.cells=[192,192]"]
    result = measured("scaling_debug", outputs, tmp_path, *own)
    assert (tmp_path / "scaling_debug.png").read_bytes()[:4] == b"\x89PNG"
    assert result["picture"] == "scaling_debug.png"
    sweeps = [row["sweep"] for row in result["growth"]]
    assert sweeps == [
        "range, equal density", "range, fixed scene", "range, calibrated scene", "pruned voxels, %", "objects",
        "radar points", "gaussians", "memory frames",
    ]  # fmt: skip
    for name in sweeps:
        assert {row["model"] for row in result[name]} == {"horizon3d", "dense_bev"}
    remembered = {(row["memory frames"], row["model"]): row["remembered MiB"] for row in result["memory frames"]}
    assert remembered[0, "horizon3d"] == remembered[0, "dense_bev"] == 0.0
    channels = compose_config(["scale=debug", "model=dense_bev"])[0].model.fused_channels
    assert remembered[2, "dense_bev"] == pytest.approx(2 * 192 * 192 * channels * 2 / 2**20, rel=1e-3)  # bfloat16
    assert {row["gaussians"] for row in result["gaussians"]} == {32, 64}  # of the frame, none of the memory
    fixed = [row["radar points"] for row in result["range, fixed scene"]]
    dense = [row["radar points"] for row in result["range, equal density"]]
    assert len(set(fixed)) == 1 and dense == sorted(dense) and dense[0] < dense[-1]


@pytest.mark.slow
def test_a_disagreement_of_the_metric_is_an_error_after_the_page(tmp_path, monkeypatch):
    monkeypatch.setattr(suite_metric, "compare_with_devkit", lambda **_: {"agrees": False, "max_difference": 0.5})
    with pytest.raises(DataError, match="disagree"):
        main(["suite=metric", f"out={tmp_path}"])
    assert "max_difference 0.5" in (tmp_path / "metric.md").read_text()


def test_a_folder_that_cannot_be_written_is_reported_first(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="out"):
        main(["suite=model", f"out={tmp_path / 'file'}"])
