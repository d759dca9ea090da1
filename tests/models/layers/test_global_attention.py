"""Attention to everything valid, against sums written out."""

import math

import torch

from src.models.layers.global_attention import GlobalAttention


@torch.no_grad()
def test_attention_is_a_softmax_over_all_valid_keys():
    torch.manual_seed(0)
    part = GlobalAttention(8, 2)
    query, key, value = torch.randn(2, 3, 8), torch.randn(2, 5, 8), torch.randn(2, 5, 8)
    valid = torch.tensor([[True, False, True, True, False], [False] * 5])
    found = part(query, key, value, valid)
    q, k, v = part.query(query)[0], part.key(key)[0], part.value(value)[0]
    for row in range(3):
        heads = []
        for head in (slice(0, 4), slice(4, 8)):
            scores = [float(q[row, head] @ k[j, head]) / 2.0 for j in (0, 2, 3)]
            total = sum(map(math.exp, scores))
            heads.append(sum(math.exp(s) / total * v[j, head] for s, j in zip(scores, (0, 2, 3), strict=True)))
        torch.testing.assert_close(found[0, row], part.output(torch.cat(heads)))
    torch.testing.assert_close(found[1], part.output.bias.expand(3, 8))
    key[:, 1], value[:, 4] = 1e3, -1e3
    torch.testing.assert_close(part(query, key, value, valid), found)
