"""Radar-guided lifting: the attention against loops over columns, what is lifted, gates, bad input."""

import math

import pytest
import torch

from src.models.crt_fusion.azimuth_attention import AzimuthAttention
from src.models.layers.views import CameraViews
from tests.models.camera_radar_frames import crt_model, radar_map
from tests.models.frames import GRID, SIZE, make_batch
from tests.models.surroundings import AXES, camera_matrices, rigs


def make_attention(count=3):
    torch.manual_seed(0)
    return AzimuthAttention(6, 4, 8, count, GRID).eval()


CELLS = [(0, 24, 60), (0, 30, 55), (0, 10, 40), (0, 40, 3), (0, 20, 2), (1, 33, 33), (1, 2, 60)]


def by_hand(module, level, bev, matrices, valid):
    """Column by column: azimuths from the camera by solving for two points of the ray, all pillars sorted."""
    out = level.clone()
    for b, n in valid.nonzero().tolist():
        x = level[b, n]  # [C, h, w]
        inverse = torch.linalg.inv(matrices[b, n].double())
        at = {
            d: [
                inverse
                @ torch.tensor([(j + 0.5) * SIZE[1] / x.shape[2] * d, SIZE[0] / 2 * d, d, 1.0], dtype=torch.float64)
                for j in range(x.shape[2])
            ]
            for d in (0.0, 5.0)
        }
        radar = torch.zeros_like(x)
        high = module.rows(x.amax(2).t())  # [h, C]
        for j in range(x.shape[2]):
            eye, far = at[0.0][j][:2], at[5.0][j][:2]
            azimuth = math.atan2(*(far - eye).flip(0).tolist())
            places = []
            for sample, row, col in sorted(CELLS):
                if sample == b and bev[b, :, row, col].any():
                    place = GRID.centre_of(torch.tensor([row, col])).double() - eye
                    turn = math.atan2(place[1], place[0]) - azimuth
                    places.append((abs(math.atan2(math.sin(turn), math.cos(turn))), row, col))
            column = module.columns(x[:, :, j].amax(1)[None])
            picked = [bev[b, :, row, col] for _, row, col in sorted(places)[: module.count]]
            if picked:
                pillars = module.pillars(torch.stack(picked))
                values = module.pairs(torch.cat([pillars, column.expand(len(picked), -1)], 1))
                weights = module.score(values).softmax(0)
                radar[:, :, j] = (weights * values).sum(0)[:, None]
        radar = radar + high.t()[..., None]
        gate = module.gates((x + radar)[None]).sigmoid()[0]
        out[b, n] = x * gate[: len(x)] + radar * gate[len(x) :]
    return out


@pytest.mark.parametrize("cells", [CELLS, CELLS[:5], []])
def test_a_column_attends_to_the_pillars_nearest_in_azimuth(cells):
    """Fewer than K pillars in a sample, none in it, none at all; a camera is missing."""
    module, bev = make_attention(), radar_map(cells)
    level, matrices = torch.randn(2, 4, 6, 3, 5), rigs(2, SIZE, AXES)
    valid = torch.ones(2, 4, dtype=torch.bool)
    valid[0, 1], matrices[0, 1] = False, torch.nan
    with torch.no_grad():
        found = module(CameraViews([level], matrices, valid, SIZE), bev).view_as(level)
        wanted = by_hand(module, level, bev, matrices, valid)
    torch.testing.assert_close(found[valid], wanted[valid], rtol=1e-4, atol=1e-5)
    assert found.isfinite().all()


def test_one_pillar_straight_ahead_reaches_the_middle_columns_only_as_nearest():
    """Two pillars, one ahead, one to the left: with K = 1 each column of the front camera takes the nearer azimuth."""
    module = make_attention(count=1)
    ahead, left = (int(GRID.cell_of(torch.tensor([x, y]))[0]) for x, y in ((20.0, 0.4), (10.0, 9.0)))
    cells = torch.tensor([[0, ahead, 50], [0, left, 42]])
    nearest = module.nearest(
        cells, CameraViews([], camera_matrices(SIZE, AXES)[None, :1], torch.ones(1, 1).bool(), SIZE), 6
    )
    assert nearest.flatten().tolist() == [1, 1, 0, 0, 0, 0]  # left is where columns begin


def test_only_foreground_pixels_and_likely_depths_are_lifted():
    model, batch = crt_model().eval(), make_batch()
    lift = model.view_transform
    with torch.no_grad():
        whole = model(batch)[0].lifted
        likely = (whole.depth_logits.softmax(2) >= 1 / 16).sum()
        assert 0 < whole.num_lifted <= likely < whole.depth_logits.numel()
        lift.foreground.bias.fill_(-20.0)
        nothing = model(batch)[0].lifted
        assert nothing.num_lifted == 0 and not nothing.bev.any()
        lift.foreground.bias.fill_(20.0)
        lift.depth.weight.zero_(), lift.depth.bias.zero_()
        lift.depth.bias[3] = 5.0
        sure = model(batch)[0].lifted  # one bin of every pixel
        assert 0 < sure.num_lifted <= whole.depth_logits[:, :, 0].numel()
