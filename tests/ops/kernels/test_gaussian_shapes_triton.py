import pytest
import torch

from src.ops.gaussian_shapes import (
    AttributeLimits,
    refined_attributes,
    refined_attributes_reference,
    sampling_points,
    sampling_points_reference,
)

LIMITS = AttributeLimits((0.2, 3.0), 4.0, 30.0, 10.0)


def draw_gaussians(count):
    draw = torch.Generator().manual_seed(count)
    means, scales, directions = (torch.randn(2, count, 2, generator=draw) for _ in range(3))
    return 20 * means, scales.exp(), torch.nn.functional.normalize(directions, dim=-1), draw


@pytest.mark.parametrize(("count", "learnt"), [(0, 3), (90, 3), (90, 0)])
def test_points(device, count, learnt):
    means, scales, directions, draw = draw_gaussians(count)
    offsets, fixed = 3 * torch.randn(2, count, 2 * learnt, generator=draw), torch.randn(5, 2, generator=draw)
    inputs = (offsets, fixed, means, scales, directions)
    with torch.no_grad():
        found = sampling_points(*(x.to(device) for x in inputs)).cpu()
    assert found.shape == (2, count, 5 + learnt, 2)
    torch.testing.assert_close(found, sampling_points_reference(*inputs), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("count", [0, 90])
def test_attributes(device, count):
    means, _, _, draw = draw_gaussians(count)
    raw = 3 * torch.randn(2, count, 9, generator=draw)
    raw[:, :1, 4:6] = 0.0  # no direction at all
    inputs = (raw, means, torch.tensor([-25.0, -20.0]), torch.tensor([25.0, 20.0]))
    with torch.no_grad():
        found = refined_attributes(*(x.to(device) for x in inputs), LIMITS)
    for value, expected in zip(found, refined_attributes_reference(*inputs, LIMITS), strict=True):
        torch.testing.assert_close(value.cpu(), expected, rtol=1e-5, atol=1e-5)
