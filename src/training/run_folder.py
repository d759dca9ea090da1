"""The folder of one run: what it holds, when it counts as finished, and what the same command does again."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from itertools import count
from pathlib import Path
from typing import Any

import yaml

from src.errors import BusyError, CheckpointError, ConfigError, DataError
from src.files.atomic_write import replacing, write_whole
from src.reliability.checkpoints import BEST, LAST, PREVIOUS, OpenCheckpoint, open_checkpoint, sync_folder
from src.training.identity import digest_of

logger = logging.getLogger(__name__)


@dataclass(kw_only=True)
class PathsConfig:
    """Folders, relative to where the command is run."""

    outputs: str  # runs, worlds, caches
    reports: str


class Resume(Enum):
    """What happens when the folder of the run exists (the values of `resume`)."""

    auto = "auto"  # resume an unfinished run, show a finished one
    never = "never"  # refuse
    restart = "restart"  # move the old folder aside


class RunFolder:
    """`outputs/<run_id>/`: config.yaml, checkpoints/, metrics.csv, metrics.json, run.json, log.txt, pictures/."""

    def __init__(self, outputs: Path, run_id: str) -> None:
        self.run_id = run_id
        self.path = outputs / run_id
        self.checkpoints = self.path / "checkpoints"
        self.pictures = self.path / "pictures"
        self.config = self.path / "config.yaml"
        self.metrics_csv = self.path / "metrics.csv"
        self.metrics_json = self.path / "metrics.json"
        self.record = self.path / "run.json"
        self.log = self.path / "log.txt"
        self._lock: Any = None

    @property
    def finished(self) -> bool:
        """Whether the run has ended and its numbers are written; both files are renamed into place when whole."""
        return self.record.is_file() and self.metrics_json.is_file()

    def open(self, resume: Resume) -> None:
        """Make the folder ready to train in, or leave a finished one as it is; see `finished`.

        What a killed process was writing is removed.

        Raises ConfigError when the run exists and `resume` is `never`, when another process trains it at this
        moment, or when the folder cannot be written.
        """
        if self.path.exists() and resume is Resume.never:
            raise ConfigError(f"{self.path} exists and resume=never; use resume=auto to resume or resume=restart")
        if self.path.exists() and resume is Resume.restart:
            self._acquire()
            aside = self._aside()
            self.path.rename(aside)
            self.close()
            logger.info("moved the old run to %s", aside)
        if self.finished:
            return  # it is shown, wherever it lies
        make_writable(self.checkpoints, "paths.outputs")
        self._acquire()
        self._tidy()

    def start_log(self, tree: dict[str, Any]) -> None:
        """Write log.txt from here on, and the configuration into config.yaml."""
        log = logging.FileHandler(self.log)
        log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.getLogger().addHandler(log)
        write_whole(self.config, yaml.safe_dump(tree, sort_keys=False))
        logger.info("run %s in %s", self.run_id, self.path)

    def finish(self, record: dict[str, Any]) -> None:
        """Write run.json, by which the run counts as finished; checkpoints that only a resumption needs go."""
        write_json(self.record, record)
        self._tidy()

    def close(self) -> None:
        """Let other processes train here."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def check_held(self) -> None:
        """Make sure that this is still the folder that was opened.

        Raises FileNotFoundError while it is away, and CheckpointError when another process has made it anew.
        """
        status = os.stat(self.path)  # raises while the disk is away
        with suppress(FileNotFoundError):
            status = os.stat(self.path / ".lock")
            if self._lock is not None and status.st_ino != os.fstat(self._lock.fileno()).st_ino:
                raise CheckpointError(
                    f"{self.path} was deleted and made anew by another process, which trains there now; this one ends"
                )

    def _aside(self) -> Path:
        """A free name for the old folder: a clock that was set back, or is slow, gives the same time twice."""
        name = self.path.with_name(f"{self.run_id}.before-{time.strftime('%Y%m%d-%H%M%S')}")
        names = (name if number == 1 else name.with_name(f"{name.name}-{number}") for number in count(1))
        return next(free for free in names if not free.exists())

    def _tidy(self) -> None:
        for folder in (self.path, self.checkpoints, self.pictures):
            for pattern in ("*.tmp", ".probe-*"):
                for left_over in folder.glob(pattern):
                    left_over.unlink(missing_ok=True)
        if self.finished:
            (self.checkpoints / PREVIOUS).unlink(missing_ok=True)

    def _acquire(self) -> None:
        self._lock = open(self.path / ".lock", "w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise BusyError(f"{self.path} is being trained by another process; wait for it or end it") from error

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is a checkpoint to resume from, be it damaged."""
        return any((self.checkpoints / name).is_file() for name in (LAST, PREVIOUS, BEST))

    def newest_checkpoint(self) -> OpenCheckpoint | None:
        """The checkpoint an unfinished run resumes from: the last one, or where it is damaged the next older whole one.

        Raises CheckpointError when there are some and none can be read: training would silently start anew.
        """
        damage: list[str] = []
        for name in (LAST, PREVIOUS, BEST):
            path = self.checkpoints / name
            if not path.is_file():
                continue
            try:
                opened = open_checkpoint(path)
            except CheckpointError as error:
                damage.append(str(error))
                continue
            if damage:
                logger.warning("%s; resuming from %s instead", "; ".join(damage), path)
            return opened
        if damage:
            raise CheckpointError(f"{'; '.join(damage)}; resume=restart moves the run aside and trains anew")
        return None

    def read_result(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """run.json and metrics.json of a finished run."""
        contents = []
        for path in (self.record, self.metrics_json):
            try:
                content = json.loads(path.read_text())
            except (OSError, ValueError, RecursionError) as error:
                raise DataError(f"{path} is not readable ({error}); delete it to have it made again") from error
            if not isinstance(content, dict):
                raise DataError(f"{path} must hold an object, but holds a {type(content).__name__}; delete it")
            contents.append(content)
        return contents[0], contents[1]


def name_of_checkpoint(source: Path) -> str:
    """The file's name, with its run's before it: every run has a last.ckpt, and one must not replace the other's."""
    folder = source.resolve().parent
    run = folder.parent.name if folder.name == "checkpoints" else folder.name
    return f"{run}-{source.stem}"


def name_of_predictions(source: Path) -> str:
    """The names of file and folder, and 8 hex digits of where they are: all of `src.predict` have the same names."""
    source = source.resolve()
    return f"{source.parent.name}-{source.stem}-{digest_of([str(source)])}"


def check_no_run(folder: Path) -> None:
    """Raises ConfigError where a run's own folder is given as `out`: its scores would be replaced."""
    if (folder / "run.json").exists() or (folder / "checkpoints").is_dir():
        raise ConfigError(f"out={folder}: is the folder of a run, whose files would be replaced; choose another one")


def make_writable(folder: Path, key: str) -> None:
    """Make a folder and try to write in it; raises ConfigError naming the setting `key` that chose it."""
    probe = folder / f".probe-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_text("")
        probe.unlink()
    except OSError as error:
        raise ConfigError(f"{folder} cannot be written ({error.strerror}); choose another {key}=FOLDER") from error


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file that is never seen half-written, after a power failure neither."""
    with replacing(path, sync=True) as file:
        file.write(json.dumps(content, indent=2, allow_nan=False) + "\n")
    sync_folder(path.parent)


def current_commit() -> str:
    """Commit of the code that runs, `+` appended when files differ from it; `unknown` outside a git checkout."""
    root = Path(__file__).resolve().parents[2]
    try:
        commit, dirty = (
            subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True)
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.stdout.strip() + ("+" if dirty.stdout.strip() else "")
