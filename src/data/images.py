"""Camera files: one decode, one resampling of the part that is used (method 3, 9)."""

from __future__ import annotations

import io
import math
import os
from dataclasses import dataclass

import numpy as np
from PIL import Image, UnidentifiedImageError

from src.data.jpeg import MAX_FILE_BYTES, REDUCTIONS, damage_of, decode_fast
from src.errors import ConfigError, DataError
from src.files.whole_read import read_whole
from src.geometry.camera import image_transform

Array = np.ndarray

MAX_PIXELS = 64_000_000
"""Above this a file is taken for a decompression bomb and refused before it is decoded."""


@dataclass(frozen=True)
class ImageCrop:
    """How one source image becomes one network input: resize, crop or pad, mirror, rotate."""

    resize: float  # network pixels per source pixel
    offset_px: tuple[int, int]  # (x, y) of the crop's corner in the resized image; negative = black padding
    size_px: tuple[int, int]  # (height, width) of the network input
    flip: bool = False
    rotation_rad: float = 0.0

    def matrix(self) -> Array:  # [3, 3]
        """M_n: network pixels from source pixels."""
        return image_transform(self.resize, self.offset_px, self.size_px, self.flip, self.rotation_rad)


def width_fit(
    source_px: tuple[int, int],  # (height, width)
    size_px: tuple[int, int],  # (height, width)
    resize_offset: float = 0.0,
    shift: float = 0.5,  # 0..1, where a crop narrower than the resized image lies
    flip: bool = False,
    rotation_rad: float = 0.0,
) -> ImageCrop:
    """Scale so that the width fits (plus an offset), keep the bottom, crop or pad the top (method 3, 9).

    Raises ConfigError when the offset leaves no positive scale.
    """
    resize = size_px[1] / source_px[1] + resize_offset
    if not resize > 0:
        raise ConfigError(
            f"data.augmentation.image.resize or data.test_resize_offset adds {resize_offset:g} to the scale "
            f"{size_px[1] / source_px[1]:g} that fits {source_px[1]} pixels into {size_px[1]}: the sum must be positive"
        )
    spare = max(0, math.floor(resize * source_px[1]) - size_px[1])
    offset = (round(shift * spare), math.floor(resize * source_px[0] + 1e-6) - size_px[0])
    return ImageCrop(resize, offset, size_px, flip, rotation_rad)


def read_image(
    path: str | os.PathLike[str],
    source_px: tuple[int, int],  # (height, width) as the tables state it
    crop: ImageCrop,
) -> Array:  # [3, H, W] uint8 RGB, not to be written to
    """Read, resample and augment one image. Greyscale and CMYK become RGB.

    Raises DataError naming the file when it is missing, no image, truncated, a bomb, of another size, or with a block
    of zeros in it. JPEG has no checksum: a few bytes changed in the middle give an image of which a part is wrong.
    """
    return resample(decode(path, source_px, reduction_for(source_px, crop)), crop, source_px)


def reduction_for(
    source_px: tuple[int, int],  # (height, width)
    crop: ImageCrop,
) -> int:
    """1/8, 1/4 or 1/2 is what is decoded where that still has more pixels than needed: half the time of a frame."""
    needed = [math.ceil(side * crop.resize) for side in source_px]
    return next((r for r in REDUCTIONS if all(s // n >= r for s, n in zip(source_px, needed, strict=True))), 1)


def decode(
    path: str | os.PathLike[str],
    source_px: tuple[int, int],  # (height, width) as the tables state it
    reduction: int,  # one of REDUCTIONS
    fast: bool = True,
) -> Image.Image:  # RGB
    """The whole image at 1/`reduction` of its size, by the fastest decoder at hand unless `fast` is False.

    Whichever it is, the pixels are the same (`src.data.jpeg`). Raises DataError as `read_image`.
    """
    content = read_whole(path, MAX_FILE_BYTES)
    damage = damage_of(content)
    if damage:
        raise DataError(f"{path}: not a readable image ({damage})")
    if fast and source_px[0] * source_px[1] <= MAX_PIXELS:
        decoded = decode_fast(content, source_px, reduction)
        if decoded is not None:
            return decoded
    try:
        # Only JPEG: other decoders of Pillow start programs or unpack without bounds.
        with Image.open(io.BytesIO(content), formats=("JPEG",)) as image:
            width, height = image.size
            if (height, width) != tuple(source_px):
                stated = f"{source_px[1]} x {source_px[0]}"
                raise DataError(f"{path}: the tables say {stated} pixels, the file has {width} x {height}")
            if width * height > MAX_PIXELS:
                raise DataError(f"{path}: {width} x {height} pixels are more than any camera gives ({MAX_PIXELS})")
            image.draft(image.mode, (max(1, width // reduction), max(1, height // reduction)))
            image.load()
            return image if image.mode == "RGB" else image.convert("RGB")
    except (DataError, MemoryError):
        raise
    except Exception as error:  # damaged metadata fails in Pillow's parsers with many types
        # Its message may hold an address in memory: the same fault always reads the same.
        reason = "no JPEG file" if isinstance(error, UnidentifiedImageError) else str(error)
        raise DataError(f"{path}: not a readable image ({reason})") from error


def resample(
    image: Image.Image,  # RGB, perhaps decoded at a power of two below the source size
    crop: ImageCrop,
    source_px: tuple[int, int],  # (height, width)
) -> Array:  # [3, H, W] uint8, not to be written to
    """Cut the source rectangle behind the crop and resize it in one step; what lies outside stays black."""
    height, width = crop.size_px
    reduction = round(source_px[1] / image.width)  # exactly that; an odd last row or column is half padding
    left, top = crop.offset_px
    # Whole network pixels whose source lies inside the image.
    x0, y0 = max(0, -left), max(0, -top)
    x1 = min(width, math.floor(crop.resize * source_px[1] - left + 1e-6))
    y1 = min(height, math.floor(crop.resize * source_px[0] - top + 1e-6))
    canvas = None
    if x1 > x0 and y1 > y0:
        box = tuple(
            min(max(0.0, edge / crop.resize), limit) / reduction
            for edge, limit in zip((x0 + left, y0 + top, x1 + left, y1 + top), 2 * source_px[::-1], strict=True)
        )
        canvas = image.resize((x1 - x0, y1 - y0), Image.Resampling.BILINEAR, box=box)
    if canvas is None or canvas.size != (width, height):
        part, canvas = canvas, Image.new("RGB", (width, height))
        if part is not None:
            canvas.paste(part, (x0, y0))
    canvas = turn(canvas, crop)
    planes = b"".join(canvas.tobytes("raw", band) for band in "RGB")
    return np.frombuffer(planes, np.uint8).reshape(3, height, width)


def turn(
    canvas: Image.Image,
    crop: ImageCrop,
) -> Image.Image:
    """The part of the augmentation that comes after the crop: mirror, then rotate about the centre."""
    if crop.flip:
        canvas = canvas.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    if crop.rotation_rad:
        # Pillow turns counter-clockwise on the screen, our angle runs from x to y, which points down.
        canvas = canvas.rotate(-math.degrees(crop.rotation_rad), Image.Resampling.BILINEAR)
    return canvas
