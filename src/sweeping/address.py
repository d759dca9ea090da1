"""Addresses of databases, as `storage=` takes them: what of them is secret, and how SQLAlchemy and Optuna read them."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

from sqlalchemy.engine import URL

from src.errors import ConfigError

# Both take too much rather than too little: a password that holds the character that should end it stays hidden.
IN_AUTHORITY = re.compile(r"(://[^:]*:)(.*)(?=@)", re.DOTALL)
AS_OPTION = re.compile(r"""((?:password|passwd|pwd)=)('.*'|".*"|[^&]*)""", re.DOTALL | re.IGNORECASE)


def default_storage(outputs: Path) -> str:
    """The SQLite database that studies of one machine share; its path is as relative as `outputs`."""
    path = str(outputs / "sweeps" / "sweeps.db")
    return URL.create("sqlite", database=path).render_as_string(hide_password=False)


def masked(text: str) -> str:
    """An address, or an override that holds one, without its password, whatever it looks like."""
    return AS_OPTION.sub(r"\1***", IN_AUTHORITY.sub(r"\1***", text))


def without_secrets(text: str, url: str) -> str:
    """What a database or its driver says of an address, without the address's passwords."""
    hidden = {found[2].strip("'\"") for form in (IN_AUTHORITY, AS_OPTION) for found in form.finditer(url)}
    for secret in sorted(hidden | {unquote(secret) for secret in hidden}, key=len, reverse=True):
        text = text.replace(secret, "***") if secret else text
    return masked(text)


def check_address(url: str) -> None:
    """Raises ConfigError, without showing the address, for one that would be read as another than was meant."""
    if not url.strip():
        raise ConfigError("storage is empty; give the address of a database, or leave storage= out for SQLite")
    if url.count("@") > 1 and not url.startswith("sqlite"):
        raise ConfigError("storage: its address has more than one @; write @ as %40 within user, password and options")


def for_optuna(url: str) -> str:
    """An address as Optuna takes it, which reads braces as places to fill in."""
    return url.replace("{", "{{").replace("}", "}}")
