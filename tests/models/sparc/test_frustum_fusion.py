"""Sparse frustum fusion: the cells on a vertical, both directions by a plain loop, cameras that are missing."""

import math

import pytest
import torch

from src.errors import ConfigError
from src.models.layers.views import CameraViews
from src.models.sparc.frustum_fusion import FrustumFusionConfig, SparseFrustumFusion
from src.models.sparc.point_transformer import RadarPoints
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV
from tests.models.frames import GRID, SIZE
from tests.models.surroundings import AXES, rigs

STRIDES = (8, 16, 32)


def make_fusion(stride=16):
    torch.manual_seed(0)
    config = FrustumFusionConfig(image_stride_px=stride, num_heights=4)
    fusion = SparseFrustumFusion(config, 6, 10, 8, STRIDES, GRID)
    torch.nn.init.normal_(fusion.place.weight)
    return fusion


def make_views():
    generator = torch.Generator().manual_seed(0)
    sizes = [(SIZE[0] // stride, SIZE[1] // stride) for stride in STRIDES]
    levels = [torch.randn(2, 4, 10, *size, generator=generator) for size in sizes]
    matrices = rigs(2, SIZE, AXES)
    return CameraViews(levels, matrices, torch.ones(2, 4, dtype=torch.bool), SIZE)


def make_radar():
    """One point a place, in cells of their own."""
    places = ((10.0, 2.0), (10.0, 2.4), (20.0, -3.0), (4.0, -9.0))
    xyz = torch.tensor([[x, y, 0.5 + 0.1 * number] for number, (x, y) in enumerate(places)])
    indices = torch.cat([torch.tensor([0, 0, 0, 1])[:, None], GRID.cell_of(xyz[:, :2])], dim=1)
    sites, order = Sites.from_indices(indices, (2, *GRID.cells))
    generator = torch.Generator().manual_seed(1)
    means = torch.cat([xyz, torch.zeros(len(xyz), 4)], dim=1)[order]
    return RadarPoints(SparseBEV(sites, torch.randn(len(xyz), 6, generator=generator)), means)


def literal_pairs(fusion, radar, views):
    """(point, cell, share of the band, share over the point, log range), point by point."""
    found, (h, w) = [], views.levels[fusion.level].shape[-2:]
    for point, (sample, mean) in enumerate(zip(radar.bev.indices[:, 0].tolist(), radar.means, strict=True)):
        for view in range(4):
            for step in range(fusion.num_heights):
                share = (step + 0.5) / fusion.num_heights
                place = torch.tensor([mean[0], mean[1], -3.0 + 8.0 * share, 1.0])
                u, v, depth, _ = (views.pix_from_aug[sample, view] @ place).tolist()
                if depth <= 0.5 or not (0 <= u / depth < SIZE[1] and 0 <= v / depth < SIZE[0]):
                    continue
                row, col = int(v / depth * h / SIZE[0]), int(u / depth * w / SIZE[1])
                cell = ((sample * 4 + view) * h + row) * w + col
                over = share - (float(mean[2]) + 3.0) / 8.0
                found.append((point, cell, share, over, math.log1p(float(mean[:2].norm()))))
    return found


def test_pairs_are_the_cells_on_each_vertical():
    fusion, radar, views = make_fusion(), make_radar(), make_views()
    pairs = fusion.pairs(radar, views)
    found = zip(pairs.points.tolist(), pairs.cells.tolist(), *pairs.places.T.tolist(), strict=True)
    wanted = literal_pairs(fusion, radar, views)
    for own, other in zip(sorted(found), sorted(wanted), strict=True):
        assert own == pytest.approx(other, abs=1e-5)
    assert len({point for point, *_ in wanted}) == 4 and (pairs.points.diff() >= 0).all()


def test_both_directions_are_softmaxes_over_their_pairs():
    fusion, radar, views = make_fusion(), make_radar(), make_views()
    points, fused = fusion(radar, views)
    pairs = literal_pairs(fusion, radar, views)
    level = views.levels[1].movedim(2, -1).flatten(0, 3)
    own = fusion.points(radar.bev.features)
    scores = [
        fusion.query(own[p]) @ (fusion.key(level[c]) + fusion.place(torch.tensor(rest))) / math.sqrt(8)
        for p, c, *rest in pairs
    ]
    wanted = []
    for point in range(4):
        mine = [k for k, pair in enumerate(pairs) if pair[0] == point]
        weights = torch.stack([scores[k] for k in mine]).softmax(0)
        taken = torch.stack([fusion.to_points(level[pairs[k][1]]) for k in mine])
        wanted.append(own[point] + weights @ taken)
    wanted = fusion.norm(torch.stack(wanted))
    torch.testing.assert_close(points.bev.features, wanted, atol=1e-5, rtol=1e-4)
    expected = level.clone()
    cells = {pair[1] for pair in pairs}
    assert len(cells) < len(pairs)  # some have two points
    for cell in cells:
        mine = [k for k, pair in enumerate(pairs) if pair[1] == cell]
        weights = torch.stack([scores[k] for k in mine]).softmax(0)
        expected[cell] += weights @ torch.stack([fusion.to_cells(wanted[pairs[k][0]]) for k in mine])
    torch.testing.assert_close(fused.levels[1].movedim(2, -1).flatten(0, 3), expected, atol=1e-5, rtol=1e-4)
    assert fused.levels[0] is views.levels[0] and fused.levels[2] is views.levels[2]


def test_a_missing_camera_takes_and_gives_nothing():
    fusion, radar, views = make_fusion(), make_radar(), make_views()
    views.valid[:, 0] = False
    points, fused = fusion(radar, views)
    assert torch.equal(fused.levels[1][:, 0], views.levels[1][:, 0])
    assert not torch.equal(fused.levels[1][:, 1], views.levels[1][:, 1])
    alone = fusion.norm(fusion.points(radar.bev.features))
    ahead = (radar.means[:, 0] > 5).nonzero().squeeze(1)
    torch.testing.assert_close(points.bev.features[ahead], alone[ahead])


def test_without_any_point_gradients_are_zero():
    fusion, views = make_fusion(), make_views()
    radar = make_radar()
    empty = RadarPoints(
        SparseBEV(Sites.from_linear(torch.zeros(0, dtype=torch.int64), (2, *GRID.cells)), radar.bev.features[:0]),
        radar.means[:0],
    )
    points, fused = fusion(empty, views)
    assert torch.equal(fused.levels[1], views.levels[1]) and len(points.bev) == 0
    (points.bev.features.sum() + fused.levels[1].sum()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in fusion.parameters())


def test_the_level_must_exist():
    with pytest.raises(ConfigError, match=r"image_stride_px=4.*\[8, 16, 32\]"):
        make_fusion(stride=4)
