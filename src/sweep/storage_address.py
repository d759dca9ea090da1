"""Addresses of databases, as `storage=` takes them, and how SQLAlchemy and Optuna read them."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy.engine import URL

from src.errors import ConfigError


def default_storage(outputs: Path) -> str:
    """The SQLite database that studies of one machine share; its path is as relative as `outputs`."""
    path = str(outputs / "sweeps" / "sweeps.db")
    return URL.create("sqlite", database=path).render_as_string(hide_password=False)


def check_address(url: str) -> None:
    """Raises ConfigError, without showing the address, for one that SQLAlchemy would misread."""
    if not url.strip():
        raise ConfigError("storage is empty; give the address of a database, or leave storage= out for SQLite")
    if url.count("@") > 1 and not url.startswith("sqlite"):
        raise ConfigError("storage: its address has more than one @; write @ as %40 within user, password and options")


def for_optuna(url: str) -> str:
    """An address as Optuna takes it, which reads braces as places to fill in."""
    return url.replace("{", "{{").replace("}", "}}")
