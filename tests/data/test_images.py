import io

import numpy as np
import pytest
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from src.data import jpeg as jpeg_module
from src.data.images import ImageCrop, read_image, width_fit
from src.errors import ConfigError, DataError

SIZE = (60, 120)  # network input, height and width


@pytest.fixture(params=[True, False], ids=["best decoder", "Pillow"])
def decoders(request, monkeypatch):
    """The decoder at hand, and Pillow alone."""
    if not request.param:
        monkeypatch.setattr(jpeg_module, "_checked_decoder", lambda: None)


def save(path, image, **options):
    image.save(path, quality=95, **options)
    return path


def noise(height, width, mode="RGB"):
    """Smooth content, so that resampling can be compared."""
    y, x = np.mgrid[:height, :width]
    image = 127 + 60 * np.sin(x / 19) + 60 * np.cos(y / 11)
    return Image.fromarray(image.astype(np.uint8)).convert(mode)


def test_paper_geometry():
    crop = width_fit((943, 1980), (256, 864))
    assert crop.resize == pytest.approx(0.4364, abs=1e-4) and crop.offset_px == (0, 155)
    padded = width_fit((943, 1980), (640, 960))
    assert padded.offset_px == (0, -183)  # black rows on top


def test_an_offset_that_leaves_no_scale_is_refused_rather_than_drawn_black():
    with pytest.raises(ConfigError, match=r"-0\.45 to the scale 0\.436364.*must be positive"):
        width_fit((943, 1980), (256, 864), resize_offset=-0.45)


@pytest.mark.parametrize("source", [(100, 240), (101, 243), (400, 960), (1001, 2003)])
def test_pixels_lie_where_the_matrix_says(tmp_path, source):
    """A soft spot is found where M maps it, at any decoding scale."""
    v, u = 0.7 * source[0], 0.3 * source[1]
    y, x = np.mgrid[: source[0], : source[1]] + 0.5
    spread = source[1] / 30
    spot = Image.fromarray((255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * spread**2))).astype(np.uint8))
    path = save(tmp_path / "a.jpg", spot)
    changes = ((), (0.05, 0.3), (-0.03, 0, True, 0.09))  # offset, shift, flip, rotation
    for crop in (width_fit(source, SIZE, *change) for change in changes):
        image = read_image(path, source, crop)[0].astype(float)
        image[image < 60] = 0
        rows, cols = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
        found = np.array([(image * cols).sum(), (image * rows).sum()]) / image.sum()
        np.testing.assert_allclose(found, (crop.matrix() @ [u, v, 1])[:2], atol=0.15)


def test_padding_is_black_and_content_is_whole(tmp_path):
    path = save(tmp_path / "a.jpg", Image.new("RGB", (240, 80), (200, 100, 50)))
    image = read_image(path, (80, 240), width_fit((80, 240), (60, 120)))
    assert image.dtype == np.uint8 and image.shape == (3, 60, 120)
    assert (image[:, :20] == 0).all() and (np.abs(image[:, 20:].mean((1, 2)) - [200, 100, 50]) < 3).all()
    small = read_image(path, (80, 240), width_fit((80, 240), (60, 120), -0.1))  # narrower than the input
    assert (small[:, :, 97:] == 0).all() and (small[0, 40:, :95] > 150).all()


@pytest.mark.parametrize("mode", ["L", "CMYK"])
def test_other_colour_spaces_become_rgb(tmp_path, mode):
    rgb = read_image(save(tmp_path / "rgb.jpg", noise(100, 240)), (100, 240), width_fit((100, 240), SIZE))
    other = read_image(save(tmp_path / "x.jpg", noise(100, 240, mode)), (100, 240), width_fit((100, 240), SIZE))
    assert np.abs(rgb.astype(int) - other).mean() < 3


def jpeg(height, width):
    buffer = io.BytesIO()
    noise(height, width).save(buffer, "JPEG")
    return buffer.getvalue()


@pytest.mark.parametrize(
    "content, words",
    [
        (b"", "not a readable image"),
        (b"just text", "not a readable image"),
        (jpeg(100, 240)[:-700], "truncated"),
        (jpeg(100, 200), "the tables say 240 x 100 pixels, the file has 200 x 100"),
    ],
    ids=["empty", "text", "truncated", "size"],
)
def test_bad_files(decoders, tmp_path, content, words):
    path = tmp_path / "bad.jpg"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words) as error:
        read_image(path, (100, 240), width_fit((100, 240), SIZE))
    assert str(path) in str(error.value)


def test_other_formats_are_refused(tmp_path):
    noise(100, 240).save(tmp_path / "a.jpg", "PNG")
    with pytest.raises(DataError, match="not a readable image"):
        read_image(tmp_path / "a.jpg", (100, 240), width_fit((100, 240), SIZE))


@pytest.mark.parametrize("side", [9_000, 20_000])  # 81 and 400 million pixels
def test_bombs_are_refused_before_decoding(tmp_path, side, monkeypatch):
    content = bytearray(jpeg(16, 16))
    at = content.index(b"\xff\xc0") + 5
    content[at : at + 4] = side.to_bytes(2, "big") * 2
    path = tmp_path / "bomb.jpg"
    path.write_bytes(bytes(content))
    monkeypatch.setattr(JpegImageFile, "load", lambda *_: pytest.fail("decoded"))
    for stated in ((100, 240), (side, side)):
        with pytest.raises(DataError, match="bomb.jpg"):
            read_image(path, stated, width_fit(stated, SIZE))


def straightforward(path, source_px, crop):
    """Step after step on the whole canvas, each with a copy."""
    image = Image.open(path)
    image.draft("RGB", [int(np.ceil(side * crop.resize)) for side in source_px[::-1]])
    image = image.convert("RGB")
    reduction = round(source_px[1] / image.width)
    (height, width), (left, top) = crop.size_px, crop.offset_px
    x0, y0 = max(0, -left), max(0, -top)
    x1 = min(width, int(np.floor(crop.resize * source_px[1] - left + 1e-6)))
    y1 = min(height, int(np.floor(crop.resize * source_px[0] - top + 1e-6)))
    canvas = Image.new("RGB", (width, height))
    if x1 > x0 and y1 > y0:
        corners = np.array([x0 + left, y0 + top, x1 + left, y1 + top]) / crop.resize
        box = np.clip(corners, 0, [*source_px[::-1], *source_px[::-1]]) / reduction
        canvas.paste(image.resize((x1 - x0, y1 - y0), Image.Resampling.BILINEAR, box=box.tolist()), (x0, y0))
    if crop.flip:
        canvas = canvas.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    if crop.rotation_rad:
        canvas = canvas.rotate(-np.degrees(crop.rotation_rad), Image.Resampling.BILINEAR)
    return np.asarray(canvas).transpose(2, 0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("source", [(114, 240), (228, 480), (301, 633), (943, 1980)])
def test_pixels_are_those_of_the_straightforward_way(decoders, tmp_path, source):
    """To the last bit: padded above and beside, cropped, mirrored, turned, and all of it outside."""
    values = np.random.default_rng(1).integers(0, 255, (*source, 3)).astype(np.uint8)
    path = save(tmp_path / "a.jpg", Image.fromarray(values))
    crops = [
        width_fit(source, size_px, *change)
        for size_px in ((96, 320), (64, 160), (150, 160))
        for change in ((), (0.11, 0.3), (-0.06, 0.8, True), (0.02, 0.5, False, 0.09), (-0.05, 0.5, True, -0.05))
    ]
    for crop in (*crops, ImageCrop(0.5, (5000, 0), SIZE)):
        np.testing.assert_array_equal(read_image(path, source, crop), straightforward(path, source, crop))


def test_missing_file(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_image(tmp_path / "a.jpg", (100, 240), width_fit((100, 240), SIZE))
