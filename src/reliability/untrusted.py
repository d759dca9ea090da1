"""What a checkpoint of unknown origin may hold: its archive, checked before torch unpacks it, and its configuration.

`weights_only` keeps code out. It does not keep a file of a few kilobytes from asking for more memory than there is, and
it allows more constructors than our files need.
"""

from __future__ import annotations

import os
import pickletools
import re
import zipfile
from typing import Any, BinaryIO

MAX_LEVELS = 30
"""Deepest nesting of a stored configuration: readers follow each level with a call of their own. A run's has six."""
ALLOWED = re.compile(
    r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|"
    r"torch ([A-Za-z0-9]+Storage|Size|(float|bfloat|u?int|bool|complex)[0-9a-z_]*)"
)
"""What pickles of tensors and plain values name."""
BUILDS_BY_NAME = {"STACK_GLOBAL", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"}
"""How other pickles than torch's call constructors; their names cannot be read off, and torch refuses most of them."""


def fault_of_archive(file: BinaryIO) -> str | None:
    """What no file that `torch.save` wrote has, from a zip archive open for reading; None for a sound one.

    torch stores entries uncompressed and each once, so together they are never larger than the file. Compressed or
    overlapping entries are how a small file becomes gigabytes. The pickle is scanned without being executed.

    Raises zipfile.BadZipFile for what is no archive, ValueError for what is no pickle.
    """
    size = file.seek(0, os.SEEK_END)
    with zipfile.ZipFile(file) as archive:
        entries = archive.infolist()
        names = [entry.filename for entry in entries]
        packed = next((entry for entry in entries if entry.compress_type != zipfile.ZIP_STORED), None)
        if packed is not None:
            return f"{packed.filename} in it is compressed, which torch never does"
        if len(set(names)) < len(names):
            return "it holds two entries of one name"
        if sum(entry.file_size for entry in entries) > size:
            return f"its entries claim to be larger than the file, which has {size} bytes"
        if any(".." in name.split("/") or name.startswith("/") or "\\" in name for name in names):
            return "an entry's name leads out of the archive"
        pickles = [name for name in names if name.endswith("data.pkl")]
        if len(pickles) != 1 or pickles[0].count("/") != 1:
            return f"it must hold one data.pkl, but has {len(pickles)}"
        content = archive.read(pickles[0])
    for operation, argument, _ in pickletools.genops(content):
        if operation.name in BUILDS_BY_NAME:
            return f"it builds objects ({operation.name})"
        if operation.name == "GLOBAL" and not ALLOWED.fullmatch(str(argument)):
            return f"it names {str(argument).replace(' ', '.')!r:.80}"
    return None


def fault_of_tree(tree: Any) -> str | None:
    """What a configuration that somebody else stored holds besides plain values, with its place; None for a sound one.

    `${` would be filled in when the tree is read, with environment variables too. A part that stands in two places is
    walked through twice by whoever reads it, so that a few nested ones are more than a machine can hold.
    """
    seen: set[int] = set()
    parts: list[tuple[str, Any]] = [("", tree)]
    while parts:
        where, part = parts.pop()
        if isinstance(part, str):
            if "${" in part:
                return f"{where} is {part!r:.80}, which refers to something else"
        elif isinstance(part, dict | list):
            if where.count(".") >= MAX_LEVELS:
                return f"{where:.80} has more than {MAX_LEVELS} levels"
            if id(part) in seen:
                return f"{where} stands in two places"
            seen.add(id(part))
            items = part.items() if isinstance(part, dict) else enumerate(part)
            for name, value in items:
                if isinstance(part, dict) and not isinstance(name, str):
                    return f"a key of {where or 'it'} is {name!r:.80}, which is not a text"
                parts.append((f"{where}.{name}" if where else str(name), value))
                parts.append((f"the key {where}.{name}", str(name)))
        elif not isinstance(part, (bool, int, float, type(None))):
            return f"{where} is a {type(part).__name__}"
    return None
