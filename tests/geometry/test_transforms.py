import numpy as np
import pytest

from src.geometry.transforms import (
    invert_rigid,
    matrix_to_quaternion,
    pose_matrix,
    quaternion_to_matrix,
    rotation_vector,
    yaw_of,
)


def random_quaternions(n):
    q = np.random.default_rng(0).normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def test_quaternion_of_a_quarter_turn():
    turn = quaternion_to_matrix(np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))
    np.testing.assert_allclose(turn @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    assert yaw_of(turn) == pytest.approx(np.pi / 2)


def test_matrices_are_rotations_and_come_back():
    q = random_quaternions(200)
    q[:4] = np.eye(4)  # no turn and the three half turns
    matrices = quaternion_to_matrix(q)
    np.testing.assert_allclose(matrices @ np.swapaxes(matrices, 1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(matrices), 1, atol=1e-14)
    back = matrix_to_quaternion(matrices)
    np.testing.assert_allclose(np.abs((back * q).sum(1)), 1, atol=1e-14)  # q and -q are the same rotation


def test_pyquaternion_agrees():
    pyquaternion = pytest.importorskip("pyquaternion", reason="comes with the devkit")
    for q in random_quaternions(20):
        np.testing.assert_allclose(quaternion_to_matrix(q), pyquaternion.Quaternion(q).rotation_matrix, atol=1e-14)


def test_rotation_vector_is_axis_times_angle():
    axis = np.array([2.0, -1.0, 2.0]) / 3
    for angle in (0.0, 1e-9, 0.02, 1.5, 3.1):
        q = np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * axis])
        np.testing.assert_allclose(rotation_vector(quaternion_to_matrix(q)), angle * axis, atol=1e-12)


def test_inverse_keeps_precision_at_utm_size():
    pose = pose_matrix(random_quaternions(3), np.array([691000.0, 5334000.0, 0.0]) + np.arange(9).reshape(3, 3))
    point = np.array([12.345678, -3.2, 1.0, 1.0])
    back = invert_rigid(pose) @ (pose @ point)[..., None]
    np.testing.assert_allclose(back[..., 0], np.tile(point, (3, 1)), atol=1e-8)


def test_quaternions_turn_vectors_as_their_matrices_do():
    rng = np.random.default_rng(0)
    turns, _ = np.linalg.qr(rng.standard_normal((50, 3, 3)))
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    turns = np.concatenate([turns, [np.eye(3), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1]), np.diag([-1.0, 1, -1])]])
    for (w, *axis), turn in zip(matrix_to_quaternion(turns), turns, strict=True):
        vector = rng.standard_normal(3)
        cross = np.cross(axis, vector)
        np.testing.assert_allclose(vector + 2 * w * cross + 2 * np.cross(axis, cross), turn @ vector, atol=1e-9)
        assert w >= 0
