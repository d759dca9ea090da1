"""What the archive of a checkpoint may hold, looked at before torch unpacks it.

`weights_only` keeps code out. It does not keep a file of a few kilobytes from asking for more memory than there is, and
it allows more constructors than our files need.
"""

from __future__ import annotations

import os
import pickletools
import re
import zipfile
from typing import BinaryIO

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
    overlapping entries are how a small file becomes gigabytes. The pickle is read through without being carried out.

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
