"""Passwords in addresses and overrides: recognised, masked in texts and in the process list."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path
from urllib.parse import unquote

# Both take too much rather than too little: a password that holds the character that should end it stays hidden.
IN_AUTHORITY = re.compile(r"(://[^:]*:)(.*)(?=@)", re.DOTALL)
AS_OPTION = re.compile(
    r"""((?:password|passwd|pwd|api_?key|secret|token)=)('.*'|".*"|[^&]*)""", re.DOTALL | re.IGNORECASE
)


def masked(text: str) -> str:
    """An address, or an override that holds one, without its password, whatever it looks like."""
    return AS_OPTION.sub(r"\1***", IN_AUTHORITY.sub(r"\1***", text))


def shown_key(name: str) -> str:
    """The key of an override as a message may name it: one that holds a password itself is not shown."""
    return name if masked(name) == name and "@" not in name else "the command line"


def without_secrets(text: str, url: str) -> str:
    """What a database or its driver says of an address, without the address's passwords."""
    hidden = _secrets(url)
    for secret in sorted(hidden | {unquote(secret) for secret in hidden}, key=len, reverse=True):
        text = text.replace(secret, "***")
    return masked(text)


def hide_in_process_list(url: str) -> None:
    """Overwrite an address's passwords in this process's command line, which every user of the machine can read.

    What the shell, make or a job's script show of it stays, and so does the moment before this is called: a password
    in ~/.pgpass or PGPASSWORD is never shown. Does nothing where the system does not say where the line lies (only
    Linux does).
    """
    try:
        # Fields 48 and 49 of proc(5); the name in parentheses, the second, may hold blanks.
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        begin, shown = int(fields[45]), Path("/proc/self/cmdline").read_bytes()
        if not begin or int(fields[46]) - begin != len(shown):
            return
    except (OSError, ValueError, IndexError):
        return
    if ctypes.string_at(begin, len(shown)) != shown:
        return
    for secret in (secret.encode() for secret in _secrets(url)):
        place = shown.find(secret)
        while place >= 0:
            ctypes.memset(begin + place, ord("*"), len(secret))
            place = shown.find(secret, place + len(secret))


def _secrets(url: str) -> set[str]:
    """The passwords of an address, as they stand there."""
    found = {match[2].strip("'\"") for form in (IN_AUTHORITY, AS_OPTION) for match in form.finditer(url)}
    return found - {""}
