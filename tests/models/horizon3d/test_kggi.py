"""Where the first Gaussians lie and what they carry."""

import pytest
import torch

from src.errors import ConfigError
from src.models.heads.keypoint_head import CameraMaps
from src.models.horizon3d.gaussian_encoder import GaussianBounds
from src.models.horizon3d.kggi import KGGI, Initialization
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import Source

BOUNDS = GaussianBounds((0.2, 3.2), 4.0, 60.0, 1.0)
ROWS, COLS = 8, 12  # cells of the finest level


class FixedHead(torch.nn.Module):
    """Stands in for the camera head with maps that the test writes."""

    def __init__(self, maps):
        super().__init__()
        self.maps = maps

    def forward(self, level):
        return self.maps


def flat_maps(b=1):
    """No keypoint anywhere, every depth alike."""
    return CameraMaps(
        keypoint_logits=torch.full((b, 4, ROWS, COLS), -12.0),
        depth_logits=torch.zeros(b, 4, 16, ROWS, COLS),
        features=torch.randn(b, 4, 16, ROWS, COLS),
    )


def make_radar(grid, cells=((0, 5, 5), (0, 20, 30), (0, 40, 60)), b=1):
    sites, _ = Sites.from_indices(torch.tensor(cells).reshape(-1, 3), (b, *grid.cells))
    return SparseBEV(sites, torch.randn(len(sites), 16))


def make_kggi(make_config, grid, **changes):
    torch.manual_seed(0)
    return KGGI(make_config(**changes).kggi, 16, 16, grid, BOUNDS)


def plant(maps, views, centres_m, points):
    """Write a sharp peak at the pixel of each 3D point, with all depth in its bin; returns (view, row, col, depth)."""
    pixels, visible = views.project(points[None, :, None])
    placed = []
    for index, point in enumerate(points):
        view = int(visible[0, index, :, 0].nonzero()[0])
        u, v = pixels[0, index, view, 0].tolist()
        depth = float((views.pix_from_aug[0, view] @ torch.cat([point, torch.ones(1)]))[2])
        row, col, bin_ = int(v // 8), int(u // 8), int((centres_m - depth).abs().argmin())
        maps.keypoint_logits[0, view, row, col] = 4.0 - index
        maps.depth_logits[0, view, bin_, row, col] = 60.0
        placed.append((view, row, col, depth))
    return placed


def test_a_keypoint_at_the_pixel_of_a_known_point_becomes_a_gaussian_at_its_place(make_config, grid, make_views):
    kggi, views, maps = make_kggi(make_config, grid), make_views(), flat_maps()
    points = torch.tensor([[12.0, 9.0, 1.0], [14.0, -13.0, 0.5], [-8.0, 9.0, 1.0]])
    plant(maps, views, kggi.depth_centres_m, points)
    kggi.camera_head = FixedHead(maps)
    out = kggi(make_radar(grid), views).gaussians
    camera = out.means[0, out.sources[0] == Source.CAMERA]
    # Best keypoint first; half a stride-8 pixel and half a depth bin of tolerance.
    torch.testing.assert_close(camera[:3], points[:, :2], atol=2.2, rtol=0)
    assert out.valid[0, out.sources[0] == Source.CAMERA].all()


def test_exact_place_when_point_lies_on_pixel_and_bin_centre(make_config, grid, make_views):
    kggi, views, maps = make_kggi(make_config, grid), make_views(), flat_maps()
    depth = kggi.depth_centres_m[7]
    target = views.lift(torch.full((1, 4, ROWS, COLS), float(depth)))[0, 2, 3, 6]  # view 2, row 3, column 6
    maps.keypoint_logits[0, 2, 3, 6] = 3.0
    maps.depth_logits[0, 2, 7, 3, 6] = 60.0
    kggi.camera_head = FixedHead(maps)
    out = kggi(make_radar(grid), views).gaussians
    torch.testing.assert_close(out.means[0, out.sources[0] == Source.CAMERA][0], target[:2], atol=1e-3, rtol=0)


def test_missing_views_and_points_outside_the_grid_make_no_keypoints(make_config, grid, make_views):
    kggi, views, maps = make_kggi(make_config, grid), make_views(), flat_maps()
    plant(maps, views, kggi.depth_centres_m, torch.tensor([[12.0, 9.0, 1.0], [14.0, -13.0, 0.5]]))
    views.valid[0] = torch.tensor([False, True, False, False])
    kggi.camera_head = FixedHead(maps)
    out = kggi(make_radar(grid), views).gaussians
    is_camera = out.sources[0] == Source.CAMERA
    assert (out.means[0, is_camera & out.valid[0]][:, 1] < 0).all()  # what the right front camera sees
    views.valid[:] = False
    out = kggi(make_radar(grid), views).gaussians
    assert not out.valid[0, is_camera].any()
    assert out.means.isfinite().all()


def test_ranking_is_joint_over_views_and_one_per_sample(make_config, grid, make_views):
    kggi, views, maps = make_kggi(make_config, grid, num_camera_keypoints=3), make_views(2), flat_maps(2)
    for sample, view in ((0, 0), (0, 3), (1, 1)):
        maps.keypoint_logits[sample, view, 2, 3] = 2.0
    maps.depth_logits[:, :, 5] = 60.0
    kggi.camera_head = FixedHead(maps)
    out = kggi(make_radar(grid, b=2), views).gaussians
    means = out.means[:, out.sources[0] == Source.CAMERA]  # [2, 3, 2]
    lifted = views.lift(kggi.depth_centres_m[5].expand(2, 4, ROWS, COLS))[:, :, 2, 3, :2]
    best_two = means[0, :2][means[0, :2, 0].argsort()]
    torch.testing.assert_close(best_two, lifted[0, [0, 3]][lifted[0, [0, 3], 0].argsort()])
    torch.testing.assert_close(means[1, 0], lifted[1, 1])


def test_more_keypoints_than_pixels_leave_padding(make_config, grid, make_views):
    wanted = 4 * ROWS * COLS + 5
    kggi = make_kggi(make_config, grid, num_camera_keypoints=wanted)
    out = kggi(make_radar(grid), make_views()).gaussians
    is_camera = out.sources[0] == Source.CAMERA
    assert is_camera.sum() == wanted
    assert not out.valid[0, is_camera][-5:].any()


def test_radar_keypoints_are_the_best_cells_and_the_rest_is_padding(make_config, grid, make_views):
    kggi, radar = make_kggi(make_config, grid, num_radar_keypoints=5), make_radar(grid)
    out = kggi(radar, make_views())
    gaussians = out.gaussians
    order = out.objectness_logits.argsort(descending=True)
    expected = grid.centre_of(radar.indices[order, 1:])
    torch.testing.assert_close(gaussians.means[0, :3], expected)
    assert gaussians.valid[0, :5].tolist() == [True, True, True, False, False]


@pytest.mark.parametrize(("peaks", "order"), [(0, [1, 2, 0]), (1, [1, 2, 0]), (2, [1, 3, 2]), (3, [1, 2, 3])])
def test_so_many_radar_keypoints_are_peaks(make_config, grid, make_views, peaks, order):
    """Three cells in a row with the best in the middle, and one alone that is worse; another sample's has few cells."""
    cells = ((0, 5, 5), (0, 5, 6), (0, 5, 7), (0, 20, 30), (1, 5, 6))
    radar, scores = make_radar(grid, cells, b=2), torch.tensor([2.0, 3.0, 2.5, -4.0, -9.0])
    radar = radar.with_features(torch.cat([scores[:, None], radar.features[:, 1:]], dim=1))
    kggi = make_kggi(make_config, grid, num_radar_keypoints=3, num_radar_peaks=peaks)
    kggi.objectness = torch.nn.Linear(16, 1, bias=False)
    with torch.no_grad():
        kggi.objectness.weight.copy_(torch.eye(1, 16))
    gaussians = kggi(radar, make_views(2)).gaussians
    wanted = grid.centre_of(radar.indices[:, 1:])
    torch.testing.assert_close(gaussians.means[0, :3], wanted[order])
    torch.testing.assert_close(gaussians.means[1, 0], wanted[4])
    assert gaussians.valid[:, :3].tolist() == [[True, True, True], [True, False, False]]


def test_property_head_changes_nothing_at_step_zero(make_config, grid, make_views):
    with_head, without = make_kggi(make_config, grid), make_kggi(make_config, grid, property_head=False)
    missing = without.load_state_dict(with_head.state_dict(), strict=False)
    assert not missing.missing_keys and all("property_heads" in key for key in missing.unexpected_keys)
    radar, views = make_radar(grid), make_views()
    a, b = with_head(radar, views).gaussians, without(radar, views).gaussians
    for name in a.__dataclass_fields__:
        assert torch.equal(getattr(a, name), getattr(b, name)), name
    assert (a.scales - 1.7).abs().max() < 1e-6
    assert torch.allclose(a.directions, torch.tensor([1.0, 0.0]))
    assert (a.opacity_logits.sigmoid() - 0.25).abs().max() < 1e-6
    assert not a.velocities.any()


def test_attributes_are_float32_numbers_under_autocast(make_config, grid):
    """Not only their type: a product in bfloat16 would keep three digits of an opacity and of a speed."""
    kggi = make_kggi(make_config, grid)
    torch.nn.init.normal_(kggi.property_heads["radar"].weight)
    valid, local = torch.ones(1, 24, dtype=torch.bool), torch.randn(1, 24, 16).bfloat16()
    plain = kggi._gaussians(Source.RADAR, torch.zeros(1, 24, 2), valid, local.float())
    with torch.autocast("cpu", torch.bfloat16):
        halved = kggi._gaussians(Source.RADAR, torch.zeros(1, 24, 2), valid, local)
    for name in ("scales", "directions", "opacity_logits", "velocities", "features"):
        assert torch.equal(getattr(halved, name), getattr(plain, name)), name


def test_keypoints_carry_the_features_of_their_pixel_and_of_their_cell(make_config, grid, make_views):
    kggi, views, maps = make_kggi(make_config, grid), make_views(2), flat_maps(2)
    for head in kggi.property_heads.values():
        with torch.no_grad():
            head.weight[:16] = torch.eye(16)
    pixels = [(0, 3, 2, 9), (1, 2, 3, 6)]  # sample, view, row, column
    for pixel in pixels:
        maps.keypoint_logits[pixel] = 3.0
    maps.depth_logits[:, :, 5] = 60.0
    kggi.camera_head = FixedHead(maps)
    radar = make_radar(grid, cells=((0, 5, 7), (1, 3, 4), (1, 20, 30)), b=2)
    out = kggi(radar, views)
    best = [0, 1 + int(out.objectness_logits[1:].argmax())]  # of each sample
    expected = {
        Source.CAMERA: [maps.features[sample, view, :, row, col] for sample, view, row, col in pixels],
        Source.RADAR: [radar.features[row] for row in best],
    }
    for source, features in expected.items():
        own = kggi.slots[source.name.lower()].features[0] + kggi.source_embedding.weight[source]
        found = out.gaussians.features[:, out.gaussians.sources[0] == source][:, 0] - own
        torch.testing.assert_close(found, torch.stack(features), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("mode", "counts"),
    [(Initialization.both, (24, 12, 8)), (Initialization.keypoint, (24, 12, 0)), (Initialization.random, (0, 0, 44))],
)
def test_initialisation_modes(make_config, grid, mode, counts, make_views):
    kggi = make_kggi(make_config, grid, initialization=mode)
    out = kggi(make_radar(grid), make_views())
    found = torch.bincount(out.gaussians.sources[0], minlength=3).tolist()
    assert tuple(found) == counts
    has_keypoints = mode is not Initialization.random
    assert (out.objectness_logits is not None) == (out.camera is not None) == has_keypoints
    assert hasattr(kggi, "camera_head") == hasattr(kggi, "objectness") == has_keypoints


@pytest.mark.parametrize("mode", list(Initialization))
@pytest.mark.parametrize("property_head", [True, False])
def test_merged_slots_give_the_same_gaussians(make_config, grid, make_views, mode, property_head):
    kggi = make_kggi(make_config, grid, initialization=mode, property_head=property_head)
    for value in kggi.parameters():
        torch.nn.init.normal_(value)
    radar, views = make_radar(grid, b=2), make_views(2)
    with torch.no_grad():
        past = kggi(radar, views).gaussians
        wanted = [kggi(radar, views, history).gaussians for history in (None, past)]
        kggi.merge_for_inference()
        found = [kggi(radar, views, history).gaussians for history in (None, past)]
    for one, other in zip(found, wanted, strict=True):
        for name in one.__dataclass_fields__:
            assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_random_means_stay_in_the_grid_and_are_trainable(make_config, grid, make_views):
    kggi = make_kggi(make_config, grid, initialization=Initialization.random)
    with torch.no_grad():
        kggi.random_means[0] = 7.0
        kggi.random_means[1] = -7.0
    out = kggi(make_radar(grid), make_views()).gaussians
    assert grid.contains(out.means).all()
    out.means.sum().backward()
    assert (kggi.random_means.grad == torch.tensor(grid.half_extent_m)).all()  # one unit is one half extent


def test_selection_passes_no_gradient_but_local_features_do(make_config, grid, make_views):
    kggi, radar, views = make_kggi(make_config, grid), make_radar(grid), make_views()
    radar.features.requires_grad_()
    out = kggi(radar, views).gaussians
    chosen = [kggi.objectness[0].weight, kggi.camera_head.depth[0].weight, radar.features]
    assert torch.autograd.grad(out.means.sum(), chosen, allow_unused=True, retain_graph=True) == (None, None, None)
    torch.nn.init.ones_(kggi.property_heads["radar"].weight)
    kggi(radar, views).gaussians.features.sum().backward()
    assert radar.features.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"num_radar_keypoints": 0}, "num_radar_keypoints=0"),
        ({"num_random_keypoints": -1}, "num_random_keypoints=-1"),
        ({"depth_range_m": [5.0, 2.0]}, "depth_range_m"),
        ({"keypoint_nms_cells": 2}, "keypoint_nms_cells=2"),
        ({"num_radar_peaks": 25}, "num_radar_peaks=25.*num_radar_keypoints=24"),
        ({"num_depth_bins": 0}, "num_depth_bins=0"),
    ],
)
def test_impossible_settings_are_refused_by_name(make_config, changes, named):
    with pytest.raises(ConfigError, match=named):
        make_config(**changes)


def test_more_radar_keypoints_than_cells_are_refused(make_config, grid):
    with pytest.raises(ConfigError, match="num_radar_keypoints=4000"):
        make_kggi(make_config, grid, num_radar_keypoints=4000)
