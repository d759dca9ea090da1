"""YAML files of people and of other machines: plain values, without what brings a reader down."""

from __future__ import annotations

from typing import Any

import yaml

MAX_CHARACTERS = 1_000_000
MAX_DEPTH = 50
"""A configuration has six levels. The fast reader follows each with a call of its own, and some thousand kill it."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Level:
    """A mapping or a list whose end has not come yet."""

    def __init__(self, is_mapping: bool) -> None:
        self.is_mapping, self.nodes, self.keys = is_mapping, 0, set[str]()

    def is_repeated_key(self, node: yaml.NodeEvent) -> bool:
        """Count the next node of this level; True for a key that the mapping already has."""
        self.nodes += 1
        if not (self.is_mapping and self.nodes % 2 and isinstance(node, yaml.ScalarEvent)):
            return False
        repeated = node.value in self.keys
        self.keys.add(node.value)
        return repeated


class PlainYAMLError(yaml.YAMLError, ValueError):
    """A text that is not read, and why."""


def load_plain_yaml(text: str) -> Any:
    """The values of a YAML text: of the types that JSON has, and dates.

    Raises PlainYAMLError for what is no YAML, for a key that stands twice, for references (`*name`: a few lines of them
    stand for more values than a memory holds, or for a value inside itself), and for more than MAX_DEPTH levels or
    MAX_CHARACTERS.
    """
    check_plain_yaml(text)
    try:
        return yaml.load(text, Loader=_LOADER)
    except Exception as error:  # PyYAML's own makers of numbers and dates fail in many ways
        raise PlainYAMLError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error


def check_plain_yaml(text: str) -> None:
    """What `load_plain_yaml` refuses, by the grammar alone, which is followed without recursion; values are not made.

    Raises PlainYAMLError.
    """
    if len(text) > MAX_CHARACTERS:
        raise PlainYAMLError(f"at most {MAX_CHARACTERS} characters are expected, but it has {len(text)}")
    levels: list[_Level] = []
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            line = event.start_mark.line + 1
            if isinstance(event, yaml.AliasEvent):
                raise PlainYAMLError(f"line {line}: references (*{event.anchor}) are not read")
            if isinstance(event, yaml.CollectionEndEvent):
                levels.pop()
            elif isinstance(event, yaml.NodeEvent):
                if levels and levels[-1].is_repeated_key(event):
                    raise PlainYAMLError(f"line {line}: {event.value} stands twice in one place; keep one of them")
                if isinstance(event, yaml.CollectionStartEvent):
                    levels.append(_Level(isinstance(event, yaml.MappingStartEvent)))
            if len(levels) > MAX_DEPTH:
                raise PlainYAMLError(f"line {line}: more than {MAX_DEPTH} levels, one in the other")
    except PlainYAMLError:
        raise
    except (yaml.YAMLError, UnicodeError) as error:
        raise PlainYAMLError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error
