"""The dashboard as one HTML file that holds everything it shows."""

from __future__ import annotations

import base64
import io
import itertools
from pathlib import Path

from PIL import Image

from src.dashboard.board import Board, BoardReader
from src.dashboard.folders import Picture
from src.dashboard.render import Renderer, shown_pictures
from src.files.atomic_write import write_whole

PICTURE_BUDGET = 8_000_000
"""Bytes of embedded pictures; those of every run's first frame come first, then of the second, and so on."""
PICTURE_WIDTH = 960
JPEG_QUALITY = 72
MAX_PIXELS = 64_000_000
"""Largest picture that is decoded; those of runs have a hundredth of it."""


def export_dashboard(reports: Path, outputs: Path | None, path: Path) -> None:
    """Write everything under `reports`, and pictures and logs under `outputs` where it is there, as one HTML file.

    The file needs no network and no other file. Pictures are embedded smaller than they are and up to a budget of
    8 MB; the page says where one is left out. Raises OSError naming `path` where it cannot be written; an older
    file then stays.
    """
    board, _ = BoardReader(reports, outputs).read()
    embedded = embed_pictures(board)
    renderer = Renderer(_address, lambda picture: embedded.get((picture.run_id, picture.name)), live=False)
    pages = [renderer.overview(board)]
    pages += [renderer.sweep(board, sweep) for sweep in board.sweeps]
    pages += [renderer.run(board, run) for run in board.runs.values()]
    if board.runs:
        pages.append(renderer.compare(board))
    write_whole(path, renderer.document(board, pages))


def embed_pictures(board: Board, budget: int = PICTURE_BUDGET) -> dict[tuple[str, str], str]:
    """Addresses that hold the pictures themselves, by run and name, as many as fit the budget."""
    by_run = [shown_pictures(board, run) for run in board.runs.values() if run.has_folder]
    embedded: dict[tuple[str, str], str] = {}
    for picture in filter(None, itertools.chain(*itertools.zip_longest(*by_run))):
        address = _data_address(picture)
        if address is None:
            continue
        budget -= len(address)
        if budget < 0:
            break
        embedded[picture.run_id, picture.name] = address
    return embedded


def _data_address(picture: Picture) -> str | None:
    """A smaller JPEG of the picture; None where it cannot be decoded."""
    if picture.width * picture.height > MAX_PIXELS:
        return None
    try:
        with Image.open(picture.path, formats=("PNG",)) as image:
            image = image.convert("RGB")
    except Exception:  # Pillow's parsers of damaged files fail in many ways
        return None
    image.thumbnail((PICTURE_WIDTH, 4 * PICTURE_WIDTH))
    stream = io.BytesIO()
    image.save(stream, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"


def _address(kind: str, name: str = "") -> str:
    """Address of a page, an anchor within the file."""
    if kind == "overview":
        return f"#{name or 'overview'}"
    return f"#{kind}-{name}"
