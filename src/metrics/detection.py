"""Detection scores of MAN TruckScenes: AP, true positive errors and NDS (devkit 1.2, `detection_cvpr_2024`).

The definition, in short. Boxes beyond their class's range, without points, or cycles in a bicycle rack do not count.
Per class and distance threshold, predictions by descending score (the later in the file first among equal ones) each
take the nearest free ground truth of their sample. AP is the area under precision over recall above 0.1 and 0.1,
averaged over four thresholds; errors are running means over the matches at 2 m. NDS joins both.
"""

from __future__ import annotations

import numpy as np

from src.metrics.checks import check_predictions
from src.metrics.curves import (
    RECALLS,
    average_precision,
    error_curve,
    mean_error,
    precision_and_confidence,
)
from src.metrics.filtering import (
    RANGE_BINS_M,
    SPEED_CLASSES_MPS,
    ego_distances,
    official_filter,
    speed_classes,
)
from src.metrics.ranking import Matching, Ranking, find_candidates, match_predictions, rank_predictions
from src.metrics.scores import (
    DISTANCE_THRESHOLDS_M,
    ERROR_THRESHOLD_M,
    ERRORS,
    DetectionScores,
    SubsetScores,
)
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASS_WITHOUT_ERRORS, CLASSES, SCENE_TAGS, TAGS_WITHOUT_SCORE

Array = np.ndarray

_UNDEFINED = np.array([[error in CLASS_WITHOUT_ERRORS[name] for error in ERRORS] for name in CLASSES])


def score_detections(
    evaluation_set: EvaluationSet,
    predictions: DetectionTable,
    by_range: bool = True,
    by_tag: bool = True,
    by_speed: bool = True,
) -> DetectionScores:
    """Score predictions as the official evaluator does, and by distance bin, scene tag and speed class.

    A sample of the set without predictions is scored as empty. Tags follow the official rule: samples whose scene
    carries the tag, NaN for the tags in TAGS_WITHOUT_SCORE. Distance bins are our own: see RANGE_BINS_M; so are speed
    classes: see `_score_speeds`.

    Raises DataError for predictions that cannot be scored (see `check_predictions`) and for matched ground truth
    whose size is not positive, as the official evaluator does.
    """
    check_predictions(predictions, evaluation_set.tokens)
    truth = evaluation_set.ground_truth
    kept, truth_kept = official_filter(evaluation_set, predictions), official_filter(evaluation_set, truth)
    ranking = rank_predictions(evaluation_set, predictions, kept, truth[truth_kept])
    pairs = find_candidates(ranking)
    matching = match_predictions(ranking, pairs)
    everyone, every_truth = np.ones(len(ranking.rows), bool), np.ones(len(ranking.truth), bool)
    scores = DetectionScores(
        overall=_score_subset(ranking, matching, everyone, every_truth),
        ranges={},
        tags={},
        speeds={},
        truth_kept=truth_kept,
        predictions_kept=kept,
    )
    if by_range:
        edges = [low for low, _ in RANGE_BINS_M[1:]]
        bins = np.digitize(ego_distances(evaluation_set, predictions), edges)[ranking.rows]
        truth_bins = np.digitize(ego_distances(evaluation_set, ranking.truth), edges)
        # Boxes of different bins never meet, so the four bins are matched at once.
        matching_in_bins = match_predictions(ranking, pairs[bins[pairs.predictions] == truth_bins[pairs.ground_truth]])
        scores.ranges = {
            f"{low:.0f}-{high:.0f}": _score_subset(ranking, matching_in_bins, bins == i, truth_bins == i)
            for i, (low, high) in enumerate(RANGE_BINS_M)
        }
    if by_tag:
        scores.tags = {tag: _score_tag(ranking, matching, tag) for tag in SCENE_TAGS}
    if by_speed:
        scores.speeds = _score_speeds(ranking, matching)
    return scores


def _score_subset(
    ranking: Ranking,
    matching: Matching,
    members: Array,  # [n] or, by threshold, [4, n] bool over the ranked predictions
    truth_members: Array,  # [k] bool over the ground truth that counts
) -> SubsetScores:
    """Curves and scores of some predictions and ground truth; members that matched did so with one another."""
    num_classes, num_points = len(CLASSES), len(RECALLS)
    num_gt = np.bincount(ranking.truth.labels[truth_members], minlength=num_classes)
    precision = np.zeros((num_classes, len(DISTANCE_THRESHOLDS_M), num_points))
    confidence = np.zeros_like(precision)
    error_curves = np.ones((num_classes, len(ERRORS), num_points))
    errors = np.ones((num_classes, len(ERRORS)))
    for t, threshold in enumerate(DISTANCE_THRESHOLDS_M):
        if t == 0 or members.ndim == 2:
            of_threshold = members if members.ndim == 1 else members[t]
            places = np.flatnonzero(of_threshold)
            scores = ranking.scores[places]
            class_starts = np.searchsorted(places, ranking.class_starts)
        chosen = of_threshold[matching.places[t]]
        matched = np.searchsorted(places, matching.places[t][chosen])  # place within the subset
        match_starts = np.searchsorted(matched, class_starts)
        match_errors = matching.errors[chosen] if threshold == ERROR_THRESHOLD_M else None
        for c in np.flatnonzero(np.diff(match_starts)):
            begin, end = class_starts[c], class_starts[c + 1]
            of_class = slice(match_starts[c], match_starts[c + 1])
            ranks, class_scores = matched[of_class] - begin, scores[begin:end]
            precision[c, t], confidence[c, t] = precision_and_confidence(ranks, class_scores, int(num_gt[c]))
            if match_errors is None:
                continue
            match_scores = class_scores[ranks]
            for e, values in enumerate(match_errors[of_class].T):
                error_curves[c, e] = error_curve(values, match_scores, confidence[c, t])
                errors[c, e] = mean_error(error_curves[c, e], confidence[c, t])
    return SubsetScores(
        num_gt=num_gt,
        ap=average_precision(precision),
        errors=np.where(_UNDEFINED, np.nan, errors),
        precision=precision,
        confidence=confidence,
        error_curves=error_curves,
    )


def _score_tag(ranking: Ranking, matching: Matching, tag: str) -> SubsetScores:
    """Scores over the samples whose scene carries `tag`; samples do not meet, so the matches stay what they are."""
    tagged = np.array([tag in tags for tags in ranking.evaluation_set.scene_tags], dtype=bool)
    scores = _score_subset(ranking, matching, tagged[ranking.samples], tagged[ranking.truth.samples])
    if tag in TAGS_WITHOUT_SCORE:
        scores.ap, scores.errors = np.full_like(scores.ap, np.nan), np.full_like(scores.errors, np.nan)
    return scores


def _score_speeds(ranking: Ranking, matching: Matching) -> dict[str, SubsetScores]:
    """Scores by speed class, from the matches of the overall score.

    A ground truth belongs to the class of its own speed, one of unknown velocity (NaN) to none. A prediction follows
    the ground truth it matches at that threshold, whatever speed it states: matched within the class it is a true
    positive there, matched elsewhere it is left out, so a wrong speed costs velocity error and no precision. One
    that matches nothing is a false positive in the class of the speed it states; stating none (NaN) it belongs to no
    class, as ground truth of unknown velocity does, and lowers the overall score alone.
    """
    truth = speed_classes(ranking.truth.velocities)
    stated = speed_classes(ranking.predictions.velocities)[ranking.rows]
    followed = np.tile(stated, (len(DISTANCE_THRESHOLDS_M), 1))
    for t, places in enumerate(matching.places):
        followed[t, places] = truth[matching.ground_truth[t]]
    return {
        name: _score_subset(ranking, matching, followed == place, truth == place)
        for place, name in enumerate(SPEED_CLASSES_MPS)
    }
