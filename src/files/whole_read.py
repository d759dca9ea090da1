"""Whole files of a data set, with a bound on what is taken into memory."""

from __future__ import annotations

import os
import stat

from src.errors import DataError


def read_whole(
    path: str | os.PathLike[str],
    most_bytes: int,
) -> bytes:
    """The bytes of a regular file.

    Raises DataError naming the path for one that is missing, no regular file (a pipe would be waited for without end),
    longer than `most_bytes`, or not readable.
    """
    try:
        # Without waiting: opening a pipe that nobody writes to would never return.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | getattr(os, "O_CLOEXEC", 0))
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise DataError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    try:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise DataError(f"{path}: must be a file, but is a folder, a pipe or a device")
        if status.st_size > most_bytes:
            raise DataError(f"{path}: at most {most_bytes} bytes are expected, but it has {status.st_size}")
        with open(handle, "rb", buffering=0, closefd=False) as file:
            return file.readall()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    finally:
        os.close(handle)
