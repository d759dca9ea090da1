import numpy as np
import pytest

from src.geometry.camera import image_transform, pixels_from_points
from tests.data.tiny_set import project

INTRINSICS = np.array([[1000.0, 0, 320], [0, 900.0, 240], [0, 0, 1]])


def test_projection_by_hand():
    cam_from_ego = np.array([[0.0, -1, 0, 0], [0, 0, -1, 2], [1, 0, 0, 0], [0, 0, 0, 1]])  # 2 m above the road
    pixels, depth = project(np.array([[10.0, 1.0, 1.0], [-5.0, 0, 0]]), pixels_from_points(INTRINSICS, cam_from_ego))
    np.testing.assert_allclose(pixels[0], [320 - 100, 240 + 90])  # left of and below the centre
    np.testing.assert_allclose(depth, [10, -5])


def test_projection_can_be_inverted():
    rng = np.random.default_rng(0)
    cam_from_src = np.eye(4)
    cam_from_src[:3, 3] = rng.normal(size=3)
    matrix = pixels_from_points(INTRINSICS, cam_from_src, image_transform(0.4, (3, 10), (60, 80), True, 0.1))
    point = np.array([1.0, 2.0, 20.0])
    (u, v), d = project(point, matrix)
    np.testing.assert_allclose(np.linalg.inv(matrix) @ [u * d, v * d, d, 1], [*point, 1], atol=1e-9)


@pytest.mark.parametrize("flip, expected", [(False, [10, 30]), (True, [70, 30])])
def test_image_transform_by_hand(flip, expected):
    matrix = image_transform(0.5, (40, 20), (60, 80), flip)
    np.testing.assert_allclose(matrix @ [100, 100, 1], [*expected, 1])


def test_rotation_turns_about_the_crop_centre_from_x_to_y():
    matrix = image_transform(1.0, (0, 0), (60, 80), rotation_rad=np.pi / 2)
    np.testing.assert_allclose(matrix @ [40, 30, 1], [40, 30, 1], atol=1e-12)
    np.testing.assert_allclose(matrix @ [50, 30, 1], [40, 40, 1], atol=1e-12)  # right becomes down
