"""The faster decoder: Pillow's pixels to the last bit, or Pillow itself."""

import io
import types
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from src.data import images, jpeg
from src.data.images import ImageCrop, read_image, width_fit
from src.data.jpeg import HOLE_BYTES, MAX_SCANS, REDUCTIONS, damage_of, decode_fast, decoder_name
from src.errors import DataError

SOURCE_PX = (187, 330)


@pytest.fixture
def simplejpeg():
    return pytest.importorskip("simplejpeg", reason="the extra `fast` is not installed")


@pytest.fixture(autouse=True)
def fresh_choice():
    """The decoder is chosen once per process; here once per test."""
    jpeg._checked_decoder.cache_clear()
    yield
    jpeg._checked_decoder.cache_clear()


def picture(height=SOURCE_PX[0], width=SOURCE_PX[1], mode="RGB"):
    """Edges and noise, so that every step of decoding shows."""
    values = np.random.default_rng(0).integers(0, 90, (height, width, 3))
    values[height // 3 :, width // 4 :] += 150
    return Image.fromarray(values.astype(np.uint8)).convert(mode)


def saved(folder, image, **options):
    image.save(folder / "a.jpg", "JPEG", **({"quality": 80} | options))
    return folder / "a.jpg"


@pytest.mark.slow
@pytest.mark.parametrize("size", [SOURCE_PX, (16, 16), (17, 31), (943, 1980)])
@pytest.mark.parametrize("options", [{}, {"subsampling": "4:4:4"}, {"subsampling": "4:2:2"}, {"progressive": True}])
def test_pixels_are_pillows(simplejpeg, tmp_path, size, options):
    path = saved(tmp_path, picture(*size), **options)
    for reduction in REDUCTIONS:
        fast, slow = decode_fast(path.read_bytes(), size, reduction), images.decode(path, size, reduction, fast=False)
        assert fast.size == slow.size == tuple(-(-side // reduction) for side in size[::-1])
        assert fast.tobytes() == slow.tobytes()


@pytest.mark.parametrize("size_px", [(30, 60), (64, 160), (200, 400)])
def test_what_is_read_does_not_tell_the_decoder(simplejpeg, tmp_path, monkeypatch, size_px):
    path = saved(tmp_path, picture())
    changes = ((), (0.02, 0.3), (-0.03, 0.7, True, 0.09))  # offset, shift, flip, rotation
    crops = [width_fit(SOURCE_PX, size_px, *change) for change in changes]
    assert decoder_name().startswith("simplejpeg")
    fast = [read_image(path, SOURCE_PX, crop) for crop in crops]
    monkeypatch.setattr(jpeg, "_checked_decoder", lambda: None)
    assert decoder_name().startswith("Pillow")
    for crop, found in zip(crops, fast, strict=True):
        np.testing.assert_array_equal(found, read_image(path, SOURCE_PX, crop))


def test_what_pillow_must_judge_is_left_to_it(simplejpeg, tmp_path):
    assert decode_fast(b"", SOURCE_PX, 1) is None
    for image in (picture(mode="L"), picture(mode="CMYK"), picture(100, 200), picture(8, 9)):
        stated = SOURCE_PX if image.size == (200, 100) else image.size[::-1]
        assert decode_fast(saved(tmp_path, image).read_bytes(), stated, 1) is None
    path = saved(tmp_path, picture())
    path.write_bytes(path.read_bytes()[:-700])
    assert decode_fast(path.read_bytes(), SOURCE_PX, 1) is None
    assert decode_fast(saved(tmp_path, picture()).read_bytes(), SOURCE_PX, 2) is not None


def test_a_decoder_with_other_pixels_is_refused_aloud(tmp_path, monkeypatch, caplog):
    def decode_jpeg(content, colours, **scale):
        pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGBX"))
        return np.ascontiguousarray(pixels[:: scale["min_factor"], :: scale["min_factor"]])

    def decode_jpeg_header(content):
        return *Image.open(io.BytesIO(content)).size[::-1], "YCbCr", "420"

    other = types.ModuleType("simplejpeg")
    other.__version__, other.decode_jpeg, other.decode_jpeg_header = "0", decode_jpeg, decode_jpeg_header
    monkeypatch.setitem(__import__("sys").modules, "simplejpeg", other)
    path = saved(tmp_path, picture())
    assert decode_fast(path.read_bytes(), SOURCE_PX, 1) is None and decoder_name().startswith("Pillow")
    assert caplog.text.count("other pixels than Pillow: not used") == 1
    crop = ImageCrop(1.0, (0, 0), SOURCE_PX)
    np.testing.assert_array_equal(read_image(path, SOURCE_PX, crop), np.asarray(Image.open(path)).transpose(2, 0, 1))


def test_without_the_extra_pillow_decodes(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(__import__("sys").modules, "simplejpeg", None)
    path = saved(tmp_path, picture())
    assert decode_fast(path.read_bytes(), SOURCE_PX, 1) is None and not caplog.text
    assert images.decode(path, SOURCE_PX, 2).size == (165, 94)


def hole_in(content, size, at=0.5):
    start = int(len(content) * at)
    return content[:start] + bytes(size) + content[start + size :]


@pytest.mark.parametrize("options", [{}, {"subsampling": "4:4:4"}, {"restart_marker_rows": 4}])
@pytest.mark.parametrize("pillow_alone", [False, True])
def test_a_block_of_zeros_that_decodes_without_an_error_is_refused(tmp_path, monkeypatch, options, pillow_alone):
    if pillow_alone:
        monkeypatch.setattr(jpeg, "_checked_decoder", lambda: None)
    path = saved(tmp_path, picture(), **options)
    path.write_bytes(hole_in(path.read_bytes(), 600))
    with Image.open(path) as image:
        image.load()  # Pillow finds nothing wrong with it
    with pytest.raises(DataError, match=f"a.jpg: not a readable image .{HOLE_BYTES} bytes from byte .* are zero"):
        read_image(path, SOURCE_PX, width_fit(SOURCE_PX, (64, 160)))


@pytest.mark.parametrize("mode", ["RGB", "L"])
@pytest.mark.parametrize("options", [{}, {"optimize": True}, {"progressive": True}])
@pytest.mark.parametrize("colour", [0, 60, 255])
def test_an_image_of_one_colour_is_no_damage(tmp_path, mode, options, colour):
    """With tables of its own it is nothing but zeros."""
    image = Image.new("RGB", (1600, 1200), (colour,) * 3).convert(mode)
    path = saved(tmp_path, image, **options)
    assert damage_of(path.read_bytes()) is None
    assert images.decode(path, (1200, 1600), 8).getpixel((9, 9)) == (colour,) * 3
    if options.get("optimize") and mode == "L":
        assert bytes(HOLE_BYTES) in path.read_bytes()


def test_zeros_beside_the_image_are_no_damage(tmp_path):
    """Room that cameras leave in their notes, a thumbnail with padding behind it, a sector filled up."""
    content = saved(tmp_path, picture()).read_bytes()
    thumbnail = saved(tmp_path, picture(40, 60)).read_bytes()
    notes = b"Exif\0\0" + thumbnail + bytes(2000)
    noted = content[:2] + b"\xff\xe1" + (len(notes) + 2).to_bytes(2, "big") + notes + content[2:] + bytes(4096)
    assert damage_of(noted) is None and damage_of(hole_in(noted, 600, at=0.75)) is not None
    (tmp_path / "a.jpg").write_bytes(noted)
    assert images.decode(tmp_path / "a.jpg", SOURCE_PX, 1).size == SOURCE_PX[::-1]


def test_a_file_of_a_million_scans_is_refused_at_once(tmp_path, monkeypatch):
    path = saved(tmp_path, picture(), progressive=True)
    content = path.read_bytes()
    assert 5 < content.count(b"\xff\xda") < 20
    start, end = content.rindex(b"\xff\xda"), len(content) - 2
    path.write_bytes(content[:start] + content[start:end] * (MAX_SCANS + 1) + content[end:])
    decoder_name()  # which compares decoders
    monkeypatch.setattr(Image.Image, "load", lambda *_: pytest.fail("decoded"))
    with pytest.raises(DataError, match=f"at most {MAX_SCANS} scans"):
        read_image(path, SOURCE_PX, width_fit(SOURCE_PX, (64, 160)))


def test_what_is_no_jpeg_file_has_no_damage_to_be_found():
    for content in (
        b"",
        b"\xff",
        b"text",
        b"\xff\xd8",
        b"\xff\xd8" + b"\xff" * 600,
        b"\xff\xd8\xff\xc4\0\0",
        bytes(9000),
    ):
        assert damage_of(content) is None


def test_images_of_a_real_camera_are_sound():
    folder = Path(__file__).resolve().parents[3] / "shared/real/horizon3d_page/front_cameras"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    paths = list(folder.glob("*.jpg"))
    assert paths and all(damage_of(path.read_bytes()) is None for path in paths)
