"""Backward projection: depth consistency at points by hand, the attention against loops, which cells change."""

import pytest
import torch
import torch.nn.functional as F

from src.models.hydra.depth_consistency import DepthConsistency, DepthConsistencyConfig
from src.models.layers.views import CameraViews
from src.targets.depth import lid_edges
from tests.models.frames import GRID, SIZE
from tests.models.surroundings import AXES, camera_matrices, rigs

LEVEL, BINS, RANGE_M = (4, 6), 16, (1.0, 40.0)
EDGES = lid_edges(RANGE_M, BINS).tolist()


def make_refinement():
    """With offsets, trust and weights that are no longer those of the start."""
    torch.manual_seed(0)
    module = DepthConsistency(DepthConsistencyConfig(num_queries=30, num_points=3), 8, 5, RANGE_M, GRID)
    for layer in (module.offset, module.attention.logits, module.foreground[1]):
        torch.nn.init.normal_(layer.weight, std=0.3)
    return module.eval()


def make_inputs():
    """Map, radar with pillars at every third cell, views with a missing camera, depth logits."""
    torch.manual_seed(1)
    fused, radar = torch.randn(2, 8, *GRID.cells), torch.rand(2, 4, *GRID.cells)
    radar[:, :, torch.arange(GRID.rows) % 3 != 0] = 0.0
    valid = torch.ones(2, 4, dtype=torch.bool)
    valid[1, 2] = False
    matrices = rigs(2, SIZE, AXES)
    matrices[1, 2] = 0.0
    views = CameraViews([torch.randn(2, 4, 5, *LEVEL)], matrices, valid, SIZE)
    return fused, radar, views, 3 * torch.randn(2, 4, BINS, *LEVEL)


def seen(point, matrix, valid):
    """(u, v, depth) of a point in a camera, None where it is not seen."""
    u, v, d = (matrix[:3].double() @ torch.cat([point.double(), torch.ones(1).double()])).tolist()
    if not valid or d <= 0.5 or not (0 <= u / d < SIZE[1] and 0 <= v / d < SIZE[0]):
        return None
    return u / d, v / d, d


def agreement(place, depth_logits):
    """d_P d_Q by its definition: a distribution of the pixel times one that is 1 at the bin of the point's depth."""
    u, v, d = place
    d_p = depth_logits[:, int(v * LEVEL[0] / SIZE[0]), int(u * LEVEL[1] / SIZE[1])].softmax(0)
    d_q = torch.tensor([float(low <= d < high) for low, high in zip(EDGES, EDGES[1:], strict=False)])
    return float(d_p @ d_q)


def test_depth_agrees_where_the_pixel_puts_the_point():
    """A camera that is sure of the bin of 20 m: points before it at 20 m, at 30 m, behind it, and beyond all bins."""
    module = make_refinement()
    views = CameraViews(
        [torch.zeros(1, 1, 5, *LEVEL)], camera_matrices(SIZE, AXES)[None, :1], torch.ones(1, 1).bool(), SIZE
    )
    logits = torch.zeros(1, 1, BINS, *LEVEL)
    sure = sum(20.0 >= edge for edge in EDGES) - 1
    logits[:, :, sure] = torch.tensor(BINS - 1.0).log()  # probability 1/2, every other bin 1/30
    points = torch.tensor([[20.0, 0.1, 2.1], [30.0, 0.1, 2.1], [-20.0, 0.1, 2.1], [60.0, 0.1, 2.1]])[None, None]
    found = module.consistency(points, torch.zeros(1, 1), views, logits)[0, 0, 0]
    torch.testing.assert_close(found, torch.tensor([0.5, 1 / 30, 0.0, 0.0]), rtol=1e-5, atol=1e-6)
    found = module.consistency(points, torch.full((1, 1), 0.2), views, logits)[0, 0, 0]
    torch.testing.assert_close(found, torch.tensor([0.6, 1 - 0.8 * 29 / 30, 0.2, 0.2]), rtol=1e-5, atol=1e-6)


def test_radar_vouches_only_where_it_returned_something():
    module, x = make_refinement(), torch.randn(1, 2, 8)
    trust = module.radar_weight(x, torch.tensor([[False, True]]))
    assert trust[0, 0] == 0.0
    torch.testing.assert_close(trust[0, 1], module.radar(x[0, 1]).sigmoid().squeeze())
    untrained = DepthConsistency(module.config, 8, 5, RANGE_M, GRID).radar_weight(
        torch.zeros(1, 1, 8), torch.ones(1, 1)
    )
    assert 0.05 < untrained.item() < 0.2


def by_hand(module, fused, radar, views, depth_logits):
    """Query by query, point by point."""
    (context,), attention, out = views.levels, module.attention, fused.clone()
    logits = F.interpolate(module.foreground(fused), size=GRID.cells, mode="bilinear").squeeze(1)
    heads, _, num_points = attention.per_view
    for b in range(len(fused)):
        camera = attention.camera(F.normalize(views.pix_from_aug[b, :, :3], dim=-1).flatten(1))  # [N, C]
        for key in logits[b].flatten().argsort(descending=True)[: module.config.num_queries].tolist():
            row, col = divmod(key, GRID.cols)
            x, centre = fused[b, :, row, col], GRID.centre_of(torch.tensor([row, col]))
            query = x + module.place(centre[None])[0]
            trust = torch.zeros(())
            if radar[b, :, row, col].any():
                trust = module.radar(x).sigmoid()
            scores, shares, samples = [], [], []
            for n in range(4):
                score = attention.logits(query) + F.linear(camera[n], attention.logits.weight)
                score = score.view(4, heads, num_points)[n]
                for p in range(num_points):
                    offset = module.offset(query).view(num_points, 3)[p]
                    point = torch.cat([centre, torch.tensor([-3.0 + 8.0 * (p + 0.5) / num_points])]) + 0.8 * offset
                    place = seen(point, views.pix_from_aug[b, n], views.valid[b, n])
                    if place is None:
                        continue
                    at = torch.tensor([[[[place[0] / SIZE[1], place[1] / SIZE[0]]]]]) * 2 - 1
                    values = module.value(context[b, n][None])
                    samples.append(F.grid_sample(values, at, align_corners=False).view(heads, -1))
                    scores.append(score[:, p])
                    shares.append(1 - (1 - agreement(place, depth_logits[b, n])) * (1 - trust))
            gathered = torch.zeros(8)
            if samples:
                weights = torch.stack(scores).softmax(0) * torch.stack([share.reshape(1) for share in shares])
                gathered = (weights[..., None] * torch.stack(samples)).sum(0).flatten()
            x = module.norm(x + attention.output(gathered))
            out[b, :, row, col] += module.mlp(x)
    return out


def test_foreground_cells_sample_the_images_where_depth_agrees():
    """In many views, in one, in none; with and without radar; a missing camera."""
    module, inputs = make_refinement(), make_inputs()
    with torch.no_grad():
        found, logits = module(*inputs)
        wanted = by_hand(module, *inputs)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    changed = (found != inputs[0]).any(1)
    best = torch.zeros(2, logits[0].numel(), dtype=torch.bool)
    best.scatter_(1, logits.flatten(1).topk(30).indices, True)
    assert torch.equal(changed.flatten(1), best)


@pytest.mark.parametrize("radar_too", [False, True])
def test_what_the_images_show_at_other_depths_does_not_matter(radar_too):
    """All pixels are sure of the nearest bin, in which no cell's vertical lies; then radar alone opens the images."""
    module, (fused, radar, views, logits) = make_refinement(), make_inputs()
    torch.nn.init.zeros_(module.offset.weight)
    logits = torch.full_like(logits, -1e4)
    logits[:, :, 0] = 0.0
    radar = torch.ones_like(radar) if radar_too else torch.zeros_like(radar)
    with torch.no_grad():
        one, _ = module(fused, radar, views, logits)
        views.levels[0] = 2 * views.levels[0] + 1
        two, _ = module(fused, radar, views, logits)
    assert torch.equal(one, two) != radar_too


def test_gradients_reach_depth_images_and_every_parameter():
    module, (fused, radar, views, logits) = make_refinement().train(), make_inputs()
    inputs = [fused, views.levels[0], logits]
    for x in inputs:
        x.requires_grad_()
    refined, foreground = module(fused, radar, views, logits)
    (refined.square().sum() + foreground.sum()).backward()
    assert all(x.grad.any() and x.grad.isfinite().all() for x in (*inputs, *module.parameters()))
