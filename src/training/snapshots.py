"""Pictures of what a trained detector sees and says, for some validation frames."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.models.detector import Detector
from src.pictures.bev import BevScene
from src.pictures.cameras import PictureViews
from src.pictures.contents import PictureBoxes, PictureGaussians, PictureGrid, PictureMemory
from src.pictures.frame import draw_frame
from src.pictures.memory_picture import MemoryScene, draw_memory
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.evidence import Evidence, WarpedPoints
from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import CAMERAS, CLASS_RANGE_M, CLASSES
from src.training.evaluation_mode import evaluation_mode

SHOWN_SCORE = 0.25
"""Boxes below are left out of pictures: a person looks for what the detector is sure of, the metric for all."""


@torch.no_grad()
def draw_frames(model: Detector, clips: Iterable[list[FrameBatch]], grid: BEVGrid, folder: Path) -> list[Path]:
    """PNGs of the last frame of each clip of consecutive frames (batches of one), on whatever device they lie.

    `frame_*` shows cameras, BEV, Gaussians and boxes; for a model with memory, which streams the clip, `memory_*`
    what it remembered. A model of single frames needs clips of one frame. Returns the paths.
    """
    paths = []
    for name, batch, output in last_outputs(model, clips):
        (predictions,) = model.decode(output)
        evidence = model.evidence(output)
        scene = scene_of(batch, predictions, evidence, grid)
        title = f"Sample {batch.tokens[0][:12]}"
        paths.append(folder / f"frame_{name}")
        draw_frame(paths[-1], scene, views_of(batch), title, SHOWN_SCORE)
        remembered = memory_of(evidence, scene)
        if remembered is not None:
            paths.append(folder / f"memory_{name}")
            draw_memory(paths[-1], remembered, f"{title}: what was remembered")
    return paths


@torch.no_grad()
def last_outputs(model: Detector, clips: Iterable[list[FrameBatch]]) -> Iterator[tuple[str, FrameBatch, Any]]:
    """For each clip the end of its pictures' names, its last frame on the model's device, and the model's output."""
    device = next(model.parameters()).device
    with evaluation_mode(model):
        for number, clip in enumerate(clips):
            memory = None
            for frame in clip:
                batch = frame.to(device)
                output, memory = model(batch, memory)
            yield f"{number}_{re.sub('[^0-9A-Za-z_-]', '_', batch.tokens[0])[:12]}.png", batch, output


def scene_of(
    batch: FrameBatch,  # of one frame
    predictions: Boxes3D,
    evidence: Evidence,
    grid: BEVGrid,
) -> BevScene:
    """What the BEV panels show. Ground truth is what the evaluation counts: with points, within the class range."""
    truth = batch.boxes[0] if batch.boxes is not None else Boxes3D.empty()
    if len(truth):
        limits = torch.tensor([CLASS_RANGE_M[name] for name in CLASSES], device=truth.labels.device)[truth.labels]
        counted = (truth.centers[:, :2].norm(dim=1) < limits) & (truth.num_points != 0)
        truth = truth[counted]
    scene = BevScene(
        grid=PictureGrid(grid.x_min_m, grid.y_min_m, grid.cell_m, grid.rows, grid.cols),
        predictions=boxes_of(predictions),
        ground_truth=boxes_of(truth),
        radar_points=_numpy(batch.radar_points) if batch.radar_points is not None else None,
        lidar_points=_numpy(batch.lidar_points) if batch.lidar_points is not None else None,
    )
    if evidence.gaussians is not None:
        scene.gaussians = _gaussians(evidence.gaussians)
    if evidence.cells is not None:
        shown = evidence.cells.indices[:, 0] == 0
        scene.occupancy = (_numpy(evidence.cells.indices[shown, 1:]), _numpy(evidence.cells.occupancy[shown]))
    return scene


def memory_of(
    evidence: Evidence,
    scene: BevScene,  # of the same frame
) -> MemoryScene | None:
    """What the memory picture shows; None for a model without memory, empty memories where it remembers nothing yet."""
    warped = (evidence.warped_gaussians, evidence.warped_cells, evidence.warped_queries)
    if all(points is None for points in warped):
        return None
    return MemoryScene(scene.grid, scene.ground_truth, *map(_memory, warped))


def _memory(points: WarpedPoints | None) -> PictureMemory | None:
    if points is None:
        return None
    gaussians = None if points.gaussians is None else _gaussians(points.gaussians)
    return PictureMemory(
        _numpy(points.xy), _numpy(points.velocities), _numpy(points.elapsed_s), gaussians, points.compensated
    )


def views_of(batch: FrameBatch) -> PictureViews | None:
    """The four images with their projection, or None for a model without cameras. Without augmentation aug = ego."""
    if batch.images is None:
        return None
    images = _numpy(batch.images[0].permute(0, 2, 3, 1))
    valid = _numpy(batch.image_valid[0])
    return PictureViews(
        images=[image if seen else None for image, seen in zip(images, valid, strict=True)],
        pix_from_ego=_numpy(batch.pix_from_aug[0]),
        names=CAMERAS,
    )


def _gaussians(gaussians: GaussianSet) -> PictureGaussians:
    """The valid Gaussians of the first sample."""
    keep = gaussians.valid[0]
    return PictureGaussians(
        means=_numpy(gaussians.means[0][keep]),
        scales=_numpy(gaussians.scales[0][keep]),
        directions=_numpy(gaussians.directions[0][keep]),
        opacities=_numpy(gaussians.opacity_logits[0][keep].sigmoid()),
        sources=_numpy(gaussians.sources[0][keep]),
    )


def boxes_of(boxes: Boxes3D) -> PictureBoxes:
    """Boxes as pictures take them."""
    names = ("centers", "sizes", "yaws", "velocities", "labels")
    scores = None if boxes.scores is None else _numpy(boxes.scores)
    return PictureBoxes(**{name: _numpy(getattr(boxes, name)) for name in names}, scores=scores)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().numpy() if tensor.is_floating_point() else tensor.detach().cpu().numpy()
