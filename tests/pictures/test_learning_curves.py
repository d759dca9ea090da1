"""Training curves from a CSV log, and score bars."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from src.errors import DataError
from src.pictures.learning_curves import draw_curves, draw_scores, read_metrics

LOG = """epoch,step,train/loss_$x$,train/loss_box,val/mAP
0,0,4.0,,
0,1,2.0,,
0,1,,5.0,0.1
1,2,nan,,
1,3,1.0,,
1,3,,-1.0,
"""


def test_values_are_averaged_within_epochs(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(LOG)
    series = read_metrics(tmp_path / "m.csv")
    assert set(series) == {"train/loss_$x$", "train/loss_box", "val/mAP"}
    assert [part.tolist() for part in series["train/loss_$x$"]] == [[0, 1], [3.0, 1.0]]
    assert [part.tolist() for part in series["train/loss_box"]] == [[0, 1], [5.0, -1.0]]
    assert [part.tolist() for part in series["val/mAP"]] == [[0], [0.1]]


def test_pictures_are_written(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text(LOG)
    draw_curves(tmp_path / "out" / "curves.png", tmp_path / "m.csv", "run $1")
    (tmp_path / "n.csv").write_text("epoch,step,lr\n0,0,0.1\n")
    draw_curves(tmp_path / "nothing.png", tmp_path / "n.csv")
    draw_scores(tmp_path / "scores.png", {"car": 0.5, "animal": None, "bus": float("nan")}, {"0-25 m": 0.0})
    draw_scores(tmp_path / "none.png", {}, {})
    for name in ("out/curves.png", "nothing.png", "scores.png", "none.png"):
        assert Image.open(tmp_path / name).size == (1600, 520)


@pytest.mark.parametrize(("text", "message"), [("", "column `epoch`"), ("a,b\n1,2\n", "column `epoch`")])
def test_a_log_without_epochs_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(DataError, match=message):
        read_metrics(tmp_path / "m.csv")


def test_a_broken_cell_is_named(tmp_path: Path) -> None:
    (tmp_path / "m.csv").write_text("epoch,train/loss\n0,1.0\n1,abc\n")
    with pytest.raises(DataError, match="line 3"):
        read_metrics(tmp_path / "m.csv")
