"""One run as a process of its own: started, watched, ended, and why it failed."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from src.errors import BusyError, ConfigError, DataError, DivergedError, InterruptedRunError
from src.reliability.command import signal_name
from src.sweep.plan import RunSpec
from src.training.identity import key_of

GRACE_PERIOD_S = 60.0
"""Time for a run to finish its step and write a checkpoint after SIGTERM; SIGKILL follows."""
POLL_S = 0.25
MEANINGS = {
    ConfigError.exit_code: "configuration or checkpoint",
    DataError.exit_code: "data",
    DivergedError.exit_code: "diverged",
}
_ERROR_LINE = re.compile(
    r"^(\w+(\.\w+)*(Error|Exception|Interrupt)\b.*|Out of memory: .*|.* could not be written or read: .*)"
)


class StopRequest:
    """Whether the runner is to stop. Set in signal handlers, where an Event could block."""

    def __init__(self) -> None:
        self.requested = False
        self.at_once = False


@dataclass(frozen=True)
class ExitStatus:
    """How a process ended."""

    code: int  # negative: of the signal that killed it
    reason: str  # in a line, empty for success
    stop_requested: bool  # whether we sent it a signal to stop

    @property
    def interrupted(self) -> bool:
        """Whether the run can be resumed: it stopped on request, or was still starting."""
        stops = (InterruptedRunError.exit_code, -signal.SIGTERM, -signal.SIGINT)
        return self.code in stops or (self.stop_requested and self.code == -signal.SIGKILL)

    @property
    def busy(self) -> bool:
        """Whether another process had the run's folder. Its exit code is that of all settings: its class tells."""
        return self.code == BusyError.exit_code and self.reason.startswith(f"{BusyError.__name__}:")


class Launcher:
    """Starts runs as processes; `command` and what it does in the new process can be replaced in tests."""

    def __init__(
        self,
        command: list[str],
        logs: Path,
        workers: int,
        gpus: list[str],
        in_child: Callable[[], None] | None = None,
        group: str = "",
    ) -> None:
        self.command, self.logs, self.workers, self.gpus = command, logs, workers, gpus
        self._in_child, self._group = in_child, group

    def log_of(self, run_id: str) -> Path:
        """Where everything that the process of a run prints is appended."""
        return self.logs / f"{run_id}.log"

    def environment(self, worker: int) -> dict[str, str]:
        """Variables of the worker's processes: its share of the cores or GPUs, unless the user has set them."""
        own = {"OMP_NUM_THREADS": str(max(1, _cores() // self.workers))} if self.workers > 1 else {}
        result = own | os.environ
        if self.gpus:
            share = self.gpus[worker :: max(1, self.workers)] or [self.gpus[worker % len(self.gpus)]]
            result["CUDA_VISIBLE_DEVICES"] = ",".join(share)
        return result

    def run(self, spec: RunSpec, worker: int, stop: StopRequest, watch: Callable[[], bool] | None = None) -> ExitStatus:
        """Train to the end, or until the runner stops or `watch`, polled meanwhile, returns True."""
        shown = self.shown_as(spec) if "logger=wandb" in spec.machine else []
        command = [*self.command, *spec.overrides, *spec.machine, *shown]
        return self.run_command(command, spec.run_id, worker, stop, watch)

    def shown_as(self, spec: RunSpec) -> list[str]:
        """Where Weights & Biases shows the run: its sweep and its row, unless the command line says otherwise."""
        places = [f"logger.wandb.group={self._group}", f"logger.wandb.row={quoted(spec.label)}"]
        return [place for place in places if key_of(place) not in map(key_of, spec.machine)]

    def run_command(
        self,
        command: list[str],
        name: str,  # of the log
        worker: int,
        stop: StopRequest,
        watch: Callable[[], bool] | None = None,
    ) -> ExitStatus:
        """Like `run` for any command."""
        self.logs.mkdir(parents=True, exist_ok=True)
        path = self.log_of(name)
        with path.open("ab") as log:
            log.write(f"\n==== {time.strftime('%Y-%m-%d %H:%M:%S')} {' '.join(command)}\n".encode())
            log.flush()
            begin = log.tell()
            try:
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    env=self.environment(worker),
                    start_new_session=True,
                    preexec_fn=self._in_child,
                )
            except OSError as error:
                return ExitStatus(1, f"{command[0]} could not be started: {error}", stop_requested=False)
        stop_requested = self._wait(process, stop, watch)
        code = process.returncode
        return ExitStatus(code, explain(code, _text_from(path, begin)) if code else "", stop_requested)

    def _wait(self, process: subprocess.Popen, stop: StopRequest, watch: Callable[[], bool] | None) -> bool:
        """Wait for the process; whether it was signalled to stop."""
        deadline = None
        try:
            while True:
                try:
                    process.wait(timeout=POLL_S)
                    return deadline is not None
                except subprocess.TimeoutExpired:
                    pass
                if deadline is None and (stop.requested or (watch is not None and watch())):
                    process.send_signal(signal.SIGTERM)
                    deadline = time.monotonic() + GRACE_PERIOD_S
                if stop.at_once or (deadline is not None and time.monotonic() > deadline):
                    deadline = deadline or 0.0
                    _kill_group(process)
        except BaseException:  # no run may outlive its runner
            _kill_group(process)
            process.wait()
            raise


def quoted(value: str) -> str:
    """A text as an override writes it: Hydra reads a backslash as one unless a quote follows."""
    escaped = re.sub(r'(\\*)("|$)', lambda found: 2 * found[1] + ('\\"' if found[2] else ""), value)
    return f'"{escaped}"'


def explain(code: int, output: str) -> str:
    """Why a process failed, in a line: its last words that look like an error, and what the exit code means."""
    if code < 0:
        return f"killed by {signal_name(-code)}" + (" (out of memory?)" if code == -signal.SIGKILL else "")
    lines = [line.strip() for line in re.split(r"[\r\n]+", output) if line.strip()]
    errors = [line for line in lines if _ERROR_LINE.match(line)]
    words = (errors or lines or ["it printed nothing"])[-1]
    words = words if len(words) <= 300 else words[:297] + "..."
    meaning = f", {MEANINGS[code]}" if code in MEANINGS else ""
    return f"{words} (exit code {code}{meaning})"


def _kill_group(process: subprocess.Popen) -> None:
    if process.poll() is None:  # not reaped, so the group is still its own
        os.killpg(process.pid, signal.SIGKILL)


def _text_from(path: Path, begin: int) -> str:
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(begin, size - 200_000))
            return file.read().decode(errors="replace")
    except OSError as error:
        return f"{path} is not readable: {error}"


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
