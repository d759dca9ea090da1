"""W&B beside metrics.csv: what is sent to it, and that nothing it does stops, slows or empties a run."""

import json
import logging
import os
import signal
import sys
import time
import types
from functools import partial
from pathlib import Path

import pytest
import yaml

from src.config import compose_config
from src.errors import ConfigError
from src.training import wandb as ours
from src.training.fit import build_loggers
from src.training.identity import run_identity
from src.training.run_folder import RunFolder
from src.training.wandb import WandbConfig, start_wandb
from tests.running import command, ended

REPOSITORY = Path(__file__).resolve().parents[2]
TREE = {"phase": {"name": "phase1"}, "scale": "debug", "seed": 3}
SCORES = {
    "mAP": 0.25,
    "NDS": 0.5,
    "classes": {"car": {"AP": 0.5, "AVE": 1.5, "recall": [0.0, 1.0]}, "bus": {"AP": 0.0, "AVE": None}},
    "ranges": {"0-25": {"mAP": 0.4}, "25-50": {"mAP": 0.2}},
}


def settings(**changes):
    return WandbConfig(**({"project": "p", "offline": True, "group": None, "row": None} | changes))


@pytest.fixture
def folder(tmp_path):
    run = RunFolder(tmp_path, "horizon3d-phase1-debug-00000000")
    run.pictures.mkdir(parents=True)
    return run


class FakeRun:
    """What start_wandb uses of a W&B run, with W&B's rule for steps."""

    def __init__(self, mode, folder, step):
        self.step, self.url = step, "https://wandb.example/run"
        self.settings = types.SimpleNamespace(mode=mode, sync_dir=str(folder / "wandb" / "offline-run-new"))
        self.rows, self.summary, self.finished, self.fault = [], {}, False, None

    def log(self, values, step=None):
        if self.fault is not None:
            raise self.fault
        assert step is None or step >= self.step, "W&B refuses this with a warning for each call"
        self.step = self.step if step is None else step
        self.rows.append((step, values))

    def finish(self):
        self.finished = True


@pytest.fixture
def wandb(monkeypatch, folder):
    """A W&B whose service can be made unreachable; it has `step` steps of the run already."""
    fake = types.ModuleType("wandb")
    fake.calls, fake.runs, fake.broken, fake.key, fake.step = [], [], (), True, 0

    def init(**arguments):
        fake.calls.append(("init", arguments["mode"]))
        if arguments["mode"] in fake.broken:
            raise ConnectionError(f"{arguments['mode']} is not to be had\nand more lines")
        fake.arguments = arguments
        fake.runs.append(FakeRun(arguments["mode"], folder.path, fake.step))
        return fake.runs[-1]

    fake.init = init
    fake.teardown = lambda: fake.calls.append(("teardown",))
    fake.login = lambda prompt, verify: fake.key and not prompt
    fake.Settings = lambda **given: types.SimpleNamespace(**given)
    fake.Table = lambda columns, data: (columns, data)
    fake.Image = lambda path: Path(path).name
    monkeypatch.setitem(sys.modules, "wandb", fake)
    return fake


def test_runs_are_grouped_by_sweep_and_row(wandb, folder):
    start_wandb(settings(group="epsilon-mini", row="4.8 m"), folder, TREE, [])
    given = wandb.arguments
    assert (given["group"], given["job_type"], given["name"]) == ("epsilon-mini", "4.8 m", "4.8 m, seed 3")
    assert given["id"] == folder.run_id and given["config"] is TREE and given["dir"] == str(folder.path)
    assert given["tags"] == ["phase1", "debug", "seed 3"] and given["mode"] == "offline"
    start_wandb(settings(), folder, TREE, [])
    assert wandb.arguments["name"] == folder.run_id and wandb.arguments["group"] is None


def test_the_end_sends_tables_pictures_and_the_summary_and_tells_where(wandb, folder):
    for name in ("frame_0_ab12.png", "memory_0_ab12.png", "curves.png"):
        (folder.pictures / name).write_bytes(b"")
    run = start_wandb(settings(), folder, TREE, [])
    run.log_metrics({"val/mAP": 0.2}, 9)
    assert run.finish(SCORES, folder.pictures) == f"wandb sync {folder.path}/wandb/offline-run-new"
    (fake,) = wandb.runs
    assert fake.rows == [
        (9, {"val/mAP": 0.2}),
        (
            None,
            {
                "classes": (["classes", "AP"], [["car", 0.5], ["bus", 0.0]]),
                "ranges": (["ranges", "mAP"], [["0-25", 0.4], ["25-50", 0.2]]),
                "pictures/curves": "curves.png",
                "pictures/frame_0": "frame_0_ab12.png",
                "pictures/memory_0": "memory_0_ab12.png",
            },
        ),
    ]
    assert fake.summary == {"mAP": 0.25, "NDS": 0.5} and fake.finished


def test_without_wandb_the_run_has_metrics_csv(monkeypatch, folder, caplog):
    monkeypatch.setitem(sys.modules, "wandb", None)  # what an import meets where it is not installed
    loggers = build_loggers(folder, None, settings(), TREE)
    assert [logger.name for logger in loggers] == ["metrics_csv"]
    assert "W&B is not installed" in caplog.text and "pip install wandb" in caplog.text


def test_an_unreachable_service_leaves_an_offline_run(wandb, folder, caplog):
    wandb.broken = ("online",)
    run = start_wandb(settings(offline=False), folder, TREE, [])
    assert wandb.calls == [("init", "online"), ("teardown",), ("init", "offline")]
    assert "could not start online (online is not to be had); it is written offline" in caplog.text
    assert run.finish(SCORES, folder.pictures).startswith("wandb sync ")
    assert ours.INIT_LIMIT_S <= 20 and wandb.arguments["settings"].init_timeout == ours.INIT_LIMIT_S
    assert wandb.arguments["settings"].finish_timeout == ours.FINISH_LIMIT_S > 0


def test_nobody_is_asked_for_a_key(wandb, folder, caplog):
    wandb.key = False
    start_wandb(settings(offline=False), folder, TREE, [])
    assert ("init", "online") not in wandb.calls and wandb.runs[0].settings.mode == "offline"
    assert "no API key; give one once with: wandb login" in caplog.text


def test_a_wandb_that_does_not_start_at_all_is_left_out(wandb, folder, caplog):
    wandb.broken = ("online", "offline")
    assert start_wandb(settings(offline=False), folder, TREE, []) is None
    assert "metrics.csv alone" in caplog.text


def test_a_wandb_that_dies_is_given_up_with_one_warning(wandb, folder, caplog):
    run = start_wandb(settings(), folder, TREE, [])
    wandb.runs[0].fault = ConnectionResetError("Connection lost")
    with caplog.at_level(logging.WARNING):
        for step in range(5):
            run.log_metrics({"loss/total": 1.0}, step)
        assert run.finish(SCORES, folder.pictures) is None
    assert len(caplog.records) == 1 and "Connection lost" in caplog.text and str(folder.path) in caplog.text


def test_a_resumed_run_loses_nothing_and_sends_nothing_twice(wandb, folder):
    """Online, the service has some steps already; the checkpoint may lie before them or behind."""
    rows = [{"step": str(step), "epoch": "0", "loss/total": str(step / 2)} for step in (9, 19, 29)]
    wandb.step = 20
    run = start_wandb(settings(offline=False), folder, TREE, rows)
    run.log_metrics({"loss/total": 19.5}, 39)
    assert [step for step, _ in wandb.runs[0].rows] == [29, 39]
    assert wandb.runs[0].rows[0][1] == {"epoch": 0.0, "loss/total": 14.5} and wandb.arguments["resume"] == "allow"
    wandb.step = 40
    run = start_wandb(settings(offline=False), folder, TREE, rows)
    for step in (35, 39, 45):
        run.log_metrics({"loss/total": 0.0}, step)
    assert [step for step, _ in wandb.runs[1].rows] == [45]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["logger=wandb", "logger.wandb.group="], "logger.wandb.group must have 1 to 128"),
        (["logger=wandb", f"logger.wandb.row={'x' * 129}"], "logger.wandb.row.*129"),
        (["logger=wandb", "logger.wandb.project=null"], "logger.wandb.project"),
    ],
)
def test_names_that_wandb_would_refuse_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        compose_config(["scale=debug", *overrides])


def test_labels_of_rows_can_be_typed():
    label = "BEV path, not compensated (4.8 m)"
    config, _ = compose_config(
        ["scale=debug", "logger=wandb", "logger.wandb.group=a-mini", f'logger.wandb.row="{label}"']
    )
    assert (config.logger.wandb.group, config.logger.wandb.row) == ("a-mini", label)


# ---------------------------------------------------------------- the real package


def real_run(outputs, *, offline, earlier, steps, killed):
    """A run of W&B with these steps; prints how it may be sent."""
    ours.INIT_LIMIT_S = 3.0
    folder = RunFolder(outputs, "run-0")
    folder.pictures.mkdir(parents=True, exist_ok=True)
    config = ours.WandbConfig(project="p", offline=offline, group="g", row="r")
    run = ours.start_wandb(config, folder, {"phase": {"name": "phase1"}, "scale": "debug", "seed": 0}, earlier)
    for step in steps:
        run.log_metrics({"loss/total": step / 2}, step)
    if killed:
        os.kill(os.getpid(), signal.SIGKILL)
    print(run.finish(SCORES, folder.pictures))


def apart(tmp_path):
    """Surroundings in which W&B knows nobody and reaches nothing."""
    known = {name: value for name, value in os.environ.items() if not name.startswith("WANDB_")}
    return known | {"HOME": str(tmp_path / "home"), "OMP_NUM_THREADS": "1"}


def start_real(tmp_path, environment=(), *, offline=True, earlier=(), steps=(), killed=False):
    work = partial(real_run, tmp_path / "outputs", offline=offline, earlier=earlier, steps=steps, killed=killed)
    return ended(work, timeout=180, env=apart(tmp_path) | dict(environment))


def history_of(path):
    """Rows of the .wandb file of an ended run as W&B would send them: {step: values}. Blocks of 32 KiB with records in
    fragments. W&B's own process writes them, and may end a moment after ours.
    """
    until = time.monotonic() + 30.0
    while not (rows := rows_of(path.read_bytes())) and time.monotonic() < until:
        time.sleep(0.1)
    return rows


def rows_of(content):
    from wandb.proto import wandb_internal_pb2

    at, record, rows = 7, b"", {}
    while at + 7 <= len(content):
        if 2**15 - at % 2**15 < 7:  # no room for a header: the block's end is padding
            at += 2**15 - at % 2**15
            continue
        length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        record += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or the last fragment
            message = wandb_internal_pb2.Record()
            message.ParseFromString(record)
            record = b""
            if message.HasField("history"):
                items = {item.key or "/".join(item.nested_key): item.value_json for item in message.history.item}
                values = {name: json.loads(value) for name, value in items.items()}
                rows.setdefault(values["_step"], {}).update(values)
    return rows


@pytest.mark.slow
def test_a_killed_offline_run_resumes_as_one(tmp_path):
    pytest.importorskip("wandb")
    killed = start_real(tmp_path, steps=(9, 19), killed=True)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    earlier = [{"step": "9", "epoch": "0", "loss/total": "4.5"}]  # the checkpoint lay before step 19
    done = start_real(tmp_path, earlier=earlier, steps=(19, 29))
    assert done.returncode == 0, done.stderr
    (kept,) = (tmp_path / "outputs" / "run-0" / "wandb").glob("offline-run-*")
    assert done.stdout.strip() == f"wandb sync {kept}"
    rows = history_of(kept / "run-run-0.wandb")
    assert {step: row["loss/total"] for step, row in rows.items()} == {9: 4.5, 19: 9.5, 29: 14.5}
    assert rows[29]["classes/_type"] == "table-file" and len(list(kept.glob("files/media/table/*.json"))) == 2


@pytest.mark.slow
def test_the_real_package_without_network_is_offline_within_its_limit(tmp_path):
    pytest.importorskip("wandb")
    nowhere = {"WANDB_API_KEY": "x" * 40, "WANDB_BASE_URL": "http://127.0.0.1:9"}
    done = start_real(tmp_path, nowhere, offline=False, steps=(9,))
    assert done.returncode == 0, done.stderr
    assert "could not start online" in done.stderr and done.stdout.startswith("wandb sync ")
    (kept,) = (tmp_path / "outputs" / "run-0" / "wandb").glob("offline-run-*")
    assert set(history_of(kept / "run-run-0.wandb")) == {9}


@pytest.mark.slow
def test_a_training_with_wandb_leaves_the_same_run_and_nothing_elsewhere(tmp_path):
    """The command itself, radar alone: one training, its W&B run below the run's folder, the command to send it."""
    pytest.importorskip("wandb")
    before = {path for path in REPOSITORY.rglob("*wandb*") if ".venv" not in path.parts and ".git" not in path.parts}
    overrides = ["scale=debug", "phase=phase1", "model.kggi=null", "model.ocsf=null", f"paths.outputs={tmp_path}"]
    done = command(
        *("train", *overrides, "trainer=cpu", "logger=wandb", "logger.wandb.row=radar only"), env=apart(tmp_path)
    )
    (record,) = tmp_path.glob("horizon3d-*/run.json")
    (offline,) = (record.parent / "wandb").glob("offline-run-*")
    assert done.stdout.strip().splitlines()[-1] == f"W&B: wandb sync {offline}"
    _, tree = compose_config(overrides)
    assert record.parent.name == run_identity(tree)  # as without a logger
    rows = history_of(next(offline.glob("*.wandb")))
    logged = set().union(*rows.values())
    media = {f"{name}/_type" for name in ("classes", "ranges", "pictures/frame_0", "pictures/curves")}
    assert {"loss/total", "val/mAP", "val/NDS", "lr"} | media <= logged
    after = {path for path in REPOSITORY.rglob("*wandb*") if ".venv" not in path.parts and ".git" not in path.parts}
    assert {path for path in after - before if path.suffix != ".pyc"} == set()
    assert yaml.safe_load((record.parent / "config.yaml").read_text())["logger"]["wandb"]["offline"] is True
