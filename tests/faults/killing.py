"""Trainings to be killed: real commands in real processes, forked from one that has imported everything already."""

import ctypes
import hashlib
import json
import os
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from src.errors import CheckpointError
from src.reliability import checkpoints
from src.reliability.checkpoints import LAST, PREVIOUS, AtomicCheckpointIO, read_checkpoint
from src.reliability.processes import die_with_parent
from tests.running import fork, run_module

GRACE_S = 60.0
"""What schedulers commonly give between SIGTERM and SIGKILL is 30 s and more; the machine of a test may be busy."""
HOOKS = {  # by point: a function, and whether the point lies before or after it
    "written": (os, "fsync", "before"),
    "synced": (os, "fsync", "after"),
    "verified": (checkpoints, "_verify_written", "after"),
    "linked": (os, "link", "after"),
    "kept": (checkpoints, "keep_as", "after"),
    "replaced": (checkpoints, "sync_folder", "before"),
}
POINTS = ("bytes", *HOOKS)
"""Inside one write of a checkpoint, in their order."""
TINY = (
    "scale=debug", "phase.epochs=2", "data.world.num_train_scenes=2", "data.world.num_val_scenes=1",
    "data.world.key_frames_per_scene=4", "trainer.num_pictures=0", "trainer.checkpoint_every_steps=2", "seed=3",
)  # fmt: skip


@dataclass(frozen=True)
class InWrite:
    """A signal that a process gives itself inside its `save`-th write of a checkpoint, or the next with that point."""

    number: int  # of the signal
    save: int
    point: str  # of POINTS
    after_bytes: int  # of the file, for the point `bytes`


def start(overrides, log, fault=None, prepare=None):
    """`python -m src.train` with these overrides in a process of its own; with one thread, so the same to the bit."""
    return fork(run_armed, overrides, fault, prepare, out=log, err=log, env=os.environ | {"OMP_NUM_THREADS": "1"})


def run_armed(overrides, fault, prepare):
    """In the new process: its fault, then the command."""
    die_with_parent(signal.SIGKILL)
    torch.set_num_threads(1)
    if fault is not None:
        arm(fault)
    if prepare is not None:
        prepare()
    run_module("train", *overrides)


def arm(fault):
    """Let this process strike itself inside a write of a checkpoint."""
    whole, write_bytes = AtomicCheckpointIO._write, checkpoints._DigestedFile.write
    state = {"saves": 0, "inside": False, "bytes": 0}

    def reached():
        if state["inside"] and state["saves"] >= fault.save:
            state["saves"] = -(10**6)  # once
            os.kill(os.getpid(), fault.number)

    def save(self, checkpoint, target):
        state["saves"] += 1
        state["inside"], state["bytes"] = True, 0
        try:
            whole(self, checkpoint, target)
        finally:
            state["inside"] = False

    def write(self, data):
        count = write_bytes(self, data)
        state["bytes"] += count
        if state["bytes"] >= fault.after_bytes:
            self.flush()
            reached()
        return count

    def around(owner, name, when):
        original = getattr(owner, name)

        def replaced(*args, **kwargs):
            if when == "before":
                reached()
            result = original(*args, **kwargs)
            if when == "after":
                reached()
            return result

        setattr(owner, name, replaced)

    AtomicCheckpointIO._write = save
    if fault.point == "bytes":
        checkpoints._DigestedFile.write = write
    else:
        around(*HOOKS[fault.point])


def write_armed(fault, path):
    """In a new process: two checkpoints, of which the second takes the place of the first, with a fault inside."""
    arm(fault)
    writer = AtomicCheckpointIO()
    for step in (1, 2):
        content = {"state_dict": {"weight": torch.zeros(100)}, "horizon3d": {"config": {}}, "global_step": step}
        writer.save_checkpoint(content, path)


def brisk():
    """In the new process: look often whether a disk is back."""
    checkpoints.RETRY_EVERY_S = 0.1


def short_wait():
    """In the new process: do not wait long for a disk."""
    checkpoints.RETRY_EVERY_S, checkpoints.WAIT_S = 0.1, 1.0


def bound_by_permissions():
    """In the new process: let permissions hold for the superuser too (no CAP_DAC_OVERRIDE)."""
    if os.geteuid() != 0:
        return
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)  # version 3, this process
    data = (ctypes.c_uint32 * 6)()
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.capget(header, data) == 0
    for part in range(3):  # effective, permitted, inheritable; of capabilities 0 to 31
        data[part] &= ~0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    assert libc.capset(header, data) == 0


def jumping_clock():
    """In the new process: every look at the wall clock finds it elsewhere; monotonic time stays what it is."""
    rng, real, form = random.Random(4), time.time, time.strftime
    time.time = lambda: real() + rng.uniform(-4e8, 4e8)
    time.strftime = lambda pattern, *moment: form(pattern, *(moment or (time.gmtime(rng.uniform(0.0, 4e9)),)))


def cpu_seconds(pid):
    """CPU time of a process so far, which does not depend on how busy the machine is; None when it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def strike_at(process, seconds, number):
    """Send a signal once the process has used so much CPU time; False when it ended before."""
    while (used := cpu_seconds(process.pid)) is not None:
        if used >= seconds:
            os.kill(process.pid, number)
            return True
        time.sleep(min(0.002, max(0.0, seconds - used)))
    return False


def wait(process, log, timeout=300):
    """Exit code of a process, which must end."""
    process.join(timeout)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise AssertionError(f"it did not end within {timeout} s:\n{Path(log).read_text()[-3000:]}")
    return process.exitcode


def rows(outputs):
    """Lines of metrics.csv so far."""
    return sum(len(path.read_bytes().splitlines()) for path in outputs.glob("*/metrics.csv"))


def run_folder(outputs):
    (folder,) = outputs.glob("horizon3d-phase*")
    return folder


def outcome(outputs):
    """All that a run must end with whatever happened to it: numbers, log, boxes, weights, optimiser, names of files."""
    folder = run_folder(outputs)
    last = read_checkpoint(folder / "checkpoints" / LAST)
    parts = ("state_dict", "optimizer_states", "lr_schedulers", "global_step", "epoch")
    return {
        "metrics.json": json.loads((folder / "metrics.json").read_text()),
        "metrics.csv": (folder / "metrics.csv").read_text(),
        "submission.json": (folder / "submission.json").read_text() if (folder / "submission.json").exists() else None,
        "files": sorted(path.name for path in folder.rglob("*") if path.is_file()),
    } | {name: digest(last[name]) for name in parts}


def digest(value):
    """SHA-256 of nested values and tensors, bit by bit."""
    found = hashlib.sha256()

    def add(node):
        if isinstance(node, dict):
            for key in sorted(node, key=str):
                found.update(f"{key}:".encode())
                add(node[key])
        elif isinstance(node, list | tuple):
            for entry in node:
                add(entry)
        elif isinstance(node, torch.Tensor):
            found.update(f"{node.dtype}{list(node.shape)}".encode() + node.contiguous().numpy().tobytes())
        else:
            found.update(repr(node).encode())

    add(value)
    return found.hexdigest()


def damage(path, rng):
    """What a power failure leaves of a file that was never synced; says what was done."""
    data = bytearray(path.read_bytes())
    if len(data) < 100:
        return "torn already"
    what = rng.choice(("truncated", "truncated", "empty", "page of zeros", "bit flipped"))
    if what == "truncated":
        data = data[: rng.randrange(len(data))]
    elif what == "empty":
        data = b""
    else:
        # Somewhere among the weights: the places between records hold nothing, and zeros there already.
        at = rng.randrange(len(data) // 8, len(data) // 8 * 7)
        if what == "bit flipped":
            data[at] ^= 1 << rng.randrange(8)
        else:
            data[at : at + 4096] = bytes(4096)
    path.write_bytes(data)
    return what


def jump_clock(folder, rng):
    """Give the files times as if the machine's clock had been anywhere."""
    for path in sorted(folder.rglob("*")):
        moment = rng.uniform(0.0, 4e9)  # 1970 to 2096
        os.utime(path, (moment, moment))


class Chain:
    """One run that is killed again and again, each time resumed by the same command."""

    def __init__(self, folder, overrides, reference, seed):
        self.outputs, self.overrides = folder, [*overrides, f"paths.outputs={folder}"]
        self.reference, self.rng = reference, random.Random(seed)
        self.log = folder.with_name(f"{folder.name}.log")
        self.kills = []  # (kind, point or damage)

    def kill_once(self):
        """One start, and its end by a fault; False when the run had nothing left to be killed in."""
        inside = self.rng.random() < 0.4
        number = signal.SIGTERM if self.rng.random() < 0.15 else signal.SIGKILL
        fault, until = None, 0.0
        if inside:
            point = self.rng.choice(("bytes", *POINTS))
            size = self.reference["size"]
            fault = InWrite(number, self.rng.choice((1, 1, 2, 3)), point, self.rng.randrange(1, size))
        else:
            first, end = self.reference["first step"], self.reference["end"]
            until = self.rng.uniform(first, first + (end - first) * self._left())
        process = start(self.overrides, self.log, fault)
        if not inside:
            strike_at(process, until, number)
        code = wait(process, self.log, timeout=300 if inside else GRACE_S + 240)
        if code == 0:
            return False
        expected = -signal.SIGKILL if number == signal.SIGKILL else 6
        assert code == expected, f"exit code {code}:\n{self.log.read_text()[-3000:]}"
        self.kills.append((number.name, f"in a write: {fault.point}" if inside else "between"))
        self._power_failure(number)
        return True

    def _left(self):
        """Share of the training that the next start has before it."""
        for path in self.outputs.glob(f"horizon3d-phase*/checkpoints/{LAST}"):
            try:
                return 1.0 - 0.8 * read_checkpoint(path)["global_step"] / self.reference["steps"]
            except CheckpointError:
                return 1.0
        return 1.0

    def _power_failure(self, number):
        folders = list(self.outputs.glob("horizon3d-phase*"))
        if not folders:
            return
        last, previous = (folders[0] / "checkpoints" / name for name in (LAST, PREVIOUS))
        two = previous.is_file() and not previous.samefile(last)  # not two names of one file that was synced long ago
        if number == signal.SIGKILL and self.rng.random() < 0.2 and two:
            what = damage(last, self.rng)
            self.kills[-1] = (f"{number.name} and power", f"{self.kills[-1][1]}, last checkpoint {what}")
        if self.rng.random() < 0.3:
            jump_clock(folders[0], self.rng)

    def finish(self):
        """Let it end, if it has not; what it ended with."""
        if list(self.outputs.glob("horizon3d-phase*/run.json")):
            return outcome(self.outputs)
        process = start(self.overrides, self.log)
        assert wait(process, self.log) == 0, self.log.read_text()[-3000:]
        return outcome(self.outputs)
