import pytest
import torch

from src.ops.tiled_rulebook import tiled_rulebook
from tests.ops.maps import map_of, random_sites


@pytest.mark.parametrize("backward", [False, True])
@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal"])
def test_tiles_hold_every_pair_once_but_those_of_the_centre(mode, backward, monkeypatch):
    monkeypatch.setattr("src.ops.tiled_rulebook.LEAST_ROWS", 2)
    monkeypatch.setattr("src.ops.tiled_rulebook.TILE_BYTES", 64)
    kernel_map = map_of(mode, random_sites((2, 5, 6, 7), 70))
    rulebook = tiled_rulebook(kernel_map, backward, 7, torch.float32)
    turned = backward and not kernel_map.mirrored
    found = []
    for tile in rulebook.tiles:
        assert len(tile.gathered) <= rulebook.most_pairs
        by_row = tile.summed[tile.order.long()]
        for row, (first, last) in enumerate(zip(tile.starts[:-1].tolist(), tile.starts[1:].tolist(), strict=True)):
            assert (by_row[first:last] == tile.first + row).all()
        for offset, first, last in tile.spans:
            pairs = (tile.gathered[first:last].tolist(), tile.summed[first:last].tolist())
            found += [(offset, *pair) for pair in zip(*(reversed(pairs) if turned else pairs), strict=True)]
    offsets = torch.repeat_interleave(torch.tensor(kernel_map.counts)).tolist()
    every = zip(offsets, kernel_map.inputs.tolist(), kernel_map.outputs.tolist(), strict=True)
    assert len(rulebook.tiles) > 10
    assert sorted(found) == sorted(pair for pair in every if pair[0] != kernel_map.centre)
    assert tiled_rulebook(kernel_map, backward, 7, torch.float32) is rulebook
