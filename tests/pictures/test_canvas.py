"""Pictures take the place of older ones as a whole."""

import errno

import pytest
from matplotlib.figure import Figure
from PIL import Image

from src.pictures.canvas import Canvas


@pytest.mark.parametrize("photographs", [True, False])
def test_a_full_disk_leaves_the_older_picture(tmp_path, monkeypatch, photographs):
    path, canvas = tmp_path / "a" / "picture.png", Canvas(64, 32)
    canvas.save(path, photographs)
    before = path.read_bytes()
    assert Image.open(path).size == (64, 32)

    def fail(self, file, **options):
        file.write(b"half")
        raise OSError(errno.ENOSPC, "no space")

    for kind, name in ((Figure, "savefig"), (Image.Image, "save")):
        monkeypatch.setattr(kind, name, fail)
    with pytest.raises(OSError, match="picture.png"):
        canvas.save(path, photographs)
    assert path.read_bytes() == before and [one.name for one in path.parent.iterdir()] == ["picture.png"]
