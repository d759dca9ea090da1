"""Detection scores of MAN TruckScenes: AP, true positive errors and NDS (devkit 1.2, `detection_cvpr_2024`).

The definition, in short. Boxes beyond their class's range, without points, or cycles in a bicycle rack do not count.
Per class and distance threshold, predictions by descending score (the later in the file first among equal ones) each
take the nearest free ground truth of their sample. AP is the area under precision over recall above 0.1 and 0.1,
averaged over four thresholds; errors are running means over the matches at 2 m. NDS joins both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from src.metrics.checks import check_predictions
from src.metrics.curves import (
    RECALLS,
    average_precision,
    error_curve,
    mean_error,
    normalized_precision,
    precision_and_confidence,
)
from src.metrics.diagnostics import FAST_MPS, FrameDiagnosis, ratios, sums_by_sample
from src.metrics.filtering import SPEED_CLASSES_MPS, speed_classes
from src.metrics.matching import CandidatePairs
from src.metrics.protocol import OFFICIAL, Protocol
from src.metrics.ranking import (
    Matching,
    Part,
    Ranking,
    SpeedPart,
    find_candidates,
    match_predictions,
    rank_predictions,
)
from src.metrics.scores import ERRORS, SubsetScores, plain_number
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASS_WITHOUT_ERRORS, CLASSES, SCENE_TAGS, TAGS_WITHOUT_SCORE

Array = np.ndarray

UNDEFINED_ERRORS = np.array([[error in CLASS_WITHOUT_ERRORS[name] for error in ERRORS] for name in CLASSES])
MOVING = [CLASSES.index(name) for name in ("car", "truck", "bus", "trailer", "motorcycle")]
"""Classes whose boxes above FAST_MPS are the moving vehicles."""
EVERY_SPEED = -2
"""In place of a speed class: a false positive far from all ground truth."""


@dataclass
class MatchedParts:
    """Predictions of an evaluation set, matched once: what scores, and their intervals, are read from."""

    ranking: Ranking
    matching: Matching
    overall: Part
    ranges: dict[str, Part]
    speeds: dict[str, SpeedPart]
    moving: SpeedPart | None  # None where speeds are not asked for
    sums: dict[str, Array]  # [S, 2] see `_motion_sums` and `sums_by_sample`
    truth_kept: Array  # [k] bool, ground truth that survives the official filters


@dataclass
class DetectionScores:
    """An evaluation: over everything, by distance bin (`"0-25"` ...), scene tag and speed class (`"0.5-10"` ...)."""

    overall: SubsetScores
    ranges: dict[str, SubsetScores]  # empty where not asked for
    tags: dict[str, SubsetScores]  # empty where not asked for
    speeds: dict[str, SubsetScores]  # empty where not asked for
    measures: dict[str, float | None]  # see `measure_parts`
    parts: MatchedParts  # what they were read from

    def as_dict(self) -> dict[str, object]:
        """The content of metrics.json but for intervals: fractions of 1, None where a number is undefined.

        A part counts a class without ground truth as the official score does (AP 0, errors 1); entries of `speeds`
        also hold the means over the classes that are there, see `PartScores.present_means`.
        """
        return self.overall.as_dict(plain_number) | {
            "ranges": {name: scores.as_dict(plain_number) for name, scores in self.ranges.items()},
            "tags": {name: scores.as_dict(plain_number) for name, scores in self.tags.items()},
            "speeds": {name: scores.as_dict(plain_number) for name, scores in self.speeds.items()},
            "measures": self.measures,
        }


def score_detections(
    evaluation_set: EvaluationSet,
    predictions: DetectionTable,
    diagnoses: Mapping[int, FrameDiagnosis] | None = None,  # by sample
    by_range: bool = True,
    by_tag: bool = True,
    by_speed: bool = True,
    protocol: Protocol = OFFICIAL,
) -> DetectionScores:
    """Score predictions as the official evaluator does, and by distance bin, scene tag and speed class.

    Another `protocol` counts other boxes and matches and is no official score.

    A sample of the set without predictions is scored as empty. Tags follow the official rule: samples whose scene
    carries the tag, NaN for the tags in TAGS_WITHOUT_SCORE. Distance bins are our own: see OFFICIAL; so are speed
    classes: see `_speed_parts`, and measures: see `measure_parts`.

    Raises DataError for predictions that cannot be scored (see `check_predictions`) and for matched ground truth
    whose size is not positive, as the official evaluator does.
    """
    parts = match_parts(evaluation_set, predictions, diagnoses or {}, by_range, by_speed, protocol)
    return DetectionScores(
        overall=_score(parts.overall),
        ranges={name: _score(part) for name, part in parts.ranges.items()},
        tags={tag: _score_tag(parts, tag) for tag in SCENE_TAGS} if by_tag else {},
        speeds={name: _score_speed(parts, part) for name, part in parts.speeds.items()},
        measures=measure_parts(parts),
        parts=parts,
    )


def match_parts(
    evaluation_set: EvaluationSet,
    predictions: DetectionTable,
    diagnoses: Mapping[int, FrameDiagnosis],  # by sample
    by_range: bool,
    by_speed: bool,
    protocol: Protocol = OFFICIAL,
) -> MatchedParts:
    """Rank and match, and say which boxes are scored together. Raises as `score_detections`."""
    check_predictions(predictions, evaluation_set.tokens)
    truth = evaluation_set.ground_truth
    kept, truth_kept = protocol.counted(evaluation_set, predictions), protocol.counted(evaluation_set, truth)
    ranking = rank_predictions(evaluation_set, protocol, predictions, kept, truth[truth_kept])
    pairs = find_candidates(ranking)
    matching = match_predictions(ranking, pairs)
    everyone, every_truth = np.ones(len(ranking.rows), bool), np.ones(len(ranking.truth), bool)
    ranges: dict[str, Part] = {}
    speeds: dict[str, SpeedPart] = {}
    moving = None
    if by_range:
        bins = protocol.bins(evaluation_set, predictions)[ranking.rows]
        truth_bins = protocol.bins(evaluation_set, ranking.truth)
        # Boxes of different bins never meet, so all bins are matched at once.
        in_bins = match_predictions(ranking, pairs[bins[pairs.predictions] == truth_bins[pairs.ground_truth]])
        ranges = {
            name: Part(ranking, in_bins, bins == i, truth_bins == i) for i, name in enumerate(protocol.range_names)
        }
    if by_speed:
        speeds, moving = _speed_parts(ranking, matching, pairs)
    found = np.zeros(len(truth), bool)
    with_errors = matching.ground_truth[protocol.thresholds_m.index(protocol.error_threshold_m)]
    found[np.flatnonzero(truth_kept)[with_errors]] = True
    return MatchedParts(
        ranking=ranking,
        matching=matching,
        overall=Part(ranking, matching, everyone, every_truth),
        ranges=ranges,
        speeds=speeds,
        moving=moving,
        sums=(_motion_sums(ranking, matching) if by_speed else {})
        | sums_by_sample(diagnoses, evaluation_set, truth_kept, found),
        truth_kept=truth_kept,
    )


def measure_parts(parts: MatchedParts) -> dict[str, float | None]:
    """What sees the claim of a memory, beside the official scores; each with the number of boxes it stands on.

    `moving_AP`: AP of MOVING above FAST_MPS as one class, so that every box weighs the same; each is matched within its
    own, and predictions follow the rule of `_speed_parts`; `moving_AP_normalized` is to it as `normalized_ap` is to the
    AP of a speed class. The others: see `_motion_sums` and `sums_by_sample`.
    """
    measures: dict[str, float | None] = {}
    if parts.moving is not None:
        boxes, every = int(parts.moving.truth_members.sum()), int(np.isin(parts.ranking.truth.labels, MOVING).sum())
        for name, part in (("moving_AP", parts.moving), ("moving_AP_normalized", parts.moving.by_place)):
            precision = np.zeros((len(parts.ranking.protocol.thresholds_m), len(RECALLS)))
            for listed in part.pooled_lists():
                scores = parts.ranking.scores[listed.places]
                precision[listed.threshold], _ = precision_and_confidence(listed.matched, scores, boxes)
            if part is not parts.moving:
                precision = normalized_precision(precision, boxes, every)
            measures[name] = float(average_precision(precision).mean()) if boxes else None
        measures["moving_boxes"] = boxes
    for name, ratio in ratios(parts.sums, np.ones((1, len(parts.ranking.evaluation_set.tokens)))).items():
        measures[name] = plain_number(ratio[0])
        if name.endswith("_recall"):
            measures[name.replace("_recall", "_boxes")] = int(parts.sums[name][:, 1].sum())
    return measures


def _score(
    part: Part,
    totals: Array | None = None,  # [12] objects of each class that precision is normalised to, without errors then
) -> SubsetScores:
    num_classes, thresholds_m = len(CLASSES), part.ranking.protocol.thresholds_m
    num_gt = np.bincount(part.ranking.truth.labels[part.truth_members], minlength=num_classes)
    precision = np.zeros((num_classes, len(thresholds_m), len(RECALLS)))
    errors = np.ones((num_classes, len(ERRORS)))
    for listed in part.lists():
        c, t, scores = listed.label, listed.threshold, part.ranking.scores[listed.places]
        precision[c, t], confidence = precision_and_confidence(listed.matched, scores, int(num_gt[c]))
        if totals is not None:
            precision[c, t] = normalized_precision(precision[c, t], num_gt[c], totals[c])
        if listed.errors is None or totals is not None:
            continue
        match_scores = scores[listed.matched]
        for e, values in enumerate(listed.errors.T):
            errors[c, e] = mean_error(error_curve(values, match_scores, confidence), confidence)
    return SubsetScores(
        thresholds_m=thresholds_m,
        num_gt=num_gt,
        ap=average_precision(precision),
        errors=np.where(UNDEFINED_ERRORS, np.nan, errors),
    )


def _score_speed(parts: MatchedParts, part: SpeedPart) -> SubsetScores:
    """Of a speed class; `normalized_ap` asks for no stated speed, and precision is that of as many objects as the class
    (car, truck ...) has at all speeds."""
    totals = np.bincount(parts.ranking.truth.labels, minlength=len(CLASSES))
    return replace(_score(part), normalized_ap=_score(part.by_place, totals).ap)


def _score_tag(parts: MatchedParts, tag: str) -> SubsetScores:
    """Scores over the samples whose scene carries `tag`; samples do not meet, so the matches stay what they are."""
    ranking = parts.ranking
    tagged = np.array([tag in tags for tags in ranking.evaluation_set.scene_tags], dtype=bool)
    scores = _score(Part(ranking, parts.matching, tagged[ranking.samples], tagged[ranking.truth.samples]))
    if tag in TAGS_WITHOUT_SCORE:
        scores.ap, scores.errors = np.full_like(scores.ap, np.nan), np.full_like(scores.errors, np.nan)
    return scores


def _speed_parts(ranking: Ranking, matching: Matching, pairs: CandidatePairs) -> tuple[dict[str, SpeedPart], SpeedPart]:
    """Parts by speed class, and the moving vehicles, with the matches of the overall score.

    A ground truth belongs to the class of its own speed, one of unknown velocity (NaN) to none. A prediction follows
    the ground truth it matches at that threshold, whatever speed it states: matched within the class it is a true
    positive there, matched elsewhere it is left out, so a wrong speed costs velocity error and no precision. One
    that matches nothing is a false positive in the class of the speed it states; stating none (NaN) it belongs to no
    class, as ground truth of unknown velocity does, and lowers the overall score alone. A detector that states wrong
    speeds so moves its false positives elsewhere. `members_by_place` do not ask what is stated: what matches nothing
    has the speed of the nearest ground truth of its class within the largest threshold (a near miss, or a second box
    of an object), and is a false positive at every speed where there is none.
    """
    truth = speed_classes(ranking.truth.velocities)
    stated = speed_classes(ranking.predictions.velocities)[ranking.rows]
    near = np.full_like(stated, EVERY_SPEED)
    first, nearest = np.unique(pairs.predictions, return_index=True)
    near[first] = truth[pairs.ground_truth[nearest]]
    followed, placed = (np.tile(speeds, (len(ranking.protocol.thresholds_m), 1)) for speeds in (stated, near))
    for t, places in enumerate(matching.places):
        followed[t, places] = placed[t, places] = truth[matching.ground_truth[t]]
    anywhere = placed == EVERY_SPEED
    speeds = {
        name: SpeedPart(ranking, matching, followed == place, truth == place, (placed == place) | anywhere)
        for place, name in enumerate(SPEED_CLASSES_MPS)
    }
    fast = list(SPEED_CLASSES_MPS.values()).index(FAST_MPS)
    vehicles = np.isin(ranking.predictions.labels[ranking.rows], MOVING)
    return speeds, SpeedPart(
        ranking,
        matching,
        (followed >= fast) & vehicles,
        (truth >= fast) & np.isin(ranking.truth.labels, MOVING),
        ((placed >= fast) | anywhere) & vehicles,
    )


def _motion_sums(ranking: Ranking, matching: Matching) -> dict[str, Array]:  # [S, 2] each
    """Total and count in each sample of how wrongly matched moving vehicles move, as far as both velocities are known.

    `moving_velocity_error`: m/s; `moving_radial_error`: m/s, what of it lies along the ray from the vehicle, which a
    radar measures; `moving_heading_error`: degrees, from which follows what lies across.
    """
    at_errors = ranking.protocol.thresholds_m.index(ranking.protocol.error_threshold_m)
    truth = ranking.truth[matching.ground_truth[at_errors]]
    wrong = ranking.predictions.velocities[ranking.rows[matching.places[at_errors]]] - truth.velocities
    _, _, turns, speeds, _ = matching.errors.T
    rays = truth.centers[:, :2] - ranking.evaluation_set.ego_centers[truth.samples, :2]
    radial = np.abs(np.vecdot(wrong, rays)) / np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
    counted = np.isin(truth.labels, MOVING) & (np.linalg.norm(truth.velocities, axis=1) >= FAST_MPS) & ~np.isnan(speeds)
    samples, num_samples = truth.samples[counted], len(ranking.evaluation_set.tokens)
    count = np.bincount(samples, minlength=num_samples)
    values = {"velocity": speeds, "radial": radial, "heading": np.degrees(turns)}
    return {
        f"moving_{name}_error": np.stack([np.bincount(samples, value[counted], num_samples), count], axis=1)
        for name, value in values.items()
    }
