"""What the entry points share: where data come from, and what a machine can do."""

from operator import attrgetter

import pytest

from src import assembly
from src.assembly import build_datamodule, build_model, build_module, data_root, save_submission
from src.config import compose_config
from src.errors import ConfigError, DataError
from src.reliability.processes import check_devices


def test_evaluation_never_writes_a_world_into_a_mistyped_folder(tmp_path):
    config, _ = compose_config(["scale=debug", f"data.root={tmp_path / 'mistyped'}", f"paths.outputs={tmp_path}"])
    with pytest.raises(DataError, match="mistyped"):
        build_datamodule(config, data_root(config, write=False))
    assert not list(tmp_path.iterdir())


def test_a_root_with_something_else_is_refused_for_training(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    config, _ = compose_config(["scale=debug", f"data.root={tmp_path}"])
    with pytest.raises(DataError, match="not a complete synthetic world.*data=truckscenes"):
        data_root(config)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


def test_too_many_workers_are_refused(tmp_path):
    config, _ = compose_config(["scale=debug", "data.num_workers=100000"])
    with pytest.raises(ConfigError, match="data.num_workers=100000"):
        build_datamodule(config, tmp_path)


def test_a_later_phase_draws_anew_and_the_same_each_time(tmp_path):
    """Phase 1 continued would else see the order and the augmentation of phase 1's first epochs once more."""
    shared = ["scale=debug", "data.world.key_frames_per_scene=8", f"paths.outputs={tmp_path}"]
    seen = []
    for choice in (["phase=phase1"], ["phase=phase1", "seed=1"], *2 * [["phase=phase1_further"]]):
        config, tree = compose_config([*shared, *choice])
        data = build_datamodule(config, data_root(config))
        data.setup("fit")
        loader = data.train_dataloader()
        keys = [key for batch in loader.batch_sampler for key in batch]
        drawn = loader.dataset[min(keys, key=attrgetter("sample"))].aug_from_ego.tolist()
        seen.append(([key.sample for key in keys], drawn, build_module(config, tree, data).seed))
    assert seen[2] == seen[3]
    for first, other in [(0, 1), (0, 2), (1, 2)]:
        assert all(a != b for a, b in zip(seen[first], seen[other], strict=True))


def test_devices_that_are_not_there_are_named(monkeypatch):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    monkeypatch.setattr("torch.backends.mps.is_available", lambda: False)
    check_devices("auto", 1)
    check_devices("cpu", 1)
    with pytest.raises(ConfigError, match="sees no GPU.*trainer.accelerator=cpu"):
        check_devices("gpu", 1)


@pytest.mark.slow
@pytest.mark.parametrize("sensors", [("radar",), ("camera", "radar"), ("lidar",)])
def test_a_submission_states_the_sensors_that_the_model_reads(tmp_path, monkeypatch, sensors):
    config, _ = compose_config(["scale=debug"])
    monkeypatch.setattr(type(config.model), "sensors", sensors)
    written = []
    monkeypatch.setattr(assembly, "write_submission", lambda path, tokens, table, meta: written.append(meta))
    assert save_submission(config, tmp_path / "submission.json", ["a"], [None])
    stated = {name.removeprefix("use_") for name, used in written[0].items() if name.startswith("use_") and used}
    assert stated == set(sensors)


@pytest.mark.parametrize(("source", "stated"), [("none", set()), ("radar", {"radar", "future_frames"})])
def test_a_submission_states_where_the_speeds_of_its_returns_come_from(tmp_path, monkeypatch, source, stated):
    lidar = ("scale=debug", "model=lrs4fusion", "phase=lrs_detection", f"data.timeline.radial_speeds={source}")
    config, _ = compose_config([*lidar])
    written = []
    monkeypatch.setattr(assembly, "write_submission", lambda path, tokens, table, meta: written.append(meta))
    assert save_submission(config, tmp_path / "submission.json", ["a"], [None])
    used = {name.removeprefix("use_") for name, value in written[0].items() if name.startswith("use_") and value}
    assert used == stated | {"lidar"} and written[0]["method_name"] == "lrs4fusion"


def test_a_world_without_lidar_is_refused_for_a_model_that_reads_it(monkeypatch):
    config, _ = compose_config(["scale=debug"])
    monkeypatch.setattr(type(config.model), "sensors", ("lidar",))
    with pytest.raises(ConfigError, match="data.world.lidar=true"):
        compose_config(["scale=debug"])
    compose_config(["scale=debug", "data.world.lidar=true"])
    compose_config(["scale=debug", "data=truckscenes", "data.root=x"])


@pytest.mark.slow
def test_a_backbone_whose_norm_needs_pretrained_weights_says_so_where_it_gets_none(caplog):
    config, _ = compose_config(["scale=debug", "phase=phase1", "backbone=vovnet99", "backbone.image_size_px=[64,96]"])
    build_model(config, pretrained=False)  # a checkpoint brings them
    assert not caplog.records
    build_model(config)
    (record,) = caplog.records
    assert record.getMessage().startswith("backbone=vovnet99 without backbone.weights")
