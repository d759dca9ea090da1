"""From one phase to the next: which run or file the weights come from, strictness, and the commands themselves."""

import copy
import functools
import json
import logging
import operator
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch

from src import evaluate, train
from src.assembly import build_model
from src.config import PHASES, compose_config
from src.errors import (
    CheckpointError,
    ConfigError,
    DataError,
    DivergedError,
    HorizonError,
    InterruptedRunError,
)
from src.models.horizon3d.model_config import Horizon3DConfig
from src.reliability.checkpoints import open_checkpoint
from src.training import handoff
from src.training.handoff import (
    INPUT_SETTINGS,
    differing_settings,
    find_source,
    hand_over,
    norms_handed_over,
    train_source,
)
from src.training.identity import run_identity
from src.training.module import TrainingModule
from src.training.run_folder import RunFolder, name_of_checkpoint
from tests.running import call, fork, run_module
from tests.untrained import write_checkpoint

ADDED = re.compile(Horizon3DConfig.new_in_temporal_phase)

ROOT = Path(__file__).resolve().parents[2]


def source_of(*overrides):
    """What a command starts from: (source, run id of the command)."""
    overrides = ["scale=debug", *overrides]
    config, tree = compose_config(overrides)
    source = find_source(config, overrides, compose_config, PHASES)
    return source, run_identity(tree, None if source is None else source.identity)


def test_what_a_later_stage_alone_builds_asks_for_no_other_first_run():
    """Of LRS4Fusion: the ray head, the neck and their losses; the U-Net is everyone's."""
    own = ("model=lrs4fusion", "phase=lrs_forecast")
    plain = source_of(*own)
    later = source_of(*own, "model.ray_head.num_samples=255", "model.loss.rays_per_frame=16")
    assert later[0].identity == plain[0].identity and later[1] != plain[1]
    assert not any("ray" in override for override in later[0].overrides)
    shared = source_of(*own, "model.unet.point_channels=16")
    assert shared[0].identity != plain[0].identity


def identity(*overrides):
    """Run id of a command that starts from fresh weights."""
    return run_identity(compose_config(["scale=debug", *overrides])[1])


def finished(source):
    """Make the folder of a source look like that of a finished run."""
    source.checkpoint.parent.mkdir(parents=True)
    source.checkpoint.write_bytes(b"")
    source.folder.record.write_text("{}")
    source.folder.metrics_json.write_text("{}")


# ---------------------------------------------------------------- which run or file


def test_phase_1_starts_from_fresh_weights():
    assert source_of("phase=phase1")[0] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "own",
    [
        [],
        ["model.dptf.max_age_s=0.55"],
        ["model.dptf.bev_path=null"],
        ["phase.epochs=7", "phase.options.velocity_code_weight=0.5", "phase.train_missing=false"],
        ["data.groups_per_scene=1"],
        ["model.loss.cell_focal_weight=null", "model.loss.dptf_weight=2", "model.loss.gaussian_velocity_weight=1"],
        ["resume=restart"],
        ["trainer.devices=2", "logger=wandb"],
    ],
    ids=",".join,
)
def test_the_run_of_the_same_command_in_phase_1(tmp_path, own):
    """Less what only the later phase has: Tables 5 to 7 and 13 start from one and the same run of phase 1."""
    shared = ["model.ocsf.margin_m=1.6", "model.loss.gaussian_velocity_in_phase1=false", "seed=3"]
    source, _ = source_of("phase=phase2", *shared, f"paths.outputs={tmp_path}", *own)
    assert source.identity == identity("phase=phase1", *shared)
    assert source.checkpoint == tmp_path / source.identity / "checkpoints" / "last.ckpt"
    assert source.overrides[0] == "phase=phase1" and not source.ready
    assert not [override for override in source.overrides if override.startswith(("phase.", "model.dptf", "resume"))]
    finished(source)
    assert source.ready
    source.checkpoint.unlink()
    assert not source.ready


@pytest.mark.slow
def test_other_settings_mean_another_run():
    assert source_of("phase=phase2")[0].identity != source_of("phase=phase2", "model.channels=32")[0].identity
    assert source_of("phase=phase2")[0].identity != source_of("phase=phase2", "seed=1")[0].identity
    in_phase_1 = "model.loss.gaussian_velocity_in_phase1=true"
    weights = [source_of("phase=phase2", in_phase_1, f"model.loss.dptf_weight={weight}") for weight in (1, 2)]
    assert weights[0][0].identity != weights[1][0].identity


@pytest.mark.slow
def test_further_epochs_of_the_same_phase():
    """What a second phase is to be compared with. The source is the phase's plain run, so nothing goes in circles."""
    source, run = source_of("phase=phase1", "phase.init_from=phase1", "phase.epochs=2")
    assert source.identity == identity("phase=phase1") != run
    source, run = source_of("phase=phase2", "phase.init_from=phase2", "phase.epochs=2")
    assert source.identity == source_of("phase=phase2")[1] != run  # a run known by what it started from itself
    assert source.overrides == ["phase=phase2", "scale=debug"]
    source, _ = source_of("phase=phase2", "phase.init_from=phase2", "model.dptf.max_age_s=0.55")
    assert source.overrides == ["phase=phase2", "scale=debug", "model.dptf.max_age_s=0.55"]


@pytest.mark.slow
def test_a_source_that_remembers_has_the_same_past():
    """What is temporal is dropped for a source of single frames alone."""
    past = ("data.past_frames=1", "data.timeline.history_stride=3", "model.temporal.max_age_s=2")
    for phase in ("lrs_forecast", "lrs_detection"):
        source, _ = source_of("model=lrs4fusion", f"phase={phase}", *past, "phase.epochs=3")
        assert source.identity == identity("model=lrs4fusion", "phase=lrs_occupancy", *past)
        assert source.overrides == ["phase=lrs_occupancy", "scale=debug", "model=lrs4fusion", *past]


@pytest.mark.slow
def test_a_file_counts_by_its_content(tmp_path):
    first, same, other = (tmp_path / name for name in ("a.ckpt", "b.ckpt", "c.ckpt"))
    first.write_bytes(b"weights"), same.write_bytes(b"weights"), other.write_bytes(b"others")
    (a, run_a), (b, run_b), (c, run_c) = (
        source_of("phase=phase2", f"phase.init_from={path}") for path in (first, same, other)
    )
    assert a.ready and a.checkpoint == first and a.folder is None
    assert a.identity == b.identity != c.identity and run_a == run_b != run_c
    assert run_a != source_of("phase=phase2")[1]


def test_a_run_is_named_by_its_id(tmp_path):
    """It need not have finished to be planned with, but to be started from."""
    name = "horizon3d-phase2-debug-0123abcd"
    source, run = source_of("phase=phase1", f"phase.init_from={name}", f"paths.outputs={tmp_path}")
    assert source.identity == name and source.checkpoint == tmp_path / name / "checkpoints" / "last.ckpt"
    assert run not in (identity("phase=phase1"), source_of("phase=phase1", f"phase.init_from={name[:-1]}e")[1])
    assert not source.ready
    with pytest.raises(ConfigError, match=f"phase.init_from={name}: .*{name} holds no finished run with its weights"):
        train_source(source, train_missing=True, processes_exist=False)


@pytest.mark.parametrize("name", ["nowhere.ckpt", "phase9", "."])
def test_a_file_that_does_not_exist(name):
    with pytest.raises(CheckpointError, match=rf"init_from={name}.*no such checkpoint.*phase1, phase1_further, phase2"):
        source_of("phase=phase2", f"phase.init_from={name}")


# ---------------------------------------------------------------- training it first


def test_the_command_can_be_pasted():
    source = source_of("phase=phase2", "grid.cells=[384,384]", "paths.outputs='a b'")[0]
    assert source.command == "python -m src.train phase=phase1 scale=debug 'grid.cells=[384,384]' " + (
        """'paths.outputs='"'"'a b'"'"''"""
    )


def test_it_is_not_trained_where_that_is_switched_off_or_impossible(tmp_path):
    source = source_of("phase=phase2", f"paths.outputs={tmp_path}")[0]
    for train_missing, processes, reason in ((False, False, "train_missing=false"), (True, True, "from outside")):
        with pytest.raises(ConfigError) as raised:
            train_source(source, train_missing, processes)
        for words in (reason, source.identity, source.command, "phase.init_from=PATH"):
            assert words in str(raised.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (3, ConfigError),
        (4, DataError),
        (5, DivergedError),
        (6, InterruptedRunError),
        (1, HorizonError),
        (-9, HorizonError),
        (-signal.SIGTERM, InterruptedRunError),  # before it listened
        (-signal.SIGINT, InterruptedRunError),
    ],
)
def test_how_the_earlier_run_ended_is_passed_on(monkeypatch, tmp_path, code, kind):
    source = source_of("phase=phase2", f"paths.outputs={tmp_path}")[0]
    commands = []
    monkeypatch.setattr(handoff, "_run_command", lambda command: commands.append(command) or code)
    with pytest.raises(HorizonError, match=f"(?s){source.identity}.*exit code {code}") as raised:
        train_source(source, True, False)
    assert type(raised.value) is kind and raised.value.exit_code == kind.exit_code
    assert commands == [[sys.executable, "-m", "src.train", *source.overrides]]


def test_a_finished_run_that_lost_its_weights(monkeypatch, tmp_path):
    """Its command shows the old result and makes nothing: say how to make it anew instead of missing a file later."""
    source = source_of("phase=phase2", f"paths.outputs={tmp_path}")[0]
    finished(source)
    source.checkpoint.unlink()
    monkeypatch.setattr(handoff, "_run_command", lambda command: 0)
    with pytest.raises(CheckpointError, match="(?s)has finished, but .*last.ckpt is gone.*resume=restart"):
        train_source(source, True, False)


def test_a_request_to_stop_goes_to_the_earlier_run(tmp_path):
    ready = tmp_path / "ready"
    script = (
        "import signal, sys, time, pathlib\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(6))\n"
        f"pathlib.Path({str(ready)!r}).write_text('')\n"
        "time.sleep(60)\n"
    )

    def stop():
        while not ready.exists():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    threading.Thread(target=stop, daemon=True).start()
    assert handoff._run_command([sys.executable, "-c", script]) == 6
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="Linux alone tells a process of its parent's death")
def test_the_earlier_run_ends_with_a_command_that_is_killed(tmp_path):
    child = (
        "import pathlib, signal, sys, time\n"
        f"def stop(*_): pathlib.Path({str(tmp_path / 'stopped')!r}).touch(); sys.exit(6)\n"
        "signal.signal(signal.SIGTERM, stop)\n"
        f"pathlib.Path({str(tmp_path / 'ready')!r}).touch()\n"
        "time.sleep(60)\n"
    )
    call = f"_run_command([sys.executable, '-c', {child!r}])"
    parent = f"import sys; from src.training.handoff import _run_command; {call}"
    process = subprocess.Popen([sys.executable, "-c", parent], cwd=ROOT)
    deadline = time.monotonic() + 300
    while not (tmp_path / "ready").exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    while not (tmp_path / "stopped").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_several_processes_train_it_only_where_the_run_begins(tmp_path):
    from src.training.run_folder import Resume

    folder = RunFolder(tmp_path, "run")
    assert train.begins(folder, Resume.auto)
    folder.checkpoints.mkdir(parents=True)
    write_checkpoint(folder.checkpoints / "last.ckpt", "phase=phase2")
    assert not train.begins(folder, Resume.auto) and train.begins(folder, Resume.restart)
    folder.record.write_text("{}"), folder.metrics_json.write_text("{}")
    assert not train.begins(folder, Resume.auto) and train.begins(folder, Resume.restart)


@pytest.mark.parametrize("by_id", [False, True])
def test_a_damaged_source_is_found_before_the_own_run_is_touched(tmp_path, by_id):
    overrides = ["phase=phase2", "scale=debug", f"paths.outputs={tmp_path}", "resume=restart"]
    config, tree = compose_config(overrides)
    source = find_source(config, overrides, compose_config, PHASES)
    finished(source)
    if by_id:  # as a sweep's rows with the weights of another
        source.folder.record.write_text(json.dumps({"overrides": source.overrides}))
        overrides += [f"phase.init_from={source.identity}"]
        config, tree = compose_config(overrides)
        source = find_source(config, overrides, compose_config, PHASES)
    folder = RunFolder(tmp_path, run_identity(tree, source.identity))
    folder.path.mkdir()
    with pytest.raises(CheckpointError, match="(?s)last.ckpt is truncated.*make it anew.*phase=phase1.*resume=restart"):
        train.prepare(config, tree, folder, source)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([folder.run_id, source.identity])


# ---------------------------------------------------------------- the weights


@pytest.fixture(scope="module")
def phase_1(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp("weights") / "phase1.ckpt", "phase=phase1")


def give(path, *overrides):
    """A fresh model of a command with the weights of a file, and its values before and after."""
    config, tree = compose_config(["scale=debug", *overrides])
    torch.manual_seed(5)
    model = build_model(config)
    before = {key: value.clone() for key, value in model.state_dict().items()}
    try:
        hand_over(model, open_checkpoint(path), tree)
    except CheckpointError:
        assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())  # no part either
        raise
    return model, before, model.state_dict()


@pytest.mark.slow
@pytest.mark.parametrize(
    "own",
    [
        [],
        ["model.dptf.bev_path=null"],
        ["model.dptf.gaussian_path=null"],
        ["model.dptf.gaussian_path.self_attention=null"],
    ],
)
def test_every_weight_of_phase_1_arrives_and_what_is_new_keeps_its_own(phase_1, own, caplog):
    given = torch.load(phase_1, weights_only=True)["state_dict"]
    with caplog.at_level(logging.INFO):
        _, before, after = give(phase_1, "phase=phase2", *own)
    for key, value in after.items():
        expected = before[key] if f"model.{key}" not in given else given[f"model.{key}"]
        assert torch.equal(value, expected), key
    new = [key for key in after if f"model.{key}" not in given]
    assert new and all(ADDED.match(key) for key in new) and f"new: {len(new)} tensors in dptf" in caplog.text
    assert len(after) - len(new) == len(given)
    assert not [key for key in given if ADDED.match(key.removeprefix("model."))]  # none of phase 1 may be missing


@pytest.mark.slow
def test_step_0_without_memory_is_phase_1(phase_1):
    """Specification 15.8, through the handoff: the same boxes and maps, bit by bit."""
    from src.structures.batch import FrameBatch

    single, double = give(phase_1, "phase=phase1")[0].eval(), give(phase_1, "phase=phase2")[0].eval()
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(400, 7, generator=generator) * torch.tensor([60.0, 60.0, 1.0, 5.0, 5.0, 5.0, 0.1])
    projection = torch.tensor([[50.0, -40.0, 0, 0], [20.0, 0, -40.0, 80.0], [1.0, 0, 0, 0], [0, 0, 0, 1.0]])
    batch = FrameBatch(
        tokens=["a"],
        timestamps_s=torch.zeros(1, dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64)[None],
        aug_from_ego=torch.eye(4)[None],
        radar_points=points,
        radar_batch=torch.zeros(400, dtype=torch.int64),
        images=torch.randint(0, 256, (1, 4, 3, *compose_config(["scale=debug"])[0].backbone.image_size_px),
                             generator=generator, dtype=torch.uint8),
        image_valid=torch.ones(1, 4, dtype=torch.bool),
        pix_from_aug=projection.expand(1, 4, 4, 4).clone(),
    )  # fmt: skip
    with torch.no_grad():
        (one, nothing), (two, memory) = single(batch), double(batch)
    assert nothing is None and memory.batch_size == 1
    assert torch.equal(one.fused_bev.features, two.dptf.bev.features) and len(one.fused_bev)
    first, second = single.decode(one)[0], double.decode(two)[0]
    assert torch.equal(first.centers, second.centers) and torch.equal(first.scores, second.scores)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stored", "wanted", "named"),
    [
        (["phase=phase1", "model.kggi=null", "model.ocsf=null"], ["phase=phase2"], r"missing .*kggi\.|missing .*image"),
        (["phase=phase1"], ["phase=phase2", "model.kggi=null", "model.ocsf=null", "model.dptf.gaussian_path=null"],
         r"unexpected (kggi|ocsf|image_encoder)\."),
        (["phase=phase1"], ["phase=phase2", "model.channels=32"], r" is \[.*16.*the model has \[.*32"),
        (["phase=phase1"], ["phase=phase2", "model.kggi.num_random_keypoints=8"], r"kggi.* is \[16, 2\].*has \[8, 2\]"),
        (["phase=phase1"], ["phase=phase2", "model.ocsf.num_layers=2"], r"missing ocsf\.encoder\.layers\.1\.(?!temp)"),
        (["phase=phase1", "model.kggi.initialization=keypoint"], ["phase=phase2"], r"missing kggi\.random_means"),
        (["phase=phase2"], ["phase=phase1"], r"unexpected (ocsf.*temporal_attention|dptf)\."),
        (["phase=phase2"], ["phase=phase1", "model.kggi=null", "model.ocsf=null"], r"unexpected "),
    ],
)  # fmt: skip
def test_weights_of_another_architecture_are_refused_by_name(tmp_path, stored, wanted, named):
    path = write_checkpoint(tmp_path / "other.ckpt", *stored)
    with pytest.raises(CheckpointError, match=f"other.ckpt is of another model: .*{named}"):
        give(path, *wanted)


@pytest.mark.parametrize("off", ["gaussian_path.self_attention", "gaussian_path", "bev_path"])
def test_trained_weights_are_scored_with_a_part_of_the_memory_switched_off(tmp_path, off, caplog):
    path = write_checkpoint(tmp_path / "two.ckpt", "phase=phase2")
    given = torch.load(path, weights_only=True)["state_dict"]
    part = (f"model.dptf.{off}=null", f"phase.init_from={path}")
    with caplog.at_level(logging.INFO):
        _, _, after = give(path, "phase=phase2", *part, "phase.epochs=0")
    assert all(torch.equal(value, given[f"model.{key}"]) for key, value in after.items())
    left = [key for key in given if key.removeprefix("model.") not in after]
    assert left and all(ADDED.match(key.removeprefix("model.")) for key in left)
    assert f"switched off: {len(left)} tensors of {path}" in caplog.text
    with pytest.raises(CheckpointError, match="unexpected"):
        give(path, "phase=phase2", *part)  # to train on, it is another model


@pytest.mark.parametrize("fewer", [1, 2])
def test_trained_weights_are_scored_with_their_last_layers_alone(tmp_path, fewer, caplog):
    path = write_checkpoint(tmp_path / "three.ckpt", "phase=phase1", "model.ocsf.num_layers=3")
    given = torch.load(path, weights_only=True)["state_dict"]
    command = ("phase=phase1", f"model.ocsf.num_layers={fewer}", f"phase.init_from={path}")
    with caplog.at_level(logging.INFO):
        _, _, after = give(path, *command, "phase.epochs=0")
    for key, value in after.items():
        stack, layers, rest = f"model.{key}".partition("encoder.layers.")
        number = f"{int(rest[0]) + 3 - fewer}{rest[1:]}" if layers else ""
        assert torch.equal(value, given[f"{stack}{layers}{number}"])
    assert f"passed over: the first {3 - fewer} of 3 layers of {path}" in caplog.text
    with pytest.raises(CheckpointError, match=r"unexpected ocsf\.encoder\.layers\.[12]\."):
        give(path, *command)  # to train on, it is another model


def test_weights_are_not_scored_with_more_layers_than_they_have(tmp_path):
    path = write_checkpoint(tmp_path / "one.ckpt", "phase=phase1", "model.ocsf.num_layers=1")
    with pytest.raises(CheckpointError, match=r"missing ocsf\.encoder\.layers\.1\."):
        give(path, "phase=phase1", "model.ocsf.num_layers=2", f"phase.init_from={path}", "phase.epochs=0")


@pytest.mark.parametrize("wanted", ["phase=phase1", "phase=phase1 model.ocsf.num_layers=1"])
def test_layers_passed_over_hide_no_other_phase(tmp_path, wanted):
    path = write_checkpoint(tmp_path / "two.ckpt", "phase=phase2", "model.dptf.bev_path=null")
    with pytest.raises(CheckpointError, match=r"unexpected ocsf\.encoder\.layers\.0\.temporal_attention"):
        give(path, *wanted.split(), f"phase.init_from={path}", "phase.epochs=0")


def test_a_checkpoint_of_phase_2_into_phase_1_names_the_memory(tmp_path):
    path = write_checkpoint(tmp_path / "two.ckpt", "phase=phase2", "model.dptf.gaussian_path.self_attention=null")
    with pytest.raises(CheckpointError, match=r"unexpected dptf\.bev_path.*more"):
        give(path, "phase=phase1")


@pytest.mark.slow
def test_broken_files_are_refused(phase_1, tmp_path):
    content = phase_1.read_bytes()
    half, flipped, text, foreign, nothing = (
        tmp_path / name for name in ("half.ckpt", "flipped.ckpt", "text.ckpt", "foreign.ckpt", "empty.ckpt")
    )
    half.write_bytes(content[: len(content) // 2])
    middle = len(content) // 2
    inverted = bytes(byte ^ 255 for byte in content[middle : middle + 64])
    flipped.write_bytes(content[:middle] + inverted + content[middle + 64 :])
    text.write_text("not a checkpoint")
    nothing.write_bytes(b"")
    torch.save({"state_dict": {"weight": torch.ones(2)}}, foreign)
    for path, words in (
        (half, "truncated"),
        (flipped, "damaged"),
        (text, "truncated, or no checkpoint"),
        (nothing, "truncated"),
        (foreign, "not of this project"),
        (tmp_path / "gone.ckpt", "does not exist"),
    ):
        with pytest.raises(CheckpointError, match=f"{path.name}.*{words}"):
            give(path, "phase=phase2")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(phase_1, tmp_path, value):
    content = torch.load(phase_1, weights_only=True)
    content["state_dict"]["model.kggi.source_embedding.weight"][2, 3] = value
    path = tmp_path / "diverged.ckpt"
    torch.save(content, path)
    with pytest.raises(CheckpointError, match=r"diverged.ckpt .*not finite, kggi\.source_embedding\.weight"):
        give(path, "phase=phase2")


@pytest.mark.slow
def test_settings_without_weights_that_differ_are_logged(phase_1, caplog):
    """A margin or a threshold is no tensor: it fits, but the phases then mean different things."""
    harmless = ("model.loss.ocsf_weight=2", "model.dptf.max_age_s=0.55", "data.num_workers=0")
    give(phase_1, "phase=phase2", "model.ocsf.margin_m=1.6", "data.num_sweeps=1", *harmless)
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    text = "{} in the run these weights come from and is {} now"
    assert sorted(warned) == [text.format("data.num_sweeps was 2", 1), text.format("model.ocsf.margin_m was 4.8", 1.6)]


def test_a_phase_that_gives_the_network_other_inputs_says_so():
    before, after = (
        {"data": {"num_sweeps": 5, "timeline": {"radial_speeds": source, "scored_rays": rays}}, "grid": None}
        for source, rays in (("radar", 64), ("none", 128))
    )
    assert differing_settings(before, after, ()) == {"data.timeline.radial_speeds": ("radar", "none")}
    assert differing_settings(before, {"data": {"num_sweeps": 6, "timeline": None}}, ()) == {"data.num_sweeps": (5, 6)}


@pytest.mark.slow
@pytest.mark.parametrize("key", INPUT_SETTINGS)
def test_every_setting_of_the_inputs_is_there_and_is_compared(key):
    """A field that was renamed would otherwise end its warning in silence."""
    _, before = compose_config(["scale=debug", "model=lrs4fusion", "phase=lrs_forecast"])
    after = copy.deepcopy(before)
    *path, name = key.split(".")
    part = functools.reduce(operator.getitem, path, after)
    assert name in part
    part[name] = "another"
    assert differing_settings(before, after, ()).keys() == {key}


# ---------------------------------------------------------------- the commands


@pytest.fixture(scope="module")
def handed_over(tmp_path_factory):
    """One command that asks for phase 2 where there is nothing yet: (outputs, phase-1 run, phase-2 run, its output)."""
    outputs = tmp_path_factory.mktemp("outputs")
    result = call("train", "phase=phase2", "scale=debug", f"paths.outputs={outputs}")
    (first,), (second,) = outputs.glob("horizon3d-phase1-debug-*"), outputs.glob("horizon3d-phase2-debug-*")
    return outputs, first, second, result


def record(run):
    return json.loads((run / "run.json").read_text())


@pytest.mark.slow
def test_a_missing_phase_1_is_trained_first_and_said(handed_over):
    _, first, second, result = handed_over
    assert first.name == identity("phase=phase1") and record(first)["run_id"] == first.name
    assert second.name == source_of("phase=phase2")[1]
    assert record(second)["initialized_from"] == first.name and record(first)["initialized_from"] is None
    assert f"no finished run {first.name} to start from: training it first" in result.stderr
    log = (second / "log.txt").read_text()
    assert f"weights from {first / 'checkpoints' / 'last.ckpt'}; new: " in log
    columns = (second / "metrics.csv").read_text().splitlines()[0]
    for term in ("cell_focal", "cell_dice", "cell_lovasz", "cell_velocity", "gaussian_velocity"):
        assert f"loss/{term}" in columns, term


@pytest.mark.slow
def test_evaluate_gives_the_scores_of_the_training(handed_over, tmp_path):
    outputs, _, second, _ = handed_over
    checkpoint = f"checkpoint={second / 'checkpoints' / 'last.ckpt'}"
    evaluate.main([checkpoint, f"out={tmp_path / 'same'}", f"paths.outputs={outputs}"])
    assert (tmp_path / "same" / "metrics.json").read_text() == (second / "metrics.json").read_text()
    assert name_of_checkpoint(second / "checkpoints" / "last.ckpt") == f"{second.name}-last"
    short = (checkpoint, "model.dptf.max_age_s=0.55", f"out={tmp_path / 'short'}", f"paths.outputs={outputs}")
    call("evaluate", *short)
    assert (
        json.loads((tmp_path / "short" / "metrics.json").read_text()).keys()
        == json.loads((second / "metrics.json").read_text()).keys()
    )


@pytest.mark.slow
def test_restarting_phase_2_leaves_phase_1_alone(handed_over):
    outputs, first, second, _ = handed_over
    before = {path: path.stat().st_mtime_ns for path in first.rglob("*") if path.is_file()}
    scores, record_of = (second / "metrics.json").read_text(), (second / "run.json").stat().st_mtime_ns
    call("train", "phase=phase2", "scale=debug", f"paths.outputs={outputs}", "resume=restart")
    assert before == {path: path.stat().st_mtime_ns for path in first.rglob("*") if path.is_file()}
    assert (second / "run.json").stat().st_mtime_ns > record_of
    assert len(list(outputs.glob(f"{second.name}.before-*"))) == 1
    assert (second / "metrics.json").read_text() == scores  # from the same weights, with the same seed


@pytest.mark.slow
def test_a_run_says_which_weights_it_began_from_after_a_resumption_too(handed_over, tmp_path):
    outputs, first, second, _ = handed_over
    copied = shutil.copytree(outputs, tmp_path / "outputs")
    (copied / second.name / "run.json").unlink()
    (copied / first.name / "checkpoints" / "last.ckpt").write_bytes(b"of another training")
    call("train", "phase=phase2", "scale=debug", f"paths.outputs={copied}", "trainer.num_pictures=0")
    assert record(first)["weights"] == record(second)["initial_weights"] != record(second)["weights"]
    assert record(copied / second.name)["initial_weights"] == record(first)["weights"]


@pytest.mark.slow
def test_the_weights_of_phase_1_are_read_once(handed_over, monkeypatch):
    outputs, first, _, _ = handed_over
    load, loads = torch.load, []
    monkeypatch.setattr(torch, "load", lambda file, **options: loads.append(Path(file.name)) or load(file, **options))
    overrides = ("phase=phase2", "scale=debug", f"paths.outputs={outputs}", "seed=1", "trainer.num_pictures=0")
    call("train", *overrides, f"phase.init_from={first / 'checkpoints' / 'last.ckpt'}")
    assert loads == [first / "checkpoints" / "last.ckpt"]


@pytest.mark.slow
def test_a_given_checkpoint_is_taken_whatever_run_it_is_of(handed_over):
    outputs, first, second, _ = handed_over
    path = first / "checkpoints" / "last.ckpt"
    arguments = ("phase=phase2", "scale=debug", f"paths.outputs={outputs}", f"phase.init_from={path}")
    call("train", *arguments, "trainer.num_pictures=0")
    run = outputs / source_of(*arguments[:1], arguments[-1])[1]
    assert run != second and record(run)["initialized_from"] == source_of("phase=phase2", arguments[-1])[0].identity
    scores = [json.loads((one / "metrics.json").read_text()) for one in (run, second)]
    assert scores[0] == scores[1]  # the same weights by another way


@pytest.mark.slow
def test_phase_1_for_further_epochs(handed_over, caplog):
    caplog.set_level(logging.INFO)
    outputs, first, _, _ = handed_over
    own = ("phase=phase1", "phase.init_from=phase1", "phase.epochs=2")
    call("train", "scale=debug", f"paths.outputs={outputs}", "trainer.num_pictures=0", *own)
    run = outputs / source_of(*own)[1]
    assert record(run)["initialized_from"] == first.name and record(run)["epochs"] == 2 and run != first
    assert f"weights from {first / 'checkpoints' / 'last.ckpt'}; new: 0 tensors in nothing" in caplog.text


@pytest.mark.slow
def test_frozen_statistics_are_those_of_phase_1_after_a_training(handed_over):
    outputs, first, second, _ = handed_over
    own = ("phase=phase2", "phase.frozen_statistics=true")
    call("train", "scale=debug", f"paths.outputs={outputs}", *own)
    runs = (first, outputs / source_of(*own)[1], second)
    given, frozen, moved = (
        torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for run in runs
    )
    statistics = [key for key in given if key.endswith(("running_mean", "running_var"))]
    assert len(statistics) > 10 and all(torch.equal(given[key], frozen[key]) for key in statistics)
    assert not any(torch.equal(given[key], moved[key]) for key in statistics)
    learnt = "model.head.heatmaps.0.norm.weight"
    assert not torch.equal(given[learnt], frozen[learnt])


@pytest.mark.slow
def test_weights_are_scored_once_more_with_other_settings(handed_over, tmp_path):
    """Without an epoch: the scores and the weights of the run they come from, unless a setting of inference differs."""
    outputs, _, second, _ = handed_over
    untrained = ("phase=phase2", f"phase.init_from={second.name}", "phase.epochs=0")

    def scored(*settings):
        call("train", "scale=debug", f"paths.outputs={outputs}", "trainer.num_pictures=0", *untrained, *settings)
        return outputs / source_of(*untrained, *settings)[1]

    same, few = scored(), scored("model.head.max_boxes=3")
    assert (same / "metrics.json").read_text() == (second / "metrics.json").read_text()
    assert (record(same)["epochs"], record(same)["steps"], record(same)["initialized_from"]) == (0, 0, second.name)
    boxes = [json.loads((run / "submission.json").read_text())["results"].values() for run in (same, few)]
    assert max(map(len, boxes[0])) > 3 >= max(map(len, boxes[1]))
    weights = [torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for run in (second, few)]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(value, weights[1][key]) for key, value in weights[0].items())
    evaluate.main([f"checkpoint={few / 'checkpoints' / 'last.ckpt'}", f"out={tmp_path}", f"paths.outputs={outputs}"])
    assert (tmp_path / "metrics.json").read_text() == (few / "metrics.json").read_text()


@pytest.mark.slow
def test_an_interrupted_phase_1_ends_the_command_resumably(handed_over, tmp_path):
    (world,) = (handed_over[0] / "worlds").iterdir()
    log = tmp_path / identity("phase=phase1") / "log.txt"
    said = tmp_path / "said"
    arguments = ("phase=phase2", "scale=debug", f"paths.outputs={tmp_path}", f"data.root={world}")
    process = fork(run_module, "train", *arguments, out=said, err=said)
    deadline = time.monotonic() + 300
    while not log.is_file():
        assert time.monotonic() < deadline and process.is_alive()
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGTERM)
    process.join(300)
    output = said.read_text()
    assert process.exitcode == 6, output[-3000:]
    assert f"the run {log.parent.name} that comes first ended with exit code 6" in output
    assert not list(tmp_path.glob("horizon3d-*/run.json"))


@pytest.mark.slow
def test_without_phase_1_and_without_training_it(tmp_path):
    overrides = ("phase=phase2", "scale=debug", f"paths.outputs={tmp_path}")
    result = call("train", *overrides, "phase.train_missing=false", expect=3)
    wanted = identity("phase=phase1")
    assert wanted in result.stderr and f"python -m src.train phase=phase1 scale=debug paths.outputs={tmp_path}" in (
        result.stderr
    )
    assert "Traceback" not in result.stderr and not (tmp_path / wanted).exists()


def made_trainings(*arguments):
    made = subprocess.run(["make", "-n", "train", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return [shlex.split(line.split("src.train")[1]) for line in made.stdout.splitlines() if "src.train" in line]


def test_make_trains_a_model_with_phases_of_its_own_in_all_of_them():
    lines = made_trainings("MODEL=lrs4fusion", "SCALE=debug")
    assert lines == [
        ["model=lrs4fusion", f"phase=lrs_{n}", "scale=debug"] for n in ("occupancy", "forecast", "detection")
    ]
    sources = [compose_config(line)[0].phase.init_from for line in lines]
    assert sources == [None, "lrs_occupancy", "lrs_occupancy"]
    assert made_trainings("MODEL=lrs4fusion", "PHASE=forecast") == [["model=lrs4fusion", "phase=lrs_forecast"]]
    assert made_trainings("MODEL=dense_bev") == [["model=dense_bev", "phase=phase1"]]
    for wrong in ("PHASE=1", "CHECKPOINT=a.ckpt"):
        made = subprocess.run(
            ["make", "-n", "train", "MODEL=lrs4fusion", wrong], cwd=ROOT, capture_output=True, text=True
        )
        assert made.returncode == 2 and wrong in made.stderr


def test_make_hands_the_checkpoint_on():
    def shown(*arguments):
        (line,) = made_trainings(*arguments)
        return line

    path = "/a folder/x=1, y/last.ckpt"
    options = shown("PHASE=2", f"CHECKPOINT={path}")
    assert options[0] == "phase=phase2" and compose_config(options)[0].phase.init_from == path
    assert shown("PHASE=2", "SCALE=debug") == ["phase=phase2", "scale=debug"]
    assert shown() == ["phase=phase1"] and shown("PHASE=1_further") == ["phase=phase1_further"]
    for phase in ("", "3", "phase2"):
        wrong = subprocess.run(["make", "-n", "train", f"PHASE={phase}"], cwd=ROOT, capture_output=True, text=True)
        assert wrong.returncode == 2 and f"PHASE={phase}: must be 1, 1_further or 2" in wrong.stderr
    helped = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "PHASE=1|1_further|2" in helped and "CHECKPOINT=PATH" in helped


def test_norms_that_were_handed_over_may_keep_their_statistics():
    """Those of the temporal part are new. Affine parameters learn, also in the head, which applies its norms itself."""
    config, tree = compose_config(["scale=debug", "phase=phase2", "phase.frozen_statistics=true"])
    model = build_model(config)
    frozen = norms_handed_over(model)
    names = {id(module): name for name, module in model.named_modules()}
    held = {names[id(norm)] for norm in frozen}
    every = {
        name
        for name, module in model.named_modules()
        if isinstance(module, torch.nn.BatchNorm2d | torch.nn.BatchNorm1d)
    }
    assert every - held == {name for name in every if name.startswith("dptf.")} and len(held) > 10
    module = TrainingModule(model, config.optim, 1.0, None, 0, tree, frozen_norms=frozen)
    for mode in (True, False, True):
        module.train(mode)
        assert [norm.training for norm in frozen] == [False] * len(frozen)
    assert model.dptf.bev_path.norms[0].training and model.head.heatmaps[0].training
    branches, before = model.head.heatmaps[0], model.head.heatmaps[0].norm.running_mean.clone()
    branches(torch.randn(9, config.model.channels) + 3.0).sum().backward()
    assert torch.equal(branches.norm.running_mean, before) and branches.norm.weight.grad.any()
