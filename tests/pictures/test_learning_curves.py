"""Training curves."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from src.pictures.learning_curves import draw_curves


def test_pictures_are_written(tmp_path: Path) -> None:
    curves = {"train/loss_$x$": [(0, 4.0), (9, 2.0)], "train/loss_box": [(0, 5.0), (9, -1.0)], "val/mAP": [(9, 0.1)]}
    draw_curves(tmp_path / "out" / "curves.png", curves, "run $1")
    draw_curves(tmp_path / "nothing.png", {})
    for name in ("out/curves.png", "nothing.png"):
        assert Image.open(tmp_path / name).size == (1600, 520)
