"""What suites measure: a model as trained and as prediction prepares it, its frame, its memory, scores as trained."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from src.assembly import build_model, restored_model
from src.benchmark.scenes import ROADS, Highway, made_batch
from src.config import Config
from src.data.reader import ReaderSettings
from src.models.deploy.inference import prepare_for_inference
from src.models.detector import Detector
from src.ops.precision import computing
from src.reliability.checkpoints import read_checkpoint
from src.streaming import StreamingDetector
from src.structures.batch import FrameBatch
from src.structures.gaussians import GaussianSet
from src.training.phases import EVALUATORS

KEY_FRAME_S = 0.5
CANDIDATES = 300  # cells above the score threshold: what traffic lights up in a trained model, within its 500 boxes
CELLS_PER_VEHICLE = {"paper": 17, "mini": 38, "debug": 2}
"""Remembered in each frame, where fresh weights would call no cell occupied; paper: 8000 cells in eight frames; mini:
of a trained phase 2 with a neck, 2,280 in the median frame."""

OCCUPIED_CELLS = {"paper": 6104, "mini": 8600, "debug": 600}
"""What trained Gaussians occupy in a frame, of 147,456. paper: the 450 that the authors show of one (project page,
ocsf_demo.json; opacities from 0.996 on), above the threshold of 0.1. mini: `occupied_share` of a trained phase 2."""
OPAQUE = 6.0  # logit


@dataclass
class Case:
    """A model, as trained and as prediction prepares it, with a batch and, in phase 2, a full memory."""

    model: Detector
    prepared: Detector
    batch: FrameBatch
    memory: Any
    device: torch.device
    precision: str
    learns_boxes: bool  # of a phase without, a world model is asked what is where rays end

    def computing(self) -> AbstractContextManager[None]:
        """Context in which the model computes as in training and prediction: in its precision, on its device."""
        return computing(self.precision, self.device)

    def infer(self) -> tuple[Any, Any]:
        """Forward and boxes, or answers where the batch's rays end, without gradients."""
        with torch.no_grad(), self.computing():
            output, _ = self.prepared(self.batch, self.memory)
            if self.learns_boxes:
                return output, self.prepared.decode(output)
            rays = self.batch.rays
            queries = torch.cat([rays.points, rays.times_s[:, None]], dim=1)
            return output, self.prepared.look_up(output, queries, rays.batch)

    def run(self) -> tuple[Any, Any]:
        """Forward, for gradients."""
        with self.computing():
            return self.model(self.batch, self.memory)

    def losses(self) -> Tensor:
        """Sum of the weighted loss terms, for gradients."""
        with self.computing():
            output, _ = self.model(self.batch, self.memory)
            return self.model.loss(output, self.batch).terms["total"]

    def step(self) -> Tensor:
        """Forward, losses and backward; the weights' gradients are dropped."""
        total = self.losses()
        total.backward()
        self.model.zero_grad(set_to_none=True)
        return total.detach()


def build_case(config: Config, batch: FrameBatch, device: torch.device) -> Case:
    """The configured model, with weights of `checkpoint=PATH` if given, before its first batch."""
    model = measured_model(config).to(device)
    prepared = prepare_for_inference(model, config.precision)
    learns_boxes = EVALUATORS[config.phase.task].labels
    return Case(model.train(), prepared, batch, None, device, config.precision, learns_boxes)


def made_case(config: Config, device: torch.device, road: Highway, image_size_px: tuple[int, int]) -> Case:
    """The configured model on made frames of this road, its memory full."""
    torch.manual_seed(config.seed)
    config = replace(config, backbone=replace(config.backbone, image_size_px=list(image_size_px)))
    batch = made_batch(config.data.batch_size, road, image_size_px).to(device)
    case = build_case(config, batch, device)
    fill_memory(case, config.model.memory_frames)
    expect_trained_scores(case)
    return case


def measured_detector(config: Config, settings: ReaderSettings, frame: FrameBatch) -> StreamingDetector:
    """The configured model with fresh weights or those of `checkpoint=PATH`, as prediction prepares it. Fresh weights
    find as many boxes in `frame` as trained ones."""
    torch.manual_seed(config.seed)
    device = config.trainer.device()
    detector = StreamingDetector(measured_model(config), config.grid.build(), settings, device, config.precision)
    if config.checkpoint is None:
        expect_trained_scores(detector_case(detector, frame))
    return detector


def detector_case(detector: StreamingDetector, frame: FrameBatch) -> Case:
    """A detector before a frame, without memory; not for gradients."""
    model, device = detector.model, detector.device
    return Case(model, model, frame.to(device), None, device, detector.precision, learns_boxes=True)


def remembering(config: Config) -> Config:
    """The configuration with as many remembered cells as traffic fills, whatever fresh weights call occupied."""
    cells = ROADS[config.scale].num_vehicles * CELLS_PER_VEHICLE[config.scale]
    return replace(config, model=config.model.scaled(cells_per_frame=cells))


def fill_memory(case: Case, num_frames: int) -> None:
    """Let it remember so many frames in which the truck stands."""
    with torch.no_grad(), case.computing():
        for _ in range(num_frames):
            _, case.memory = case.prepared(case.batch, case.memory)
            case.batch = later(case.batch)


def later(batch: FrameBatch) -> FrameBatch:
    """The next key frame of a truck that stands."""
    return replace(batch, timestamps_s=batch.timestamps_s + KEY_FRAME_S)


def measured_model(config: Config) -> Detector:
    """The configured model, with the weights of `checkpoint=PATH`, if given, which must be of this configuration."""
    if config.checkpoint is None:
        return build_model(config)
    path = Path(config.checkpoint)
    return restored_model(config, read_checkpoint(path), path)


def expect_trained_scores(case: Case) -> tuple[Any, Any]:
    """Set the score threshold of the prepared model so that decoding has the work that it has in a trained one; of a
    model without boxes nothing.

    Fresh weights give every cell about the threshold of the configuration, and boxes would be made of half of them.
    Returns what forward gave for the frame that the scores are of: output and memory.
    """
    with torch.no_grad(), case.computing():
        output, memory = case.prepared(case.batch, case.memory)
    scores = output.head.logits.float().sigmoid().flatten() if case.learns_boxes else ()
    if len(scores) > CANDIDATES:
        head = case.prepared.head
        head.config = replace(head.config, score_threshold=float(scores.topk(CANDIDATES).values[-1]))
    return output, memory


def expect_trained_occupancy(case: Case, num_cells: int) -> None:
    """Make as many Gaussians of the prepared model opaque as occupy about `num_cells` cells, evenly among all, and the
    rest transparent, and set the score threshold anew; nothing of a model without Gaussians.

    Of fresh weights every Gaussian is faintly opaque, and together they fill the map to its limit.
    """
    ocsf = getattr(case.prepared, "ocsf", None)
    if ocsf is None:
        return
    encode, opaque = ocsf.encoder.forward, None

    def forward(*inputs: Any) -> tuple[GaussianSet, Tensor]:
        gaussians, velocities = encode(*inputs)
        if opaque is None:
            return gaussians, velocities
        logits = torch.where(opaque, OPAQUE, -OPAQUE).expand_as(gaussians.opacity_logits)
        return replace(gaussians, opacity_logits=logits), velocities

    def output() -> Any:
        with torch.no_grad(), case.computing():
            return case.prepared(case.batch, case.memory)[0].ocsf

    ocsf.encoder.forward = forward
    number = torch.arange(output().gaussians.valid.shape[1], device=case.device)
    low, high = 0, len(number) + 1
    while high - low > 1:
        middle = (low + high) // 2
        opaque = (number + 1) * middle // len(number) > number * middle // len(number)
        low, high = (middle, high) if len(output().splat.cells.occupied) <= num_cells else (low, middle)
    opaque = (number + 1) * low // len(number) > number * low // len(number)
    expect_trained_scores(case)
