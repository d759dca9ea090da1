"""The faster decoder: Pillow's pixels to the last bit, or Pillow itself."""

import io
import types

import numpy as np
import pytest
from PIL import Image

from src.data import images, jpeg
from src.data.images import ImageCrop, decode_by_pillow, read_image, width_fit
from src.data.jpeg import REDUCTIONS, decode_fast, decoder_name

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


@pytest.mark.parametrize("size", [SOURCE_PX, (16, 16), (17, 31), (943, 1980)])
@pytest.mark.parametrize("options", [{}, {"subsampling": "4:4:4"}, {"subsampling": "4:2:2"}, {"progressive": True}])
def test_pixels_are_pillows(simplejpeg, tmp_path, size, options):
    path = saved(tmp_path, picture(*size), **options)
    for reduction in REDUCTIONS:
        fast, slow = decode_fast(path, size, reduction), decode_by_pillow(path, size, reduction)
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
    assert decode_fast(tmp_path / "none.jpg", SOURCE_PX, 1) is None
    for image in (picture(mode="L"), picture(mode="CMYK"), picture(100, 200), picture(8, 9)):
        stated = SOURCE_PX if image.size == (200, 100) else image.size[::-1]
        assert decode_fast(saved(tmp_path, image), stated, 1) is None
    path = saved(tmp_path, picture())
    path.write_bytes(path.read_bytes()[:-700])
    assert decode_fast(path, SOURCE_PX, 1) is None
    assert decode_fast(saved(tmp_path, picture()), SOURCE_PX, 2) is not None


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
    assert decode_fast(path, SOURCE_PX, 1) is None and decoder_name().startswith("Pillow")
    assert caplog.text.count("other pixels than Pillow: not used") == 1
    crop = ImageCrop(1.0, (0, 0), SOURCE_PX)
    np.testing.assert_array_equal(read_image(path, SOURCE_PX, crop), np.asarray(Image.open(path)).transpose(2, 0, 1))


def test_without_the_extra_pillow_decodes(tmp_path, monkeypatch, caplog):
    monkeypatch.setitem(__import__("sys").modules, "simplejpeg", None)
    path = saved(tmp_path, picture())
    assert decode_fast(path, SOURCE_PX, 1) is None and not caplog.text
    assert images.decode(path, SOURCE_PX, 2).size == (165, 94)
