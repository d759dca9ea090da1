"""The exported file: complete, within its budget, never half-written."""

import base64
import io
import re

import pytest
from PIL import Image

from src.dashboard import render as render_module
from src.dashboard import single_file as export_module
from src.dashboard.board import BoardReader
from src.dashboard.render import shortened_paths
from src.dashboard.single_file import embed_pictures, export_dashboard
from tests.dashboard.experiments import World

RUN = World.run_id(0, 0)


def test_the_file_holds_every_page_and_asks_for_nothing(world, tmp_path):
    path = tmp_path / "new" / "dashboard.html"
    export_dashboard(world.reports, world.outputs, path)
    text = path.read_text()
    board, _ = BoardReader(world.reports, world.outputs).read()
    for name in ("overview", "compare", "sweep-epsilon_mini", *(f"run-{run_id}" for run_id in board.runs)):
        assert f'<section class="page" id="{name}"' in text
    assert re.search(r"default-src &#39;none&#39;.*connect-src &#39;none&#39;", text)
    # What an HTML document can load: nothing but what it holds itself.
    loads = re.findall(r'\b(?:src|href|action|srcset|data)="([^"]*)"', text)
    assert loads and all(address.startswith(("#", "data:")) for address in loads)
    anchors = {address[1:] for address in loads if address.startswith("#")} - {"content"}
    assert anchors <= set(re.findall(r'\bid="([^"]*)"', text))
    assert "url(" not in text and "@import" not in text
    assert str(tmp_path) not in text  # says nothing of where it was made


def test_without_run_folders(world, tmp_path):
    path = tmp_path / "dashboard.html"
    export_dashboard(world.reports, None, path)
    text = path.read_text()
    assert "[39.0, 44.0]" in text and "data:image" not in text and "Pictures and the log lie in" in text


def test_pictures_are_smaller_copies(world, monkeypatch):
    monkeypatch.setattr(export_module, "PICTURE_WIDTH", 160)
    board, _ = BoardReader(world.reports, world.outputs).read()
    embedded = embed_pictures(board)
    assert set(embedded) == {(World.run_id(row, 0), "frame_0_abc.png") for row in range(3)}
    content = base64.b64decode(embedded[RUN, "frame_0_abc.png"].removeprefix("data:image/jpeg;base64,"))
    image = Image.open(io.BytesIO(content))
    assert image.size == (160, 120)
    assert image.getpixel((80, 60)) == pytest.approx((200, 30, 30), abs=4)


def test_a_budget_is_kept_and_what_is_left_out_is_said(world, tmp_path, monkeypatch):
    folder = world.outputs / RUN / "pictures"
    (folder / "frame_1_def.png").write_bytes((folder / "frame_0_abc.png").read_bytes())
    board, _ = BoardReader(world.reports, world.outputs).read()
    one = len(embed_pictures(board)[RUN, "frame_0_abc.png"])
    # Each run's first picture before any run's second.
    assert list(embed_pictures(board, 3 * one)) == [(World.run_id(row, 0), "frame_0_abc.png") for row in range(3)]
    assert len(embed_pictures(board, 4 * one)) == 4 and embed_pictures(board, one - 1) == {}
    monkeypatch.setattr(export_module, "embed_pictures", lambda board: embed_pictures(board, 3 * one))
    path = tmp_path / "dashboard.html"
    export_dashboard(world.reports, world.outputs, path)
    assert path.read_text().count("Left out of this file") == 1


def test_a_broken_picture_is_left_out(world):
    path = world.outputs / RUN / "pictures" / "frame_0_abc.png"
    whole = path.read_bytes()
    path.write_bytes(whole[:60] + bytes(len(whole) - 80) + whole[-20:])
    board, _ = BoardReader(world.reports, world.outputs).read()
    assert (RUN, "frame_0_abc.png") not in embed_pictures(board)


def test_an_older_file_survives_a_full_disk(world, tmp_path, monkeypatch):
    path = tmp_path / "dashboard.html"
    path.write_text("older")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space left"):
        export_dashboard(world.reports, world.outputs, path)
    assert path.read_text() == "older" and list(tmp_path.glob(".*")) == []


def test_a_page_that_cannot_be_drawn_says_so_and_the_others_are_there(world, tmp_path, monkeypatch):
    def run_figures(board, runs, original=render_module.run_figures):
        if any(run.run_id == RUN for run in runs.values()):
            raise OverflowError("too large")
        return original(board, runs)

    monkeypatch.setattr(render_module, "run_figures", run_figures)
    path = tmp_path / "dashboard.html"
    export_dashboard(world.reports, world.outputs, path)
    pages = dict(re.findall(r'<section class="page" id="([^"]*)".*?>(.*?)</section>', path.read_text(), re.DOTALL))
    assert "This cannot be shown: OverflowError: too large" in pages[f"run-{RUN}"]
    assert "By distance" in pages[f"run-{World.run_id(2, 1)}"] and "table12_epsilon" in pages["sweep-epsilon_mini"]


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ('File "/home/alice/code/src/train.py", line 5', 'File ".../src/train.py", line 5'),
        ("no /tmp/x, /root/a/b/c.ckpt: gone", "no .../x, .../b/c.ckpt: gone"),
        ("file:///Users/bob/d/e/", "file://.../d/e"),
        ("(/home/bob/last.ckpt)", "(.../last.ckpt)"),
        ("1/tmp/2 and data/home/x and /opt/a/b/c, 3 m/s", "1/tmp/2 and data/home/x and /opt/a/b/c, 3 m/s"),
    ],
)
def test_paths_of_the_machine_are_shortened(text, shown):
    assert shortened_paths(text) == shown


def test_logs_and_reasons_of_the_file_say_nothing_of_the_machine(world, tmp_path):
    log = world.outputs / "sweeps" / "epsilon_mini" / "failed.log"
    log.write_text("Traceback in /home/alice/venv/lib/torch/nn.py\n")
    record = world.reports / "sweeps" / "epsilon_mini.json"
    record.write_text(record.read_text().replace("loss/total is <nan>", "no file /root/alice/deep/down/x.pcd"))
    path = tmp_path / "dashboard.html"
    export_dashboard(world.reports, world.outputs, path)
    text = path.read_text()
    assert "alice" not in text and ".../torch/nn.py" in text and "no file .../down/x.pcd" in text
