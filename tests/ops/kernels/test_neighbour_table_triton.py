import pytest
import torch

from src.ops.neighbour_table import neighbour_table, tap_bits


@pytest.mark.parametrize(("count", "cells", "taps"), [(0, 5, 9), (1, 3, 1), (300, 700, 27), (64, 64, 125)])
def test_table_and_bits(device, count, cells, taps):
    draw = torch.Generator().manual_seed(count)
    keys = torch.randperm(2000, generator=draw)[:count].sort().values.to(device)
    corners = torch.randint(-20, 2020, (cells,), generator=draw).to(device)
    steps = torch.arange(taps).to(device)
    table, bits = neighbour_table(keys, corners, steps)
    rows = {key: row for row, key in enumerate(keys.tolist())}
    wanted = (corners + steps[:, None]).tolist()
    assert table.tolist() == [[rows.get(key, -1) for key in line] for line in wanted]
    assert torch.equal(bits, tap_bits(table))
