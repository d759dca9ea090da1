import itertools

import pytest
import torch

from src.ops.kernel_map import KernelMap
from src.ops.kernel_maps import pruned_map, strided_map, submanifold_map, temporal_map, window_map
from src.ops.sites import Sites
from tests.ops.maps import random_sites


def test_map_equals_a_search_by_hand():
    sites = random_sites((2, 3, 4, 5), 30)
    cells = {tuple(cell): row for row, cell in enumerate(sites.indices().tolist())}
    expected = []
    for offset in itertools.product((-1, 0, 1), repeat=3):
        for cell, row in cells.items():
            other = (cell[0], *(a + b for a, b in zip(cell[1:], offset, strict=True)))
            if other in cells:
                expected.append((cells[other], row))
    kernel_map: KernelMap = submanifold_map(sites, 3)
    found = list(zip(kernel_map.inputs.tolist(), kernel_map.outputs.tolist(), strict=True))
    assert sorted(found) == sorted(expected)
    assert sum(kernel_map.counts) == len(found)


def test_samples_do_not_mix():
    """The last row of sample 0 and the first of sample 1 are no neighbours."""
    sites, _ = Sites.from_indices(torch.tensor([[0, 3, 2], [1, 0, 2]]), (2, 4, 4))
    for kernel in (3, 5):
        assert len(submanifold_map(sites, kernel).inputs) == 2
    kernel_map, out = strided_map(sites, 3, 1, 1)
    assert set(out.indices()[kernel_map.outputs[kernel_map.inputs == 0].long(), 0].tolist()) == {0}


def test_maps_are_made_once_per_set_of_sites():
    sites = random_sites((1, 6, 6), 10)
    assert submanifold_map(sites, 3) is submanifold_map(sites, (3, 3))
    assert strided_map(sites, 3, 2, 1)[1] is strided_map(sites, 3, (2, 2), 1)[1]


def test_wrong_kernels_are_named():
    sites = random_sites((1, 6, 6), 10)
    with pytest.raises(ValueError, match="must be odd"):
        submanifold_map(sites, 2)
    with pytest.raises(ValueError, match="at most 5"):
        submanifold_map(sites, 7)
    with pytest.raises(ValueError, match="one per spatial axis"):
        strided_map(sites, (3, 3, 3), 2, 1)
    with pytest.raises(ValueError, match="does not fit"):
        strided_map(sites, 9, 1, 0)
    with pytest.raises(ValueError, match="the plane would change"):
        temporal_map(random_sites((1, 4, 4, 4), 5), 3, 2, 1)


@pytest.mark.parametrize("kernel", [3, (1, 3, 5)])
def test_a_window_joins_two_sets_of_sites(kernel):
    inputs, outputs = random_sites((2, 3, 4, 6), 40), random_sites((2, 3, 4, 6), 50, seed=1)
    half = torch.tensor([0, *(size // 2 for size in ((kernel,) * 3 if isinstance(kernel, int) else kernel))])
    apart = (inputs.indices()[None] - outputs.indices()[:, None]).abs()  # [outputs, inputs, 4]
    expected = (apart <= half).all(2).nonzero()
    found = window_map(inputs, outputs, kernel)
    pairs = torch.stack([found.outputs, found.inputs], 1).long()
    assert sorted(pairs.tolist()) == expected.tolist() and sum(found.counts) == len(pairs)
    itself, known = window_map(inputs, inputs, kernel), submanifold_map(inputs, kernel)
    assert torch.equal(itself.inputs, known.inputs) and itself.counts == known.counts
    with pytest.raises(ValueError, match="sites of one grid"):
        window_map(inputs, random_sites((2, 3, 4, 5), 3), kernel)


def test_outputs_are_left_out():
    kernel_map, _ = strided_map(random_sites((2, 5, 6), 20), 3, 1, 1)
    rows = torch.arange(0, kernel_map.num_outputs, 3)
    kept = kernel_map.keep_outputs(rows)
    offsets = torch.arange(9).repeat_interleave(torch.tensor(kernel_map.counts))
    wanted = [
        (offset, source, rows.tolist().index(target))
        for offset, source, target in zip(
            offsets.tolist(), kernel_map.inputs.tolist(), kernel_map.outputs.tolist(), strict=True
        )
        if target % 3 == 0
    ]
    offsets = torch.arange(9).repeat_interleave(torch.tensor(kept.counts)).tolist()
    assert wanted == list(zip(offsets, kept.inputs.tolist(), kept.outputs.tolist(), strict=True))
    assert kept.num_outputs == len(rows)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_only_wide_sites_dilate(share):
    sites = random_sites((2, 5, 6, 7), 40)
    wide = torch.rand(40, generator=torch.Generator().manual_seed(0)) < share
    full, reached = strided_map(sites, 3, 2, 1)
    found, out = pruned_map(sites, wide, 3, 2, 1)
    kept = {tuple(cell) for cell in (sites.indices() // torch.tensor([1, 2, 2, 2])).tolist()}
    by_wide = wide.index_select(0, full.inputs)
    kept |= {tuple(cell) for cell in reached.indices()[full.outputs[by_wide].long()].tolist()}
    assert out.shape == reached.shape and {tuple(cell) for cell in out.indices().tolist()} == kept
    assert len(kept) == len(out) and (share < 1.0 or torch.equal(out.keys, reached.keys))

    def pairs(kernel_map, outputs):
        taps = torch.arange(27).repeat_interleave(torch.tensor(kernel_map.counts)).tolist()
        cells = outputs.indices()[kernel_map.outputs.long()].tolist()
        return {(t, i, *c) for t, i, c in zip(taps, kernel_map.inputs.tolist(), cells, strict=True)}

    assert pairs(found, out) == {pair for pair in pairs(full, reached) if pair[2:] in kept}


def test_a_window_that_misses_its_own_cell_is_refused():
    with pytest.raises(ValueError, match="no window reaches its whole cell"):
        pruned_map(random_sites((1, 6, 6), 3), torch.ones(3).bool(), 2, 2, 1)
