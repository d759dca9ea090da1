"""Damage to files, drawn from a seeded generator: what disks, transfers and strangers do to them."""

from __future__ import annotations

import copy
import io
import json
import random
import zipfile
from collections.abc import Callable, Iterator
from typing import Any

import yaml

Mutate = Callable[[random.Random, bytes, list[bytes]], tuple[str, bytes]]

DEEP = 100_000
"""Brackets: far more than any reader may follow one into the other; fewer pass the parser and break what walks on."""
_DEEP_MARK, _HUGE_MARK = "a mark for depth", "a mark for digits"

NUMBERS = (
    float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 1e39, -1e39, 1e-320, 0, -1, 1, 0.5, -0.0, 2**31, 2**53,
    2**63, -(2**63) - 1, 10**30, 10**400,
)  # fmt: skip
TEXTS = (
    "", " ", "nan", "x" * 70_000, "\ud800", "a\0b", "../../etc/passwd", "/etc/passwd", "<script>alert(1)</script>",
    "a\nb", "1e999", "²", "٣", "=1+1", "${oc.env:HOME}", "${", "__reduce__",
)  # fmt: skip
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [None], {"": None}, [1] * 5000, _DEEP_MARK, _HUGE_MARK)


def damaged(rng: random.Random, content: bytes, strangers: list[bytes]) -> tuple[str, bytes]:
    """Damage that knows nothing of the format: what was done, and the bytes. `strangers` are files of other kinds."""
    how = rng.choice([cut, empty, flip, fill, drop, insert, repeat, huge_numbers, swap, append])
    return how.__name__, how(rng, content, strangers)


def cut(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    return content[: rng.randrange(len(content) + 1)]


def empty(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    return b"" if rng.random() < 0.5 else bytes(len(content))


def flip(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    """One to eight bits, half of them early, where headers are."""
    changed = bytearray(content)
    reach = len(changed) if rng.random() < 0.5 else min(len(changed), 400)
    for _ in range(rng.choice([1, 1, 2, 8])):
        changed[rng.randrange(reach)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def fill(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    """A block of zeros, ones or noise in place of what was there."""
    at, size = rng.randrange(len(content)), min(rng.choice([1, 4, 16, 64, 512, 4096]), len(content))
    block = rng.choice([bytes(size), b"\xff" * size, rng.randbytes(size)])
    return content[:at] + block + content[at + size :]


def drop(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    at = rng.randrange(len(content))
    return content[:at] + content[at + rng.choice([1, 2, 7, 64, 512]) :]


def insert(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    at = rng.randrange(len(content))
    return content[:at] + rng.randbytes(rng.choice([1, 2, 7, 64, 512])) + content[at:]


def repeat(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    """A part of the file, many times over."""
    at = rng.randrange(len(content))
    part = content[at : at + rng.choice([1, 4, 20, 200])]
    return content[:at] + part * rng.choice([2, 10, 500]) + content[at:]


def huge_numbers(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    """A declared size beyond all bounds, in binary or in digits."""
    at = rng.randrange(len(content))
    if rng.random() < 0.5:
        size = rng.choice([2, 4, 8])
        number = rng.choice([2 ** (8 * size) - 1, 2 ** (8 * size - 1) - 1, 2 ** (8 * size - 1)])
        return content[:at] + number.to_bytes(size, rng.choice(["little", "big"])) + content[at + size :]
    digits = [place for place in range(len(content)) if 48 <= content[place] < 58] or [at]
    place = rng.choice(digits)
    return content[:place] + b"9" * rng.choice([5, 12, 400, 5000]) + content[place + 1 :]


def swap(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    """Another kind's file under this name."""
    return rng.choice(strangers)


def append(rng: random.Random, content: bytes, strangers: list[bytes]) -> bytes:
    return content + rng.choice([b"\0" * 512, b"\n", b"}", rng.randbytes(64), content])


# -------------------------------------------------------------------- values inside a document


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key) of every value in nested lists and dicts."""
    for key, value in list(node.items()) if isinstance(node, dict) else list(enumerate(node)):
        yield node, key
        if isinstance(value, dict | list):
            yield from _places(value)


def changed_value(rng: random.Random, document: Any, others: tuple[Any, ...] = OTHERS) -> tuple[str, Any]:
    """The document with one to three values of other types or sizes, or without them; what was done first."""
    document = copy.deepcopy(document)
    said = []
    for _ in range(rng.choice([1, 1, 1, 3])):
        # The depth first: uniform over places would hardly ever touch the few entries at the top.
        places = list(_places(document)) if isinstance(document, dict | list) else []
        top = [place for place in places if place[0] is document]
        places = top if rng.random() < 0.3 else places
        if not places or rng.random() < 0.02:
            document = copy.deepcopy(rng.choice([*NUMBERS, *TEXTS, *others]))
            return f"all of it is {document!r:.40}", document
        container, key = rng.choice(places)
        deed = rng.random()
        if deed < 0.12:
            del container[key]
            said.append(f"without {key!r:.40}")
            continue
        if deed < 0.22 and isinstance(container, list):
            container.append(copy.deepcopy(container[key]))
            said.append(f"{key!r} twice")
            continue
        if deed < 0.3:
            value = copy.deepcopy(rng.choice([where[which] for where, which in places]))
        elif deed < 0.36 and isinstance(container, dict):
            value = container.pop(key)
            key = rng.choice(["", "x" * 3000, "\ud800", f"{key} "])
        else:
            # A copy: a later change may put a list of ours into itself.
            value = copy.deepcopy(rng.choice([*NUMBERS, *rng.sample(TEXTS, 8), *rng.sample(others, 4)]))
        container[key] = value
        said.append(f"{key!r:.40} is {value!r:.40}")
    return ", ".join(said), document


def changed_json(rng: random.Random, content: bytes) -> tuple[str, bytes]:
    """A JSON file with other values; NaN, Infinity, huge digits and depth stand in it as they would in a text."""
    said, document = changed_value(rng, json.loads(content))
    text = json.dumps(document)
    bracket = rng.choice([("[", "]"), ('{"a":', "}")])
    depth = rng.choice([DEEP, 930, 850, 400])
    deep = bracket[0] * depth + "1" + bracket[1] * depth
    text = text.replace(f'"{_DEEP_MARK}"', deep).replace(f'"{_HUGE_MARK}"', "9" * 5000)
    return said, text.encode("utf-8", "surrogatepass")


YAML_VALUES = (
    "[" * 3000 + "]" * 3000, "[" * DEEP, "{a: " * DEEP, "!!int ''", "!!float ''", "!!bool x", "!!timestamp x",
    "2026-13-45", "!!python/object/apply:os.system ['true']", "!!python/name:os.system", "&x [*x]", "*nowhere",
    "!!binary '~'", "!!set {1}", "!!omap [1]", "? [1, 2]", "9" * 5000, "1:1:1:1:1:1", "0x" + "f" * 3000, ".inf", ".nan",
    "'\0'", "%YAML 9.9", "--- 1", "!!null x", "<<: 3",
    # Ten levels of nine references each: three thousand million values once they are written out.
    "{a: &a [0,0,0,0,0,0,0,0,0], "
    + ", ".join(f"{y}: &{y} [{','.join(9 * [f'*{x}'])}]" for x, y in zip("abcdefghi", "bcdefghij", strict=True)) + "}",
)  # fmt: skip


def changed_yaml(rng: random.Random, content: bytes) -> tuple[str, bytes]:
    """A YAML file with other values, or with what only YAML can say."""
    others = tuple(other for other in OTHERS if other not in (_DEEP_MARK, _HUGE_MARK)) + (_DEEP_MARK,) * 6
    said, document = changed_value(rng, yaml.safe_load(content), others)
    text = yaml.safe_dump(document, sort_keys=False, allow_unicode=True)
    if _DEEP_MARK in text:
        value = rng.choice(YAML_VALUES)
        said, text = f"{said}: {value[:40]}", text.replace(_DEEP_MARK, value)
    return said, text.encode("utf-8", "surrogatepass")


def changed_csv(rng: random.Random, content: bytes) -> tuple[str, bytes]:
    """A CSV file with another cell, also in its head."""
    rows = [row.split(",") for row in content.decode().splitlines()]
    row = rng.choice(rows)
    at = rng.randrange(len(row))
    row[at] = str(rng.choice([*NUMBERS[:-1], *TEXTS, "9" * 5000, "x" * 200_000, '"', "a,b,c", "\r"]))
    return f"cell {at} is {row[at]!r:.40}", "\n".join(map(",".join, rows)).encode("utf-8", "surrogatepass")


# -------------------------------------------------------------------- archives (checkpoints, the table cache)


def repacked(rng: random.Random, content: bytes, strangers: list[bytes]) -> tuple[str, bytes]:
    """An archive in which a member is damaged and its checksum right: what a stranger can make, and no disk can."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    at = rng.randrange(len(members))
    name, body = members[at]
    deed = rng.random()
    if deed < 0.1:
        del members[at]
        said = f"without {name}"
    elif deed < 0.2:
        members[at] = (rng.choice(["../../x", "/etc/x", name + "\n", members[rng.randrange(len(members))][0]]), body)
        said = f"{name} as {members[at][0]!r}"
    elif deed < 0.25:
        members[at] = (name, bytes(20_000_000))
        said = f"{name} of 20 MB of zeros, compressed"
    else:
        what, body = damaged(rng, body or b"\0", strangers)
        members[at] = (name, body)
        said = f"{name}: {what}"
    packing = zipfile.ZIP_DEFLATED if rng.random() < 0.15 or "compressed" in said else zipfile.ZIP_STORED
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", packing) as archive:
        for name, body in dict(members).items():
            archive.writestr(name, body)
    return said, buffer.getvalue()


def either(change: Callable[[random.Random, bytes], tuple[str, bytes]]) -> Mutate:
    """A change of the document two times in three, else blind damage."""

    def mutate(rng: random.Random, content: bytes, strangers: list[bytes]) -> tuple[str, bytes]:
        return damaged(rng, content, strangers) if rng.random() < 0.33 else change(rng, content)

    return mutate


def archive(rng: random.Random, content: bytes, strangers: list[bytes]) -> tuple[str, bytes]:
    """Damage to the file of an archive, or to what is in it."""
    return damaged(rng, content, strangers) if rng.random() < 0.4 else repacked(rng, content, strangers)
