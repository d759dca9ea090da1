"""What a validation measures: one evaluator a task (`phase.task`), detection being the first."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, ClassVar, Self

import torch

from src.data.datamodule import DetectionDataModule
from src.geometry.bev_grid import BEVGrid
from src.metrics.bootstrap import LONG_RANGE, score_report
from src.metrics.detection import DetectionScores, score_detections
from src.metrics.diagnostics import FrameDiagnosis, diagnose
from src.metrics.protocol import Protocol
from src.metrics.score_text import format_scores
from src.metrics.submission import to_ego, to_global
from src.models.detector import Detector
from src.pictures.comparison import BarPanel, draw_comparison
from src.reliability.processes import gather_by_rank
from src.structures.batch import FrameBatch
from src.structures.detections import DetectionTable, EvaluationSet
from src.training.snapshots import draw_frames

SaveTable = Callable[[Path, list[str], DetectionTable], bool]
"""Writes the boxes of these samples as a submission; whether there were any."""


class Evaluator(ABC):
    """Collects outputs of a validation and scores them."""

    headline: ClassVar[str]
    """The number at the top of `as_dict` that sweeps and messages go by; larger is better."""
    monitored: ClassVar[tuple[str, ...]]
    """Numbers of `compute` that the best checkpoint may be chosen by (`phase.monitor`); larger is better."""
    labels: ClassVar[bool] = True
    """Whether annotations are read, in training as well; without, those of a data set are not touched."""

    @classmethod
    @abstractmethod
    def of(cls, datamodule: DetectionDataModule) -> Self:
        """The evaluator of a data set's validation split."""

    @abstractmethod
    def reset(self) -> None:
        """Forget what was collected."""

    @abstractmethod
    def update(self, model: Detector, output: Any, batch: FrameBatch) -> None:
        """Collect one batch's output."""

    @abstractmethod
    def compute(self) -> dict[str, float]:
        """Score what all ranks collected, the same on each; the numbers to log as `val/<name>`, the headline first."""

    @abstractmethod
    def as_dict(self) -> dict[str, Any]:
        """The last scores as metrics.json holds them."""

    @staticmethod
    @abstractmethod
    def describe(metrics: Mapping[str, Any]) -> str:
        """Content of metrics.json as a table for the terminal. Raises KeyError or TypeError for another task's."""

    def draw(self, folder: Path, title: str) -> None:  # noqa: B027, a task may have none
        """Pictures of the last scores."""

    def draw_frames(self, model: Detector, clips: list[list[FrameBatch]], grid: BEVGrid, folder: Path) -> None:
        """Pictures of what the model says at the end of each of some clips of consecutive validation frames."""
        draw_frames(model, clips, grid, folder)

    def write(self, folder: Path, save: SaveTable) -> list[str]:
        """Files besides metrics.json that hold the last results; their names."""
        return []


class DetectionEvaluator(Evaluator):
    """3D boxes by the official TruckScenes metric, and by a protocol of one's own beside it (`long_range`).

    A sample that several processes (or a padded batch) saw counts once. After `compute`, `scores` and `detections` are
    the same on every process, boxes in the order of the evaluation set whoever saw what.
    """

    headline = "mAP"
    monitored = ("mAP", "NDS")

    def __init__(self, evaluation_set: EvaluationSet, long_range: Protocol | None = None) -> None:
        self.evaluation_set, self.long_range = evaluation_set, long_range
        self.boxes: dict[int, DetectionTable] = {}  # by sample, a row of the evaluation set's tokens
        self.diagnoses: dict[int, FrameDiagnosis] = {}  # by sample as well
        self.scores: DetectionScores | None = None
        self.detections: DetectionTable | None = None
        self.content: dict[str, Any] | None = None  # of metrics.json

    @classmethod
    def of(cls, datamodule: DetectionDataModule, long_range: Protocol | None = None) -> DetectionEvaluator:
        """The evaluator over all annotations of the validation split."""
        return cls(datamodule.evaluation_set(), long_range)

    def reset(self) -> None:
        """Forget the boxes of an earlier pass."""
        self.boxes.clear()
        self.diagnoses.clear()

    def update(self, model: Detector, output: Any, batch: FrameBatch) -> None:
        """Decode, bring the boxes to the global frame, keep them by sample beside what they were made of."""
        samples = [self.evaluation_set.index_of[token] for token in batch.tokens]
        poses, truth = batch.global_from_ego.cpu().numpy(), self.evaluation_set.ground_truth
        in_ego = [to_ego(truth[truth.samples == sample], pose) for sample, pose in zip(samples, poses, strict=True)]
        with torch.autocast(batch.device.type, enabled=False):  # bfloat16 would move a box at 100 m by half a metre
            in_aug = [boxes.to(batch.device).transform(a) for boxes, a in zip(in_ego, batch.aug_from_ego, strict=True)]
        diagnoses = diagnose(model.evidence(output), batch, in_aug)
        for sample, boxes, pose, diagnosis in zip(samples, model.decode(output), poses, diagnoses, strict=True):
            self.boxes.setdefault(sample, to_global(boxes.to("cpu"), pose, sample))
            self.diagnoses.setdefault(sample, diagnosis)

    def compute(self) -> dict[str, float]:
        """mAP, NDS and the mean errors."""
        tables: dict[int, DetectionTable] = {}
        diagnoses: dict[int, FrameDiagnosis] = {}
        for boxes_of_rank, diagnoses_of_rank in gather_by_rank((self.boxes, self.diagnoses)):
            tables, diagnoses = boxes_of_rank | tables, diagnoses_of_rank | diagnoses
        in_order = [tables[sample] for sample in sorted(tables)]
        self.detections = DetectionTable.concatenate([DetectionTable.empty(), *in_order])
        self.scores, self.content = score_detections(self.evaluation_set, self.detections, diagnoses), None
        return self.scores.overall.headline()

    def as_dict(self) -> dict[str, Any]:
        """See `score_report`; made when first asked for: a validation in the middle of a training does without."""
        if self.content is None:
            self.content = score_report(self.evaluation_set, self.detections, self.scores, self.long_range)
        return self.content

    @staticmethod
    def describe(metrics: Mapping[str, Any]) -> str:
        """Scores by distance, class and speed, as text."""
        return format_scores(metrics)

    def draw(self, folder: Path, title: str) -> None:
        """Bars by class and distance."""
        scores, panels = self.as_dict(), []
        bounds = scores["intervals"]["bounds"]
        shown = [("AP by class, %", "classes.", "AP"), ("mAP by distance, %", "ranges.", "mAP")]
        if self.long_range is not None:
            near = f"{self.long_range.error_threshold_m:g} m"
            shown.append((f"mAP by distance, matches within {near}, %", f"{LONG_RANGE}.ranges.", "mAP"))
        for what, path, metric in shown:
            groups, bars = reduce(getitem, path.split(".")[:-1], scores), []
            for name, values in groups.items():
                low, high = bounds.get(f"{path}{name}.{metric}", 2 * [values[metric]])
                bars.append((100 * values[metric], 100 * low, 100 * high))
            panels.append(BarPanel(what, [name.replace("_", " ") for name in groups], {title: bars}))
        draw_comparison(folder / "scores.png", panels, title)

    def write(self, folder: Path, save: SaveTable) -> list[str]:
        """The submission, where there is any box."""
        path = folder / "submission.json"
        return [path.name] if save(path, self.evaluation_set.tokens, self.detections) else []
