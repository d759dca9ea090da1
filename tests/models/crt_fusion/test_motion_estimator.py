"""Motion estimator: its losses against sums over cells by hand."""

import torch

from src.losses.classification import balanced_focal, sigmoid_focal
from src.models.crt_fusion.motion_estimator import CellMotion, MotionEstimator, velocity_loss
from src.structures.boxes import Boxes3D
from src.targets.box_raster import BoxRaster
from tests.models.frames import GRID


def boxes(*rows):
    """x, y, vx, vy of cars of 4 x 1.6 m along x."""
    table = torch.tensor(rows).view(-1, 4)
    count = len(table)
    return Boxes3D(
        centers=torch.cat([table[:, :2], torch.zeros(count, 1)], 1),
        sizes=torch.tensor([4.0, 1.6, 1.5]).expand(count, 3),
        yaws=torch.zeros(count), velocities=table[:, 2:], labels=torch.zeros(count, dtype=torch.long),
        attributes=torch.full((count,), -1), num_points=torch.full((count,), 5),
    )  # fmt: skip


def test_targets_are_the_cells_of_boxes_and_the_faster_box_wins():
    """Two boxes over each other at 3 and 20 m/s, one whose velocity nobody knows; the second sample is empty."""
    annotated = [boxes((2.1, -1.1, 3.0, 0.0), (2.1, -1.1, 20.0, 1.0), (14.1, 8.9, torch.nan, torch.nan)), boxes()]
    raster = BoxRaster(annotated, GRID, margin_m=0.0)
    cells = GRID.rows * GRID.cols
    torch.manual_seed(0)
    motion = CellMotion(torch.randn(2 * cells), torch.randn(2 * cells, 2))
    row, col = torch.meshgrid(torch.arange(GRID.rows), torch.arange(GRID.cols), indexing="ij")
    x, y = GRID.centre_of(torch.stack([row, col], -1)).view(-1, 2).unbind(1)

    def inside(cx, cy):
        return ((x - cx).abs() < 2.0) & ((y - cy).abs() < 0.8)

    moving, unknown = inside(2.1, -1.1), inside(14.1, 8.9)
    target = torch.cat([moving | unknown, torch.zeros(cells, dtype=torch.bool)])
    assert torch.equal(target.nonzero().squeeze(1), raster.keys) and len(raster.keys) > 15
    focal = sigmoid_focal(motion.occupancy_logits, target)
    found = balanced_focal(motion.occupancy_logits, raster.keys)
    torch.testing.assert_close(found, focal[target].mean() + focal[~target].mean())
    errors = (motion.velocities[:cells][moving] - torch.tensor([20.0, 1.0])).abs()
    torch.testing.assert_close(velocity_loss(motion, raster), errors.mean())
    nothing = BoxRaster([boxes(), boxes()], GRID, margin_m=0.0)
    assert velocity_loss(motion, nothing) == 0.0 and balanced_focal(motion.occupancy_logits, nothing.keys).isfinite()


def test_it_predicts_metres_per_second_and_an_empty_map_at_first():
    torch.manual_seed(0)
    estimator = MotionEstimator(8).eval()
    motion = estimator(torch.randn(2, 8, 5, 7))
    assert motion.occupancy_logits.shape == (70,) and motion.velocities.shape == (70, 2)
    assert motion.occupancy_logits.sigmoid().max() < 0.05
    raw = estimator.output(estimator.hidden(torch.zeros(1, 8, 1, 1)))[0, :, 0, 0]
    torch.testing.assert_close(estimator(torch.zeros(1, 8, 1, 1)).velocities[0], 10.0 * raw[1:])
