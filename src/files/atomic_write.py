"""Files that are never seen half-written; an older one survives a full disk."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any


@contextmanager
def replacing(path: Path, mode: str = "w", sync: bool = False, newline: str | None = None) -> Iterator[IO[Any]]:
    """A file to write, which takes the place of `path` where the block ends without an error; `sync`: from the disk.

    Raises OSError with the file's name for any failure to write, such as a full disk; an older file then stays.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")  # process ids of two machines may be one
    try:
        with open(temporary, mode, encoding=None if "b" in mode else "utf-8", newline=newline) as file:
            yield file
            if sync:
                file.flush()
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:  # a write that fails does not say where
        error.filename, error.filename2 = str(path), None
        raise
    finally:
        with suppress(OSError):  # a folder above it may be a file
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> None:
    """Write a text file in one step, and make its folder; raises as `replacing`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        file.write(text)
