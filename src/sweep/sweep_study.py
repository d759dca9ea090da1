"""The Optuna study of a sweep: which worker on which machine trains what, and the outcome of each trial.

Every step that reads the trials and then acts on them holds one file lock: a worker chooses a run, creates its trial
and takes it before another worker reads. So the study never holds a waiting trial, and a running one always names its
worker.
"""

from __future__ import annotations

import fcntl
import logging
import os
import socket
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import optuna
from optuna.storages import RDBStorage
from optuna.storages._heartbeat import get_heartbeat_thread  # of `Study.optimize`; `ask` and `tell` go without
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy import text
from sqlalchemy.engine import URL
from sqlalchemy.exc import SQLAlchemyError

from src.errors import ConfigError
from src.reliability.passwords import masked, without_secrets

logger = logging.getLogger(__name__)

FORMAT = 1
HEARTBEAT_S = 60
GRACE_PERIOD_S = 300
"""A worker of another machine without a heartbeat for this long is dead."""
CONNECT_S = 15
DATABASE_FAULTS = (
    SQLAlchemyError, optuna.exceptions.StorageInternalError, ImportError, RuntimeError, ValueError, LookupError,
)  # fmt: skip
"""What SQLAlchemy, Optuna and a driver raise over an address or a database."""


class DatabaseError(ConfigError):
    """The database of a sweep cannot be used, which may pass."""


class TrialEndedError(Exception):
    """Ends a trial as failed; with a reason unless its run is to be resumed."""


@dataclass(frozen=True)
class SweepTrial:
    """One trial of the study."""

    number: int
    run_id: str | None
    state: str  # running, done, pruned, failed, or interrupted (to be resumed)
    worker: str | None
    reason: str | None
    started: float | None  # seconds since 1970
    ended: float | None
    value: float | None
    params: dict[str, Any]
    attrs: dict[str, Any]


def trials_begun(trials: Iterable[SweepTrial]) -> int:
    """Trials of a search that have values; one that resumes another is not counted again."""
    return sum(trial.run_id is not None and "retry_of" not in trial.attrs for trial in trials)


def default_storage(outputs: Path) -> str:
    """The SQLite database that studies of one machine share; its path is as relative as `outputs`."""
    path = str(outputs / "sweeps" / "sweeps.db")
    return URL.create("sqlite", database=path).render_as_string(hide_password=False)


def check_address(url: str) -> None:
    """Raises ConfigError, without showing the address, for one that SQLAlchemy would misread."""
    if not url.strip():
        raise ConfigError("storage is empty; give the address of a database, or leave storage= out for SQLite")
    if url.count("@") > 1 and not url.startswith("sqlite"):
        raise ConfigError("storage: its address has more than one @; write @ as %40 within user, password and options")


@contextmanager
def file_lock(path: Path) -> Iterator[TextIO]:
    """Wait for the lock file and hold it; closing the file, or the end of the process, releases it before the block."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield file


@contextmanager
def database_errors(url: str) -> Iterator[None]:
    """Turn what a database and its driver raise into one line with the masked address. Raises DatabaseError."""
    remedy = "check storage=..., and that the server runs; finished runs are kept, the same command resumes the sweep"
    try:
        yield
    except DATABASE_FAULTS as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, SQLAlchemyError):
            cause = cause.__cause__ or cause.__context__
        error = cause or error
        message = str(getattr(error, "orig", None) or error).strip().splitlines() or [type(error).__name__]
        message = without_secrets(" ".join(line.strip() for line in message[:2]), url)
        if isinstance(error, ImportError):
            remedy = 'a PostgreSQL server needs `pip install "horizon3d[postgres]"`'
        raise DatabaseError(
            f"storage={masked(url)}: the database of the sweep cannot be used ({message}); {remedy}"
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
        self._lost: set[int] = set()  # trials of this process whose end could not be stored
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        with file_lock(outputs / "sweeps" / ".lock"), database_errors(url):  # concurrent creators would collide
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
        """The lock under which workers choose and the record is written."""
        return file_lock(self.folder / ".lock")

    def trials(self) -> list[SweepTrial]:
        """Every trial, oldest first."""
        with database_errors(self.url):
            return [_sweep_trial(trial) for trial in self._load().get_trials(deepcopy=False)]

    def release_dead(self) -> list[SweepTrial]:
        """Release the trials of dead workers and return them; the lock is held.

        Dead is a worker of this machine whose process is gone, one of another without a heartbeat for
        `GRACE_PERIOD_S`, and one that took a trial but did not store its name. A waiting trial has no worker (see the
        module), nor has one of this process that ended while the database was away.
        """
        with database_errors(self.url), warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            study = self._load()
            open_states = (TrialState.RUNNING, TrialState.WAITING)
            before = study.get_trials(deepcopy=False, states=open_states)
            for trial in before:
                if trial.state == TrialState.WAITING or self._is_dead(trial):
                    self._fail(trial)
            optuna.storages.fail_stale_trials(study)
            still = {trial.number for trial in study.get_trials(deepcopy=False, states=open_states)}
        dead = [_sweep_trial(trial) for trial in before if trial.number not in still]
        for trial in dead:
            if trial.run_id is not None:
                logger.warning("worker %s is gone; %s is released", trial.worker, trial.run_id)
        return dead

    def _fail(self, trial: FrozenTrial) -> None:
        try:
            self._storage.set_trial_state_values(trial._trial_id, state=TrialState.FAIL)
        except optuna.exceptions.UpdateFinishedTrialError:
            pass  # its worker has just ended it

    def _is_dead(self, trial: FrozenTrial) -> bool:
        worker = trial.user_attrs.get("worker")
        if worker is None or trial._trial_id in self._lost:
            return True
        if worker["machine"] == self._this_machine:
            return _start_time_of(worker["pid"]) != worker["start_time"]
        # Optuna never calls a trial stale whose worker died before its first heartbeat.
        old = trial.datetime_start is not None and time.time() - trial.datetime_start.timestamp() > GRACE_PERIOD_S
        return old and trial._trial_id not in self._with_heartbeat()

    def _with_heartbeat(self) -> set[int]:
        with self._storage.engine.connect() as connection:
            return set(connection.execute(text("SELECT trial_id FROM trial_heartbeats")).scalars())

    def add_failed(self, attrs: dict[str, Any], reason: str) -> None:
        """Add the trial of a run that fails without being started; the lock is held."""
        with database_errors(self.url):
            attrs = attrs | {"reason": reason}
            self._load().add_trial(optuna.create_trial(state=TrialState.FAIL, user_attrs=attrs))

    def take(
        self,
        lock: TextIO,
        work: Callable[[Trial], float],
        choose: Callable[[Trial], None] | None = None,
        attrs: dict[str, Any] | None = None,
        params: dict[str, Any] | None = None,
        sampler: optuna.samplers.BaseSampler | None = None,
        pruner: optuna.pruners.BasePruner | None = None,
    ) -> None:
        """Create a trial and take it; release the held lock once the trial names its worker. Then `work`.

        `params` are retried as they are; None lets the sampler choose. `choose` gets the trial before the lock is
        released. `work` returns the score, or raises TrialEndedError or TrialPruned.
        """
        me = {
            "machine": self._this_machine,
            "host": socket.gethostname(),
            "pid": os.getpid(),
            "start_time": _start_time_of(os.getpid()),
        }
        with database_errors(self.url):
            study = self._load(sampler, pruner)
            if params is not None:
                study.enqueue_trial(params, user_attrs=attrs)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Heartbeat of storage is supposed")  # the trial has one below
                trial = study.ask()
        value, state = None, None
        try:
            with database_errors(self.url):
                for key, attr in (attrs or {}).items():
                    if key not in trial.user_attrs:
                        trial.set_user_attr(key, attr)
                if choose is not None:
                    choose(trial)
                trial.set_user_attr("worker", me)
            lock.close()
            with get_heartbeat_thread(trial._trial_id, self._storage):
                value = work(trial)
        except optuna.TrialPruned:
            state = TrialState.PRUNED
        except TrialEndedError:
            state = TrialState.FAIL
        except BaseException:
            with suppress(DatabaseError):
                self._end(study, trial, None, TrialState.FAIL)
            raise
        self._end(study, trial, value, state)

    def _end(self, study: optuna.Study, trial: Trial, value: float | None, state: TrialState | None) -> None:
        """Store the end of a trial, unless another worker found this one dead, as after a suspended machine."""
        try:
            with database_errors(self.url):
                study.tell(trial, value, state, skip_if_finished=True)
        except DatabaseError:
            self._lost.add(trial._trial_id)
            raise

    def reconnect(self) -> None:
        """Close open connections: their database may be gone."""
        self._storage.engine.dispose()

    def set_attr(self, trial: Trial, key: str, value: Any) -> None:
        """Set a user attribute of a trial, unless it was ended from outside."""
        with database_errors(self.url), suppress(optuna.exceptions.UpdateFinishedTrialError):
            trial.set_user_attr(key, value)

    def report(self, trial: Trial, value: float, step: int) -> bool:
        """Report a value to the pruner; whether it prunes the trial (never one that was ended from outside)."""
        with database_errors(self.url), suppress(optuna.exceptions.UpdateFinishedTrialError):
            trial.report(value, step)
            return trial.should_prune()
        return False

    def _load(
        self, sampler: optuna.samplers.BaseSampler | None = None, pruner: optuna.pruners.BasePruner | None = None
    ) -> optuna.Study:
        """A study object of this thread; the default sampler is a cheap one that draws nothing."""
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
        # Optuna reads braces as places to fill in.
        address = url.replace("{", "{{").replace("}", "}}")
        return RDBStorage(address, engine_kwargs=arguments, heartbeat_interval=HEARTBEAT_S, grace_period=GRACE_PERIOD_S)


def _sweep_trial(trial: FrozenTrial) -> SweepTrial:
    attrs = trial.user_attrs
    states = {TrialState.RUNNING: "running", TrialState.COMPLETE: "done", TrialState.PRUNED: "pruned"}
    state = states.get(trial.state) or ("failed" if attrs.get("reason") else "interrupted")
    worker = attrs.get("worker")
    return SweepTrial(
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
    """Identifies the machine, and its container where processes of others are not visible."""
    parts = [socket.gethostname()]
    for read in (lambda: Path("/proc/sys/kernel/random/boot_id").read_text(), lambda: os.readlink("/proc/self/ns/pid")):
        try:
            parts.append(read().strip())
        except OSError:
            continue  # not Linux
    return "/".join(parts)


def _start_time_of(pid: int) -> str | None:
    """Start time of a process of this machine, None when there is none; it tells reused process numbers apart."""
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
