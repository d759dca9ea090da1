"""A faster decoder for JPEG files, used where it is installed and gives Pillow's pixels to the last bit.

`pip install horizon3d[fast]` brings simplejpeg. Training and evaluation cannot differ by it: the first use in a process
compares both decoders at every scale, and where it differs, fails or is not installed, Pillow decodes.
"""

from __future__ import annotations

import io
import logging
from functools import cache
from types import ModuleType

import numpy as np
from PIL import Image

REDUCTIONS = (8, 4, 2, 1)
"""Scales at which a decoder gives a smaller image for less work: 1/8, 1/4, 1/2 and 1."""
LEAST_PX = 16
"""Below, several scales give the same size and the one that a decoder takes is not known."""

MAX_FILE_BYTES = 2**28
"""Four bytes a pixel of the largest image; a longer file is no camera's."""
MAX_SCANS = 100
"""Progressive files have about ten. Each scan is a walk over all pixels, so a small file with many is a bomb."""
HOLE_BYTES = 512
"""A sector of a disk: zeros of this length among compressed data are a block that was never written."""

_log = logging.getLogger(__name__)


def decode_fast(
    content: bytes,
    source_px: tuple[int, int],  # (height, width) as the tables state it
    reduction: int,  # one of REDUCTIONS
    decoder: ModuleType | None = None,  # None: the checked one
) -> Image.Image | None:
    """The image that Pillow's `draft` and `load` give, for resizing only, or None where Pillow must read it itself.

    None stands for: no faster decoder, a damaged file, another size, and anything but colour in the usual encoding.
    Pillow then finds the same fault and names it, or overlooks it.
    """
    decoder = decoder or _checked_decoder()
    if decoder is None or min(source_px) < LEAST_PX:
        return None
    wanted = [-(-side // reduction) for side in source_px]
    try:
        height, width, colours, _ = decoder.decode_jpeg_header(content)
        if (height, width) != tuple(source_px) or colours != "YCbCr":
            return None
        scale = {"min_height": wanted[0], "min_width": wanted[1], "min_factor": reduction}
        pixels = decoder.decode_jpeg(content, "RGBX", **scale)  # [H, W, 4], as Pillow lays out its own images
        if list(pixels.shape[:2]) != wanted:
            return None
        # What Image.frombuffer does without a copy for RGBX; as RGB it resizes three of the four bytes.
        memory = Image.core.map_buffer(pixels, (wanted[1], wanted[0]), "raw", 0, ("RGB", 0, 1))
        return Image.new("RGB", (1, 1))._new(memory)
    except Exception:  # whatever is wrong with a file, Pillow says it in the words that callers know
        return None


def damage_of(content: bytes) -> str | None:
    """What is wrong with a JPEG file though decoders accept it, or None.

    A hole (a block of zeros) decodes without an error, and whatever comes after it in the image is wrong.
    """
    start, first_symbols = _head(content)
    if start < 0:
        return None  # no JPEG file, or none with image data: a decoder says so
    scans = content.count(b"\xff\xda", start)
    if scans > MAX_SCANS:
        return f"at most {MAX_SCANS} scans are expected, but it has {scans}"
    if first_symbols and not any(first_symbols):
        return None  # tables made for an image of hardly more than one colour, where zeros may be many equal pixels
    end = content.find(b"\xff\xd9", start)  # what comes after the image is not checked
    hole = content.find(bytes(HOLE_BYTES), start, end if end >= 0 else len(content))
    return f"{HOLE_BYTES} bytes from byte {hole} are zero, a block of the file that was lost" if hole >= 0 else None


def _head(content: bytes) -> tuple[int, list[int]]:
    """Byte at which the image data begin, -1 without any, and what the code of zeros means in each Huffman table."""
    at, first_symbols = 2, []
    while at + 4 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xDA:
            return at, first_symbols
        end = at + 1 if marker == 0xFF else at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if marker == 0xC4:
            table = at + 4
            while table + 17 < min(end, len(content)):
                first_symbols.append(content[table + 17])
                table += 17 + sum(content[table + 1 : table + 17])
        at = end
    return -1, first_symbols


def decoder_name() -> str:
    """What decodes the files of this process, with its version."""
    decoder = _checked_decoder()
    return f"Pillow {Image.__version__}" if decoder is None else f"simplejpeg {decoder.__version__}"


@cache
def _checked_decoder() -> ModuleType | None:
    try:
        import simplejpeg
    except ImportError:
        return None
    rng = np.random.default_rng(0)
    ramp = np.linspace(0, 200, 83)[:, None, None] * np.linspace(0, 1, 118)[:, None]
    picture = Image.fromarray((ramp + rng.uniform(0, 55, (83, 118, 3))).astype(np.uint8))
    for subsampling in ("4:2:0", "4:2:2", "4:4:4"):
        buffer = io.BytesIO()
        picture.save(buffer, "JPEG", quality=85, subsampling=subsampling)
        for reduction in REDUCTIONS:
            expected = Image.open(buffer)
            expected.draft("RGB", (118 // reduction, 83 // reduction))
            expected.load()
            found = decode_fast(buffer.getvalue(), (83, 118), reduction, simplejpeg)
            if found is None or found.tobytes() != expected.tobytes():
                _log.warning("simplejpeg %s gives other pixels than Pillow: not used", simplejpeg.__version__)
                return None
    return simplejpeg
