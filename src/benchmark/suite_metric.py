"""Our detection scores against the official evaluator's: the same random boxes, the same numbers, CPU seconds."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from src.config import Config
from src.errors import ConfigError
from src.metrics.detection import score_detections
from src.metrics.protocol import OFFICIAL
from src.metrics.scores import DISTANCE_THRESHOLDS_M, ERRORS, SubsetScores
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import ATTRIBUTES, BICYCLE_RACK, CLASSES, REFERENCE_CHANNEL, SCENE_TAGS

Array = np.ndarray

AGREEMENT = 1e-9
"""Largest difference between two numbers that counts as agreement."""

_DEVKIT_ERRORS = dict(zip(ERRORS, ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err"), strict=True))


def measure(config: Config, tree: dict[str, Any]) -> dict[str, float | int | bool]:
    """`compare_with_devkit` on a problem about the size of the official val split with a full submission."""
    return compare_with_devkit(num_samples=3000, gts=25, preds=300, seed=config.seed)


def compare_with_devkit(num_samples: int, gts: int, preds: int, seed: int) -> dict[str, float | int | bool]:
    """Score one random problem with ours and with the official evaluator, both from parsed boxes to all numbers.

    `gts` and `preds` are boxes per sample. Seconds are CPU time of this process. Both also score the four distance
    bins: the official evaluator on boxes cut to each bin. `agrees` says whether every AP and error of every class (and
    mAP and NDS) is within 1e-9.

    Raises ConfigError when truckscenes-devkit is not installed.
    """
    devkit = _import_devkit()
    evaluation_set, predictions = random_problem(num_samples, gts, preds, seed)
    timed: dict[str, float] = {}
    for name, by_range in (("ours_s", False), ("ours_ranges_s", True)):
        start = time.process_time()
        ours = score_detections(evaluation_set, predictions, by_range=by_range, by_tag=False, by_speed=False)
        timed[name] = time.process_time() - start

    official = _OfficialEvaluation(devkit, evaluation_set, predictions)
    start = time.process_time()
    official.filter()
    differences = [_difference(ours.overall, official.evaluate())]
    timed["devkit_s"] = time.process_time() - start
    result: dict[str, float | int | bool] = {"samples": num_samples, "ground_truth": gts, "predictions": preds}
    result |= timed | {"speedup": timed["devkit_s"] / timed["ours_s"]}
    start = time.process_time()
    for low, high in OFFICIAL.ranges_m:
        differences.append(_difference(ours.ranges[f"{low:.0f}-{high:.0f}"], official.evaluate(low, high)))
    result["devkit_ranges_s"] = timed["devkit_s"] + time.process_time() - start
    result["speedup_ranges"] = result["devkit_ranges_s"] / timed["ours_ranges_s"]
    worst = max(differences)
    return result | {"max_difference": worst, "agrees": bool(worst <= AGREEMENT)}


def random_problem(num_samples: int, gts: int, preds: int, seed: int) -> tuple[EvaluationSet, DetectionTable]:
    """A split of random samples with `gts` boxes each, and `preds` predictions each, about half of them near a box.

    It holds what the rules treat specially: boxes out of range and without points, cycles in racks, unknown
    velocities and attributes, equal scores, several predictions for one box.
    """
    rng = np.random.default_rng(seed)
    tokens = [f"{row:032x}" for row in range(num_samples)]
    ego = np.concatenate([rng.uniform(6.9e5, 7.1e5, (num_samples, 1)), rng.uniform(5.3e6, 5.4e6, (num_samples, 1))], 1)
    ego = np.concatenate([ego, np.zeros((num_samples, 1))], axis=1)
    truth = _random_boxes(rng, ego, gts)
    truth.num_points = rng.integers(0, 30, len(truth))
    predictions = _random_boxes(rng, ego, preds)
    predictions.scores = np.round(rng.beta(1, 4, len(predictions)), 3)
    if len(truth):
        near = np.flatnonzero(rng.random(len(predictions)) < 0.5)
        source = predictions.samples[near] * gts + rng.integers(0, gts, len(near))
        predictions.labels[near] = np.where(rng.random(len(near)) < 0.9, truth.labels[source], predictions.labels[near])
        predictions.centers[near] = truth.centers[source] + rng.normal(0, 1.5, (len(near), 3))
        predictions.sizes[near] = truth.sizes[source] * rng.uniform(0.7, 1.4, (len(near), 3))
        predictions.attributes[near] = truth.attributes[source]
    racks = _random_boxes(rng, ego, 1)
    racks.labels[:] = 0
    racks.sizes[:] = (30.0, 30.0, 6.0)
    tags = [tuple(rng.choice(SCENE_TAGS, 3, replace=False)) for _ in range(max(1, num_samples // 40))]
    scenes = np.arange(num_samples) * len(tags) // num_samples
    of_samples = [tags[scene] for scene in scenes]
    times_s = 0.5 * np.arange(num_samples)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (num_samples, 1))
    instances = np.arange(len(truth))
    return EvaluationSet(tokens, ego, level, of_samples, truth, racks, scenes, times_s, instances), predictions


def _random_boxes(
    rng: np.random.Generator,
    ego: Array,  # [S, 3]
    per_sample: int,
) -> DetectionTable:
    n = len(ego) * per_sample
    samples = np.repeat(np.arange(len(ego)), per_sample)
    distance, bearing = rng.uniform(1, 160, n), rng.uniform(-np.pi, np.pi, n)
    offsets = np.stack([distance * np.cos(bearing), distance * np.sin(bearing), rng.normal(1, 0.3, n)], axis=1)
    half_yaw = rng.uniform(-np.pi, np.pi, n) / 2
    zeros = np.zeros(n)
    velocities = rng.normal(0, 8, (n, 2))
    velocities[rng.random(n) < 0.1] = np.nan
    return DetectionTable(
        samples=samples,
        labels=rng.integers(0, len(CLASSES), n),
        centers=ego[samples] + offsets,
        sizes=rng.uniform(0.4, 6.0, (n, 3)),
        rotations=np.stack([np.cos(half_yaw), zeros, zeros, np.sin(half_yaw)], axis=1),
        velocities=velocities,
        attributes=rng.integers(-1, len(ATTRIBUTES), n),
        scores=np.zeros(n),
        num_points=np.full(n, -1),
    )


def _import_devkit() -> SimpleNamespace:
    """The parts of truckscenes-devkit that score boxes."""
    try:
        from truckscenes.eval.common import data_classes as common
        from truckscenes.eval.common import loaders
        from truckscenes.eval.detection import config, evaluate
        from truckscenes.eval.detection import data_classes as detection
    except ImportError as error:
        raise ConfigError(
            f"the metric benchmark compares with truckscenes-devkit, which cannot be imported ({error}); "
            "install it with pip install 'truckscenes-devkit>=1.2,<2' (Python below 3.12)"
        ) from error
    rules = config.config_factory("detection_cvpr_2024")
    return SimpleNamespace(common=common, loaders=loaders, detection=detection, evaluate=evaluate, rules=rules)


class _Tables:
    """The records that the official filters look up, in memory: sample, its LIDAR_LEFT pose, its bicycle racks."""

    def __init__(self, evaluation_set: EvaluationSet) -> None:
        self.records: dict[tuple[str, str], dict[str, object]] = {}
        racks = evaluation_set.racks
        for row, token in enumerate(evaluation_set.tokens):
            names = [f"{token}-{rack}" for rack in np.flatnonzero(racks.samples == row)]
            self.records["sample", token] = {"data": {REFERENCE_CHANNEL: token}, "anns": names}
            self.records["sample_data", token] = {"ego_pose_token": token}
            self.records["ego_pose", token] = {"translation": evaluation_set.ego_centers[row].tolist()}
        for row, sample in enumerate(racks.samples):
            self.records["sample_annotation", f"{evaluation_set.tokens[sample]}-{row}"] = {
                "category_name": BICYCLE_RACK,
                "translation": racks.centers[row].tolist(),
                "size": racks.sizes[row].tolist(),
                "rotation": racks.rotations[row].tolist(),
            }

    def get(self, table: str, token: str) -> dict[str, object]:
        """The record of a table, as the official loader gives it."""
        return self.records[table, token]


class _OfficialEvaluation:
    """The official evaluator on boxes in memory; building it is parsing and not timed."""

    def __init__(self, devkit: SimpleNamespace, evaluation_set: EvaluationSet, predictions: DetectionTable) -> None:
        self.devkit = devkit
        self.tables = _Tables(evaluation_set)
        tokens = evaluation_set.tokens
        self.truth = self._boxes(evaluation_set.ground_truth, tokens)
        self.predictions = self._boxes(predictions, tokens)

    def _boxes(self, table: DetectionTable, tokens: list[str]) -> object:
        boxes = self.devkit.common.EvalBoxes()
        of_sample: list[list[object]] = [[] for _ in tokens]
        columns = (table.centers, table.sizes, table.rotations, table.velocities, table.scores)
        integers = (table.samples, table.labels, table.attributes, table.num_points)
        for center, size, rotation, velocity, score, sample, label, attribute, points in zip(
            *(column.tolist() for column in columns + integers), strict=True
        ):
            box = self.devkit.detection.DetectionBox(
                sample_token=tokens[sample],
                translation=tuple(center),
                size=tuple(size),
                rotation=tuple(rotation),
                velocity=tuple(velocity),
                num_pts=points,
                detection_name=CLASSES[label],
                detection_score=score,
                attribute_name=ATTRIBUTES[attribute] if attribute >= 0 else "",
            )
            of_sample[sample].append(box)
        for token, listed in zip(tokens, of_sample, strict=True):
            boxes.add_boxes(token, listed)
        return boxes

    def filter(self) -> None:
        """Apply the official filters to both, in place."""
        for boxes in (self.truth, self.predictions):
            self.devkit.loaders.add_center_dist(self.tables, boxes)
            self.devkit.loaders.filter_eval_boxes(self.tables, boxes, self.devkit.rules.class_range)

    def evaluate(self, low_m: float = 0.0, high_m: float = np.inf) -> object:
        """The official scores of the boxes with low <= distance to the ego < high."""
        evaluator = self.devkit.evaluate.DetectionEval.__new__(self.devkit.evaluate.DetectionEval)
        evaluator.cfg, evaluator.verbose = self.devkit.rules, False
        evaluator.gt_boxes = self._cut(self.truth, low_m, high_m)
        evaluator.pred_boxes = self._cut(self.predictions, low_m, high_m)
        evaluator.gt_boxes_masks, evaluator.pred_boxes_masks = {}, {}
        metrics, _ = evaluator.evaluate()
        return metrics["all"]

    def _cut(self, boxes: object, low_m: float, high_m: float) -> object:
        if low_m <= 0 and np.isinf(high_m):
            return boxes
        cut = self.devkit.common.EvalBoxes()
        for token in boxes.sample_tokens:
            cut.add_boxes(token, [box for box in boxes[token] if low_m <= box.ego_dist < high_m])
        return cut


def _difference(ours: SubsetScores, official: object) -> float:
    """Largest absolute difference over mAP, NDS, every AP and every error; inf where only one is undefined."""
    pairs = [(ours.mean_ap, official.mean_ap), (ours.nds, official.nd_score)]
    for c, name in enumerate(CLASSES):
        pairs += [(ours.ap[c, t], official.get_label_ap(name, th)) for t, th in enumerate(DISTANCE_THRESHOLDS_M)]
        pairs += [(ours.errors[c, e], official.get_label_tp(name, _DEVKIT_ERRORS[m])) for e, m in enumerate(ERRORS)]
    left, right = np.array(pairs).T
    difference = np.where(np.isnan(left) & np.isnan(right), 0.0, np.abs(left - right))
    return float(np.where(np.isnan(difference), np.inf, difference).max())
