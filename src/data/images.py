"""Camera files: one decode, one resampling of the part that is used (spec section 3, section 9)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from src.errors import ConfigError, DataError
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
    """Scale so that the width fits (plus an offset), keep the bottom, crop or pad the top (spec sections 3, 9).

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
    path: Path,
    source_px: tuple[int, int],  # (height, width) as the tables state it
    crop: ImageCrop,
) -> Array:  # [3, H, W] uint8 RGB
    """Read, resample and augment one image. Greyscale and CMYK become RGB.

    Raises DataError naming the file when it is missing, no image, truncated, a bomb or of another size.
    """
    try:
        # Only JPEG: other decoders of Pillow start programs or unpack without bounds.
        with Image.open(path, formats=("JPEG",)) as image:
            width, height = image.size
            if (height, width) != tuple(source_px):
                stated = f"{source_px[1]} x {source_px[0]}"
                raise DataError(f"{path}: the tables say {stated} pixels, the file has {width} x {height}")
            if width * height > MAX_PIXELS:
                raise DataError(f"{path}: {width} x {height} pixels are more than any camera gives ({MAX_PIXELS})")
            # Decode at 1/2, 1/4 or 1/8 where that still has more pixels than needed: half the time of a frame.
            image.draft(image.mode, (math.ceil(width * crop.resize), math.ceil(height * crop.resize)))
            return resample(image.convert("RGB"), crop, (height, width))
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: not a readable image ({error})") from error


def resample(
    image: Image.Image,  # RGB, perhaps decoded at a power of two below the source size
    crop: ImageCrop,
    source_px: tuple[int, int],  # (height, width)
) -> Array:  # [3, H, W] uint8
    """Cut the source rectangle behind the crop and resize it in one step; what lies outside stays black."""
    height, width = crop.size_px
    reduction = round(source_px[1] / image.width)  # exactly that; an odd last row or column is half padding
    left, top = crop.offset_px
    # Whole network pixels whose source lies inside the image.
    x0, y0 = max(0, -left), max(0, -top)
    x1 = min(width, math.floor(crop.resize * source_px[1] - left + 1e-6))
    y1 = min(height, math.floor(crop.resize * source_px[0] - top + 1e-6))
    canvas = Image.new("RGB", (width, height))
    if x1 > x0 and y1 > y0:
        box = tuple(
            min(max(0.0, edge / crop.resize), limit) / reduction
            for edge, limit in zip((x0 + left, y0 + top, x1 + left, y1 + top), 2 * source_px[::-1], strict=True)
        )
        canvas.paste(image.resize((x1 - x0, y1 - y0), Image.Resampling.BILINEAR, box=box), (x0, y0))
    if crop.flip:
        canvas = canvas.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    if crop.rotation_rad:
        # Pillow turns counter-clockwise on the screen, our angle runs from x to y, which points down.
        canvas = canvas.rotate(-math.degrees(crop.rotation_rad), Image.Resampling.BILINEAR)
    return np.ascontiguousarray(np.asarray(canvas).transpose(2, 0, 1))
