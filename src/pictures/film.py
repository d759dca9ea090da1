"""Pictures of consecutive frames joined: an animation of all, a strip of some."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from src.files.atomic_write import replacing

WIDTH_PX = 960
"""Width of the animation, and of each picture in the strip."""
MAX_FRAMES = 100
"""The picture of a frame takes about a megabyte until the film is written; a recorded scene has 40."""
MIN_STEP_MS, MAX_STEP_MS = 20, 2000


class Film:
    """Collects pictures; those after the first MAX_FRAMES are left out."""

    def __init__(self) -> None:
        self._pictures: list[Image.Image] = []
        self._times_s: list[float] = []

    def __len__(self) -> int:
        return len(self._pictures)

    @property
    def full(self) -> bool:
        """Whether a further picture would be left out."""
        return len(self) >= MAX_FRAMES

    def add(self, draw: Callable[[Path], None], time_s: float) -> None:
        """Take the PNG that `draw` writes as the next frame; all get the size of the first, narrowed to WIDTH_PX."""
        if self.full:
            return
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frame.png"
            draw(path)
            with Image.open(path) as file:
                picture = file.convert("RGB")
        size = (WIDTH_PX, round(picture.height * WIDTH_PX / picture.width))
        picture = picture.resize(size, Image.Resampling.LANCZOS)
        if self._pictures and picture.size != self._pictures[0].size:
            canvas = Image.new("RGB", self._pictures[0].size, "white")
            canvas.paste(picture)
            picture = canvas
        self._pictures.append(picture.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE))
        self._times_s.append(time_s)

    def write_animation(self, path: Path) -> None:
        """Write a looping GIF, or by its name an animated PNG, at the frames' own rate; atomically."""
        steps = np.diff(self._times_s) * 1000
        steps = np.append(steps, steps[-1] if len(steps) else MAX_STEP_MS).clip(MIN_STEP_MS, MAX_STEP_MS)
        first, *others = self._pictures
        durations = [int(step) for step in steps.round()]
        _write(path, first, path.suffix[1:].upper(), save_all=True, append_images=others, duration=durations, loop=0)

    def write_strip(self, path: Path, count: int) -> None:
        """Write a PNG of up to `count` frames side by side, spread over the film; atomically."""
        picks = np.unique(np.linspace(0, len(self) - 1, count).round().astype(int))
        width, height = self._pictures[0].size
        strip = Image.new("RGB", (width * len(picks), height), "white")
        for column, pick in enumerate(picks):
            strip.paste(self._pictures[pick], (column * width, 0))
        _write(path, strip, "PNG")


def _write(path: Path, picture: Image.Image, kind: str, **options: object) -> None:
    with replacing(path, "wb") as file:
        picture.save(file, kind, **options)
