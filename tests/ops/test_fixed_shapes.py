"""Sets of stated capacity hold what sets of any size do, padding behind them, and say when they overflow."""

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.geometry.ragged import enumerate_items, enumerate_some
from src.ops.fixed_shapes import Capacities, FixedShapes, fixed_shapes, in_fixed_shapes
from src.ops.kernel_maps import pruned_map, strided_map, submanifold_map, temporal_map
from src.ops.nms import maxpool_peaks
from src.ops.sites import Sites, union
from src.ops.sparse_conv import sparse_conv
from src.ops.splat import splat_gaussians
from src.ops.voxelize import voxelize

GRID = BEVGrid(cells=(24, 20), cell_m=0.8, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))


def shapes(points=100, voxels=400, cells=400, pairs=6000):
    return FixedShapes(Capacities(points, voxels, cells, pairs), GRID.cells)


def random_cells(shape, count, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randint(0, size, (count,), generator=generator) for size in shape], 1)


def padded(indices, count, samples):
    """With cells of a sample that does not exist behind them."""
    behind = torch.zeros(count, indices.shape[1], dtype=torch.int64)
    behind[:, 0] = samples
    return torch.cat([indices, behind])


def assert_padded(sites, wanted):
    assert torch.equal(sites.keys[: len(wanted)], wanted.keys) and len(sites) > len(wanted)
    assert (sites.keys[len(wanted) :] == sites.end).all()


def test_distinct_keys_by_hand():
    fixed = shapes()
    keys = torch.tensor([7, 3, 90, 3, 50, 12, 7])  # from 50 on there is no cell
    assert fixed.distinct(keys, 50, 5).tolist() == [3, 7, 12, 50, 50, 50] and not fixed.overflow()
    assert fixed.distinct(keys, 50, 3).tolist() == [3, 7, 12, 50] and not fixed.overflow()
    assert fixed.distinct(keys, 50, 2).tolist() == [3, 7, 12] and fixed.overflow()


def test_the_context_ends():
    with in_fixed_shapes(shapes()) as fixed:
        assert fixed_shapes() is fixed
    assert fixed_shapes() is None


def test_some_items_by_hand():
    counts = torch.tensor([2, 0, 3])
    owners, places, total = enumerate_some(counts, 7)
    wanted = enumerate_items(counts)
    assert owners.tolist() == wanted[0].tolist() + [3, 3] and places[:5].tolist() == wanted[1].tolist()
    assert total.tolist() == [5] and enumerate_some(counts, 4)[2].tolist() == [5]


@pytest.mark.parametrize("shape", [(2, 24, 20), (2, 6, 24, 20)])
def test_sets_and_convolutions_are_those_of_varying_shapes(shape):
    indices = random_cells(shape, 150, 0)
    wanted, wanted_rows = Sites.unique(indices, shape)
    ndim = len(shape) - 1
    with in_fixed_shapes(shapes()) as fixed:
        sites, rows = Sites.unique(padded(indices, 9, shape[0]), shape)
        assert_padded(sites, wanted)
        assert torch.equal(rows[:150], wanted_rows) and (rows[150:] >= len(wanted)).all()
    generator = torch.Generator().manual_seed(1)
    features = torch.randn(len(sites), 5, generator=generator)
    weights = torch.randn(5**ndim, 5, 4, generator=generator)
    wide = torch.rand(len(sites), generator=generator) > 0.5
    builds = {
        "submanifold": lambda of: (submanifold_map(of, 3), of),
        "strided": lambda of: strided_map(of, 3, 2, 1),
        "dilating": lambda of: strided_map(of, 3, 1, 1),
        "reaching far": lambda of: strided_map(of, 5, 2, 1),
        "pruned": lambda of: pruned_map(of, wide[: len(of)], 3, 2, 1),
    }
    if ndim == 3:
        builds["temporal"] = lambda of: temporal_map(of, 3, (2, 1, 1), 1)
    for name, build in builds.items():
        kernel_map, out = build(wanted)
        weight = weights[: kernel_map.num_offsets]
        truth = sparse_conv(features[: len(wanted)], weight, kernel_map)
        with in_fixed_shapes(shapes(voxels=3000, cells=1000)) as fixed:
            fixed_map, fixed_out = build(sites)
            found = sparse_conv(features, weight, fixed_map)
            assert name == "submanifold" or not fixed.overflow(), name
        if name != "submanifold":
            assert_padded(fixed_out, out)
        torch.testing.assert_close(found[: len(truth)], truth)
        assert found.isfinite().all()


def test_a_union_is_that_of_varying_shapes():
    shape = (1, *GRID.cells)
    parts = [random_cells(shape, 60, seed) for seed in (0, 1)]
    joint, *wanted = union(*(Sites.unique(part, shape)[0] for part in parts))
    with in_fixed_shapes(shapes()):
        own = [Sites.unique(padded(part, 3, 1), shape)[0] for part in parts]
        found, *rows = union(*own)
    assert_padded(found, joint)
    for mine, theirs in zip(rows, wanted, strict=True):
        assert torch.equal(mine[: len(theirs)], theirs) and (mine[len(theirs) :] >= len(joint)).all()


def test_voxels_leave_out_points_outside():
    generator = torch.Generator().manual_seed(3)
    points = torch.rand(80, 2, generator=generator) * 18 - 8
    points[5], points[6] = 1e6, torch.nan
    owners = torch.zeros(80, dtype=torch.int64)
    arguments = (points, points, owners, (GRID.x_min_m, GRID.y_min_m), (0.8, 0.8), GRID.cells, 1)
    wanted, means, counts = voxelize(*arguments)
    with in_fixed_shapes(shapes()):
        sites, found, numbers = voxelize(*arguments)
    assert_padded(sites, wanted)
    torch.testing.assert_close(found[: len(wanted)], means)
    assert torch.equal(numbers[: len(wanted)], counts)


def test_peaks_see_no_padding():
    shape = (1, *GRID.cells)
    cells = random_cells(shape, 90, 4)
    wanted = Sites.unique(cells, shape)[0]
    scores = torch.rand(121, 3, generator=torch.Generator().manual_seed(0))
    with in_fixed_shapes(shapes()):
        sites = Sites.unique(padded(cells, 30, 1), shape)[0]
        found = maxpool_peaks(scores[: len(sites)], sites)
    assert torch.equal(found[: len(wanted)], maxpool_peaks(scores[: len(wanted)], wanted))


def gaussians():
    count, generator = 30, torch.Generator().manual_seed(5)
    means = torch.rand(count, 2, generator=generator) * 20 - 10
    angle = 6 * torch.rand(count, generator=generator)
    return {
        "means": means,
        "scales": 0.3 + torch.rand(count, 2, generator=generator),
        "directions": torch.stack([angle.cos(), angle.sin()], 1),
        "opacity_logits": torch.randn(count, generator=generator),
        "features": torch.randn(count, 4, generator=generator),
        "batch": torch.arange(count) * 2 // count,
    }


def splat(parts, max_cells=2000):
    return splat_gaussians(
        **parts, grid=GRID, batch_size=2, threshold=0.1, max_cells=max_cells, support_sigmas=3.0
    )  # fmt: skip


def test_a_splat_is_that_of_varying_shapes():
    parts = gaussians()
    parts["means"][7] = 1e6  # one that is nowhere
    wanted = splat(parts)
    with in_fixed_shapes(shapes(cells=2000)) as fixed:
        found = splat(parts)
        assert not fixed.overflow()
    assert_padded(found.occupied, wanted.occupied)
    torch.testing.assert_close(found.features[: len(wanted.features)], wanted.features)
    torch.testing.assert_close(found.occupancy.index_select(0, wanted.support), wanted.occupancy)
    assert torch.equal(found.peak_cell, wanted.peak_cell) and found.peak_cell[7] == -1
    torch.testing.assert_close(found.peak_contribution, wanted.peak_contribution)
    assert (found.features[len(wanted.features) :] == 0).all()


@pytest.mark.parametrize(("room", "max_cells"), [({"pairs": 100}, 2000), ({"cells": 40}, 2000), ({}, 30)])
def test_a_splat_beyond_its_capacity_says_so(room, max_cells):
    with in_fixed_shapes(shapes(**room)) as fixed:
        splat(gaussians(), max_cells)
        assert fixed.overflow()
