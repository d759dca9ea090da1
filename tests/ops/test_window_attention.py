import math

import torch

from src.ops.kernel_maps import window_map
from src.ops.window_attention import window_attention
from tests.ops.maps import random_sites

PAST, NOW = random_sites((2, 3, 5, 6), 40), random_sites((2, 3, 5, 6), 50, seed=1)


def operands():
    generator = torch.Generator().manual_seed(0)
    sizes = ((50, 2, 4), (40, 2, 4), (40, 2, 4))
    return [torch.randn(*size, dtype=torch.float64, generator=generator, requires_grad=True) for size in sizes]


def test_it_is_masked_attention_over_all_pairs():
    """Dense softmax over all remembered sites, those outside the window masked; nothing where all are."""
    q, k, v = operands()
    apart = (NOW.indices()[:, None] - PAST.indices()[None]).abs()
    seen = (apart <= torch.tensor([0, 1, 1, 1])).all(2)  # [50, 40]
    scores = torch.einsum("ihd,jhd->hij", q, k) / math.sqrt(4)
    weights = scores.masked_fill(~seen, -torch.inf).softmax(2).nan_to_num(0.0)
    expected = torch.einsum("hij,jhd->ihd", weights, v)
    found = window_attention(q, k, v, window_map(PAST, NOW, 3))
    torch.testing.assert_close(found, expected)
    alone = ~seen.any(1)
    assert alone.any() and not found[alone].any()


def test_gradients():
    window = window_map(PAST, NOW, 3)
    assert torch.autograd.gradcheck(lambda q, k, v: window_attention(q, k, v, window), operands())


def test_large_scores_do_not_overflow_and_nothing_remembered_gives_zeros():
    q, k, v = (x.detach().float() for x in operands())
    assert window_attention(1e4 * q, 1e4 * k, v, window_map(PAST, NOW, 3)).isfinite().all()
    nothing = random_sites((2, 3, 5, 6), 0)
    out = window_attention(q, k[:0], v[:0], window_map(nothing, NOW, 3))
    assert out.shape == (50, 2, 4) and not out.any()
