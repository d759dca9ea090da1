"""The study: its database, dead workers, and what is refused."""

import multiprocessing
import os
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from src.errors import ConfigError
from src.sweep.sweep_study import SweepStudy, TrialEndedError, check_address, default_storage
from tests.sweep.fake_sweep import ROOT, make_runner, make_sweep

ROWS = {"format": 1, "kind": "rows"}


@pytest.fixture
def study(tmp_path):
    return SweepStudy(tmp_path, "fake-debug", default_storage(tmp_path), ROWS)


def take(study, work, **more):
    with study.lock() as lock:
        study.release_dead()
        study.take(lock, work, attrs={"run_id": "a"}, params={}, **more)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("sqlite:////proc/nowhere/a.db", "unable to open"),
        ("garbage", "Could not parse"),
        ("nosuch://u:s3cret@h/db", "nosuch"),
        ("sqlite:///{folder}/garbage.db", "not a database"),
    ],
)
def test_a_database_that_cannot_be_used_is_told_in_a_line(tmp_path, url, said):
    (tmp_path / "garbage.db").write_bytes(os.urandom(5000))
    with pytest.raises(ConfigError, match=said) as caught:
        SweepStudy(tmp_path, "x", url.format(folder=tmp_path), ROWS)
    assert "s3cret" not in str(caught.value) and "\n" not in str(caught.value)


def test_a_server_that_does_not_answer_is_told_without_its_password(tmp_path):
    pytest.importorskip("psycopg", reason="psycopg is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(ConfigError, match="refused") as caught:
        SweepStudy(tmp_path, "x", f"postgresql+psycopg://me:s3cret@127.0.0.1:{port}/db", ROWS)
    assert "s3cret" not in str(caught.value) and "me:***@127.0.0.1" in str(caught.value)


@pytest.mark.slow
def test_the_lock_is_let_go_while_work_is_done_and_the_worker_is_named(study):
    def work(trial):
        with study.lock():  # another would wait for ever
            (trial,) = study.trials()
            assert trial.state == "running" and trial.worker == f"{socket.gethostname()}:{os.getpid()}"
            assert study.release_dead() == []
        return 0.5

    take(study, work)
    (trial,) = study.trials()
    assert (trial.state, trial.value, trial.run_id) == ("done", 0.5, "a")


@pytest.mark.slow
def test_failed_and_interrupted_differ_by_the_reason(study):
    def fail(trial):
        study.set_attr(trial, "reason", "why")
        raise TrialEndedError

    def interrupt(trial):
        raise TrialEndedError

    take(study, fail)
    take(study, interrupt)
    assert [trial.state for trial in study.trials()] == ["failed", "interrupted"]
    with study.lock():
        study.add_failed({"run_id": "b"}, "needs a")
    assert study.trials()[-1].reason == "needs a"


@pytest.mark.slow
def test_what_dead_workers_had_is_free_at_once(study, tmp_path):
    storage = optuna.storages.RDBStorage(default_storage(tmp_path))
    raw = optuna.load_study(study_name="fake-debug", storage=storage)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    mine = study._this_machine
    workers = [
        {"machine": mine, "host": "h", "pid": gone.pid, "start_time": "1"},  # dead
        {"machine": mine, "host": "h", "pid": os.getpid(), "start_time": "1"},  # its number was used again
        {"machine": "elsewhere", "host": "h", "pid": gone.pid, "start_time": "1"},  # not known to be dead
        None,  # killed between taking the trial and naming itself
    ]
    for worker in workers:
        trial = raw.ask()
        trial.set_user_attr("run_id", "a")
        if worker is not None:
            trial.set_user_attr("worker", worker)
    raw.enqueue_trial({})  # killed before taking it
    with study.lock():
        study.release_dead()
    states = [trial.state for trial in raw.trials]
    assert states == [TrialState.FAIL, TrialState.FAIL, TrialState.RUNNING, TrialState.FAIL, TrialState.FAIL]


@pytest.mark.slow
def test_a_worker_elsewhere_that_is_silent_too_long_is_dead(study, tmp_path, monkeypatch):
    def freeze(trial):
        deadline = time.monotonic() + 20
        while not study._with_heartbeat():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        with study._storage.engine.begin() as connection:  # as if no heartbeat had come for ten minutes
            connection.exec_driver_sql("UPDATE trial_heartbeats SET heartbeat = datetime('now', '-600 seconds')")
        monkeypatch.setattr(study, "_this_machine", "another")
        with study.lock():
            (dead,) = study.release_dead()
        assert dead.run_id == "a"
        return 0.5  # it was alive after all: no error, and what it trained stays in its folder

    take(study, freeze)
    assert [trial.state for trial in study.trials()] == ["interrupted"]


@pytest.mark.slow
def test_a_worker_elsewhere_that_died_before_its_first_heartbeat_is_dead_too(study, tmp_path, monkeypatch):
    raw = optuna.load_study(study_name="fake-debug", storage=optuna.storages.RDBStorage(default_storage(tmp_path)))
    trial = raw.ask()
    trial.set_user_attr("worker", {"machine": "elsewhere", "host": "h", "pid": 1, "start_time": "1"})
    assert study.release_dead() == []
    monkeypatch.setattr("src.sweep.sweep_study.GRACE_PERIOD_S", 0)
    assert len(study.release_dead()) == 1


@pytest.mark.slow
def test_another_definition_is_refused(study, tmp_path):
    SweepStudy(tmp_path, "fake-debug", default_storage(tmp_path), dict(ROWS))
    with pytest.raises(ConfigError, match=r"format was 1 and is 2.*delete-study --study-name fake-debug"):
        SweepStudy(tmp_path, "fake-debug", default_storage(tmp_path), ROWS | {"format": 2})
    url = f"sqlite:///{tmp_path}/other.db"
    optuna.create_study(study_name="fake-debug", storage=url).optimize(lambda trial: 1.0, n_trials=1)
    with pytest.raises(ConfigError, match="another definition"):
        SweepStudy(tmp_path, "fake-debug", url, ROWS)


def _create(folder, barrier):
    barrier.wait()
    SweepStudy(Path(folder), "fake-debug", default_storage(Path(folder)), ROWS)


@pytest.mark.slow
def test_many_may_create_the_database_at_once(tmp_path):
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(4)
    processes = [context.Process(target=_create, args=(str(tmp_path), barrier)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0, 0, 0]


def test_an_address_that_would_be_read_wrongly_is_refused_unseen():
    with pytest.raises(ConfigError, match="write @ as %40") as caught:
        check_address("postgresql://me:s3@cret@host/db")
    assert "s3" not in str(caught.value) and "cret" not in str(caught.value)
    check_address("sqlite:////a@b/c@d.db")
    check_address("postgresql://me:s3%40cret@host/db")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["{x}", "50%20off", "a?b", "a#b @:c", "{SCHEMA_VERSION}"])
def test_any_folder_can_hold_the_database(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    outputs = Path(name)
    SweepStudy(outputs, "fake-debug", default_storage(outputs), ROWS)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (outputs / "sweeps" / "sweeps.db").stat().st_size > 0


def test_the_default_address_is_as_relative_as_the_folder():
    assert default_storage(Path("outputs")) == "sqlite:///outputs/sweeps/sweeps.db"
    assert default_storage(Path("/o")) == "sqlite:////o/sweeps/sweeps.db"


@pytest.mark.parametrize("url", ["nosuch://me:s3{cret}@h/db", "nosuch://me:{s3cret@h/db", "nosuch://me:{0}s3cret@h/db"])
def test_braces_in_a_password_are_part_of_it_and_not_shown(tmp_path, url):
    with pytest.raises(ConfigError, match="cannot be used") as caught:
        SweepStudy(tmp_path, "x", url, ROWS)
    assert "cret" not in str(caught.value) and "nosuch" in str(caught.value)


# ---------------------------------------------------------------- PostgreSQL


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A private PostgreSQL server on a loopback port: (its address, what stops it)."""
    pytest.importorskip("psycopg", reason="psycopg is not installed (horizon3d[postgres])")
    found = [*Path("/usr/lib/postgresql").glob("*/bin/initdb"), *map(Path, filter(None, [shutil.which("initdb")]))]
    if not found:
        pytest.skip("no PostgreSQL server (initdb, pg_ctl) on this machine")
    binaries = found[0].parent
    folder = Path("/tmp") / f"horizon3d-postgres-{os.getpid()}"  # short, and another user can reach it
    folder.mkdir(mode=0o777)
    as_other: list[str] = []
    if os.geteuid() == 0:  # the server refuses root
        if shutil.which("setpriv") is None:
            pytest.skip("PostgreSQL refuses root, and there is no setpriv to become another user")
        shutil.chown(folder, "nobody")
        as_other = ["setpriv", "--reuid=nobody", "--regid=nogroup", "--clear-groups"]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    (folder / "password").write_text("s3cret")
    (folder / "password").chmod(0o644)

    def run(*words):
        words = [*as_other, *words]
        return subprocess.run(words, check=True, capture_output=True, text=True, cwd="/", timeout=90)

    run(str(binaries / "initdb"), "-D", str(folder / "data"), "-U", "me", "-A", "scram-sha-256", "--no-sync",
        "--pwfile", str(folder / "password"))  # fmt: skip
    options = f"-p {port} -h 127.0.0.1 -k {folder} -F"
    control = [str(binaries / "pg_ctl"), "-D", str(folder / "data"), "-w", "-l", str(folder / "log")]

    def stop():
        subprocess.run([*as_other, *control, "-m", "immediate", "stop"], capture_output=True, cwd="/", timeout=60)

    try:
        run(*control, "-o", options, "start")
        yield f"postgresql+psycopg://me:s3cret@127.0.0.1:{port}/postgres", stop
    finally:
        stop()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.slow
def test_several_runners_share_a_study_on_a_server(tmp_path, server):
    import json

    url, stop = server
    what = {"folder": str(tmp_path), "rows": {f"{i}": [f"model.x={i}"] for i in range(8)}, "storage": url, "workers": 2}
    what["sweep"] = {"overrides": ["fake.seconds=0.3"]}
    command = [
        sys.executable,
        "-m",
        "tests.sweep.fake_sweep",
        json.dumps(what | {"sweep": {"overrides": ["fake.seconds=0.3"]}}),
    ]
    runners = [subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    trained = tmp_path / "outputs" / "trained.txt"
    deadline = time.monotonic() + 60
    while not trained.exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)
    runners[0].kill()
    runners[0].communicate()
    runners[0] = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    for runner in runners:
        error = runner.communicate(timeout=90)[1]
        assert runner.returncode == 0, error
        assert "s3cret" not in error
    ends = [line.split()[1] for line in trained.read_text().splitlines() if line.startswith("end")]
    assert len(ends) == len(set(ends)) == 8
    assert "s3cret" not in (tmp_path / "reports" / "sweeps" / "fake_debug.json").read_text()

    runner = make_runner(tmp_path, make_sweep({"late": ["model.x=99"]}), storage=url)
    stop()
    with pytest.raises(ConfigError, match=r"me:\*\*\*@127.0.0.1") as caught:
        runner.run()
    assert "s3cret" not in str(caught.value)
