"""Height association: which column and depth bin a pillar is seen in, attention against loops, what must not matter."""

import math

import pytest
import torch

from src.models.hydra.height_association import HeightAssociation
from src.models.layers.views import CameraViews
from src.targets.depth import lid_edges
from tests.models.camera_radar_frames import hydra_model, radar_map
from tests.models.frames import GRID, SIZE, make_batch
from tests.models.surroundings import AXES, camera_matrices

LEVEL = (4, 6)  # h, w
CELLS = [(0, 24, 60), (0, 30, 55), (0, 30, 56), (0, 10, 40), (0, 40, 3), (0, 20, 2), (1, 33, 33), (1, 2, 60)]


def make_association():
    torch.manual_seed(0)
    config = hydra_model().config.view_transform
    return HeightAssociation(config, 6, 4, LEVEL[0], GRID).eval()


def turned_cameras():
    """Four cameras of each sample whose images are turned by 5 degrees, as augmentation turns them; one is missing."""
    angle = math.radians(5.0)
    turn = torch.eye(4)
    turn[:2, :2] = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    matrices = (turn @ camera_matrices(SIZE, AXES)).repeat(2, 1, 1, 1)
    valid = torch.ones(2, 4, dtype=torch.bool)
    valid[0, 1], matrices[0, 1] = False, torch.nan
    return matrices, valid


def column_and_bin(row, col, matrix, edges):
    """Where a camera sees a pillar: points every mm of the vertical, that on the middle row counts; None outside."""
    z = torch.arange(-40.0, 40.0, 1e-3, dtype=torch.float64)
    x, y = GRID.centre_of(torch.tensor([row, col]), torch.float64)
    points = torch.stack([x.expand_as(z), y.expand_as(z), z, torch.ones_like(z)], 1)
    u, v, d = (points @ matrix.double()[:3].t()).unbind(1)
    best = (v - SIZE[0] / 2 * d).abs().argmin()
    u, d = float(u[best] / d[best]), float(d[best])
    if not (edges[0] <= d < edges[-1] and 0 <= u < SIZE[1]):
        return None
    return int(u * LEVEL[1] / SIZE[1]), sum(d >= edge for edge in edges.tolist()) - 1


def attend(module, query, keys, values):
    """Multi-head attention of rows, head by head: [q, C], [k, C], [k, C]."""
    q, k, v = module.query(query), module.key(keys), module.value(values)
    size, heads = q.shape[1] // module.num_heads, []
    for head in range(module.num_heads):
        part = slice(head * size, (head + 1) * size)
        heads.append((q[:, part] @ k[:, part].t() / math.sqrt(size)).softmax(1) @ v[:, part])
    return module.output(torch.cat(heads, 1))


def by_hand(module, level, bev, cells, matrices, valid):
    """Column by column, with the returns that it looks at and no other."""
    out, edges = level.clone(), lid_edges(module.depth_range, module.num_bins, torch.float64)
    for b, n in valid.nonzero().tolist():
        seen = {}
        for sample, row, col in cells:
            place = column_and_bin(row, col, matrices[b, n], edges) if sample == b else None
            if place is not None:
                seen.setdefault(place, []).append(module.returns(bev[b, :, row, col]))
        for column in range(LEVEL[1]):
            pixels = module.pixels(level[b, n, :, :, column].t())  # [h, width]
            places, x = pixels + module.row_embedding, pixels
            bins = sorted(k for j, k in seen if j == column)
            gathered = module.to_pixels.output.bias
            if bins:
                returns = torch.stack([torch.stack(seen[column, k]).mean(0) for k in bins])
                at = module.bin_embedding[bins]
                found = module.norms[0](returns + attend(module.to_returns, returns + at, places, x))
                gathered = attend(module.to_pixels, places, found + at, found)
            x = module.norms[1](x + gathered)
            x = module.norms[2](x + module.mlp(x))
            out[b, n, :, :, column] += module.output(x).t()
    return out


@pytest.mark.parametrize("cells", [CELLS, CELLS[:6], []])
def test_a_column_and_the_returns_of_its_ray_attend_to_each_other(cells):
    """Two pillars in one bin, none in a sample, none at all; turned images, a missing camera."""
    module, bev = make_association(), radar_map(cells)
    matrices, valid = turned_cameras()
    level = torch.randn(2, 4, 6, *LEVEL)
    with torch.no_grad():
        found = module(CameraViews([level], matrices, valid, SIZE), bev).view_as(level)
        wanted = by_hand(module, level, bev, cells, matrices, valid)
    torch.testing.assert_close(found[valid], wanted[valid], rtol=1e-4, atol=1e-5)
    assert found.isfinite().all()
    if len(cells) == len(CELLS):  # else nothing was compared
        edges = lid_edges(module.depth_range, module.num_bins, torch.float64)
        places = [column_and_bin(r, c, matrices[s, n], edges) for s, r, c in cells for n in range(4) if valid[s, n]]
        assert len([place for place in places if place is not None]) >= 6


def test_a_pillar_ahead_is_seen_in_the_middle_at_its_depth():
    """20.4 m ahead of the front camera, whose middle lies between columns 2 and 3 of 6; left of it by 0.2 m."""
    module = make_association()
    cell = GRID.cell_of(torch.tensor([20.4, 0.0]))
    x, y = GRID.centre_of(cell).tolist()
    assert 0 < y < 0.8
    front = (camera_matrices(SIZE, AXES)[None, :1], torch.ones(1, 1, dtype=torch.bool), SIZE)
    pillar, place = module.seen_at(CameraViews([torch.empty(1, 1, 6, *LEVEL)], *front), torch.tensor([[0, *cell]]))
    edges = lid_edges((1.0, 40.0), 16).tolist()
    assert pillar.tolist() == [0] and edges[place % 16] <= x < edges[place % 16 + 1] and place // 16 == 2


def test_a_return_changes_the_columns_that_look_at_it_and_no_other():
    """At y = -0.6 m, ahead on the right: the fourth of the front camera's six columns."""
    module, level = make_association(), torch.randn(1, 4, 6, *LEVEL)
    views = CameraViews([level], camera_matrices(SIZE, AXES)[None], torch.ones(1, 4, dtype=torch.bool), SIZE)
    with torch.no_grad():
        nothing, one = (module(views, radar_map(cells)[:1]) for cells in ([], [(0, 24, 60)]))
    changed = (nothing != one).any(1).any(1)  # [N, w]
    assert changed.nonzero().tolist() == [[0, 3]]


def test_depth_knows_the_radar_before_anything_is_lifted():
    model, batch = hydra_model().eval(), make_batch()
    with torch.no_grad():
        with_radar = model(batch)[0].lifted
        batch.radar_points[:, 0] += 4.0
        elsewhere = model(batch)[0].lifted
    assert not torch.allclose(with_radar.depth_logits, elsewhere.depth_logits)
    assert not torch.allclose(with_radar.context, elsewhere.context)
