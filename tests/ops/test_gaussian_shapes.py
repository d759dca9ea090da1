"""Shapes of Gaussians: sampling points and refined attributes worked by hand, and their gradients."""

import math
from functools import partial

import pytest
import torch

from src.ops import backend
from src.ops.gaussian_shapes import AttributeLimits, refined_attributes, sampling_points

LIMITS = AttributeLimits(scale_range_m=(0.2, 3.2), max_mean_shift_m=4.0, max_speed_mps=60.0, velocity_unit_mps=10.0)
LOWER, UPPER = torch.tensor([-20.0, -10.0]), torch.tensor([20.0, 10.0])
THIRD = math.log(3)  # whose sigmoid is 3/4


def test_learnt_points_follow_scale_and_rotation():
    """Two Gaussians, the second turned by 90 degrees; sigmoids of 3/4 and 1/2 lie 1.5 and 0 standard deviations off."""
    offsets = torch.tensor([[[THIRD, 0.0], [-THIRD, THIRD]]])
    fixed = torch.tensor([[0.0, 0.0], [0.5, -1.0]])
    means, scales = torch.tensor([[[1.0, 2.0], [-3.0, 0.0]]]), torch.tensor([[[2.0, 1.0], [2.0, 3.0]]])
    directions = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    found = sampling_points(offsets, fixed, means, scales, directions)
    expected = [[[1, 2], [2, 1], [4, 2]], [[-3, 0], [0, 1], [-7.5, -3]]]
    torch.testing.assert_close(found, torch.tensor([expected]).float())


def test_refined_attributes_by_hand():
    raw = torch.tensor([[[THIRD, -THIRD, 0.0, THIRD, 3.0, 4.0, 9.0, 6.0, -0.6]]])
    means, scales, directions, velocities = refined_attributes(raw, torch.tensor([[[1.0, -9.0]]]), LOWER, UPPER, LIMITS)
    torch.testing.assert_close(means, torch.tensor([[[3.0, -10.0]]]))  # 2 m each; the second ends at the edge
    torch.testing.assert_close(scales, torch.tensor([[[1.7, 2.45]]]))
    torch.testing.assert_close(directions, torch.tensor([[[0.6, 0.8]]]))
    torch.testing.assert_close(velocities, torch.tensor([[[60 * math.tanh(1.0), -60 * math.tanh(0.1)]]]))


def test_a_rotation_of_no_length_stays_finite():
    raw = torch.zeros(1, 1, 9, requires_grad=True)
    found = refined_attributes(raw, torch.zeros(1, 1, 2), LOWER, UPPER, LIMITS)
    sum(part.sum() for part in found).backward()
    assert all(part.isfinite().all() for part in found) and raw.grad.isfinite().all()


@pytest.mark.parametrize("count", [0, 3])
def test_gradients(count):
    draw = torch.Generator().manual_seed(0)
    offsets, raw = (torch.randn(2, count, n, generator=draw, dtype=torch.float64) for n in (4, 9))
    means, scales = (torch.rand(2, count, 2, generator=draw, dtype=torch.float64) + 0.5 for _ in range(2))
    directions = torch.randn(2, count, 2, generator=draw, dtype=torch.float64)
    points = (offsets, torch.eye(2, dtype=torch.float64), means, scales, directions)
    attributes = partial(refined_attributes, lower_m=LOWER.double(), upper_m=UPPER.double(), limits=LIMITS)
    for op, inputs in ((sampling_points, points), (attributes, (raw, means))):
        assert torch.autograd.gradcheck(op, [value.requires_grad_() for value in inputs])


@torch.no_grad()
def test_attributes_compile_whole_beside_triton(monkeypatch):
    """A compiled part calls no kernel of ours."""
    monkeypatch.setattr(backend, "_chosen", "triton")
    call = partial(refined_attributes, lower_m=LOWER, upper_m=UPPER, limits=LIMITS)
    inputs = torch.randn(1, 5, 9), torch.randn(1, 5, 2)
    found = torch.compile(call, backend="eager", fullgraph=True)(*inputs)
    monkeypatch.undo()
    for one, other in zip(found, call(*inputs), strict=True):
        torch.testing.assert_close(one, other)
