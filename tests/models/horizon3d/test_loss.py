"""Losses of the temporal part by hand (method 6.1, 8.1): cells of F_fuse against tight boxes."""

import math

import pytest
import torch

from src.models.horizon3d.bev_path import CellPrediction
from src.models.horizon3d.kggi import KGGIOutput
from src.models.horizon3d.loss import VelocityGroups, cell_losses, gaussian_velocity_loss, kggi_losses, ocsf_losses
from src.models.horizon3d.ocsf import OCSFOutput
from src.models.horizon3d.splatting import GaussianSplat
from src.ops.splat import Splat
from src.structures.boxes import Boxes3D
from src.targets.box_raster import BoxRaster
from tests.gaussian_sets import gaussians_at
from tests.models.horizon3d.cells import TINY, bev_of

NAMES = ["cell_focal", "cell_dice", "cell_lovasz", "cell_velocity"]
NAN = float("nan")


def boxes_of(*rows):
    """Boxes from rows x, y, l, w, vx, vy on the grid of 5 x 6 cells of 1 m around the origin."""
    t = torch.tensor(rows).reshape(-1, 6)
    ones, labels = torch.ones(len(t), 1), torch.zeros(len(t), dtype=torch.int64)
    return Boxes3D(
        torch.cat([t[:, :2], ones], 1), torch.cat([t[:, 2:4], ones], 1), t[:, 0] * 0, t[:, 4:], labels, labels - 1
    )


@pytest.fixture
def settings(make_config):
    """Loss weights by name, all 1 but where given."""

    def build(**changes):
        ones = {f"{name}_weight": 1.0 for name in [*NAMES, "gaussian_velocity", "dptf"]}
        return make_config(**(ones | changes)).loss

    return build


@pytest.fixture
def scene():
    """Two frames. The first has a box over cells (2, 2) and (2, 3) and one of unknown velocity over (0, 0).

    Its map lacks (2, 3), so one of its three cells lies in the moving box and one in the other; the second has no box.
    """
    cells = torch.tensor([[0, 0, 0], [0, 2, 2], [0, 4, 4], [1, 1, 1]])
    fused, _ = bev_of(cells, TINY, batch_size=2)
    boxes = [boxes_of((0.0, 0.0, 2.0, 1.0, 7.0, -2.0), (-2.5, -2.0, 1.0, 1.0, NAN, NAN)), boxes_of()]
    scores = torch.tensor([0.8, 0.3, 0.6, 0.1])
    velocities = torch.tensor([[9.0, 9], [4, 1], [9, 9], [9, 9]])
    prediction = CellPrediction(torch.logit(scores), velocities + 50.0, velocities)  # the second ones are supervised
    return prediction, fused, BoxRaster(boxes, TINY, 0.0)


def test_each_term_by_hand(settings, scene):
    found = cell_losses(*scene, settings())
    assert list(found) == NAMES
    # Positives 0.8 and 0.3, negatives 0.6 and 0.1; divided by the two positives.
    focal = -0.25 * (0.2**2 * math.log(0.8) + 0.7**2 * math.log(0.3))
    focal -= 0.75 * (0.6**2 * math.log(0.4) + 0.1**2 * math.log(0.9))
    # The cell that the map lacks counts nowhere.
    first, second = 1 - (2 * 1.1 + 1) / (1.7 + 2 + 1), 1 - 1 / (0.1 + 0 + 1)
    # Errors 0.7, 0.6, 0.2 in order; the Jaccard losses after 1, 2 and 3 of them are 1/2, 2/3 and 1.
    lovasz = 0.7 * 0.5 + 0.6 * (2 / 3 - 1 / 2) + 0.2 * (1 - 2 / 3)
    expected = [focal / 2, (first + second) / 2, lovasz / 2, (abs(4 - 7) + abs(1 + 2)) / 2]
    assert [float(found[name]) for name in NAMES] == pytest.approx(expected, rel=1e-5)


def test_inner_and_outer_weights_multiply_and_null_switches_off(settings, scene):
    plain = cell_losses(*scene, settings())
    weights = dict(zip(NAMES, (2.0, 3.0, 5.0, 7.0), strict=True))
    changed = cell_losses(
        *scene, settings(dptf_weight=0.5, **{f"{name}_weight": value for name, value in weights.items()})
    )
    for name, weight in weights.items():
        torch.testing.assert_close(changed[name], 0.5 * weight * plain[name])
        assert set(cell_losses(*scene, settings(**{f"{name}_weight": None}))) == set(NAMES) - {name}


def test_velocity_is_supervised_only_in_boxes_of_known_velocity(settings, scene):
    prediction, fused, raster = scene
    prediction.loss_velocities.requires_grad_()
    cell_losses(prediction, fused, raster, settings())["cell_velocity"].backward()
    assert prediction.loss_velocities.grad.tolist() == [[0, 0], [-0.5, 0.5], [0, 0], [0, 0]]
    unknown = BoxRaster([boxes_of((0.0, 0.0, 2.0, 1.0, NAN, NAN)), boxes_of()], TINY, 0.0)
    assert not cell_losses(prediction, fused, unknown, settings())["cell_velocity"].any()


def test_boxes_are_tight(settings, scene):
    """A cell next to the box is background, however large the margin of the splatted mask."""
    prediction, fused, _ = scene
    near = [boxes_of((0.0, 1.0, 2.0, 1.0, 7.0, -2.0)), boxes_of()]  # one row above cell (2, 2)
    found = cell_losses(prediction, fused, BoxRaster(near, TINY, 4.0), settings())
    assert not found["cell_velocity"].any() and not found["cell_lovasz"].any()


@pytest.mark.parametrize("empty", ["boxes", "cells", "both"])
def test_nothing_to_supervise_is_finite_with_finite_gradients(settings, scene, empty):
    prediction, fused, raster = scene
    if empty != "boxes":
        fused, _ = bev_of(torch.zeros(0, 3, dtype=torch.int64), TINY, batch_size=2)
        prediction = CellPrediction(torch.zeros(0), torch.zeros(0, 2), torch.zeros(0, 2))
    if empty != "cells":
        raster = BoxRaster([boxes_of(), boxes_of()], TINY, 0.0)
    prediction.occupancy_logits.requires_grad_()
    prediction.loss_velocities.requires_grad_()
    found = cell_losses(prediction, fused, raster, settings())
    assert list(found) == NAMES and all(value.isfinite() for value in found.values())
    sum(found.values()).backward()
    assert prediction.occupancy_logits.grad.isfinite().all() and not prediction.loss_velocities.grad.any()
    assert not found["cell_velocity"].any() and not found["cell_lovasz"].any()


def key(sample, row, col):
    return (sample * 5 + row) * 6 + col


def test_radar_objectness_by_hand(make_config):
    """Two cells in the box, one in its margin and one of the other sample, both of which are background."""
    radar, _ = bev_of(torch.tensor([[0, 2, 2], [0, 2, 3], [0, 3, 2], [1, 2, 2]]), TINY, batch_size=2)
    raster = BoxRaster([boxes_of((0.0, 0.0, 2.0, 1.0, 7.0, -2.0)), boxes_of()], TINY, 2.0)
    kggi = KGGIOutput(None, torch.logit(torch.tensor([0.3, 0.9, 0.6, 0.1])), camera=object())
    weights = {"kggi_weight": 2.0, "radar_objectness_weight": 3.0, "keypoint_weight": None, "depth_weight": None}
    config = make_config(**weights)
    found = kggi_losses(kggi, radar, None, raster, config.kggi, config.loss)
    focal = -0.25 * (0.7**2 * math.log(0.3) + 0.1**2 * math.log(0.9))
    focal -= 0.75 * (0.6**2 * math.log(0.4) + 0.1**2 * math.log(0.9))
    assert {name: float(value) for name, value in found.items()} == {
        "radar_objectness": pytest.approx(2 * 3 * focal / 2)
    }
    config = make_config(**weights | {"radar_objectness_weight": None})
    assert kggi_losses(kggi, radar, None, raster, config.kggi, config.loss) == {}


def test_occupancy_of_the_splat_by_hand(make_config):
    """The margin of 2 m makes 3 x 4 cells of the box's two; Gaussians reach two of them, a third cell, and sample 1."""
    support = torch.tensor([key(0, 0, 0), key(0, 1, 1), key(0, 2, 2), key(1, 1, 1)])
    occupancy = torch.tensor([0.6, 0.3, 0.8, 0.1])
    occupied = bev_of(torch.tensor([[0, 2, 2]]), TINY, batch_size=2)[0].sites
    splat = Splat(support, torch.log1p(-occupancy), occupied, *[None] * 4, 0)
    raster = BoxRaster([boxes_of((0.0, 0.0, 2.0, 1.0, 7.0, -2.0)), boxes_of()], TINY, 2.0)
    weights = {"ocsf_weight": 5.0, "occupancy_focal_weight": 2.0, "occupancy_dice_weight": 3.0}
    ocsf = OCSFOutput(None, GaussianSplat(splat, None, None, None), None, None)
    found = ocsf_losses(ocsf, raster, make_config(**weights).loss)
    focal = -0.25 * (0.7**2 * math.log(0.3) + 0.2**2 * math.log(0.8) + 10 * (1 - 1e-4) ** 2 * math.log(1e-4))
    focal -= 0.75 * (0.6**2 * math.log(0.4) + 0.1**2 * math.log(0.9))
    dice = (1 - (2 * 1.1 + 1) / (1.7 + 12 + 1)) / 2 + (1 - 1 / (0.1 + 0 + 1)) / 2
    assert {name: float(value) for name, value in found.items()} == {
        "occupancy_focal": pytest.approx(5 * 2 * focal / 12, rel=1e-5),
        "occupancy_dice": pytest.approx(5 * 3 * dice, rel=1e-5),
    }
    for name in ("focal", "dice"):
        one_less = ocsf_losses(ocsf, raster, make_config(**weights | {f"occupancy_{name}_weight": None}).loss)
        assert one_less.keys() == {"occupancy_focal", "occupancy_dice"} - {f"occupancy_{name}"}


def test_gaussian_velocity_by_hand(settings):
    """Smooth L1 at the peak cells: in the box, in its margin, beside it, in a box of unknown velocity, nowhere."""
    velocities = torch.tensor([[7.5, -2.0], [7.0, 1.0], [9.0, 9.0], [9.0, 9.0], [9.0, 9.0]])[None].requires_grad_()
    gaussians = gaussians_at(torch.zeros(1, 5, 2), velocities=velocities)
    peaks = torch.tensor([[2 * 6 + 2, 1 * 6 + 2, 4 * 6 + 3, 0, -1]])
    ocsf = OCSFOutput(gaussians, GaussianSplat(None, None, peaks, torch.zeros(1, 5)), None, gaussians.velocities)
    boxes = [boxes_of((0.0, 0.0, 2.0, 1.0, 7.0, -2.0), (-2.5, -2.0, 1.0, 1.0, NAN, NAN))]
    wide, narrow = (BoxRaster(boxes, TINY, margin_m) for margin_m in (2.0, 0.0))
    # Margin 2 m in total: rows 1..3 around the first box, rows and columns 0..1 around the second.
    terms = gaussian_velocity_loss(ocsf, wide, settings(dptf_weight=3.0, gaussian_velocity_weight=2.0))
    expected = 3.0 * 2.0 * (0.5 * 0.5**2 + (3.0 - 0.5)) / 4
    assert {name: float(value.detach()) for name, value in terms.items()} == {
        "gaussian_velocity": pytest.approx(expected)
    }
    terms["gaussian_velocity"].backward()
    assert velocities.grad[0, 2:].abs().sum() == 0 and velocities.grad[0, :2].abs().sum() > 0
    tight = gaussian_velocity_loss(ocsf, narrow, settings())
    assert float(tight["gaussian_velocity"].detach()) == pytest.approx(0.5 * 0.5**2 / 2)
    assert gaussian_velocity_loss(ocsf, wide, settings(gaussian_velocity_weight=None)) == {}


def test_what_stands_and_the_ground_have_their_own_means(settings):
    """Cells of a moving box (2, 2), (2, 3), a standing one (4, 0), its margin (3, 0), an unseen box (0, 5), ground."""
    cells = torch.tensor([[0, 0, 2], [0, 0, 5], [0, 2, 2], [0, 2, 3], [0, 3, 0], [0, 4, 0]])
    fused, _ = bev_of(cells, TINY)
    boxes = boxes_of((0.0, 0.0, 2.0, 1.0, 7.0, -2.0), (-2.5, 2.0, 1.0, 1.0, 0.5, 0.0), (2.5, -2.0, 1.0, 1.0, 9.0, 0.0))
    boxes.num_points = torch.tensor([1, 1, 0])
    found = torch.tensor([[3.0, -1.0], [50.0, 50.0], [7.0, -1.0], [9.0, -2.0], [60.0, 0.0], [0.5, 4.0]])
    moving, standing, ground = (1 + 2) / 4, 4 / 2, (3 + 1) / 2
    prediction = CellPrediction(torch.zeros(6), found, found)
    for groups, expected in (
        (VelocityGroups.boxes, (1 + 2 + 4) / 6),
        (VelocityGroups.motion, moving + standing),
        (VelocityGroups.motion_and_ground, moving + standing + ground),
    ):
        terms = cell_losses(prediction, fused, BoxRaster([boxes], TINY, 2.0), settings(velocity_groups=groups))
        assert terms["cell_velocity"].item() == pytest.approx(expected), groups
    alone = cell_losses(prediction, fused, BoxRaster([boxes_of()], TINY, 2.0), settings(velocity_groups=groups))
    assert alone["cell_velocity"].item() == pytest.approx(found.abs().mean().item())  # all of it is ground
