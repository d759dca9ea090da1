import math

import torch
import torch.nn.functional as F

from src.geometry.tensor_transforms import (
    invert_projection,
    invert_rigid,
    pixel_centres,
    rotate,
    rotate_back,
    transform_points,
    transform_points_xy,
    transform_vectors,
    transform_vectors_xy,
    unit_vectors,
)
from tests.models.moving import UTM, bda, pose


def test_inverse_of_poses_far_from_the_origin():
    matrix = torch.stack([pose(3.0, -2.0, 0.7, UTM, 0.1), pose(0.0, 0.0, -3.0, UTM)])
    eye = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    torch.testing.assert_close(invert_rigid(matrix) @ matrix, eye, rtol=0, atol=1e-8)


def test_a_heading_to_the_left_by_hand():
    """Facing +y: 2 m ahead and 1 m to the left is 1 m behind the origin's side and 2 m up the y axis."""
    ahead, left = torch.tensor(2.0), torch.tensor(1.0)
    cosine, sine = torch.tensor(0.0), torch.tensor(1.0)
    assert [float(v) for v in rotate(cosine, sine, ahead, left)] == [-1.0, 2.0]
    assert [float(v) for v in rotate_back(cosine, sine, torch.tensor(-1.0), torch.tensor(2.0))] == [2.0, 1.0]


def test_points_and_vectors_of_the_plane_equal_the_homogeneous_product():
    matrix = torch.stack([bda(0.3, 1.05, flip_y=True), bda(-2.0, 0.95)]).double()
    matrix[:, :2, 3] = torch.tensor([[5.0, -1.0], [0.5, 2.0]])
    xy = torch.randn(2, 2, dtype=torch.float64)
    homogeneous = torch.cat([xy, torch.tensor([[0.0, 1.0]] * 2)], 1)[..., None]
    torch.testing.assert_close(transform_points_xy(matrix, xy), (matrix @ homogeneous)[:, :2, 0])
    homogeneous[:, 3] = 0.0
    torch.testing.assert_close(transform_vectors_xy(matrix, xy), (matrix @ homogeneous)[:, :2, 0])


def test_pixel_centres_of_a_level():
    centres = pixel_centres((32, 48), (4, 3), torch.device("cpu"))
    assert centres.shape == (4, 3, 3)
    assert centres[2, 1].tolist() == [24.0, 20.0, 1.0]


def test_projections_are_inverted_and_missing_cameras_may_be_singular():
    turn = math.radians(20)
    matrix = torch.eye(4).repeat(1, 2, 1, 1)
    matrix[0, 0, :2, :2] = 600 * torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    matrix[0, 0, :3, 3] = torch.tensor([1.0, 2.0, 3.0])
    matrix[0, 1] = 0.0
    inverse = invert_projection(matrix, torch.tensor([[True, False]]))
    torch.testing.assert_close(inverse[0, 0] @ matrix[0, 0], torch.eye(4), rtol=0, atol=1e-5)
    assert torch.equal(inverse[0, 1], torch.eye(4))


def test_points_and_vectors_of_space_equal_the_homogeneous_product():
    matrix = torch.stack([pose(3.0, -2.0, 0.7, pitch=0.1), pose(-1.0, 5.0, -2.0)])
    points = torch.randn(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for last, transform in ((1.0, transform_points), (0.0, transform_vectors)):
        full = torch.cat([points, torch.full((2, 1), last, dtype=torch.float64)], 1)
        torch.testing.assert_close(transform(matrix, points), (matrix @ full[..., None])[:, :3, 0])


def test_unit_vectors_and_their_gradient():
    vectors = torch.tensor([[3.0, 4.0], [1e-3, 0.0], [0.0, 0.0], [-2.0, 0.5]], dtype=torch.float64, requires_grad=True)
    pull = torch.tensor([[0.3, -1.0], [2.0, 1.0], [1.0, 1.0], [0.0, 4.0]], dtype=torch.float64)
    found, wanted = unit_vectors(vectors, 0.01), F.normalize(vectors, dim=-1, eps=0.01)
    torch.testing.assert_close(found, wanted)
    gradients = [torch.autograd.grad(x, vectors, pull)[0] for x in (found, wanted)]
    torch.testing.assert_close(*gradients)
