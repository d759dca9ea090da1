import math

import pytest
import torch

from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import Source


def gaussians(count=5, source=Source.RADAR, **changes):
    values = {name: torch.randn(2, count, 2) for name in ("means", "scales", "directions", "velocities")}
    values |= {name: torch.randn(2, count) for name in ("opacity_logits", "elapsed_s")}
    values |= {
        "features": torch.randn(2, count, 8),
        "sources": torch.full((2, count), int(source)),
        "valid": torch.ones(2, count, dtype=torch.bool),
    }
    return GaussianSet(**(values | changes))


def test_sets_are_joined_along_the_gaussians():
    parts = [gaussians(3), gaussians(0, Source.CAMERA), gaussians(2, Source.HISTORY)]
    joined = GaussianSet.concatenate(parts, dim=1)
    assert joined.valid.shape == (2, 5) and len(joined) == 5
    assert joined.sources.tolist() == [[0, 0, 0, 3, 3]] * 2
    assert torch.equal(joined.features[:, 3:], parts[2].features)


@pytest.mark.parametrize(
    "name, value",
    [
        ("means", torch.zeros(2, 5, 3)),
        ("scales", torch.zeros(2, 4, 2)),
        ("opacity_logits", torch.zeros(2, 5, 1)),
        ("features", torch.zeros(1, 5, 8)),
        ("elapsed_s", torch.zeros(2)),
        ("valid", torch.ones(2, 5)),
    ],
)
def test_what_does_not_fit_is_named(name, value):
    with pytest.raises(ValueError, match=f"GaussianSet.{name} must be"):
        gaussians(**{name: value})


def augmentation(flip_x, flip_y, angle, scale):
    """[1, 4, 4] A = S R F with a shift."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    mirror = torch.diag(torch.tensor([-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0, 1.0]))
    matrix = torch.eye(4)[None].clone()
    matrix[0, :3, :3] = scale * rotation @ mirror
    matrix[0, :3, 3] = torch.tensor([5.0, -3.0, 2.0])
    return matrix


def physical():
    """Random Gaussians whose attributes have a meaning: unit directions, positive scales."""
    torch.manual_seed(0)
    drawn = gaussians(7)
    directions = torch.nn.functional.normalize(drawn.directions, dim=-1)
    return gaussians(7, directions=directions, scales=drawn.scales.abs() + 0.2)


def covariance(of):
    """Sigma = R diag(s^2) R^T (Eq. 4)."""
    cos, sin = of.directions.unbind(-1)
    rotation = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)
    return rotation @ torch.diag_embed(of.scales.square()) @ rotation.mT


@pytest.mark.parametrize("flip_x", [False, True])
@pytest.mark.parametrize("flip_y", [False, True])
@pytest.mark.parametrize("angle, scale", [(0.0, 1.0), (0.39, 1.05), (-2.0, 0.95)])
def test_transformed_gaussians_cover_the_transformed_plane(flip_x, flip_y, angle, scale):
    """Sigma' = Lam Sigma Lam^T, reflections included; means as points, velocities as their differences (method 9)."""
    before, matrix = physical(), augmentation(flip_x, flip_y, angle, scale)
    after, linear = before.transform(matrix.expand(2, -1, -1)), matrix[0, :2, :2]
    torch.testing.assert_close(covariance(after), linear @ covariance(before) @ linear.T, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(after.means, before.means @ linear.T + matrix[0, :2, 3])
    torch.testing.assert_close(after.velocities, before.velocities @ linear.T)
    torch.testing.assert_close(after.scales, before.scales * scale)
    torch.testing.assert_close(after.directions.norm(dim=-1), torch.ones(2, 7))
    for name in ("opacity_logits", "features", "sources", "elapsed_s", "valid"):
        assert getattr(after, name) is getattr(before, name)


def test_transform_back_gives_the_same_gaussians():
    before, matrix = physical(), augmentation(True, False, 0.3, 1.04).expand(2, -1, -1)
    back = before.transform(matrix).transform(matrix.inverse())
    for name in ("means", "scales", "directions", "velocities"):
        torch.testing.assert_close(getattr(back, name), getattr(before, name), atol=1e-5, rtol=1e-5)


def test_every_sample_has_its_own_transform():
    before = physical()
    both = before.transform(torch.cat([augmentation(True, False, 0.3, 1.0), augmentation(False, False, 0.0, 1.05)]))
    assert not torch.allclose(both.scales[1], before.scales[1])
    torch.testing.assert_close(both.scales[0], before.scales[0])
    torch.testing.assert_close(both.means[1], 1.05 * before.means[1] + torch.tensor([5.0, -3.0]))


def test_transforms_are_not_rounded_by_autocast():
    """A position of 150 m has steps of half a metre in bfloat16."""
    before = physical()
    before.means *= 100
    matrix = augmentation(False, True, 0.3, 1.05).expand(2, -1, -1)
    with torch.autocast("cpu", torch.bfloat16):
        after = before.transform(matrix)
    exact = before.transform(matrix)
    for name in ("means", "scales", "directions", "velocities"):
        assert torch.equal(getattr(after, name), getattr(exact, name)), name


def test_map_reaches_every_tensor():
    picked = physical().map(lambda value: value[1:, :3])
    assert picked.valid.shape == (1, 3)
    assert torch.equal(picked.features, physical().features[1:, :3])
