"""Maps as tables, as a GPU makes them, against maps as pairs."""

import pytest
import torch

from src.ops import kernel_maps
from src.ops.kernel_maps import pruned_map, strided_map, submanifold_map, temporal_map, window_map
from src.ops.neighbour_table import neighbour_table, stacked_table, tap_bits
from tests.ops.maps import random_sites, stack_of

BUILDERS = {
    "submanifold": lambda sites: submanifold_map(sites, (3, 1, 5)),
    "strided": lambda sites: strided_map(sites, 3, 2, 1)[0],
    "dilating": lambda sites: strided_map(sites, (1, 3, 2), 1, (0, 1, 0))[0],
    "inverse": lambda sites: strided_map(sites, 3, 2, 1)[0].transposed,
    "pruned": lambda sites: pruned_map(sites, torch.arange(len(sites)) % 2 == 0, 3, 2, 1)[0],
    "temporal": lambda sites: temporal_map(sites, 3, (2, 1, 1), 1)[0],
    "window": lambda sites: window_map(random_sites((2, 4, 5, 6), 50, seed=1), sites, 3),
    "stacked": lambda sites: stack_of(sites, 3, [torch.arange(0, len(sites), 2), torch.arange(len(sites) // 2)]),
    "kept": lambda sites: submanifold_map(sites, 3).keep_outputs(torch.arange(0, len(sites), 3)),
}


@pytest.mark.parametrize("count", [0, 1, 60])
@pytest.mark.parametrize("name", BUILDERS)
def test_a_table_holds_the_pairs(name, count, monkeypatch):
    by_pairs = BUILDERS[name](random_sites((2, 4, 5, 6), count))
    sites = random_sites((2, 4, 5, 6), count)
    monkeypatch.setattr(kernel_maps, "makes_tables", lambda sites: True)
    by_table = BUILDERS[name](sites)
    assert (by_table.num_inputs, by_table.num_outputs) == (by_pairs.num_inputs, by_pairs.num_outputs)
    assert by_table.mirrored == by_pairs.mirrored and by_table.num_offsets == by_pairs.num_offsets
    assert torch.equal(by_table.table, by_pairs.table) and torch.equal(by_table.order, by_pairs.order)
    assert by_table.counts == by_pairs.counts
    pairs = [sorted(zip(m.inputs.tolist(), m.outputs.tolist(), strict=True)) for m in (by_table, by_pairs)]
    assert pairs[0] == pairs[1]


def test_sites_of_a_strided_table_are_those_of_the_pairs(monkeypatch):
    _, expected = strided_map(random_sites((2, 7, 5, 6), 40), 3, (2, 2, 1), (0, 1, 1))
    monkeypatch.setattr(kernel_maps, "makes_tables", lambda sites: True)
    _, found = strided_map(random_sites((2, 7, 5, 6), 40), 3, (2, 2, 1), (0, 1, 1))
    assert found.shape == expected.shape and torch.equal(found.keys, expected.keys)


def test_a_search_by_hand():
    table, bits = neighbour_table(torch.tensor([2, 3, 9]), torch.tensor([1, 8]), torch.tensor([0, 1, 2]))
    assert table.tolist() == [[-1, -1], [0, 2], [1, -1]] and table.dtype == torch.int32
    assert bits.tolist() == [0b110, 0b010] and torch.equal(tap_bits(table), bits)


def test_the_rows_of_two_parts_are_those_of_their_maps():
    table = torch.tensor([[0, -1, 2], [1, 2, -1]], dtype=torch.int32)
    places = (torch.tensor([0, -1, 1]), torch.tensor([-1, 0, 1]))
    found, bits = stacked_table(table, places, 2)
    assert found.tolist() == [[0, -1, 1], [-1, 1, -1], [-1, -1, 3], [2, 3, -1]] and bits.tolist() == [9, 10, 5]
