import numpy as np
import pytest
import torch

from src.ops.farthest_point import farthest_points, pick_on_device


def oracle(points, valid, start, count):
    """One sample by the definition: the distance of every point to every pick, in float64."""
    picks = [start] if valid[start] else []
    while picks and len(picks) < min(count, valid.sum()):
        gaps = np.linalg.norm(points[:, None] - points[picks][None], axis=-1).min(axis=1)
        gaps[~valid] = -1
        gaps[picks] = -1
        picks.append(int(gaps.argmax()))
    return picks + [-1] * (count - len(picks))


def test_by_hand():
    points = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [10.0, 0.0], [0.0, 6.0], [9.0, 0.0]]])
    valid = torch.ones(1, 5, dtype=torch.bool)
    # From row 1: row 2 is 9 m away; then row 3 (6.1 m); then 0 and 4 are both 1 m from a pick: the lower row first.
    assert farthest_points(points, valid, torch.tensor([1]), 5).tolist() == [[1, 2, 3, 0, 4]]
    assert farthest_points(points, valid, torch.tensor([1]), 2).tolist() == [[1, 2]]
    valid[0, 2] = False
    assert farthest_points(points, valid, torch.tensor([1]), 5).tolist() == [[1, 4, 3, 0, -1]]


@pytest.mark.parametrize("seed", range(8))
def test_random_sets_against_the_definition(seed):
    """Points on a grid of whole metres: squared distances are exact, so ties are real and must fall the same way."""
    generator = np.random.default_rng(seed)
    count = int(generator.integers(1, 40))
    points = generator.integers(-12, 13, size=(3, 30, 2)).astype(np.float64)
    valid = generator.random((3, 30)) < (0.9, 0.4, 0.1)[seed % 3]
    valid[:, 5] = True
    start = np.array([generator.choice(np.flatnonzero(row)) for row in valid])
    picks = farthest_points(torch.tensor(points).float(), torch.tensor(valid), torch.tensor(start), count)
    expected = [oracle(*sample, count) for sample in zip(points, valid, start, strict=True)]
    assert picks.tolist() == expected


def test_fewer_valid_points_than_wanted():
    points, valid = torch.randn(2, 6, 2), torch.zeros(2, 6, dtype=torch.bool)
    valid[0, [1, 4]] = True
    picks = farthest_points(points, valid, torch.tensor([4, 0]), 9)
    assert picks.tolist() == [[4, 1] + [-1] * 7, [-1] * 9]


def test_points_in_one_place_are_all_picked_once():
    """Equal points are distinct Gaussians: picked last, in order, never twice."""
    points = torch.tensor([[[2.0, 2.0]] * 4 + [[3.0, 2.0]]])
    picks = farthest_points(points, torch.ones(1, 5, dtype=torch.bool), torch.tensor([2]), 5)
    assert picks.tolist() == [[2, 4, 0, 1, 3]]


def test_samples_do_not_mix():
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 20, 2, generator=generator) * 30
    valid = torch.rand(2, 20, generator=generator) < 0.7
    valid[:, 3] = True
    both = farthest_points(points, valid, torch.tensor([3, 3]), 7)
    for row in (0, 1):
        alone = farthest_points(points[row : row + 1], valid[row : row + 1], torch.tensor([3]), 7)
        assert torch.equal(both[row], alone[0])


def test_the_subset_covers_the_set():
    """No point is further from the picks than they are from one another, the property the method is named for."""
    points = torch.randn(1, 200, 2, generator=torch.Generator().manual_seed(1)) * 40
    picks = farthest_points(points, torch.ones(1, 200, dtype=torch.bool), torch.tensor([0]), 25)[0]
    chosen = points[0, picks]
    cover = torch.cdist(points[0], chosen).min(dim=1).values.max()
    apart = torch.cdist(chosen, chosen).fill_diagonal_(torch.inf).min()
    assert cover <= apart + 1e-4


@pytest.mark.parametrize("b, g", [(0, 5), (2, 0), (0, 0)])
def test_nothing_to_pick_from(b, g):
    picks = farthest_points(torch.zeros(b, g, 2), torch.zeros(b, g, dtype=torch.bool), torch.zeros(b).long(), 3)
    assert picks.tolist() == [[-1] * 3] * b


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"points \[1, 4, 3\]"):
        farthest_points(torch.zeros(1, 4, 3), torch.ones(1, 4, dtype=torch.bool), torch.zeros(1).long(), 2)


@pytest.mark.parametrize("seed", range(4))
def test_the_loop_for_other_devices_picks_the_same(seed):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randint(0, 12, (3, 40, 2), generator=generator).float()  # a lattice: many ties
    valid = torch.rand(3, 40, generator=generator) < torch.tensor([[0.9], [0.2], [0.0]])
    points[~valid] = torch.nan
    start = valid.int().argmax(dim=1)
    assert torch.equal(pick_on_device(points, valid, start, 20), farthest_points(points, valid, start, 20))
