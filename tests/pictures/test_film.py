"""Frames into an animation and a strip: order, speed, sizes, bounds."""

import numpy as np
from PIL import Image

from src.pictures.film import MAX_FRAMES, WIDTH_PX, Film


def picture(level, height=40):
    """Draws a grey sheet of the given level and height."""
    return Image.new("RGB", (1920, height), (level,) * 3).save


def levels(image, count):
    columns = np.asarray(image.convert("RGB"))[2, :, 0]
    return columns.reshape(count, -1).mean(axis=1).round().tolist()


def test_an_animation_keeps_order_and_time(tmp_path):
    film = Film()
    for level, time_s in ((10, 5.0), (90, 5.5), (200, 6.0), (250, 99.0)):
        film.add(picture(level), time_s)
    film.write_animation(tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as animation:
        assert animation.size == (WIDTH_PX, 20) and animation.n_frames == 4 and animation.info["loop"] == 0
        for number, (level, duration) in enumerate(((10, 500), (90, 500), (200, 2000), (250, 2000))):
            animation.seek(number)
            assert levels(animation, 1) == [level] and animation.info["duration"] == duration


def test_a_strip_spreads_over_the_film(tmp_path):
    film = Film()
    for level in range(0, 250, 50):
        film.add(picture(level), float(level))
    for count, expected in ((3, [0, 100, 200]), (1, [0]), (9, [0, 50, 100, 150, 200])):
        film.write_strip(tmp_path / "strip.png", count)
        with Image.open(tmp_path / "strip.png") as strip:
            assert levels(strip, len(expected)) == expected
    assert {path.name for path in tmp_path.iterdir()} == {"strip.png"}


def test_one_frame_and_frames_of_another_height(tmp_path):
    film = Film()
    film.add(picture(30), 0.0)
    film.write_animation(tmp_path / "film.gif")
    film.add(picture(60, height=80), 0.5)
    film.write_strip(tmp_path / "strip.png", 2)
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.size == (2 * WIDTH_PX, 20) and levels(strip, 2) == [30, 60]


def test_a_long_scene_is_cut():
    film, drawn = Film(), []

    def draw(path):
        drawn.append(path)
        picture(0)(path)

    for number in range(MAX_FRAMES + 5):
        film.add(draw, 0.5 * number)
    assert len(film) == len(drawn) == MAX_FRAMES and film.full
    assert not any(path.exists() for path in drawn)
