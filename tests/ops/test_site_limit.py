import pytest
import torch

from src.ops.kernel_maps import strided_map
from src.ops.site_limit import limit_sites
from src.ops.sites import Sites
from src.ops.sparse_conv import sparse_conv
from tests.ops.maps import random_sites


def test_own_sites_stay_first_then_those_that_most_reach():
    """Three cells in a row, one alone: between and beside the three there are cells that 3, 2 and 1 of them reach."""
    before, _ = Sites.from_indices(torch.tensor([[0, 2, 2], [0, 2, 3], [0, 2, 4], [0, 6, 6]]), (1, 8, 8))
    kernel_map, after = strided_map(before, 3, 1, 1)
    assert len(after) == 15 + 9
    own = [[0, 2, 2], [0, 2, 3], [0, 2, 4], [0, 6, 6]]
    for limit, added in ((4, []), (6, [[0, 1, 3], [0, 3, 3]]), (7, [[0, 1, 3], [0, 3, 3], [0, 1, 2]])):
        pruned, sites = limit_sites(kernel_map, before, after, limit)
        assert sites.indices().tolist() == sorted(own + added) and pruned.num_outputs == limit
    assert limit_sites(kernel_map, before, after, 24) == (kernel_map, after)


def test_each_sample_has_its_limit_and_what_stays_is_convolved_as_before():
    before = random_sites((2, 4, 9, 9), 60)
    kernel_map, after = strided_map(before, (1, 3, 3), 1, (0, 1, 1))
    samples = after.indices()[:, 0]
    limit = int((samples == 0).sum()) - 20
    pruned, sites = limit_sites(kernel_map, before, after, limit)
    kept = sites.indices()[:, 0]
    assert (kept == 0).sum() == limit and (kept == 1).sum() == min(limit, int((samples == 1).sum()))
    generator = torch.Generator().manual_seed(0)
    features, weight = (torch.randn(*size, generator=generator).double() for size in ((60, 2), (9, 2, 3)))
    rows = after.rows_of(sites.indices())
    torch.testing.assert_close(sparse_conv(features, weight, pruned), sparse_conv(features, weight, kernel_map)[rows])
    again = limit_sites(kernel_map, before, after, limit)[1]
    assert torch.equal(again.keys, sites.keys)


def test_it_is_for_one_grid():
    before = random_sites((1, 6, 6), 12)
    with pytest.raises(ValueError, match="needs one grid"):
        limit_sites(*[strided_map(before, 3, 2, 1)[0], before, strided_map(before, 3, 2, 1)[1]], limit=3)
