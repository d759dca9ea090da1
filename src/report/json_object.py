"""JSON objects of files that anybody may have written: every value is checked and named when it is not as expected."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from src.errors import DataError

SHARES = ("AP", "mAP", "NDS", "mAP_present")
"""Numbers from 0 to 1, by the last part of their names."""
LARGEST_SCORE, LARGEST = 1e6, 1e15
"""Of any other number in a table, and of any number in a result: beyond it is damage, not a measurement."""
SUSPICIOUS = re.compile(r"[\s\[,:]-?(\d{16}|\d[\d.]*[eE]\+?\d\d)|NaN|Infinity")
"""How a number beyond LARGEST looks in JSON; NaN and Infinity are not JSON, though Python reads them."""

NUMBER = (float, int)
NONE = type(None)


class JsonObject:
    """A JSON object of a file; whatever it lacks is named with the file and what to do."""

    def __init__(self, path: Path, remedy: str, content: Any = None, prefix: tuple[str, ...] = ()) -> None:
        self.path, self.remedy, self.content, self.prefix = path, remedy, content, prefix
        if content is not None:
            return
        try:
            text = path.read_text(encoding="utf-8")
            self.content = json.loads(text)
            if "\\ud" in text or "\\uD" in text:  # half a pair, which no page can hold, is a UnicodeEncodeError
                json.dumps(self.content, ensure_ascii=False).encode()
        except (OSError, ValueError) as error:
            raise DataError(f"{path}: not readable as JSON ({error}); {remedy}") from error
        except RecursionError as error:
            raise self.too_deep() from error
        if not isinstance(self.content, dict):
            raise DataError(f"{path}: must hold an object, but holds a {type(self.content).__name__}; {remedy}")
        if SUSPICIOUS.search(text):
            for names, value in _leaves(self.content):
                if isinstance(value, float) and not math.isfinite(value):
                    raise self.refusal(names, f"must be a finite number, but is {value}")
                if isinstance(value, NUMBER) and abs(value) > LARGEST and names[0] != "config":
                    raise self.refusal(names, f"must be at most {LARGEST:g} in size, but is {value!r:.80}")

    def below(self, name: str) -> JsonObject:
        """The object at one name, checked as this one is."""
        return JsonObject(self.path, self.remedy, self.get(name, dict), (*self.prefix, name))

    def get(self, names: str | Sequence[str], *kinds: type) -> Any:
        """The value at one name, or under several names one inside the other; its type is exactly one of `kinds`."""
        names = (names,) if isinstance(names, str) else names
        value: Any = self.content
        for depth, name in enumerate(names):
            if not isinstance(value, dict) or name not in value:
                raise self.refusal(names[: depth + 1], "is missing")
            value = value[name]
        if type(value) not in kinds:
            expected = " or ".join("null" if kind is NONE else kind.__name__ for kind in kinds)
            raise self.refusal(names, f"must be {expected}, but is {value!r:.80}")
        return value

    def score(self, names: str | Sequence[str], *kinds: type) -> Any:
        """A number as by `get`, within what a number of this name can be."""
        names = (names,) if isinstance(names, str) else names
        value = self.get(names, *NUMBER, *kinds)
        share = names[-1] in SHARES
        low, high = (0.0, 1.0) if share else (-LARGEST_SCORE, LARGEST_SCORE)
        if value is not None and not low - 1e-9 <= value <= high + 1e-9:  # a mean of ones may be 1.0000000000000002
            raise self.refusal(names, f"must be from {low:g} to {high:g}, but is {value!r:.80}")
        return value

    def too_deep(self) -> DataError:
        """What is wrong with a file of too many brackets."""
        return DataError(f"{self.path}: not readable as JSON (nested too deeply); {self.remedy}")

    def refusal(self, names: Sequence[str], fault: str) -> DataError:
        """What is wrong at `names`."""
        return DataError(f"{self.path}: {'.'.join((*self.prefix, *names))} {fault}; {self.remedy}")


def _leaves(content: Any, names: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(content, (dict, list)):
        for name, value in content.items() if isinstance(content, dict) else enumerate(content):
            yield from _leaves(value, (*names, str(name)))
    else:
        yield names, content
