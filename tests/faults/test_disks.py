"""Full, read-only and vanished output folders, and a clock that jumps, under a training that runs."""

import os
import shutil
import signal
import subprocess
import time

import pytest

from src.reliability.checkpoints import LAST, read_checkpoint
from tests.faults import killing

OF_SIZE = 64 * 2**20


@pytest.fixture
def training(tiny, tmp_path):
    """A training of phase 2 in a folder of its own."""
    return Training(*tiny("phase2"), tmp_path)


class Training:
    """Starts of one command, each with its own log."""

    def __init__(self, overrides, reference, base):
        self.reference, self.base = reference, base
        self.outputs = base / "outputs"
        self.overrides = [*overrides, f"paths.outputs={self.outputs}"]
        self.log = base / "0.log"

    def start(self, prepare=None):
        self.log = self.base / f"{len(list(self.base.glob('*.log')))}.log"
        self.log.touch()
        return killing.start(self.overrides, self.log, prepare=prepare)

    def wait_for(self, condition, process, timeout=300):
        deadline = time.monotonic() + timeout
        while not condition():
            assert process.exitcode is None and time.monotonic() < deadline, self.said()[-3000:]
            time.sleep(0.01)

    def said(self):
        return self.log.read_text()

    @property
    def last(self):
        return next(iter(self.outputs.glob(f"horizon3d-*/checkpoints/{LAST}")), None)

    def ends_as_ever(self, process):
        assert killing.wait(process, self.log) == 0, self.said()[-3000:]
        assert killing.outcome(self.outputs) == self.reference["outcome"]


@pytest.fixture
def small_disk(tmp_path):
    """A file system of a few checkpoints' size at the place of the outputs."""
    place = tmp_path / "outputs"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={OF_SIZE}", "tmpfs", str(place)], capture_output=True, text=True
    )
    if mounted.returncode != 0:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


def fill(place):
    """Take all the room there is."""
    with (place / "filler").open("wb") as file:
        try:
            while True:
                file.write(bytes(2**16))
                file.flush()
        except OSError:
            pass
    assert shutil.disk_usage(place).free < 2**16


@pytest.mark.slow
def test_a_disk_that_is_full_for_a_while_only_costs_time(small_disk, training):
    process = training.start(killing.brisk)
    training.wait_for(lambda: training.last, process)
    fill(small_disk)
    training.wait_for(lambda: "trying again" in training.said(), process)
    assert "No space left on device" in training.said() and "MiB are free there" in training.said()
    read_checkpoint(training.last)
    (small_disk / "filler").unlink()
    training.ends_as_ever(process)


@pytest.mark.faults
def test_a_disk_that_stays_full_ends_the_run_and_the_same_command_resumes(small_disk, training):
    process = training.start(killing.short_wait)
    training.wait_for(lambda: training.last, process)
    fill(small_disk)
    assert killing.wait(process, training.log) == 3
    message = training.said().strip().splitlines()[-1]
    assert message.startswith("CheckpointError") and str(small_disk) in message and "No space left" in message
    assert "Traceback" not in training.said()
    assert read_checkpoint(training.last)["global_step"] >= 2  # what was written stays readable
    (small_disk / "filler").unlink()
    training.ends_as_ever(training.start())


@pytest.mark.faults
def test_a_stop_is_not_held_up_by_a_full_disk(small_disk, training):
    process = training.start(killing.brisk)
    training.wait_for(lambda: training.last, process)
    fill(small_disk)
    training.wait_for(lambda: "trying again" in training.said(), process)
    os.kill(process.pid, signal.SIGTERM)
    assert killing.wait(process, training.log, timeout=killing.GRACE_S) == 3
    assert "the checkpoint before it is kept" in training.said()
    (small_disk / "filler").unlink()
    training.ends_as_ever(training.start())


@pytest.mark.faults
def test_a_folder_that_vanishes_for_a_while_only_costs_time(training):
    process = training.start(killing.brisk)
    training.wait_for(lambda: training.last, process)
    away = training.base / "away"
    training.outputs.rename(away)
    training.wait_for(lambda: "trying again" in training.said(), process)
    assert "its folder is gone" in training.said() and not training.outputs.exists()
    away.rename(training.outputs)
    training.ends_as_ever(process)


@pytest.mark.faults
def test_a_folder_that_vanishes_for_good_ends_the_run_and_is_not_made_anew(training):
    process = training.start(killing.short_wait)
    training.wait_for(lambda: training.last, process)
    away = training.base / "away"
    training.outputs.rename(away)
    assert killing.wait(process, training.log) == 3
    assert "its folder is gone" in training.said().strip().splitlines()[-1] and "Traceback" not in training.said()
    assert not training.outputs.exists()
    away.rename(training.outputs)
    training.ends_as_ever(training.start())


@pytest.mark.faults
def test_a_folder_that_becomes_read_only_ends_the_run_at_once(training):
    process = training.start(killing.bound_by_permissions)
    training.wait_for(lambda: training.last, process)
    folder = training.last.parent
    folder.chmod(0o555)
    try:
        assert killing.wait(process, training.log) == 3
        message = training.said().strip().splitlines()[-1]
        assert LAST in message and "Permission denied" in message and "trying again" not in training.said()
        read_checkpoint(training.last)
        again = training.start(killing.bound_by_permissions)
        assert killing.wait(again, training.log) == 3  # reported before anything is trained
        assert "choose another paths.outputs=FOLDER" in training.said() and "Epoch" not in training.said()
    finally:
        folder.chmod(0o755)
    training.ends_as_ever(training.start())


@pytest.mark.faults
def test_a_clock_that_jumps_changes_nothing(training):
    process = training.start(killing.jumping_clock)
    training.wait_for(lambda: training.last, process)
    os.kill(process.pid, signal.SIGKILL)
    assert killing.wait(process, training.log) == -signal.SIGKILL
    training.ends_as_ever(training.start(killing.jumping_clock))
