"""Look-ups among sites by index, against a dictionary of their keys."""

from __future__ import annotations

import itertools

import pytest
import torch

from src.ops.site_index import CHUNK, SiteIndex
from src.ops.sites import HALO, Sites


def some_sites(shape: tuple[int, ...], count: int) -> Sites:
    """Distinct random cells."""
    cells = torch.randperm(torch.Size(shape).numel(), generator=torch.Generator().manual_seed(0))[:count]
    return Sites.from_linear(cells.sort().values, shape)


@pytest.mark.parametrize(
    ("shape", "count"),
    [((2, 4, 5, 40), 300), ((3, 6, 7), 40), ((2, 50), 30), ((1, 2, 3, 4), 24), ((2, 3, 3, 3), 1), ((1, 4, 4), 0)],
)
@pytest.mark.parametrize("taps", [1, 3, CHUNK])
def test_finds_exactly_the_sites_of_every_window(shape: tuple[int, ...], count: int, taps: int) -> None:
    """Windows that begin at any cell of the grid or of the halo before it, in rows to each side."""
    sites = some_sites(shape, count)
    rows_of = {tuple(cell): row for row, cell in enumerate(sites.indices().tolist())}
    begins = [range(shape[0]), *(range(size) for size in shape[1:-1]), range(-HALO, shape[-1])]
    corners = list(itertools.product(*begins))
    lines = [0, HALO, -HALO] if len(shape) > 2 else [0]  # along the last axis but one
    windows = SiteIndex.of(sites).windows(sites.keys_of(torch.tensor(corners)), torch.tensor(lines), taps)
    expected = [
        [rows_of.get((*before, row + line, x + tap), -1) for *before, row, x in corners]
        for line in lines
        for tap in range(taps)
    ]
    found = windows.found()
    assert found.tolist() == [[row >= 0 for row in of_tap] for of_tap in expected]
    hits = found.nonzero()
    assert windows.sites(*hits.unbind(1)).tolist() == [expected[tap][column] for tap, column in hits.tolist()]


def test_padding_behind_the_sites_hides_none() -> None:
    """In fixed shapes the key behind the grid is there many times."""
    sites = some_sites((1, 3, 40), 60)
    padded = Sites(sites.shape, torch.cat([sites.keys, torch.full((50,), sites.end)]))
    row, every = torch.tensor([0]), torch.arange(sites.end)
    found = SiteIndex.of(padded).windows(every, row, 1).found()
    assert torch.equal(found, SiteIndex.of(sites).windows(every, row, 1).found())
    own = SiteIndex.of(padded).windows(padded.keys, row, 1)
    assert own.sites(torch.zeros(110, dtype=torch.int64), torch.arange(110)).tolist() == [*range(60), *[60] * 50]
