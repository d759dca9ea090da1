import pytest
import torch
import torch.nn.functional as F

from src.models.lrs4fusion.late_encoder import (
    ACROSS_X,
    ACROSS_Y,
    PLANE,
    Aggregation3D,
    Completion,
    FusionStem,
    LateEncoder,
)
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseMap
from tests.ops.maps import random_sites

NORM = {"eps": 1e-3, "momentum": 0.1}
MANY = 10**6


def random_map(shape, count, channels):
    sites = random_sites(shape, count)
    return SparseMap(sites, torch.randn(len(sites), channels, generator=torch.Generator().manual_seed(1)))


def one_voxel():
    sites, _ = Sites.from_indices(torch.tensor([[0, 4, 4, 4]]), (1, 9, 9, 9))
    return SparseMap(sites, torch.ones(1, 2))


def test_completion_reaches_the_cells_of_its_kernels():
    """Along xy 9 cells of one layer; with all three kernels the offsets that their sums reach."""
    flat, dropped = Completion(2, (PLANE,), MANY, NORM)(one_voxel())
    assert dropped == 0 and (flat.indices[:, 1] == 4).all() and len(flat) == 9
    full, _ = Completion(2, (PLANE, ACROSS_Y, ACROSS_X), MANY, NORM)(one_voxel())
    apart = (full.indices[:, 1:] - 4).abs()
    assert len(full) == 5 * 5 * 5 and apart.max() == 2


def test_completion_is_the_dense_one_where_it_reaches():
    layer, x = Completion(2, (PLANE,), MANY, NORM).eval(), random_map((2, 4, 6, 7), 30, 2)
    y, _ = layer(x)
    conv = layer.layers[0].conv
    dense = F.conv3d(x.to_dense(), conv.weight.permute(2, 1, 0).unflatten(2, PLANE), padding=(0, 1, 1))
    rows = layer.layers[0].norm(dense.movedim(1, -1)[y.indices.unbind(1)])
    torch.testing.assert_close(y.features, F.leaky_relu(rows, 0.01))


def test_the_guard_counts_what_it_leaves_out_and_never_a_voxel_that_was_there():
    x = random_map((2, 6, 10, 10), 80, 2)
    free, _ = Completion(2, (PLANE,), MANY, NORM)(x)
    own = x.indices[:, 0].bincount()
    limit = int(own.max()) + 30
    kept, dropped = Completion(2, (PLANE,), limit, NORM)(x)
    assert dropped == len(free) - len(kept) > 0 and kept.indices[:, 0].bincount().tolist() == [limit, limit]
    assert (kept.sites.rows_of(x.indices) >= 0).all()
    through_three, lost = Completion(2, (PLANE, ACROSS_Y, ACROSS_X), limit, NORM)(x)
    assert len(through_three) == 2 * limit and lost > dropped


def test_aggregation_sums_two_branches_on_the_same_sites():
    layer, x = Aggregation3D(3, 5, NORM).eval(), random_map((2, 4, 6, 7), 60, 3)
    y = layer(x)
    assert y.sites is x.sites
    expected = 0
    for branch, kernels in zip(layer.branches, ((PLANE, ACROSS_Y), (ACROSS_X, PLANE)), strict=True):
        rows = x
        for number, (part, kernel) in enumerate(zip(branch, kernels, strict=True)):
            weight = part.conv.weight.permute(2, 1, 0).unflatten(2, kernel)
            dense = F.conv3d(rows.to_dense(), weight, padding=tuple(size // 2 for size in kernel))
            features = part.norm(dense.movedim(1, -1)[x.indices.unbind(1)])
            rows = x.with_features(F.leaky_relu(features, 0.01) if number == 0 else features)
        expected = expected + rows.features
    torch.testing.assert_close(y.features, expected)


def encoder(max_sites=(MANY,) * 4):
    torch.manual_seed(0)
    return LateEncoder(3, (4, 5, 6, 7), max_sites, NORM)


def test_four_scales_each_on_a_grid_half_as_fine():
    net, x = encoder(), random_map((2, 16, 16, 24), 50, 3)
    volumes = net(x)
    assert [v.sites.shape for v in volumes.scales] == [(2, 16, 16, 24), (2, 8, 8, 12), (2, 4, 4, 6), (2, 2, 2, 3)]
    assert [v.channels for v in volumes.scales] == [4, 5, 6, 7] and volumes.dropped == (0, 0, 0, 0)
    sum(v.features.square().sum() for v in volumes.scales).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.isfinite().all()] == []


def test_the_memory_joins_at_the_second_scale_before_its_aggregation():
    net, x = encoder().eval(), random_map((1, 16, 16, 16), 30, 3)
    seen = []

    def fuse(current):
        seen.append((current.sites.shape, current.channels))
        return current.with_features(current.features + 1)

    plain, fused = net(x), net(x, fuse)
    assert seen == [((1, 8, 8, 8), 4)]
    assert torch.equal(plain.scales[0].features, fused.scales[0].features)
    for before, after in zip(plain.scales[1:], fused.scales[1:], strict=True):
        assert torch.equal(before.sites.keys, after.sites.keys) and not torch.equal(before.features, after.features)


def test_sites_are_bounded_and_the_same_every_time():
    x = random_map((2, 16, 16, 16), 400, 3)
    limits = (500, 300, 100, 40)
    first, second = (encoder(limits)(x) for _ in range(2))
    for volume, again, limit in zip(first.scales, second.scales, limits, strict=True):
        assert volume.indices[:, 0].bincount().max() <= limit
        assert torch.equal(volume.sites.keys, again.sites.keys)
    assert first.dropped == second.dropped and min(first.dropped[:2]) > 0


def test_an_empty_map_goes_through():
    x = random_map((2, 16, 16, 16), 0, 3)
    stem, net = FusionStem(3, 4, 3, NORM), encoder()
    volumes = net(stem(x))
    assert [len(v) for v in volumes.scales] == [0] * 4
    sum(v.features.sum() for v in volumes.scales).backward()
    assert all(p.grad is not None for p in (*stem.parameters(), *net.parameters()))


@pytest.mark.parametrize("sensors", [1, 3])
def test_the_stem_keeps_its_sites(sensors):
    x = random_map((2, 4, 5, 6), 40, 3 * sensors)
    y = FusionStem(3 * sensors, 8, 5, NORM)(x)
    assert y.sites is x.sites and y.channels == 5 and (y.features >= 0).all()
