"""Gated fusion of two sparse maps against its layers on dense maps, and its gradients."""

import pytest
import torch
import torch.nn.functional as F

from src.ops.gated_fusion import gated_fusion_conv
from src.ops.sites import Sites

SHAPE, C, OUT = (2, 5, 6), 2, 3
GAUSSIAN = [[0, 1, 1], [0, 1, 2], [0, 4, 5], [1, 0, 0]]
RADAR = [[0, 1, 2], [0, 2, 2], [1, 0, 1]]  # one cell of both


def sites_of(cells):
    return Sites.from_indices(torch.tensor(cells, dtype=torch.int64).reshape(-1, 3), SHAPE)[0]


def draw(*size):
    return torch.randn(*size, generator=torch.Generator().manual_seed(sum(size)), dtype=torch.float64)


def weights(kernel_size):
    gates = [(draw(kernel_size**2, 2 * C, C) + number, draw(C) * number) for number in range(2)]
    return gates, draw(9, 2 * C, OUT), draw(OUT), draw(2 * C, OUT)


def dense(features, sites):
    return features.new_zeros(*SHAPE, features.shape[1]).index_put(tuple(sites.indices().T), features).movedim(-1, 1)


def convolved(x, weight, bias=None):
    """On a whole map: [k * k, in, out] as [out, in, k, k]."""
    size = int(len(weight) ** 0.5)
    return F.conv2d(x, weight.unflatten(0, (size, size)).permute(3, 2, 0, 1), bias, padding=size // 2)


@pytest.mark.parametrize("kernel_size", [1, 3])
@pytest.mark.parametrize(("gaussian", "radar"), [(GAUSSIAN, RADAR), (GAUSSIAN, []), ([], RADAR), ([], [])])
def test_it_is_its_layers_on_the_union(kernel_size, gaussian, radar):
    sites = (sites_of(gaussian), sites_of(radar))
    features = tuple(draw(len(own), C) for own in sites)
    gates, weight, bias, shortcut = weights(kernel_size)
    joint, found, addends = gated_fusion_conv(features, sites, gates, weight, bias, shortcut)
    union = sorted({tuple(cell) for cell in (*gaussian, *radar)})
    assert [tuple(cell) for cell in joint.indices().tolist()] == union
    maps = [dense(x, own) for x, own in zip(features, sites, strict=True)]
    pair = torch.cat(maps, 1)
    gated = [x * convolved(pair, *gate).sigmoid() for x, gate in zip(maps, gates, strict=True)]
    places = joint.indices().unbind(1)
    expected = convolved(torch.cat(gated, 1), weight, bias).movedim(1, -1)[places]
    torch.testing.assert_close(found, expected)
    for mine, x, matrix in zip(addends, gated, shortcut.chunk(2), strict=True):
        torch.testing.assert_close(mine, x.movedim(1, -1)[places] @ matrix)


@pytest.mark.parametrize("kernel_size", [1, 3])
def test_gradients(kernel_size):
    sites = (sites_of(GAUSSIAN), sites_of(RADAR))
    gates, *others = weights(kernel_size)
    inputs = [*(draw(len(own), C) for own in sites), *gates[0], *gates[1], *others]

    def op(a, b, w0, b0, w1, b1, weight, bias, shortcut):
        _, found, addends = gated_fusion_conv((a, b), sites, ((w0, b0), (w1, b1)), weight, bias, shortcut)
        return found, *addends

    assert torch.autograd.gradcheck(op, [value.requires_grad_() for value in inputs])
