"""Lift-splat against the published formulation with its frustum tensor, by hand, and without cameras."""

import itertools

import pytest
import torch

from src.errors import ConfigError
from src.models.layers.lift_splat import LiftSplat
from src.models.layers.views import CameraViews
from src.targets.depth import lid_centres
from tests.models.dense_bev.dense_frames import lift_config
from tests.models.frames import GRID, SIZE
from tests.models.surroundings import AXES, camera_matrices, rigs

CHANNELS = 6


def make_module(**changes):
    torch.manual_seed(0)
    return LiftSplat(lift_config(**changes), CHANNELS, GRID)


def frustum_oracle(module, level, pix_from_aug, valid):
    """[B, N, D, C, h, w] in double, every point solved for on its own, added cell by cell."""
    b, n, _, h, w = level.shape
    hidden = module.trunk(level.flatten(0, 1))
    depth = module.depth(hidden).double().softmax(1).unflatten(0, (b, n))
    context = module.context(hidden).double().unflatten(0, (b, n))
    frustum = depth[:, :, :, None] * context[:, :, None]
    centres = lid_centres(module.config.depth_range, module.config.num_depth_bins, torch.float64)
    low, high = module.config.z_range_m
    met = []  # (sample, row, col) and (camera, bin, i, j)
    for s, camera in valid.nonzero().tolist():
        pix_from_seen = pix_from_aug[s, camera].double().inverse()
        for i, j, k in itertools.product(range(h), range(w), range(len(centres))):
            d, u, v = float(centres[k]), (j + 0.5) * SIZE[1] / w, (i + 0.5) * SIZE[0] / h
            x, y, z, _ = (pix_from_seen @ torch.tensor([u * d, v * d, d, 1.0], dtype=torch.float64)).tolist()
            col, row = (x - GRID.x_min_m) // GRID.cell_m, (y - GRID.y_min_m) // GRID.cell_m
            if 0 <= col < GRID.cols and 0 <= row < GRID.rows and low <= z < high:
                met.append((s, int(row), int(col), camera, k, i, j))
    sample, row, col, camera, k, i, j = torch.tensor(met).unbind(1)
    bev = torch.zeros(b, GRID.rows, GRID.cols, frustum.shape[3], dtype=torch.float64)
    bev = bev.index_put((sample, row, col), frustum[sample, camera, k, :, i, j], accumulate=True)
    return bev.movedim(-1, 1), len(met)


@pytest.mark.parametrize("missing", [None, (0, 1)])
def test_it_is_the_published_frustum_pooled(missing):
    """Values and gradients, through depth and through context; the cameras are tilted a little against the grid."""
    module = make_module(num_depth_bins=6, z_range_m=[-1.0, 3.0])
    generator = torch.Generator().manual_seed(1)
    matrices = rigs(2, SIZE, AXES)[:, :2]
    tilt = 0.05 * torch.randn(matrices.shape, generator=generator)
    matrices[:, :, :3] += tilt[:, :, :3]
    valid = torch.ones(2, 2, dtype=torch.bool)
    if missing is not None:
        valid[missing], matrices[missing] = False, 0.0
    level = torch.randn(2, 2, CHANNELS, 3, 4, generator=generator)
    weight = torch.randn(2, 12, GRID.rows, GRID.cols, generator=generator)
    results = []
    for oracle in (False, True):
        module.zero_grad()
        leaf = level.clone().requires_grad_()
        if oracle:
            bev, met = frustum_oracle(module, leaf, matrices, valid)
        else:
            lifted = module(CameraViews([leaf], matrices, valid, SIZE))
            bev = lifted.bev
        (bev * weight).sum().backward()
        results.append([bev.detach(), leaf.grad, *(p.grad for p in module.parameters())])
    assert len(results[0]) == len(results[1]) and results[0][0].any()
    for ours, wanted in zip(*results, strict=True):
        torch.testing.assert_close(ours, wanted.float(), rtol=1e-4, atol=1e-5)
    assert lifted.num_lifted == met


def test_a_pixel_lands_where_its_depth_says():
    """The front camera's pixels look straight ahead in the middle; all depth in one bin."""
    module = make_module()
    centres = lid_centres(module.config.depth_range, 16)
    wanted = 7
    with torch.no_grad():
        for part in (module.depth, module.context):
            part.weight.zero_()
            part.bias.zero_()
        module.depth.bias[wanted] = 100.0
        module.context.bias[:] = torch.arange(12.0) + 1
    level = torch.randn(1, 4, CHANNELS, 4, 7)  # 7 columns, so that one looks straight ahead
    valid = torch.tensor([[True, False, False, False]])
    bev = module(CameraViews([level], camera_matrices(SIZE, AXES)[None], valid, SIZE)).bev[0]
    row, col = GRID.cell_of(torch.tensor([float(centres[wanted]), 0.0])).tolist()
    torch.testing.assert_close(bev[:, row, col], 4.0 * (torch.arange(12.0) + 1))  # the column's four pixels
    columns = {int(c) for c in (bev > 1e-6).any(dim=0).nonzero()[:, 1]}
    assert columns == {col}  # depth is along the optical axis: all seven columns of pixels are equally far ahead


def test_views_of_other_samples_and_missing_views_stay_out():
    module = make_module().eval()
    level, matrices = torch.randn(2, 4, CHANNELS, 4, 6), rigs(2, SIZE, AXES)
    valid = torch.ones(2, 4, dtype=torch.bool)
    both = module(CameraViews([level], matrices, valid, SIZE)).bev
    for sample in range(2):
        one = slice(sample, sample + 1)
        torch.testing.assert_close(both[one], module(CameraViews([level[one]], matrices[one], valid[one], SIZE)).bev)
    valid[0] = False
    matrices[0] = torch.nan
    lifted = module(CameraViews([level], matrices, valid, SIZE))
    assert not lifted.bev[0].any() and torch.equal(lifted.bev[1], both[1])
    valid[1] = False
    lifted = module.train()(CameraViews([level], matrices, valid, SIZE))
    assert lifted.num_lifted == 0 and not lifted.bev.any()
    lifted.bev.sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in module.parameters())


def test_autocast_changes_neither_geometry_nor_types():
    module = make_module().eval()
    level, valid = torch.randn(1, 4, CHANNELS, 4, 6), torch.ones(1, 4, dtype=torch.bool)
    plain = module(CameraViews([level], camera_matrices(SIZE, AXES)[None], valid, SIZE))
    with torch.autocast("cpu", torch.bfloat16):
        half = module(CameraViews([level], camera_matrices(SIZE, AXES)[None], valid, SIZE))
    assert half.bev.dtype == torch.float32 and half.num_lifted == plain.num_lifted
    assert torch.equal(half.bev.any(dim=1), plain.bev.any(dim=1))
    torch.testing.assert_close(half.bev, plain.bev, rtol=0.1, atol=0.05)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"num_depth_bins": 0}, "num_depth_bins=0"),
        ({"depth_range_m": [2.0, 1.0]}, "depth_range_m"),
        ({"z_range_m": [1.0]}, "z_range_m"),
    ],
)
def test_mistakes_are_named(changes, message):
    with pytest.raises(ConfigError, match=f"model.view_transform.{message}"):
        lift_config(**changes)
