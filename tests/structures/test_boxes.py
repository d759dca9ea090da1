import math

import pytest
import torch

from src.structures.boxes import Boxes3D


def boxes(count=4, **changes):
    generator = torch.Generator().manual_seed(0)
    values = {
        "centers": torch.randn(count, 3, generator=generator) * 20,
        "sizes": torch.rand(count, 3, generator=generator) * 4 + 0.5,
        "yaws": torch.rand(count, generator=generator) * 6 - 3,
        "velocities": torch.randn(count, 2, generator=generator) * 10,
        "labels": torch.arange(count),
        "attributes": torch.full((count,), -1),
        "num_points": torch.arange(count),
    }
    return Boxes3D(**(values | changes))


def corners(of):
    """[K, 8, 3] corners in an order that a reflection permutes."""
    signs = torch.tensor([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    local = signs * of.sizes[:, None]
    c, s = of.yaws.cos()[:, None], of.yaws.sin()[:, None]
    x, y, z = local.unbind(-1)
    turned = torch.stack([c * x - s * y, s * x + c * y, z], -1)
    return turned + of.centers[:, None]


def augmentation(flip_x, flip_y, angle, scale):
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    mirror = torch.diag(torch.tensor([-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0, 1.0]))
    matrix = torch.eye(4)
    matrix[:3, :3] = scale * rotation @ mirror
    return matrix


@pytest.mark.parametrize("flip_x", [False, True])
@pytest.mark.parametrize("flip_y", [False, True])
@pytest.mark.parametrize("angle, scale", [(0.0, 1.0), (0.39, 1.05), (-2.0, 0.95)])
def test_transformed_boxes_fill_the_transformed_space(flip_x, flip_y, angle, scale):
    """Corners, heading and velocity by their own points: a second before and after, the box's nose."""
    before, matrix = boxes(), augmentation(flip_x, flip_y, angle, scale)
    matrix[:3, 3] = torch.tensor([3.0, -7.0, 0.5])
    after = before.transform(matrix)
    expected = corners(before) @ matrix[:3, :3].T + matrix[:3, 3]
    distance = torch.cdist(corners(after), expected)
    assert distance.min(dim=2).values.max() < 1e-4 and distance.min(dim=1).values.max() < 1e-4
    nose = torch.stack([before.yaws.cos(), before.yaws.sin(), torch.zeros(4)], 1)
    turned = nose @ matrix[:3, :3].T / scale
    torch.testing.assert_close(torch.stack([after.yaws.cos(), after.yaws.sin()], 1), turned[:, :2])
    ahead = before.centers + torch.cat([before.velocities, torch.zeros(4, 1)], 1)
    moved = ahead @ matrix[:3, :3].T + matrix[:3, 3] - after.centers
    torch.testing.assert_close(after.velocities, moved[:, :2], atol=1e-4, rtol=1e-4)
    assert torch.equal(after.labels, before.labels) and torch.equal(after.num_points, before.num_points)


def test_flips_by_hand():
    """method 9: flip y gives -yaw, flip x gives pi - yaw."""
    before = boxes()
    down = before.transform(augmentation(False, True, 0.0, 1.0))
    torch.testing.assert_close(down.yaws, -before.yaws)
    across = before.transform(augmentation(True, False, 0.0, 1.0))
    torch.testing.assert_close(across.yaws.cos(), (math.pi - before.yaws).cos())
    torch.testing.assert_close(across.yaws.sin(), (math.pi - before.yaws).sin())


def test_transform_back_gives_the_same_boxes():
    before, matrix = boxes(), augmentation(True, False, 0.3, 1.04)
    back = before.transform(matrix).transform(matrix.inverse())
    for name in ("centers", "sizes", "velocities"):
        torch.testing.assert_close(getattr(back, name), getattr(before, name), atol=1e-4, rtol=1e-4)
    assert torch.remainder(back.yaws - before.yaws + 1, 2 * math.pi).sub(1).abs().max() < 1e-5


def test_unknown_velocities_stay_unknown():
    unknown = boxes(velocities=torch.full((4, 2), math.nan)).transform(augmentation(True, True, 0.2, 1.0))
    assert unknown.velocities.isnan().all() and unknown.centers.isfinite().all()


def test_no_box_at_all():
    empty = Boxes3D.empty().transform(augmentation(True, False, 0.1, 1.05))
    assert len(empty) == 0 and empty.bev().shape == (0, 5)
    assert len(empty[torch.zeros(0, dtype=torch.bool)]) == 0


def test_rows_are_picked_from_every_column():
    picked = boxes()[torch.tensor([False, True, False, True])]
    assert picked.labels.tolist() == [1, 3] == picked.num_points.tolist()
    assert torch.equal(picked.bev(), boxes().bev()[[1, 3]]) and picked.scores is None


@pytest.mark.parametrize(
    "name, value",
    [
        ("sizes", torch.ones(4, 2)),
        ("yaws", torch.ones(4, 1)),
        ("velocities", torch.ones(3, 2)),
        ("labels", torch.ones(5)),
        ("scores", torch.ones(4, 1)),
    ],
)
def test_wrong_shapes_are_named(name, value):
    with pytest.raises(ValueError, match=f"Boxes3D.{name} must be"):
        boxes(**{name: value})
