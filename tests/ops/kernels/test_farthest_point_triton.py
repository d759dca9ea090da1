import pytest
import torch

from src.ops.farthest_point import farthest_points, farthest_points_reference


@pytest.mark.parametrize("g", [1, 2, 33, 130])
@pytest.mark.parametrize("whole_metres", [True, False])
def test_picks_are_those_of_the_reference(device, g, whole_metres):
    """Whole metres make real ties; the other points make near ties that only equal rounding decides equally."""
    generator = torch.Generator().manual_seed(g)
    points = torch.randn(3, g, 2, generator=generator) * 9
    if whole_metres:
        points = points.round()
    valid = torch.rand(3, g, generator=generator) < torch.tensor([[1.0], [0.5], [0.1]])
    valid[:, g // 2] = True
    start = torch.full((3,), g // 2)
    start[1] = int(valid[1].nonzero()[-1])
    for count in (1, min(g + 3, 40)):
        picks = farthest_points(points.to(device), valid.to(device), start.to(device), count)
        assert picks.dtype == torch.int64 and picks.device.type == device.type
        expected = farthest_points_reference(points.double() if whole_metres else points, valid, start, count)
        assert torch.equal(picks.cpu(), expected)


def test_strided_inputs(device):
    """Rows of a larger tensor, as a slice of a set of Gaussians gives them."""
    table = torch.randn(2, 40, 5, generator=torch.Generator().manual_seed(0))
    points, valid = table[..., 1:3], torch.ones(2, 80, dtype=torch.bool)[:, ::2]
    start = torch.tensor([3, 0, 5, 0])[::2]
    picks = farthest_points(points.to(device), valid.to(device), start.to(device), 9)
    assert torch.equal(picks.cpu(), farthest_points_reference(points, valid, start, 9))


def test_a_start_that_is_not_valid_picks_nothing(device):
    valid = torch.ones(2, 6, dtype=torch.bool, device=device)
    valid[0] = False
    picks = farthest_points(torch.rand(2, 6, 2, device=device), valid, torch.zeros(2, dtype=torch.int64).to(device), 3)
    assert picks[0].tolist() == [-1] * 3 and picks[1, 0] == 0 and (picks[1] >= 0).all()


@pytest.mark.parametrize(("b", "g", "count"), [(0, 5, 3), (2, 0, 3), (2, 5, 0)])
def test_nothing_to_pick_from(device, b, g, count):
    valid = torch.ones(b, g, dtype=torch.bool, device=device)
    picks = farthest_points(torch.rand(b, g, 2, device=device), valid, torch.zeros(b).long().to(device), count)
    assert picks.tolist() == [[-1] * count] * b


def test_more_points_than_registers_hold_go_to_the_reference(device, monkeypatch):
    from src.ops.kernels import farthest_point_triton

    monkeypatch.setattr(farthest_point_triton, "MOST_POINTS", 8)
    points, valid = torch.rand(1, 9, 2, device=device), torch.ones(1, 9, dtype=torch.bool, device=device)
    with pytest.raises(AssertionError, match="left its work"):
        farthest_points(points, valid, torch.zeros(1, dtype=torch.int64, device=device), 3)
