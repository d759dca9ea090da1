import pytest
import torch

from src.ops.sites import HALO, Sites, _counted_anew, places_among, rows_of_keys, union

SHAPE = (2, 4, 5)


def test_sites_are_sorted_and_know_their_order():
    indices = torch.tensor([[1, 0, 0], [0, 3, 4], [0, 0, 1], [1, 3, 4], [0, 0, 0]])
    sites, order = Sites.from_indices(indices, SHAPE)
    assert sites.indices().tolist() == [[0, 0, 0], [0, 0, 1], [0, 3, 4], [1, 0, 0], [1, 3, 4]]
    assert torch.equal(indices[order], sites.indices())
    assert sites.linear().tolist() == [0, 1, 19, 20, 39]
    assert sites.indices()[:, 0].bincount(minlength=sites.shape[0]).tolist() == [3, 2]
    assert torch.equal(Sites.from_linear(sites.linear(), SHAPE).keys, sites.keys)


def test_look_up_finds_sites_and_nothing_else():
    sites, _ = Sites.from_indices(torch.tensor([[0, 0, 4], [1, 2, 2]]), SHAPE)
    asked = torch.tensor([[1, 2, 2], [0, 0, 4], [0, 1, 0], [0, 0, 5], [0, 1, -1], [2, 2, 2], [0, -1, 0]])
    assert sites.rows_of(asked).tolist() == [1, 0, -1, -1, -1, -1, -1]


def test_keys_are_looked_up_among_sorted_ones():
    keys = torch.tensor([2, 5, 9])
    assert rows_of_keys(keys, torch.tensor([9, 1, 5, 10, -1, 2])).tolist() == [2, -1, 1, -1, -1, 0]
    assert rows_of_keys(keys[:0], keys).tolist() == [-1, -1, -1]


def test_an_empty_set_answers_too():
    sites, order = Sites.from_indices(torch.zeros(0, 3, dtype=torch.int64), SHAPE)
    assert len(sites) == len(order) == 0
    assert sites.indices().shape == (0, 3)
    assert sites.indices()[:, 0].bincount(minlength=sites.shape[0]).tolist() == [0, 0]
    assert sites.rows_of(torch.tensor([[0, 0, 0]])).tolist() == [-1]


def test_unique_merges_repeats():
    sites, rows = Sites.unique(torch.tensor([[1, 0, 0], [0, 0, 2], [1, 0, 0]]), SHAPE)
    assert sites.indices().tolist() == [[0, 0, 2], [1, 0, 0]]
    assert rows.tolist() == [1, 0, 1]


def test_union_gives_rows_of_both():
    a, _ = Sites.from_indices(torch.tensor([[0, 0, 0], [1, 1, 1]]), SHAPE)
    b, _ = Sites.from_indices(torch.tensor([[0, 0, 3], [1, 1, 1]]), SHAPE)
    both, rows_a, rows_b = union(a, b)
    assert both.indices().tolist() == [[0, 0, 0], [0, 0, 3], [1, 1, 1]]
    assert rows_a.tolist() == [0, 2] and rows_b.tolist() == [1, 2]
    same, rows, again = union(a, a)
    assert same is a and rows.tolist() == again.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("indices", "words"),
    [
        ([[0, 0, 0], [0, 0, 0]], "more than once"),
        ([[0, 4, 0]], r"\[0, 4, 0\] lies outside"),
        ([[0, -1, 0]], "outside"),
        ([[2, 0, 0]], "outside"),
        ([[0, 0]], r"\[n, 3\]"),
    ],
)
def test_wrong_cells_are_named(indices, words):
    with pytest.raises(ValueError, match=words):
        Sites.from_indices(torch.tensor(indices), SHAPE)


def test_union_needs_one_grid():
    a, _ = Sites.from_indices(torch.zeros(1, 3, dtype=torch.int64), SHAPE)
    b, _ = Sites.from_indices(torch.zeros(1, 3, dtype=torch.int64), (2, 4, 6))
    with pytest.raises(ValueError, match="different grids"):
        union(a, b)


@pytest.mark.parametrize("first", [0, 70])
def test_positions_of_a_gpu_are_those_of_a_cpu(first):
    shape, steps = (2, 5, 6, 7), (1000, 0, 14, 2)
    keys = torch.tensor([[0, 0, 0, 0], [0, 4, 5, 6], [1, 2, 0, 3], [2, 0, 0, 0]])  # the last is padding
    sites = Sites(shape, Sites(shape, keys).keys_of(keys))
    sizes = tuple(size + HALO for size in shape[1:])
    wanted = (keys * torch.tensor(steps)).sum(1) + first
    assert torch.equal(sites.positions(steps, first), wanted)
    assert torch.equal(_counted_anew(sites.keys, sites.strides, sizes, steps, first), wanted)


def test_places_among_by_hand():
    part, joint = (Sites((1, 4, 4), torch.tensor(keys)) for keys in ([3, 8], [1, 3, 7, 8]))
    assert places_among(part, joint).tolist() == [-1, 0, -1, 1]
