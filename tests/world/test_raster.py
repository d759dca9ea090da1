"""The z-buffer on cases that can be counted by hand."""

import numpy as np

from src.world.raster import draw_quads

INTRINSIC = np.array([[10.0, 0.0, 8.0], [0.0, 10.0, 6.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 16, 12


def facing(x0, x1, y0, y1, z):
    """A quad across the view at depth z whose outside faces the camera."""
    return [[x0, y0, z], [x0, y1, z], [x1, y1, z], [x1, y0, z]]


def draw(quads, two_sided=False, groups=None):
    n = len(quads)
    groups = np.arange(n) if groups is None else np.array(groups)
    return draw_quads(
        np.array(quads, dtype=float).reshape(n, 4, 3),
        np.full(n, two_sided),
        np.ones(n),
        groups,
        max(int(groups.max(initial=-1)) + 1, 1),
        INTRINSIC,
        WIDTH,
        HEIGHT,
    )


def test_a_square_fills_its_pixels_at_its_depth():
    drawn = draw([facing(-2, 2, -1, 1, 10.0)])  # 4 x 2 pixels around the middle
    shown = drawn.quad.reshape(HEIGHT, WIDTH) == 0
    assert shown.sum() == 8 and shown[5:7, 6:10].all()
    np.testing.assert_allclose(drawn.depth_m.reshape(HEIGHT, WIDTH)[shown], 10.0, rtol=1e-5)
    assert np.isinf(drawn.depth_m.reshape(HEIGHT, WIDTH)[~shown]).all()


def test_the_nearer_quad_wins_in_either_order():
    near, far = facing(-1, 1, -1, 1, 5.0), facing(-4, 4, -3, 3, 10.0)  # 4 x 4 and 8 x 6 pixels
    for quads, order in (([near, far], (0, 1)), ([far, near], (1, 0))):
        drawn = draw(quads)
        assert drawn.seen_pixels[order[0]] == drawn.own_pixels[order[0]] == 16
        assert drawn.own_pixels[order[1]] == 48
        assert drawn.seen_pixels[order[1]] == 32


def test_depth_is_that_of_the_plane_on_a_slanted_quad():
    drawn = draw([[[-4, -1, 8], [-4, 1, 8], [4, 1, 16], [4, -1, 16]]])  # z = 12 + x
    depth = drawn.depth_m.reshape(HEIGHT, WIDTH)[6]
    for column in np.flatnonzero(np.isfinite(depth)):
        slope = (column + 0.5 - 8) / 10
        np.testing.assert_allclose(depth[column], 12 / (1 - slope), rtol=1e-4)


def test_backs_are_hidden_unless_the_quad_is_open():
    back = facing(-2, 2, -1, 1, 10.0)[::-1]
    assert (draw([back]).quad < 0).all()
    assert (draw([back], two_sided=True).quad == 0).sum() == 8


def test_what_lies_behind_the_camera_is_not_drawn_and_what_crosses_is_cut():
    assert (draw([facing(-2, 2, -1, 1, -10.0)], two_sided=True).quad < 0).all()
    floor = [[-50, 1, -20], [-50, 1, 50], [50, 1, 50], [50, 1, -20]]  # one metre below the camera
    shown = draw([floor], two_sided=True).quad.reshape(HEIGHT, WIDTH) == 0
    assert not shown[:6].any() and shown[7:].all()


def test_two_quads_of_one_object_count_each_pixel_once():
    drawn = draw([facing(-2, 2, -1, 1, 10.0), facing(-2, 2, -1, 1, 11.0)], groups=[0, 0])
    assert drawn.own_pixels[0] == 8 and drawn.seen_pixels[0] == 8


def test_an_empty_scene_is_all_background():
    drawn = draw(np.zeros((0, 4, 3)), groups=np.zeros(0, dtype=int))
    assert (drawn.quad == -1).all() and drawn.own_pixels.tolist() == [0]
