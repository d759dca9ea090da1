"""Pictures of what a trained detector sees and says, for some validation frames."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.models.detector import Detector
from src.pictures.bev import BevScene
from src.pictures.cameras import CameraViews
from src.pictures.contents import PictureBoxes, PictureGaussians, PictureGrid
from src.pictures.frame import draw_frame
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CAMERAS, CLASS_RANGE_M, CLASSES

SHOWN_SCORE = 0.25
"""Boxes below are left out of pictures: a person looks for what the detector is sure of, the metric for all."""


@torch.no_grad()
def draw_frames(model: Detector, frames: list[FrameBatch], grid: BEVGrid, folder: Path) -> list[Path]:
    """One PNG per frame (batches of one): cameras, BEV, Gaussians, boxes. Returns the paths."""
    was_training = model.training
    model.eval()
    paths = []
    for number, batch in enumerate(frames):
        output = model(batch)
        (predictions,) = model.decode(output)
        path = folder / f"frame_{number}_{re.sub('[^0-9A-Za-z_-]', '_', batch.tokens[0])[:12]}.png"
        draw_frame(
            path,
            scene_of(batch, predictions, output, grid),
            views_of(batch),
            title=f"Sample {batch.tokens[0][:12]}",
            score_threshold=SHOWN_SCORE,
        )
        paths.append(path)
    model.train(was_training)
    return paths


def scene_of(
    batch: FrameBatch,  # of one frame
    predictions: Boxes3D,
    output: Any,  # the model's own output; Gaussians are drawn where it has some
    grid: BEVGrid,
) -> BevScene:
    """What the BEV panels show. Ground truth is what the evaluation counts: with points, within the class range."""
    truth = batch.boxes[0] if batch.boxes is not None else Boxes3D.empty()
    if len(truth):
        limits = torch.tensor([CLASS_RANGE_M[name] for name in CLASSES], device=truth.labels.device)[truth.labels]
        counted = (truth.centers[:, :2].norm(dim=1) < limits) & (truth.num_points > 0)
        truth = truth[counted]
    scene = BevScene(
        grid=PictureGrid(grid.x_min_m, grid.y_min_m, grid.cell_m, grid.rows, grid.cols),
        predictions=_boxes(predictions),
        ground_truth=_boxes(truth),
        radar_points=_numpy(batch.radar_points),
    )
    ocsf = getattr(output, "ocsf", None)
    if ocsf is not None:
        gaussians, keep = ocsf.gaussians, ocsf.gaussians.valid[0]
        scene.gaussians = PictureGaussians(
            means=_numpy(gaussians.means[0][keep]),
            scales=_numpy(gaussians.scales[0][keep]),
            directions=_numpy(gaussians.directions[0][keep]),
            opacities=_numpy(gaussians.opacity_logits[0][keep].sigmoid()),
            sources=_numpy(gaussians.sources[0][keep]),
        )
        cells = ocsf.splat.cells
        rows = _numpy(cells.support % (grid.rows * grid.cols))
        scene.occupancy = (np.stack([rows // grid.cols, rows % grid.cols], axis=1), _numpy(cells.occupancy))
    return scene


def views_of(batch: FrameBatch) -> CameraViews | None:
    """The four images with their projection, or None for a model without cameras. Without augmentation aug = ego."""
    if batch.images is None:
        return None
    images = _numpy(batch.images[0].permute(0, 2, 3, 1))
    valid = _numpy(batch.image_valid[0])
    return CameraViews(
        images=[image if seen else None for image, seen in zip(images, valid, strict=True)],
        pix_from_ego=_numpy(batch.pix_from_aug[0]),
        names=CAMERAS,
    )


def _boxes(boxes: Boxes3D) -> PictureBoxes:
    names = ("centers", "sizes", "yaws", "velocities", "labels")
    scores = None if boxes.scores is None else _numpy(boxes.scores)
    return PictureBoxes(**{name: _numpy(getattr(boxes, name)) for name in names}, scores=scores)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy() if tensor.is_floating_point() else tensor.detach().cpu().numpy()
