"""Checkpoint files: written atomically, verified before they replace another, refused with a reason when broken."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import pickle
import re
import shutil
import struct
import time
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from src.errors import CheckpointError
from src.files.atomic_write import replacing
from src.reliability.untrusted import fault_of_archive

logger = logging.getLogger(__name__)

LAST, PREVIOUS, BEST = "last.ckpt", "previous.ckpt", "best.ckpt"
"""What a run keeps: the newest, the one before it until the run has finished, and the best by validation."""
WAIT_S = 240.0
"""How long a save waits for a disk: less than the other processes of a training wait for this one."""
RETRY_EVERY_S = 5.0
_REMEDY = "copy it again, or name another checkpoint"
TRANSIENT = {errno.ENOSPC, errno.EDQUOT, errno.ENOENT, errno.ESTALE, errno.EIO}
"""Disk full, unmounted or failing: others make room and mounts come back. A read-only folder stays so."""

_MARK = b"horizon3d sha256 "
_COMMENT_BYTES = len(_MARK) + hashlib.sha256().digest_size * 2
_COMMENT_LENGTH = struct.pack("<H", _COMMENT_BYTES)
_END = b"PK\5\6" + bytes(18)
"""The last record of an archive: its signature first, the length of a comment last."""
_CHUNK_BYTES = 2**20
_BROKEN = (
    RuntimeError,
    EOFError,
    OSError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    ArithmeticError,
    struct.error,
)
"""How torch fails at a damaged pickle of plain values."""


@dataclass
class OpenCheckpoint:
    """A checkpoint that was read and found whole."""

    path: Path
    content: dict[str, Any] | None  # None once taken

    def take(self) -> dict[str, Any]:
        """Hand the content to its one consumer, so that no second copy of the weights stays in memory."""
        content, self.content = self.content, None
        return content


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes beside the target, syncs, reads back, and only then renames: no crash costs the previous checkpoint.

    The file ends with the SHA-256 of itself, as the comment that a zip archive may have, so a copy keeps it. The
    `last.ckpt` that is replaced stays as `previous.ckpt`, provided that it was whole.

    Lightning's own writer goes through the system's temporary folder, which may be another file system, and there a
    rename becomes a copy that can stop half-way.
    """

    def __init__(
        self, check_folder: Callable[[], None] = lambda: None, fail_fast: Callable[[], bool] = lambda: False
    ) -> None:
        """`check_folder` raises where nothing may be written; while `fail_fast()`, a save does not wait for a disk."""
        super().__init__()
        self._check_folder, self._fail_fast = check_folder, fail_fast
        self._verified: set[Path] = set()
        self.opened: OpenCheckpoint | None = None

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any | None = None) -> None:
        """Write `checkpoint` to `path`, waiting for a disk that is full or away.

        Raises CheckpointError with the path, the reason and the free space when the disk keeps refusing.
        """
        target = Path(path)
        deadline = time.monotonic() + WAIT_S
        warned = False
        while True:
            try:
                return self._write(checkpoint, target)
            except (OSError, RuntimeError) as error:
                refusal = _refusal(target, error)
                transient = isinstance(error, OSError) and error.errno in TRANSIENT
                if not transient or self._fail_fast() or time.monotonic() > deadline:
                    raise CheckpointError(refusal) from error
            if not warned:
                logger.warning("%s; trying again for %.0f s before the run ends", refusal, WAIT_S)
                warned = True
            time.sleep(RETRY_EVERY_S)

    def load_checkpoint(self, path: str | Path, *_: Any, **__: Any) -> dict[str, Any]:
        """The content of `opened` where that is this file, else as `read_checkpoint`."""
        opened, self.opened = self.opened, None
        if opened is None or opened.path != Path(path):
            opened = open_checkpoint(Path(path))
        self._verified.add(opened.path)
        return opened.take()

    def _write(self, checkpoint: dict[str, Any], target: Path) -> None:
        self._check_folder()
        temporary = target.with_name(target.name + ".tmp")
        try:
            digest = _write_digested(checkpoint, temporary)
            _verify_written(temporary, digest)
            if target.name == LAST and target in self._verified and target.is_file():
                keep_as(target, target.with_name(PREVIOUS))
            os.replace(temporary, target)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        self._verified.add(target)
        sync_folder(target.parent)


class _DigestedFile:
    """Writes bytes to a file and digests them as they were meant, whatever reaches the disk."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.digest = hashlib.sha256()
        self.refusal: OSError | None = None  # torch raises another error in its place

    def write(self, data: memoryview) -> int:
        """Write all of it."""
        try:
            self._file.write(data)
        except OSError as error:
            self.refusal = error
            raise
        self.digest.update(data)
        return len(data)

    def flush(self) -> None:
        """Torch calls it at the end."""
        self._file.flush()


def _write_digested(checkpoint: dict[str, Any], path: Path) -> str:
    """Write a checkpoint and its digest, which is that of the archive without a comment, onto the disk."""
    with open(path, "wb") as file:
        digested = _DigestedFile(file)
        try:
            torch.save(checkpoint, digested)
        except (OSError, RuntimeError) as error:
            raise digested.refusal or error from None
        digest = digested.digest.hexdigest()
        file.seek(-2, os.SEEK_END)  # the length of the comment, 0 so far
        file.write(_COMMENT_LENGTH + _MARK + digest.encode())
        file.flush()
        os.fsync(file.fileno())
    return digest


def _verify_written(path: Path, digest: str) -> None:
    """Read a file back, from the disk where the system allows it. Raises OSError when it is not what was written."""
    with open(path, "rb") as file:
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        if _digests(file) != (digest, digest):
            raise OSError(errno.EIO, "it does not read back as it was written", str(path))


def keep_as(path: Path, kept: Path) -> None:
    """Give a file a second name in place of an older file; at no moment is there neither."""
    link = kept.with_name(kept.name + ".tmp")
    link.unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:  # a file system without hard links
        with open(path, "rb") as source, replacing(kept, "wb", sync=True) as file:
            shutil.copyfileobj(source, file)
        return
    os.replace(link, kept)
    link.unlink(missing_ok=True)  # it stays where both names were of one file already


def sync_folder(folder: Path) -> None:
    """Sync a folder's entries to disk, where its file system can."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _refusal(target: Path, error: Exception) -> str:
    """Why a checkpoint could not be written, and what the disk has left."""
    if not target.parent.is_dir():
        return f"{target} could not be written: its folder is gone (deleted, moved, or its disk is no longer mounted)"
    reason = error.strerror if isinstance(error, OSError) and error.strerror else error
    free = shutil.disk_usage(target.parent).free / 2**20
    return f"{target} could not be written ({reason}); {free:.0f} MiB are free there; the checkpoint before it is kept"


def open_checkpoint(path: Path) -> OpenCheckpoint:
    """Read a checkpoint by `read_checkpoint`, which raises for a broken one, and keep its path beside it."""
    return OpenCheckpoint(path, read_checkpoint(path))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Load one of our checkpoints; tensors and plain values only, nothing in the file is executed.

    The digest at the file's end is compared; a file from before there were digests is held to its archive's checksums.
    Raises CheckpointError when the file is missing, broken, or not written by this project.
    """
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise CheckpointError(f"checkpoint {path} {what}; runs keep theirs in outputs/<run_id>/checkpoints/last.ckpt")
    try:
        with open(path, "rb") as file:  # once: another process may put a newer file in its place
            _verify(file, path)
            file.seek(0)
            content = torch.load(file, map_location="cpu", weights_only=True)
    except zipfile.BadZipFile as error:
        raise CheckpointError(
            f"checkpoint {path} is truncated, or no checkpoint at all ({error}); {_REMEDY}"
        ) from error
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"checkpoint {path} holds more than tensors and plain values, so it is not of this project; "
            "nothing in it was executed"
        ) from error
    except _BROKEN as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CheckpointError(f"checkpoint {path} is truncated or damaged ({reason}); {_REMEDY}") from error
    if not _is_ours(content):
        raise CheckpointError(
            f"checkpoint {path} is not of this project: it lacks 'state_dict' (tensors by name) or the configuration "
            "in 'horizon3d'"
        )
    return content


def _verify(file: BinaryIO, path: Path) -> None:
    """Raises CheckpointError or BadZipFile unless the file is what was once written; torch loads flipped bits."""
    digests = _digests(file)
    if digests is not None and digests[0] != digests[1]:
        raise CheckpointError(
            f"checkpoint {path} is damaged: its SHA-256 is not the one it states at its end; {_REMEDY}"
        )
    fault = fault_of_archive(file)
    if fault is not None:
        raise CheckpointError(
            f"checkpoint {path} holds more than tensors and plain values, so it is not of this project ({fault}); "
            "nothing in it was executed"
        )
    if digests is None:  # of an earlier version, or torn
        file.seek(-len(_END), os.SEEK_END)
        end = file.read()
        if end[:4] != _END[:4] or end[-2:] != _END[-2:]:
            raise CheckpointError(f"checkpoint {path} is damaged: the digest at its end is torn; {_REMEDY}")
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise CheckpointError(f"checkpoint {path} is damaged: the checksum of {damaged} in it is wrong; {_REMEDY}")


def _digests(file: BinaryIO) -> tuple[str, str] | None:
    """(the SHA-256 that a file states, the one it has); None where it states none."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(0, size - _COMMENT_BYTES))
    comment = file.read()
    if not comment.startswith(_MARK):
        return None
    digest = hashlib.sha256()
    file.seek(0)
    left = size - _COMMENT_BYTES - 2
    while left > 0 and (chunk := file.read(min(left, _CHUNK_BYTES))):
        digest.update(chunk)
        left -= len(chunk)
    length = file.read(2)  # of the comment; it was 0 before there was one
    digest.update(bytes(2) if length == _COMMENT_LENGTH else length)
    return comment[len(_MARK) :].decode("ascii", "replace"), digest.hexdigest()


def stated_digest(path: Path) -> str | None:
    """The start of the SHA-256 that a checkpoint states at its end; None where it states none, or is not there."""
    if not path.is_file():
        return None
    with open(path, "rb") as file:
        file.seek(-min(_COMMENT_BYTES, path.stat().st_size), os.SEEK_END)
        comment = file.read()
    return comment[len(_MARK) :][:16].decode("ascii", "replace") if comment.startswith(_MARK) else None


def _is_ours(content: object) -> bool:
    """Whether a file holds what `TrainingModule` and Lightning write: weights by name and the run's configuration."""
    if not isinstance(content, dict):
        return False
    about, state = content.get("horizon3d"), content.get("state_dict")
    return (
        isinstance(about, dict)
        and isinstance(about.get("config"), dict)
        and isinstance(state, dict)
        and all(isinstance(key, str) and isinstance(value, torch.Tensor) for key, value in state.items())
    )


def load_model_weights(
    model: nn.Module, checkpoint: dict[str, Any], path: Path, may_be_new: re.Pattern[str] | None = None
) -> list[str]:
    """Put a checkpoint's weights into `model`; keys that match `may_be_new` may be missing and keep their values.

    Returns those keys. Raises CheckpointError naming the keys that are missing, unexpected, of another shape or not
    finite; never loads a part.
    """
    prefix = "model."
    state = {key[len(prefix) :]: value for key, value in checkpoint["state_dict"].items() if key.startswith(prefix)}
    wanted = model.state_dict()
    new = [key for key in wanted if key not in state and may_be_new is not None and may_be_new.match(key)]
    problems = [f"missing {key}" for key in wanted if key not in state and key not in new]
    problems += [f"unexpected {key}" for key in state if key not in wanted]
    problems += [
        f"{key} is {list(state[key].shape)}, the model has {list(wanted[key].shape)}"
        for key in wanted
        if key in state and state[key].shape != wanted[key].shape
    ]
    if problems:
        more = f" and {len(problems) - 6} more" if len(problems) > 6 else ""
        raise CheckpointError(
            f"checkpoint {path} is of another model: {'; '.join(problems[:6])}{more}; name one of this model and "
            "configuration"
        )
    broken = [key for key, value in state.items() if not torch.isfinite(value).all()]
    if broken:
        raise CheckpointError(f"checkpoint {path} holds weights that are not finite, {broken[0]} for one")
    model.load_state_dict({key: wanted[key] for key in new} | state)
    return new
