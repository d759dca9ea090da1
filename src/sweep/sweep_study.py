"""The Optuna study of a sweep: who trains what at this moment, on which machine, and what became of it.

Every step that looks at the trials and then acts on them happens under one file lock: a worker chooses a cell, makes
its trial and takes it before another worker looks. So Optuna never holds a trial that nobody has taken, and a taken
one always names its worker.
"""

from __future__ import annotations

import fcntl
import os
import socket
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import optuna
from optuna.storages import RDBStorage
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from src.errors import ConfigError
from src.reliability.passwords import masked, without_secrets
from src.sweep.storage_address import for_optuna

FORMAT = 1
HEARTBEAT_S = 60
GRACE_S = 300
"""A worker of another machine that has not been heard of for so long is dead."""
CONNECT_S = 15
DATABASE_FAULTS = (
    SQLAlchemyError, optuna.exceptions.StorageInternalError, ImportError, RuntimeError, ValueError, LookupError,
    UnboundLocalError,
)  # fmt: skip
"""What SQLAlchemy, Optuna and a driver raise over an address or a database; the last one where it is away at the end
of a trial, which Optuna does not expect."""


class DatabaseError(ConfigError):
    """The database of a sweep cannot be used, which may pass."""


class CellEndedError(Exception):
    """Ends a trial as failed; with a reason unless the cell is to be trained on."""


@dataclass(frozen=True)
class Attempt:
    """One trial of the study."""

    number: int
    run_id: str | None
    state: str  # running, done, pruned, failed, or interrupted: to be gone on with
    worker: str | None
    reason: str | None
    started: float | None  # seconds since 1970
    ended: float | None
    value: float | None
    params: dict[str, Any]
    attrs: dict[str, Any]


def trials_begun(attempts: Iterable[Attempt]) -> int:
    """Trials of a search that have got their values; one that goes on with another is that one."""
    return sum(attempt.run_id is not None and "retry_of" not in attempt.attrs for attempt in attempts)


class Hold:
    """A lock that is held; it can be let go before the block ends."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def release(self) -> None:
        """Let go; nothing happens the second time."""
        self._file.close()


@contextmanager
def file_lock(path: Path) -> Iterator[Hold]:
    """Hold the lock file, waiting for it; the system lets go when the process dies."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield Hold(file)
    finally:
        file.close()


@contextmanager
def database_errors(url: str) -> Iterator[None]:
    """Turn what a database and its driver raise into one line with the masked address. Raises DatabaseError."""
    remedy = "check storage=..., and that the server runs; finished runs are kept, the same command goes on"
    try:
        yield
    except DATABASE_FAULTS as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, SQLAlchemyError):
            cause = cause.__cause__ or cause.__context__
        if cause is None and isinstance(error, UnboundLocalError):
            raise
        error = cause or error
        said = str(getattr(error, "orig", None) or error).strip().splitlines() or [type(error).__name__]
        said = without_secrets(" ".join(line.strip() for line in said[:2]), url)
        if isinstance(error, ImportError):
            remedy = 'a PostgreSQL server needs `pip install "horizon3d[postgres]"`'
        raise DatabaseError(
            f"storage={masked(url)}: the database of the sweep cannot be used ({said}); {remedy}"
        ) from error


class SweepStudy:
    """The trials of one sweep at one scale, shared by all its workers on all machines."""

    def __init__(self, outputs: Path, name: str, url: str, definition: dict[str, Any]) -> None:
        """Open the study, making it if missing. Raises ConfigError for a database that cannot be used and for a study
        that another definition of the sweep made.
        """
        self.name, self.url = name, url
        self.folder = outputs / "sweeps" / name
        self._this_machine = _machine()
        self._lost: set[int] = set()  # trials of this process whose end the database did not take
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        with file_lock(outputs / "sweeps" / ".lock"), database_errors(url):  # two creators at once would collide
            self._storage = _open_storage(url)
            study = optuna.create_study(
                storage=self._storage, study_name=name, direction="maximize", load_if_exists=True
            )
            made_by = study.user_attrs.get("definition")
            if made_by is None and not study.get_trials(deepcopy=False):
                study.set_user_attr("definition", definition)
                made_by = definition
        if made_by != definition:
            made_by = made_by or {}
            changed = sorted(
                key for key in definition.keys() | made_by.keys() if definition.get(key) != made_by.get(key)
            )
            what = "; ".join(f"{key} was {made_by.get(key)!r} and is {definition.get(key)!r}" for key in changed)
            raise ConfigError(
                f"study {name} in storage={masked(url)} was made by another definition of the sweep ({what}); give "
                f"storage=sqlite:///another.db, or remove it: optuna delete-study --study-name {name} --storage URL. "
                "Finished runs are kept"
            )

    def lock(self) -> Any:
        """The lock under which workers look and choose, and the record is written."""
        return file_lock(self.folder / ".lock")

    def attempts(self) -> list[Attempt]:
        """Every trial, oldest first."""
        with database_errors(self.url):
            return [_attempt(trial) for trial in self._load().get_trials(deepcopy=False)]

    def clear_dead(self) -> list[Attempt]:
        """Free what dead workers had; the lock is held. Returns what was theirs.

        Dead is a worker of this machine whose process is gone, one of another that has not been heard of for
        `GRACE_S`, and one that took a trial and left no name. A trial that waits is nobody's: see the module. So is
        one of this process that ended while the database was away.
        """
        with database_errors(self.url), warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study = self._load()
            open_states = (TrialState.RUNNING, TrialState.WAITING)
            before = study.get_trials(deepcopy=False, states=open_states)
            for trial in before:
                if trial.state == TrialState.WAITING or self._is_gone(trial):
                    self._fail(trial)
            optuna.storages.fail_stale_trials(study)
            still = {trial.number for trial in study.get_trials(deepcopy=False, states=open_states)}
            return [_attempt(trial) for trial in before if trial.number not in still]

    def _fail(self, trial: FrozenTrial) -> None:
        try:
            self._storage.set_trial_state_values(trial._trial_id, state=TrialState.FAIL)
        except optuna.exceptions.UpdateFinishedTrialError:
            pass  # its worker ended it at this moment

    def _is_gone(self, trial: FrozenTrial) -> bool:
        worker = trial.user_attrs.get("worker")
        if worker is None or trial._trial_id in self._lost:
            return True
        if worker["machine"] == self._this_machine:
            return _born(worker["pid"]) != worker["born"]
        # Optuna never calls a trial stale whose worker died before its first heartbeat.
        old = trial.datetime_start is not None and time.time() - trial.datetime_start.timestamp() > GRACE_S
        return old and trial._trial_id not in self._heard_of()

    def _heard_of(self) -> set[int]:
        with self._storage.engine.connect() as connection:
            return set(connection.execute(text("SELECT trial_id FROM trial_heartbeats")).scalars())

    def add_failed(self, attrs: dict[str, Any], reason: str) -> None:
        """Note a cell that fails without having been tried; the lock is held."""
        with database_errors(self.url):
            attrs = attrs | {"reason": reason}
            self._load().add_trial(optuna.create_trial(state=TrialState.FAIL, user_attrs=attrs))

    def take(
        self,
        hold: Hold,
        work: Callable[[Trial], float],
        choose: Callable[[Trial], None] | None = None,
        attrs: dict[str, Any] | None = None,
        params: dict[str, Any] | None = None,
        sampler: optuna.samplers.BaseSampler | None = None,
        pruner: optuna.pruners.BasePruner | None = None,
    ) -> None:
        """Make a trial and take it; the lock, which is held, is let go once the trial names its worker. Then `work`.

        `params` are tried again as they are; None lets the sampler choose. `choose` sees the trial before the lock is
        let go. `work` returns the score, or raises CellEndedError or TrialPruned.
        """
        me = {
            "machine": self._this_machine,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "born": _born(os.getpid()),
        }
        taken: list[int] = []
        ended: list[bool] = []
        defects: list[BaseException] = []  # kept apart from what the database raises

        def objective(trial: Trial) -> float:
            taken.append(trial._trial_id)
            try:
                for key, value in (attrs or {}).items():
                    if key not in trial.user_attrs:
                        trial.set_user_attr(key, value)
                if choose is not None:
                    choose(trial)
                trial.set_user_attr("worker", me)
            finally:
                hold.release()
            try:
                return work(trial)
            except (CellEndedError, optuna.TrialPruned):
                raise
            except BaseException as error:
                defects.append(error)
                raise CellEndedError from error
            finally:
                ended.append(True)

        try:
            with database_errors(self.url):
                study = self._load(sampler, pruner)
                if params is not None:
                    study.enqueue_trial(params, user_attrs=attrs)
                try:
                    study.optimize(objective, n_trials=1, catch=(CellEndedError,))
                except (AssertionError, optuna.exceptions.UpdateFinishedTrialError):
                    # Another worker took this one for dead, as after a suspended machine; what the run left stays.
                    if not ended:
                        raise
        except DatabaseError:
            self._lost.update(taken)
            if not defects:
                raise
        if defects:
            raise defects[0]

    def reconnect(self) -> None:
        """Let go of the connections that are open: they may lead to a database that is no longer there."""
        self._storage.engine.dispose()

    def note(self, trial: Trial, key: str, value: Any) -> None:
        """Keep something with a trial, unless it was ended from outside."""
        with database_errors(self.url), suppress(optuna.exceptions.UpdateFinishedTrialError):
            trial.set_user_attr(key, value)

    def report(self, trial: Trial, value: float, step: int) -> bool:
        """Tell the pruner a value; whether it would end the trial, which it never would of one ended from outside."""
        with database_errors(self.url), suppress(optuna.exceptions.UpdateFinishedTrialError):
            trial.report(value, step)
            return trial.should_prune()
        return False

    def _load(
        self, sampler: optuna.samplers.BaseSampler | None = None, pruner: optuna.pruners.BasePruner | None = None
    ) -> optuna.Study:
        """A study object of this thread; without a sampler one that costs nothing."""
        sampler = sampler or optuna.samplers.RandomSampler(seed=0)
        return optuna.load_study(
            study_name=self.name, storage=self._storage, sampler=sampler, pruner=pruner or optuna.pruners.NopPruner()
        )


def _open_storage(url: str) -> RDBStorage:
    arguments: dict[str, Any] = {}
    if url.startswith("sqlite"):
        arguments = {"connect_args": {"timeout": 60}}
    elif url.startswith("postgresql"):
        arguments = {"connect_args": {"connect_timeout": CONNECT_S}, "pool_pre_ping": True}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return RDBStorage(
            for_optuna(url), engine_kwargs=arguments, heartbeat_interval=HEARTBEAT_S, grace_period=GRACE_S
        )


def _attempt(trial: FrozenTrial) -> Attempt:
    attrs = trial.user_attrs
    states = {TrialState.RUNNING: "running", TrialState.COMPLETE: "done", TrialState.PRUNED: "pruned"}
    state = states.get(trial.state) or ("failed" if attrs.get("reason") else "interrupted")
    worker = attrs.get("worker")
    return Attempt(
        number=trial.number,
        run_id=attrs.get("run_id"),
        state=state,
        worker=f"{worker['host']}:{worker['pid']}" if worker else None,
        reason=attrs.get("reason"),
        started=trial.datetime_start.timestamp() if trial.datetime_start else None,
        ended=trial.datetime_complete.timestamp() if trial.datetime_complete else None,
        value=trial.value if trial.state == TrialState.COMPLETE else attrs.get("value"),
        params=dict(trial.params),
        attrs=dict(attrs),
    )


def _machine() -> str:
    """What tells machines apart, and containers of one machine that do not see each other's processes."""
    parts = [socket.gethostname()]
    for read in (lambda: Path("/proc/sys/kernel/random/boot_id").read_text(), lambda: os.readlink("/proc/self/ns/pid")):
        try:
            parts.append(read().strip())
        except OSError:
            continue  # not Linux
    return "/".join(parts)


def _born(pid: int) -> str | None:
    """When a process of this machine started, None when there is none: numbers are used again."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] in "ZX" else fields[19]
    except OSError:
        pass
    if Path("/proc/self/stat").exists():
        return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return "alive"
