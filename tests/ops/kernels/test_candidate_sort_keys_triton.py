import pytest
import torch

from src.models.heads.fixed_decode import CLASS_TABLE
from src.ops.candidate_sort_keys import (
    candidate_sort_keys,
    candidate_sort_keys_reference,
    unpack_candidates,
    unpack_candidates_reference,
)
from src.ops.fixed_shapes import Capacities, FixedShapes, in_fixed_shapes
from src.ops.sites import Sites, padded_sites

SHAPE = (1, 12, 16)


@pytest.mark.parametrize("peaks", [False, True])
def test_ranks(device, peaks):
    """With padding that is not finite, and equal scores."""
    draw = torch.Generator().manual_seed(0)
    some = Sites.from_linear(torch.arange(0, 192).unfold(0, 2, 3).flatten(), SHAPE)
    with in_fixed_shapes(FixedShapes(Capacities(1, 1, 150, 1), SHAPE[1:])):
        keys = torch.cat([some.keys, torch.full((40,), some.end)])
        sites = padded_sites(keys, SHAPE)
        logits = torch.randint(-6, 6, (len(sites), 12), generator=draw).float()
        logits[len(some) :] = torch.nan
        wanted = candidate_sort_keys_reference(logits, sites, CLASS_TABLE, peaks)
        found = candidate_sort_keys(logits.to(device), Sites(SHAPE, sites.keys.to(device)), CLASS_TABLE, peaks).cpu()
    assert 0 < (wanted > 0).sum() < 12 * len(some) + 1 and len(sites) > len(some)
    (a, *own), (b, *others) = (unpack_candidates_reference(x, CLASS_TABLE, 12) for x in (found, wanted))
    torch.testing.assert_close(a, b)
    assert all(torch.equal(x, y) for x, y in zip(own, others, strict=True))


@pytest.mark.parametrize("count", [0, 50])
def test_candidates(device, count):
    scores = torch.rand(7, 90, generator=torch.Generator().manual_seed(1)) * (torch.arange(90) % 3 > 0)
    ranks = ((scores.view(torch.int32).long() << 31) - torch.arange(90)).topk(count, dim=1).values
    wanted = unpack_candidates_reference(ranks, CLASS_TABLE, 12)
    for value, expected in zip(unpack_candidates(ranks.to(device), CLASS_TABLE, 12), wanted, strict=True):
        assert torch.equal(value.cpu(), expected)
