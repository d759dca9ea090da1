"""Rotations and rigid transforms in float64 numpy: `dst_from_src`, quaternions as (w, x, y, z); for torch see
`tensor_transforms`.

Global coordinates are UTM metres near 5e6, where float32 steps are 0.5 m (method 1.1): compose here, cast the
ego-relative result.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def quaternion_to_matrix(
    quaternion: Array,  # [..., 4] (w, x, y, z); normalised here
) -> Array:  # [..., 3, 3] float64
    """Rotation matrix of each quaternion."""
    q = np.asarray(quaternion, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def rotation_zyx(
    yaw: Array | float,  # [...] rad
    pitch: Array | float,
    roll: Array | float,
) -> Array:  # [..., 3, 3]
    """Rz(yaw) Ry(pitch) Rx(roll); a positive pitch lowers the nose."""
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def matrix_to_quaternion(
    matrix: Array,  # [..., 3, 3] rotation
) -> Array:  # [..., 4] (w, x, y, z), w >= 0
    """Unit quaternion of each rotation; the largest component is taken from the diagonal, so half turns are exact."""
    m = np.asarray(matrix, np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # Row i holds 4 q_i q; the row of the largest component is the well conditioned one.
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    d, e, f = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0], m[..., 2, 1] + m[..., 1, 2]
    rows = np.stack(
        [
            np.stack([1 + xx + yy + zz, a, b, c], axis=-1),
            np.stack([a, 1 + xx - yy - zz, d, e], axis=-1),
            np.stack([b, d, 1 - xx + yy - zz, f], axis=-1),
            np.stack([c, e, f, 1 - xx - yy + zz], axis=-1),
        ],
        axis=-2,
    )  # [..., 4, 4]
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def rotation_vector(
    matrix: Array,  # [..., 3, 3] rotation by less than half a turn
) -> Array:  # [..., 3] axis times angle, rad
    """Logarithm of each rotation; divided by the elapsed time it is a rate of rotation."""
    q = matrix_to_quaternion(matrix)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[..., :1])
    # angle / sine tends to 2 as the rotation vanishes.
    return q[..., 1:] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def rigid(
    rotation: Array,  # [..., 3, 3]
    translation: Array,  # [..., 3] m
) -> Array:  # [..., 4, 4] float64
    """Homogeneous transform of a rotation and a translation."""
    rotation, translation = np.asarray(rotation, np.float64), np.asarray(translation, np.float64)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    matrix = np.zeros((*shape, 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def pose_matrix(
    quaternion: Array,  # [..., 4] (w, x, y, z)
    translation: Array,  # [..., 3] m
) -> Array:  # [..., 4, 4] float64
    """Homogeneous transform of a table's rotation and translation."""
    return rigid(quaternion_to_matrix(quaternion), translation)


def invert_rigid(
    dst_from_src: Array,  # [..., 4, 4] rotation and translation
) -> Array:  # [..., 4, 4] src_from_dst
    """Inverse of rigid transforms, without a general solve."""
    rotation = np.swapaxes(dst_from_src[..., :3, :3], -1, -2)
    return rigid(rotation, -(rotation @ dst_from_src[..., :3, 3:])[..., 0])


def yaw_of(
    rotation: Array,  # [..., 3, 3]
) -> Array:  # [...] rad
    """Heading of the rotated x axis, counter-clockwise from +x in the xy plane."""
    return np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0])
