import pytest
import torch
import torch.nn.functional as F

from src.models.horizon3d.sparse_neck import SparseNeck
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV
from tests.ops.maps import random_sites


def neck(*widths):
    torch.manual_seed(0)
    return SparseNeck(4, widths).eval()


def random_map(sites):
    return SparseBEV(sites, torch.randn(len(sites), 4, generator=torch.Generator().manual_seed(1)))


def on_dense_map(net, x):
    """The same pyramid by torch's own convolutions, on a map without an empty cell."""

    def conv(layer, x, **named):
        weight = layer.weight.unflatten(0, (3, 3)).permute(3, 2, 0, 1)
        return F.conv2d(x, weight, layer.bias, padding=1, **named)

    def norm(layer, x):
        return F.batch_norm(x, layer.running_mean, layer.running_var, layer.weight, layer.bias, eps=layer.eps)

    def go(level, x):
        if level == len(net.down):
            return x
        first, block = net.down[level]
        y = F.relu(norm(first.norm, conv(first.conv, x, stride=2)))
        residual = norm(block.bn2, conv(block.conv2, F.relu(norm(block.bn1, conv(block.conv1, y)))))
        y = go(level + 1, F.relu(y + residual))
        up = net.up[level]
        weight = up.conv.weight.unflatten(0, (3, 3)).permute(2, 3, 0, 1)
        return x + F.relu(norm(up.norm, F.conv_transpose2d(y, weight, stride=2, padding=1, output_padding=1)))

    return go(0, x)


def test_equals_a_dense_pyramid_where_every_cell_is_occupied():
    net, shape = neck(6, 8), (2, 8, 12)
    x = random_map(Sites.from_linear(torch.arange(torch.Size(shape).numel()), shape))
    torch.testing.assert_close(net(x).to_dense(), on_dense_map(net, x.to_dense()), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("widths", "first", "last"), [((6,), 59, 69), ((6, 8, 8), 29, 99)])
def test_a_cell_sees_as_far_as_its_coarsest_level(widths, first, last):
    """Cell 64 is below cell 32 of level 1, which sees 30 to 34, that is 59 to 69 of the map; and so on down."""
    net = neck(*widths)
    for parameter in net.parameters():
        parameter.data.abs_()  # with ReLUs that are all open
    x = random_map(Sites.from_linear(torch.arange(128), (1, 1, 128)))
    x.features.abs_().requires_grad_()
    net(x).features[64].sum().backward()
    seen = x.features.grad.abs().sum(1).nonzero().squeeze(1)
    assert (seen.min(), seen.max()) == (first, last)


def test_the_cells_stay_samples_do_not_mix_and_a_map_may_be_empty():
    net = neck(6, 8)
    both = random_map(random_sites((2, 16, 16), 90))
    out = net(both)
    assert out.sites is both.sites
    first = both.indices[:, 0] == 0
    alone = SparseBEV(Sites((2, 16, 16), both.sites.keys[first]), both.features[first])
    torch.testing.assert_close(out.features[first], net(alone).features)
    empty = net.train()(SparseBEV(Sites((2, 16, 16), both.sites.keys[:0]), both.features[:0]))
    assert empty.features.shape == (0, 4)
    empty.features.sum().backward()
    assert all(p.grad is not None for p in net.parameters())
