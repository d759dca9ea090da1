"""A sheet measured in pixels: placement of axes, text and legends, and the PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from src.files.atomic_write import replacing
from src.pictures.contents import INK

DPI = 100
SHEET_PX = 1600
"""Width of every picture."""
MARGIN_PX = 10
GAP_PX = 12
"""Gap between panels."""
HALF_PX = (SHEET_PX - 2 * MARGIN_PX - GAP_PX) / 2
"""Width of one of two panels side by side."""
CAPTION_PX = 34
"""Height of the caption above a panel."""


class Canvas:
    """A white sheet measured in pixels from the top left corner.

    Uses matplotlib's Agg canvas directly: no window system, no global figure list, nothing to close.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """An empty plot over the given pixels."""
        box = (left / self.width, 1 - (top + height) / self.height, width / self.width, height / self.height)
        return self.figure.add_axes(box)

    def text(
        self,
        left: float,
        top: float,
        text: str,
        size_px: float,
        bold: bool = False,
        colour: str = INK,
        align: str = "left",
    ) -> None:
        """One line of plain text (never read as formulas), its upper corner at the given pixels."""
        self.figure.text(
            left / self.width, 1 - top / self.height, text.replace("\n", " "), fontsize=size_px * 72 / DPI,
            fontweight="bold" if bold else "normal", color=colour, ha=align, va="top", parse_math=False,
        )  # fmt: skip

    def legend(self, left: float, top: float, handles: Sequence[Artist], size_px: float = 13) -> None:
        """One row of keys, its upper left corner at the given pixels."""
        if handles:
            self.figure.legend(
                handles=handles, loc="upper left", bbox_to_anchor=(left / self.width, 1 - top / self.height),
                ncols=len(handles), fontsize=size_px * 72 / DPI, frameon=False, borderpad=0,
                borderaxespad=0, handlelength=1.9, handletextpad=0.5, columnspacing=1.5, labelcolor=INK,
            )  # fmt: skip

    def save(self, path: Path | str, photographs: bool = True) -> None:
        """Write the PNG, making the folder where needed; without photographs 256 colours do, in a third of the size."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if photographs:
            with replacing(path, "wb") as file:
                self.figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
            return
        self.figure.canvas.draw()
        picture = Image.fromarray(np.asarray(self.figure.canvas.buffer_rgba())).convert("RGB")
        picture = picture.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)  # keeps rare colours
        with replacing(path, "wb") as file:
            picture.save(file, format="PNG", optimize=True)
