import pytest
import torch
import torch.nn.functional as F
from torch import nn

from src.models.layers.sparse import (
    ConvNormReLU,
    PrunedSparseConv,
    ResidualBlock,
    RowBatchNorm,
    SparseConv,
    SparseInverseConv,
    SparseKernel,
    SubmanifoldConv,
)
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV, SparseMap

CONV = {2: F.conv2d, 3: F.conv3d}
SHAPES = {2: (2, 9, 7), 3: (2, 5, 6, 7)}


def random_map(ndim: int, channels: int, count: int = 30) -> SparseMap:
    generator = torch.Generator().manual_seed(0)
    shape = SHAPES[ndim]
    linear = torch.randperm(torch.Size(shape).numel(), generator=generator)[:count].sort().values
    features = torch.randn(count, channels, generator=generator)
    return (SparseBEV if ndim == 2 else SparseMap)(Sites.from_linear(linear, shape), features)


def dense_weight(conv: SparseKernel) -> torch.Tensor:
    return conv.weight.permute(2, 1, 0).unflatten(2, conv.kernel_size)


@pytest.mark.parametrize("ndim", [2, 3])
def test_submanifold_convolution_is_the_dense_one_on_its_sites(ndim: int) -> None:
    conv, x = SubmanifoldConv(3, 5, 3, ndim, bias=True), random_map(ndim, 3)
    y = conv(x)
    assert y.sites is x.sites and type(y) is type(x)
    dense = CONV[ndim](x.to_dense(), dense_weight(conv), conv.bias, padding=1)
    torch.testing.assert_close(y.features, _at(dense, y))


@pytest.mark.parametrize("ndim", [2, 3])
@pytest.mark.parametrize("stride", [1, 2])
def test_sparse_convolution_is_the_dense_one_wherever_a_site_reaches(ndim: int, stride: int) -> None:
    conv, x = SparseConv(3, 5, 3, ndim, bias=False, stride=stride), random_map(ndim, 3, count=6)
    y = conv(x)
    dense = CONV[ndim](x.to_dense(), dense_weight(conv), stride=stride, padding=1)
    torch.testing.assert_close(y.to_dense(), dense)
    touched = CONV[ndim](x.with_features(torch.ones(6, 1)).to_dense(), torch.ones(1, 1, *[3] * ndim), None, stride, 1)
    assert len(y) == touched.count_nonzero()


def _at(dense: torch.Tensor, where: SparseMap) -> torch.Tensor:
    batch, *cell = where.indices.unbind(1)
    return dense.movedim(1, -1)[(batch, *cell)]


def test_weights_start_like_those_of_a_dense_convolution() -> None:
    torch.manual_seed(0)
    ours, torch_own = SubmanifoldConv(32, 64, 3, 2, bias=True), nn.Conv2d(32, 64, 3)
    assert ours.weight.shape == (9, 32, 64)
    assert ours.weight.std().item() == pytest.approx(torch_own.weight.std().item(), rel=0.02)
    assert ours.weight.abs().max().item() == pytest.approx(torch_own.weight.abs().max().item(), rel=0.01)
    assert ours.bias.abs().max() <= 1 / (9 * 32) ** 0.5


def test_row_norm_is_batch_norm_over_rows() -> None:
    ours, reference = RowBatchNorm(4, eps=1e-3, momentum=0.01), nn.BatchNorm1d(4, eps=1e-3, momentum=0.01)
    x = torch.randn(20, 4) * 3 + 1
    torch.testing.assert_close(ours(x), reference(x))
    torch.testing.assert_close(ours.running_var, reference.running_var)


@pytest.mark.parametrize("rows", [0, 1])
def test_row_norm_without_statistics_uses_the_running_ones(rows: int) -> None:
    norm = RowBatchNorm(4, eps=1e-3, momentum=0.01).train()
    norm(torch.randn(20, 4) * 3 + 1)
    before = {name: value.clone() for name, value in norm.named_buffers()}
    x = torch.randn(rows, 4)
    y = norm(x)
    assert all(torch.equal(value, before[name]) for name, value in norm.named_buffers())
    torch.testing.assert_close(y, norm.eval()(x))
    y.sum().backward()
    assert norm.weight.grad is not None and norm.bias.grad.tolist() == [float(rows)] * 4


@pytest.mark.parametrize("ndim", [2, 3])
def test_residual_block(ndim: int) -> None:
    block, x = ResidualBlock(4, ndim, eps=1e-3, momentum=0.01), random_map(ndim, 4)
    hidden = x.with_features(F.relu(block.bn1(block.conv1(x).features)))
    expected = F.relu(x.features + block.bn2(block.conv2(hidden).features))
    y = block(x)
    torch.testing.assert_close(y.features, expected)
    (y.features**2).sum().backward()
    biases = {"conv1.bias", "conv2.bias"}  # batch norm removes them in training: their gradient is zero up to rounding
    assert [n for n, p in block.named_parameters() if p.grad is None or (n not in biases and not p.grad.any())] == []


def test_samples_do_not_mix() -> None:
    layer = ConvNormReLU(SparseConv(3, 4, 3, 2, bias=False), eps=1e-3, momentum=0.1).eval()
    x = random_map(2, 3)
    second = x.indices[:, 0] == 1
    y = layer(x)
    z = layer(x.with_features(torch.where(second[:, None], 7.0, x.features)))
    changed = (y.features != z.features).any(1)
    assert changed[y.indices[:, 0] == 1].any() and not changed[y.indices[:, 0] == 0].any()


def test_map_without_sites() -> None:
    empty = random_map(3, 3, count=0)
    layers = nn.Sequential(
        ConvNormReLU(SubmanifoldConv(3, 4, 3, 3, bias=False), eps=1e-3, momentum=0.1),
        ConvNormReLU(SparseConv(4, 4, 3, 3, bias=False, stride=2), eps=1e-3, momentum=0.1),
        ResidualBlock(4, 3, eps=1e-3, momentum=0.1),
    )
    y = layers(empty)
    assert y.features.shape == (0, 4) and y.sites.shape == (2, 3, 3, 4)
    y.features.sum().backward()
    assert all(p.grad is not None and not p.grad.any() for p in layers.parameters())


@pytest.mark.parametrize("kernel", [(1, 3, 3), (3, 1, 3), (3, 3, 1), (1, 5, 5), (1, 1, 3)])
def test_kernels_of_any_shape_are_the_dense_ones(kernel: tuple[int, ...]) -> None:
    """The default padding is half the kernel, axis by axis, so the grid keeps its size."""
    x, padding = random_map(3, 3), tuple(size // 2 for size in kernel)
    same, dilating = SubmanifoldConv(3, 5, kernel, 3, bias=True), SparseConv(3, 5, kernel, 3, bias=True)
    assert same.weight.shape == (torch.Size(kernel).numel(), 3, 5)
    for conv, sites in ((same, x.sites), (dilating, dilating(x).sites)):
        dense = F.conv3d(x.to_dense(), dense_weight(conv), conv.bias, padding=padding)
        torch.testing.assert_close(conv(x).features, dense.movedim(1, -1)[sites.indices().unbind(1)])
    reached = F.conv3d(x.with_features(torch.ones(len(x), 1)).to_dense(), torch.ones(1, 1, *kernel), padding=padding)
    assert torch.equal(dilating(x).indices, reached.squeeze(1).nonzero())


def test_a_kernel_of_wrong_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"kernel_size=\(3, 3\): expected one number or 3"):
        SubmanifoldConv(3, 5, (3, 3), 3, bias=False)


@pytest.mark.parametrize("ndim", [2, 3])
def test_inverse_convolution_leads_back_to_the_finer_sites(ndim: int) -> None:
    down = SparseConv(3, 4, 3, ndim, bias=False, stride=2)
    up, x = SparseInverseConv(4, 5, 3, ndim, bias=True, stride=2), random_map(ndim, 3)
    coarse = down(x)
    fine = up(coarse, x.sites)
    assert fine.sites is x.sites and type(fine) is type(x)
    extra = [size - (2 * low - 1) for size, low in zip(x.sites.shape[1:], coarse.sites.shape[1:], strict=True)]
    transposed = {2: F.conv_transpose2d, 3: F.conv_transpose3d}[ndim]
    weight = up.weight.permute(1, 2, 0).unflatten(2, up.kernel_size)  # [in, out, k...]
    dense = transposed(coarse.to_dense(), weight, up.bias, stride=2, padding=1, output_padding=extra)
    torch.testing.assert_close(fine.features, dense.movedim(1, -1)[x.indices.unbind(1)])
    layer = ConvNormReLU(up, eps=1e-3, momentum=0.1)
    layer(coarse, x.sites).features.sum().backward()
    assert all(p.grad is not None for p in (*layer.parameters(), down.weight))


def test_leaky_relu() -> None:
    conv = SubmanifoldConv(3, 4, 3, 2, bias=False)
    leaky, plain = (ConvNormReLU(conv, 1e-3, 0.1, negative_slope=slope).eval() for slope in (0.01, 0.0))
    x = random_map(2, 3)
    before = leaky.norm(conv(x).features)
    assert (before < 0).any() and (before > 0).any()
    torch.testing.assert_close(leaky(x).features, torch.where(before > 0, before, 0.01 * before))
    torch.testing.assert_close(plain(x).features, before.clamp(min=0))


def test_the_faintest_sites_of_every_sample_do_not_dilate() -> None:
    """Of five sites the two faintest reach only their own cell; those of the other sample rank among themselves."""
    cells = torch.tensor([[0, 0], [0, 6], [0, 10], [0, 15], [0, 20], [1, 3], [1, 15]])
    sites = Sites.from_indices(cells, (2, 24))[0]
    magnitudes = torch.tensor([5.0, -4.0, 1.0, 2.0, 3.0, 0.1, 0.2])
    layer = PrunedSparseConv(2, 3, 3, 1, bias=False, stride=2, pruning_ratio=0.5)
    found = layer(SparseMap(sites, magnitudes[:, None] * torch.tensor([[1.0, -1.0]])))
    # An even cell has one output, an odd one two, of which the lower is its own.
    assert found.indices.tolist() == [[0, 0], [0, 3], [0, 5], [0, 7], [0, 10], [1, 1], [1, 7], [1, 8]]
