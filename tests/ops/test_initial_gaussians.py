"""The Gaussians that a frame starts from, worked by hand."""

import math

import pytest
import torch

from src.ops.gaussian_shapes import AttributeLimits
from src.ops.initial_gaussians import Attributes, Keypoints, Slots, initial_gaussians

LIMITS = AttributeLimits(scale_range_m=(0.2, 3.2), max_mean_shift_m=4.0, max_speed_mps=60.0, velocity_unit_mps=10.0)
CENTRE = torch.tensor([7.0, -1.0])
THIRD = math.log(3)  # whose sigmoid is 3/4
C = 2


def row(features, scale=(0.0, 0.0), rotation=(1.0, 0.0), opacity=0.0, velocity=(0.0, 0.0)):
    return [*features, *scale, *rotation, opacity, *velocity]


def slots():
    """Two of radar, one of cameras, one whose mean is learnt."""
    values = torch.tensor(
        [row((1, 2)), row((3, 4), opacity=0.5), row((5, 6), rotation=(0, 2)), row((7, 8), velocity=(6, 0))]
    )
    return Slots(values, torch.tensor([0, 0, 1, 2]), torch.tensor([[9.0, 9.0]]), torch.tensor([10.0, 20.0]))


def keypoints(changed):
    """Of two samples; the second radar keypoint of the second sample is missing."""
    radar = torch.tensor([[[1.0, 1.0], [2.0, 2.0]], [[3.0, 3.0], [4.0, 4.0]]])
    camera = torch.tensor([[[5.0, 5.0]], [[6.0, 6.0]]])
    change = torch.zeros(2, 2, C + 7)
    change[1, 0] = torch.tensor(row((0.5, 0.5), (THIRD, -THIRD), (2.0, 4.0), 0.25, (0.0, 3.0)))
    return (
        Keypoints(radar, torch.tensor([[True, True], [True, False]]), change if changed else None),
        Keypoints(camera, torch.tensor([[True], [True]]), torch.zeros(2, 1, C + 7) if changed else None),
    )


def history():
    means, ones = torch.tensor([[[0.0, 1.0]], [[2.0, 3.0]]]), torch.ones(2, 1)
    kept = torch.tensor([[True], [False]])
    return Attributes(means, means, means, ones, means, means, ones.long() * 3, ones * 0.5, kept)


@pytest.mark.parametrize("changed", [False, True])
def test_by_hand(changed):
    found = initial_gaussians(slots(), keypoints(changed), None, CENTRE, LIMITS, 2)
    assert found.means.tolist() == [[[1, 1], [2, 2], [5, 5], [9, 9]], [[3, 3], [7, -1], [6, 6], [9, 9]]]
    assert found.valid.tolist() == [[True, True, True, True], [True, False, True, True]]
    assert found.sources.tolist() == [[0, 0, 1, 2]] * 2
    assert found.features[0].tolist() == [[1, 2], [3, 4], [5, 6], [7, 8]]
    assert found.opacity_logits[0].tolist() == [0.0, 0.5, 0.0, 0.0]
    torch.testing.assert_close(found.scales[0], torch.full((4, 2), 1.7))
    torch.testing.assert_close(found.directions[0], torch.tensor([[1.0, 0], [1, 0], [0, 1], [1, 0]]))
    torch.testing.assert_close(found.velocities[0, 3], torch.tensor([60 * math.tanh(1.0), 0.0]))
    assert not found.elapsed_s.any() and found.elapsed_s.dtype == torch.float32
    if not changed:
        assert all(torch.equal(part[0], part[1]) for part in (found.scales, found.directions, found.features))
        return
    assert found.features[1].tolist() == [[1.5, 2.5], [3, 4], [5, 6], [7, 8]]
    torch.testing.assert_close(found.scales[1, 0], torch.tensor([2.45, 0.95]))
    torch.testing.assert_close(found.directions[1, 0], torch.tensor([0.6, 0.8]))  # (1, 0) + (2, 4)
    assert found.opacity_logits[1].tolist() == [0.25, 0.5, 0.0, 0.0]
    torch.testing.assert_close(found.velocities[1, 0], torch.tensor([0.0, 60 * math.tanh(0.5)]))


def test_history_follows_with_shifted_features():
    now = initial_gaussians(slots(), keypoints(False), None, CENTRE, LIMITS, 2)
    both = initial_gaussians(slots(), keypoints(False), history(), CENTRE, LIMITS, 2)
    for name, whole in both._asdict().items():
        assert torch.equal(whole[:, :4], getattr(now, name)), name
        expected = getattr(history(), name)
        assert torch.equal(whole[:, 4:], expected + slots().history_shift if name == "features" else expected), name


def test_learnt_means_alone_and_nothing_at_all():
    """Without sources every sample has the same; without slots none has any."""
    mine = slots()
    alone = Slots(mine.values[3:], mine.sources[3:], mine.learnt_means, mine.history_shift)
    found = initial_gaussians(alone, (), None, CENTRE, LIMITS, 3)
    assert found.means.tolist() == [[[9.0, 9.0]]] * 3 and found.valid.all()
    nothing = Slots(mine.values[:0], mine.sources[:0], mine.learnt_means[:0], mine.history_shift)
    found = initial_gaussians(nothing, (), history(), CENTRE, LIMITS, 2)
    assert torch.equal(found.means, history().means) and torch.equal(found.valid, history().valid)
