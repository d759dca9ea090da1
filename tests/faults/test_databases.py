"""The database of a sweep is lost, broken or slow in time while runs train; what they leave is not lost."""

import logging
import sqlite3
import threading

import pytest

from src.errors import ConfigError
from src.report.sweep_record import read_record, record_path
from src.sweep import runner as runner_module
from src.sweep.sweep_study import GRACE_PERIOD_S
from tests.running import wait_for
from tests.sweep.fake_sweep import ROOT, make_runner, make_sweep, trained

ROWS = {"a": ["model.x=1"], "b": ["model.x=2"], "c": ["model.x=3"]}
pytestmark = pytest.mark.faults


@pytest.fixture(autouse=True)
def at_the_root(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(runner_module, "DATABASE_RETRY_S", 0.2)


def sweep_of(seconds, rows=ROWS):
    return make_sweep(rows, overrides=[f"fake.seconds={seconds}"])


def beside(action):
    """Do something in another thread while the sweep runs in this one, where its signals are."""
    failures = []

    def run():
        try:
            action()
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, failures


def database(folder):
    return folder / "outputs" / "sweeps" / "sweeps.db"


def away(folder, began, until):
    """Overwrite the database once a run has begun, and bring the old content back when `until` is true."""

    def act():
        wait_for(lambda: trained(folder, "begin").total() >= began)
        content = database(folder).read_bytes()
        database(folder).write_bytes(b"no database " * 1000)
        wait_for(until)
        database(folder).write_bytes(content)

    return act


def test_a_database_that_comes_back_costs_no_run(tmp_path, caplog):
    """It is garbage while the first run ends, so its end cannot be stored."""
    runner = make_runner(tmp_path, sweep_of(0.4))
    thread, failures = beside(away(tmp_path, 1, lambda: "retrying" in caplog.text))
    with caplog.at_level(logging.WARNING):
        record = runner.run()
    thread.join()
    assert not failures and "retrying for 15 minutes" in caplog.text
    assert record.count("done") == 3
    assert set(trained(tmp_path, "begin").values()) == {1} and trained(tmp_path, "begin").total() == 3


def test_a_run_that_failed_meanwhile_is_released(tmp_path, caplog):
    """Nobody else would free it: the process that had it lives."""
    runner = make_runner(tmp_path, sweep_of(0.3, {"a": ["model.x=1"]}))
    (spec,) = runner.plan.specs.values()
    fault = tmp_path / "outputs" / "faults" / spec.run_id
    fault.parent.mkdir(parents=True)
    fault.write_text("1")
    thread, failures = beside(away(tmp_path, 1, lambda: "retrying" in caplog.text))
    enough = threading.Timer(0.7 * GRACE_PERIOD_S, setattr, (runner.stop, "requested", True))
    enough.start()  # by its silence the trial would be found dead in the end
    record = runner.run()
    enough.cancel()
    thread.join()
    assert not failures
    assert record.count("done") == 1 and trained(tmp_path, "begin").total() == 2


@pytest.mark.parametrize("loss", ["garbage", "deleted"])
def test_a_database_that_is_lost_ends_the_sweep_and_no_finished_run(tmp_path, monkeypatch, loss):
    monkeypatch.setattr(runner_module, "DATABASE_TIMEOUT_S", 1.0)

    def lose():
        wait_for(lambda: trained(tmp_path, "begin").total() >= 2)
        if loss == "garbage":
            database(tmp_path).write_bytes(b"no database " * 1000)
        else:
            database(tmp_path).unlink()

    thread, failures = beside(lose)
    with pytest.raises(ConfigError, match="the database of the sweep cannot be used") as caught:
        make_runner(tmp_path, sweep_of(0.6)).run()
    thread.join()
    assert not failures and "\n" not in str(caught.value) and caught.value.exit_code == 3
    ended = trained(tmp_path, "end")
    assert ended

    database(tmp_path).unlink(missing_ok=True)  # what the message advises
    record = make_runner(tmp_path, sweep_of(0.0)).run()
    assert record.count("done") == 3
    assert all(trained(tmp_path, "end")[name] == 1 for name in ended)  # none of them was trained again
    stored = read_record(record_path(tmp_path / "reports", "fake", "debug"))
    assert stored.count("done") == 3


def test_a_clock_that_jumps_ahead_makes_no_run_train_twice(tmp_path):
    """The heartbeat of a run that trains looks old; a second runner must not train beside it."""
    second = []

    def jump():
        wait_for(lambda: trained(tmp_path, "begin").total() == 1)
        with sqlite3.connect(database(tmp_path), timeout=30) as connection:
            past = f"-{10 * GRACE_PERIOD_S} seconds"
            wait_for(lambda: connection.execute("SELECT count(*) FROM trial_heartbeats").fetchone()[0] == 1)
            connection.execute("UPDATE trial_heartbeats SET heartbeat = datetime('now', ?)", (past,))
            connection.execute("UPDATE trials SET datetime_start = datetime('now', ?)", (past,))
        runner = make_runner(tmp_path, sweep_of(2.0, {"a": ["model.x=1"]}))
        with runner.study.lock():
            second.append([trial.run_id for trial in runner.study.release_dead()])
        second.append(runner._step(1))

    thread, failures = beside(jump)
    record = make_runner(tmp_path, sweep_of(2.0, {"a": ["model.x=1"]})).run()
    thread.join()
    assert not failures and len(second) == 2
    assert trained(tmp_path, "begin").total() == 1 and record.count("done") == 1
