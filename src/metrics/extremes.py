"""What a gallery shows, chosen by rule and not by taste: frames by condition, the worst misses and false positives."""

from __future__ import annotations

import numpy as np

from src.metrics.detection import MatchedParts
from src.structures.detections import EvaluationSet

Array = np.ndarray

CONDITIONS = ("weather", "daytime", "lighting")
"""Groups of the scene tags that say how well sensors see."""


def frames_by_condition(evaluation_set: EvaluationSet, count: int) -> dict[int, str]:
    """Up to `count` samples with the tag that each stands for, in the order of the set.

    Tags of CONDITIONS, the rarest first, give each the first scene that stands for none yet, while there are any; of a
    scene the sample in its middle.
    """
    scenes_of: dict[str, list[int]] = {}
    for scene, tags in zip(evaluation_set.scenes.tolist(), evaluation_set.scene_tags, strict=True):
        for tag in tags:
            known = scenes_of.setdefault(tag, [])
            if tag.startswith(CONDITIONS) and scene not in known:
                known.append(scene)
    chosen: dict[int, str] = {}
    for tag in sorted(filter(scenes_of.get, scenes_of), key=lambda tag: (len(scenes_of[tag]), tag)):
        free = [scene for scene in scenes_of[tag] if scene not in chosen]
        if free and len(chosen) < count:
            chosen[free[0]] = tag
    middle = {scene: np.flatnonzero(evaluation_set.scenes == scene) for scene in chosen}
    return dict(sorted((int(rows[len(rows) // 2]), chosen[scene]) for scene, rows in middle.items()))


def worst_misses(
    parts: MatchedParts,
    returns: Array,  # [k] of each ground truth
    count: int,
) -> Array:  # [<= count] int64
    """Rows of the ground truth that counts and that no prediction found at the protocol's error distance.

    By falling number of returns, at most one of a class.
    """
    rows = np.flatnonzero(parts.truth_kept)
    protocol = parts.ranking.protocol
    found = parts.matching.ground_truth[protocol.thresholds_m.index(protocol.error_threshold_m)]
    missed = np.delete(rows, found)
    order = missed[np.argsort(-returns[missed], kind="stable")]
    return _first_of_class(order, parts.ranking.evaluation_set.ground_truth.labels, count)


def worst_false_positives(parts: MatchedParts, count: int) -> Array:  # [<= count] int64
    """Rows of the predictions that count and match nothing of their class even at the largest distance.

    By falling score, at most one of a class.
    """
    ranking = parts.ranking
    places = np.delete(np.arange(len(ranking.rows)), parts.matching.places[-1])
    places = places[np.argsort(-ranking.scores[places], kind="stable")]
    return _first_of_class(ranking.rows[places], ranking.predictions.labels, count)


def _first_of_class(rows: Array, labels: Array, count: int) -> Array:
    """The first row of each class, of the first `count` classes that come."""
    _, first = np.unique(labels[rows], return_index=True)
    return rows[np.sort(first)[:count]]
