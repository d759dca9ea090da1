import pytest
import torch

from src.ops.neighbour_table import (
    moved_table,
    moved_table_reference,
    neighbour_table,
    stacked_table,
    tap_bits,
    transposed_table,
)


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


@pytest.mark.parametrize(("num", "cells", "taps"), [(0, 5, 9), (5, 0, 9), (1, 3, 1), (300, 700, 27), (64, 64, 125)])
def test_a_table_read_backwards(device, num, cells, taps):
    draw = torch.Generator().manual_seed(num)
    lines = [torch.randperm(max(num, cells), generator=draw)[:cells] for _ in range(taps)]
    table = torch.stack([torch.where(line < num, line, -1) for line in lines]).to(torch.int32)
    back, bits = transposed_table(table.to(device), num)
    expected = torch.full((taps, num), -1, dtype=torch.int32)
    for tap, cell in (table >= 0).nonzero().tolist():
        expected[tap, table[tap, cell]] = cell
    assert torch.equal(back.cpu(), expected) and torch.equal(bits.cpu(), tap_bits(expected))


@pytest.mark.parametrize(("cells", "taps"), [(0, 9), (1, 1), (700, 27), (64, 40)])
def test_the_rows_of_two_parts(device, cells, taps):
    draw = torch.Generator().manual_seed(cells)
    table = torch.randint(-1, max(cells, 1), (taps, cells), generator=draw).clamp(max=cells - 1).to(torch.int32)
    places = [torch.randint(-1, 20, (cells,), generator=draw) for _ in range(2)]
    found, bits = stacked_table(table.to(device), (places[0].to(device, torch.int32), places[1].to(device)), 30)
    lines = [
        [place[row] + shift * (place[row] >= 0) if row >= 0 else -1 for row in line]
        for place, shift in zip((x.tolist() for x in places), (0, 30), strict=True)
        for line in table.tolist()
    ]
    assert found.tolist() == lines and torch.equal(bits.cpu(), tap_bits(found.cpu()))


@pytest.mark.parametrize(("count", "cells"), [(0, 5), (200, 0), (300, 700)])
def test_a_table_of_moved_cells(device, count, cells):
    draw = torch.Generator().manual_seed(count)
    keys = torch.randperm(900, generator=draw)[:count].sort().values.to(device)
    coarse = torch.randint(0, 2800, (cells,), generator=draw).to(device)
    axes = ((100, 28, 2, 1, -2, 32, 30), (1, 100, 1, 4, 0, 24, 1))
    given = (keys, coarse, (2800, 900), axes, (-1, 3), torch.arange(9).to(device))
    for found, wanted in zip(moved_table(*given), moved_table_reference(*given), strict=True):
        assert torch.equal(found, wanted)
