"""What a user is told of a configuration that does not compose, or holds what it must not."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Collection
from typing import Any

from src.errors import ConfigError

# Lines of Hydra's messages that tell a user nothing, or to do what is refused here (`+key`).
HYDRA_INTERNALS = (
    "full_key:",
    "object_type=",
    "reference_type=",
    "schema_",
    "Config search path",
    "provider=",
    "To append to your",
    "See https",
    "3. To sweep",
)


def hydra_message(error: Exception, known_keys: Callable[[], Collection[str]]) -> str:
    """Hydra's message in one paragraph, with the nearest of the keys there are where one is not known."""
    cause = error.__cause__
    lines = [line.strip() for line in [*str(error).splitlines(), *str(cause or "").splitlines()]]
    lines = [line for line in dict.fromkeys(lines) if line.strip("^") and not line.startswith(HYDRA_INTERNALS)]
    text = " | ".join(lines)
    if "/override_grammar/" in str(error):
        text += (
            " | options are key=value; a value with characters like = , ~ { or a blank is quoted twice, "
            """key='"value"', and ~ is written as $HOME"""
        )
    unknown = getattr(cause or error, "full_key", None)
    if "type hint 'float'" in text:
        text += " | write whole numbers of a nested list with a point, as 50.0"
    elif unknown:
        known = known_keys()
        near = difflib.get_close_matches(str(unknown), known, n=1, cutoff=0.6) if str(unknown) not in known else []
        if near:
            text += f" | did you mean {near[0]}?"
    return text


def check_tree(value: Any, node: Any, path: str = "") -> None:
    """Refuse what OmegaConf lets pass: keys added with `+` and numbers that are not finite."""
    if dataclasses.is_dataclass(value):
        known = [f.name for f in dataclasses.fields(value)]
        for key in node:
            name = f"{path}.{key}" if path else str(key)
            if key not in known:
                near = difflib.get_close_matches(str(key), known, n=1)
                hint = f"; did you mean {near[0]}?" if near else f"; known here: {', '.join(known)}"
                raise ConfigError(f"{name} is not a configuration key{hint}")
            check_tree(getattr(value, key), node[key], name)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            check_tree(item, node[index], f"{path}[{index}]")
    elif isinstance(value, dict):
        for key, item in value.items():
            check_tree(item, node[key], f"{path}.{key}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{path} must be a finite number, but got {value}")
