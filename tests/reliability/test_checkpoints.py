import errno
import hashlib
import os
import random
import resource
import subprocess
import sys
import zipfile

import pytest
import torch
from torch import nn

from src.errors import CheckpointError
from src.reliability import checkpoints
from src.reliability.checkpoints import (
    BEST,
    LAST,
    PREVIOUS,
    WAIT_S,
    AtomicCheckpointIO,
    keep_as,
    load_model_weights,
    read_checkpoint,
    stated_digest,
)


def content(model):
    return {"state_dict": {f"model.{k}": v for k, v in model.state_dict().items()}, "horizon3d": {"config": {"a": 1}}}


def test_round_trip(tmp_path):
    model, other = nn.Linear(3, 2), nn.Linear(3, 2)
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(model), path)
    checkpoint = read_checkpoint(path)
    load_model_weights(other, checkpoint, path)
    assert torch.equal(model.weight, other.weight) and checkpoint["horizon3d"]["config"] == {"a": 1}
    assert [p.name for p in path.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped", "text", "foreign", "other values"])
def test_damaged_files_are_named(tmp_path, damage):
    path = tmp_path / "x.ckpt"
    model = nn.Linear(30, 20)
    AtomicCheckpointIO().save_checkpoint(content(model), path)
    data = path.read_bytes()
    flipped = bytearray(data)
    flipped[data.index(model.weight.detach().numpy().tobytes())] ^= 0xFF  # one bit pattern of one weight
    if damage == "foreign":
        torch.save({"weights": torch.zeros(2)}, path)
    elif damage == "other values":
        torch.save({"state_dict": {"model.weight": "hello"}, "horizon3d": {"config": {}}}, path)
    else:
        path.write_bytes(
            {"empty": b"", "truncated": data[: len(data) // 2], "flipped": bytes(flipped), "text": b"hello"}[damage]
        )
    with pytest.raises(CheckpointError, match=r"x\.ckpt"):
        read_checkpoint(path)


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    canary = tmp_path / "canary"

    class Malicious:
        def __reduce__(self):
            return (open, (str(canary), "w"))

    path = tmp_path / "x.ckpt"
    torch.save({"state_dict": Malicious(), "horizon3d": {}}, path)
    with pytest.raises(CheckpointError, match="nothing in it was executed"):
        read_checkpoint(path)
    assert not canary.exists()


def test_a_checkpoint_of_another_model_names_the_keys(tmp_path):
    with pytest.raises(CheckpointError, match=r"bias.*weight is \[2, 3\], the model has \[2, 4\]"):
        load_model_weights(nn.Linear(4, 2), content(nn.Linear(3, 2, bias=False)), tmp_path / "x.ckpt")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    model = nn.Linear(3, 2)
    broken = content(model)
    broken["state_dict"]["model.bias"] = torch.tensor([0.0, float("nan")])
    with pytest.raises(CheckpointError, match="not finite, bias"):
        load_model_weights(model, broken, tmp_path / "x.ckpt")
    assert torch.isfinite(model.bias).all()


def test_missing_file(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        read_checkpoint(tmp_path / "nothing.ckpt")


@pytest.mark.slow
def test_a_full_disk_keeps_the_older_checkpoint(tmp_path):
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(nn.Linear(3, 2)), path)
    before = path.read_bytes()
    code = f"""
import resource, torch
from src.reliability.checkpoints import AtomicCheckpointIO
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, {resource.RLIM_INFINITY}))
AtomicCheckpointIO().save_checkpoint({{"state_dict": {{"w": torch.zeros(100000)}}}}, {str(path)!r})
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode != 0
    assert "MiB are free" in result.stderr
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def numbered(number):
    return {"state_dict": {"w": torch.full((50,), float(number))}, "horizon3d": {"config": {}}}


def number_of(path):
    return int(read_checkpoint(path)["state_dict"]["w"][0])


@pytest.fixture
def naps(monkeypatch):
    """Waiting takes no time; how often there was a wait."""
    now, naps = [0.0], []

    def sleep(seconds):
        now[0] += seconds
        naps.append(seconds)

    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(checkpoints.time, "sleep", sleep)
    return naps


def test_every_changed_byte_and_every_missing_end_is_noticed(tmp_path):
    path = tmp_path / LAST
    AtomicCheckpointIO().save_checkpoint(numbered(1), path)
    data = path.read_bytes()
    rng = random.Random(3)
    places = {*range(len(data) - 110, len(data)), *rng.sample(range(len(data)), 200)}  # the end, and anywhere
    for place in places:
        changed = bytearray(data)
        changed[place] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        with pytest.raises(CheckpointError, match=r"last\.ckpt is"):
            read_checkpoint(path)
    for length in [*range(len(data) - 110, len(data)), *rng.sample(range(len(data)), 50)]:
        path.write_bytes(data[:length])
        with pytest.raises(CheckpointError, match=r"last\.ckpt is"):
            read_checkpoint(path)
    path.write_bytes(data + b"more")
    with pytest.raises(CheckpointError, match="digest at its end is torn"):
        read_checkpoint(path)


def test_the_digest_is_that_of_what_torch_wrote(tmp_path):
    AtomicCheckpointIO().save_checkpoint(numbered(1), tmp_path / LAST)
    with zipfile.ZipFile(tmp_path / LAST) as archive:
        name, kind, digest = archive.comment.decode().split()
    data = (tmp_path / LAST).read_bytes()
    plain = data[: -len(f"{name} {kind} {digest}") - 2] + b"\0\0"
    assert (name, kind) == ("horizon3d", "sha256") and hashlib.sha256(plain).hexdigest() == digest
    assert stated_digest(tmp_path / LAST) == digest[:16]
    assert torch.load(tmp_path / LAST, weights_only=True)["state_dict"]["w"][0] == 1.0  # others read it as ever


def test_files_from_before_there_were_digests_are_read_and_checked(tmp_path):
    path = tmp_path / LAST
    torch.save(numbered(7), path)
    assert number_of(path) == 7 and stated_digest(path) is None
    data = bytearray(path.read_bytes())
    data[data.index(torch.full((50,), 7.0).numpy().tobytes())] ^= 1
    path.write_bytes(data)
    with pytest.raises(CheckpointError, match="the checksum of .* is wrong"):
        read_checkpoint(path)


def test_the_one_before_is_kept_only_where_it_was_whole(tmp_path):
    last, previous = tmp_path / LAST, tmp_path / PREVIOUS
    io = AtomicCheckpointIO()
    for number in (1, 2, 3):
        io.save_checkpoint(numbered(number), last)
    assert (number_of(previous), number_of(last)) == (2, 3)

    last.write_bytes(last.read_bytes()[:-500])
    again = AtomicCheckpointIO()  # of the next process, which resumes from the older one
    again.load_checkpoint(previous)
    again.save_checkpoint(numbered(4), last)
    assert (number_of(previous), number_of(last)) == (2, 4)
    again.save_checkpoint(numbered(5), last)
    assert (number_of(previous), number_of(last)) == (4, 5)
    third = AtomicCheckpointIO()
    third.load_checkpoint(last)
    third.save_checkpoint(numbered(6), last)
    assert (number_of(previous), number_of(last)) == (5, 6)
    third.save_checkpoint(numbered(1), tmp_path / "best.ckpt")
    assert {path.name for path in tmp_path.iterdir()} == {LAST, PREVIOUS, "best.ckpt"}


def test_a_process_killed_between_the_two_names_leaves_nothing_behind(tmp_path):
    last, previous = tmp_path / LAST, tmp_path / PREVIOUS
    io = AtomicCheckpointIO()
    io.save_checkpoint(numbered(1), last)
    os.link(last, previous)  # both names are of one file
    io.save_checkpoint(numbered(2), last)
    assert (number_of(previous), number_of(last)) == (1, 2) and len(list(tmp_path.iterdir())) == 2


def test_without_hard_links_the_one_before_is_kept_too(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    io = AtomicCheckpointIO()
    for number in (1, 2):
        io.save_checkpoint(numbered(number), tmp_path / LAST)
    assert (number_of(tmp_path / PREVIOUS), number_of(tmp_path / LAST)) == (1, 2)
    keep_as(tmp_path / LAST, tmp_path / BEST)
    assert (number_of(tmp_path / BEST), number_of(tmp_path / LAST)) == (2, 2), "a second name, not another one"
    assert len(list(tmp_path.iterdir())) == 3


def test_it_is_on_the_disk_before_it_takes_the_name(tmp_path, monkeypatch):
    order, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(
        os, "fsync", lambda number: (order.append(os.readlink(f"/proc/self/fd/{number}")), fsync(number))
    )
    monkeypatch.setattr(os, "replace", lambda *names: (order.append("renamed"), replace(*names)))
    AtomicCheckpointIO().save_checkpoint(numbered(1), tmp_path / LAST)
    assert order == [str(tmp_path / f"{LAST}.tmp"), "renamed", str(tmp_path)]


def test_what_reads_back_otherwise_never_replaces_the_one_before(tmp_path, monkeypatch, naps):
    io = AtomicCheckpointIO()
    io.save_checkpoint(numbered(1), tmp_path / LAST)
    fsync, broken = os.fsync, [True]

    def lose_a_page(number):
        fsync(number)
        if broken[0] and os.readlink(f"/proc/self/fd/{number}").endswith(".tmp"):
            os.pwrite(number, bytes(100), 300)

    monkeypatch.setattr(os, "fsync", lose_a_page)
    with pytest.raises(CheckpointError, match="does not read back"):
        io.save_checkpoint(numbered(2), tmp_path / LAST)
    assert number_of(tmp_path / LAST) == 1 and sum(naps) >= WAIT_S
    broken[0] = False
    io.save_checkpoint(numbered(3), tmp_path / LAST)
    assert (number_of(tmp_path / PREVIOUS), number_of(tmp_path / LAST)) == (1, 3)


def refusing(monkeypatch, number, times):
    """Make the first writes end with an error of the system."""
    write, left = checkpoints._write_digested, [times]

    def refuse(checkpoint, path):
        path.write_bytes(b"half")
        if left[0] > 0:
            left[0] -= 1
            raise OSError(number, os.strerror(number))
        return write(checkpoint, path)

    monkeypatch.setattr(checkpoints, "_write_digested", refuse)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.ESTALE, errno.EIO])
def test_a_disk_that_is_full_or_away_for_a_while_is_waited_for(tmp_path, monkeypatch, naps, caplog, number):
    refusing(monkeypatch, number, 3)
    AtomicCheckpointIO().save_checkpoint(numbered(1), tmp_path / LAST)
    assert number_of(tmp_path / LAST) == 1 and len(naps) == 3
    assert [path.name for path in tmp_path.iterdir()] == [LAST]
    (message,) = [record.getMessage() for record in caplog.records]  # once, not at every try
    assert os.strerror(number) in message and "MiB are free" in message and "trying again" in message


def test_a_disk_that_stays_full_ends_the_run_in_time(tmp_path, monkeypatch, naps):
    refusing(monkeypatch, errno.ENOSPC, 10**6)
    with pytest.raises(CheckpointError, match=r"last\.ckpt could not be written \(No space left.*MiB are free"):
        AtomicCheckpointIO().save_checkpoint(numbered(1), tmp_path / LAST)
    assert WAIT_S <= sum(naps) < 300.0  # what the other ranks wait


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.EFBIG])
def test_what_does_not_pass_is_not_waited_for(tmp_path, monkeypatch, naps, number):
    refusing(monkeypatch, number, 1)
    with pytest.raises(CheckpointError, match=r"last\.ckpt could not be written"):
        AtomicCheckpointIO().save_checkpoint(numbered(1), tmp_path / LAST)
    assert not naps and not list(tmp_path.iterdir())


def test_nor_is_anything_while_the_run_is_asked_to_end(tmp_path, monkeypatch, naps):
    refusing(monkeypatch, errno.ENOSPC, 1)
    with pytest.raises(CheckpointError, match="No space left"):
        AtomicCheckpointIO(fail_fast=lambda: True).save_checkpoint(numbered(1), tmp_path / LAST)
    assert not naps


def test_a_folder_that_is_gone_is_not_made_anew(tmp_path, naps):
    """What lies there may be the empty place of a disk that is not mounted."""
    with pytest.raises(CheckpointError, match="its folder is gone"):
        AtomicCheckpointIO().save_checkpoint(numbered(1), tmp_path / "gone" / LAST)
    assert not list(tmp_path.iterdir()) and sum(naps) >= WAIT_S
