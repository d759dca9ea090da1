"""How sure scores are: the scenes of the split drawn again with replacement (percentile bootstrap over scenes).

Frames of a scene show the same objects and say nothing new of one another, so whole scenes are drawn. Matching is
within a sample, hence nothing is matched again: a draw says how often each scene counts, and all draws are scored at
once from the matches of the one evaluation, to the numbers that the official rule gives for the drawn scenes laid end
to end. (Where predictions have equal scores, those of a scene's copies stand together.)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from src.metrics.curves import FIRST_POINT, RECALLS, average_precision, normalized_precision
from src.metrics.detection import MOVING, UNDEFINED_ERRORS, DetectionScores, MatchedParts, score_detections
from src.metrics.diagnostics import ratios
from src.metrics.protocol import Protocol
from src.metrics.ranking import Part, RankedList, SpeedPart
from src.metrics.scores import ERRORS, PartScores
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES

Array = np.ndarray

NUM_DRAWS = 500
LEVEL = 0.95
SEED = 0
LONG_RANGE = "long_range"
"""Key of the scores by a second protocol."""
CHUNK = 4_000_000
"""Numbers that one intermediate array may hold: long lists are drawn in parts."""


def score_report(
    evaluation_set: EvaluationSet,
    predictions: DetectionTable,
    scores: DetectionScores,  # of them, by the official protocol
    long_range: Protocol | None,
) -> dict[str, object]:
    """The content of metrics.json: `with_intervals`, and under LONG_RANGE the scores by a protocol of one's own.

    The intervals of these stand among the others. Raises as `score_detections`.
    """
    content = with_intervals(scores)
    if long_range is not None:
        further = with_intervals(
            score_detections(evaluation_set, predictions, by_tag=False, by_speed=False, protocol=long_range)
        )
        bounds = further.pop("intervals")["bounds"]
        content["intervals"]["bounds"] |= {f"{LONG_RANGE}.{name}": ends for name, ends in bounds.items()}
        content[LONG_RANGE] = {name: value for name, value in further.items() if value != {}}
    return content


def with_intervals(scores: DetectionScores) -> dict[str, object]:
    """The scores as plain values, and `intervals`.

    These hold `scenes`, `draws`, `level` and `bounds`, [low, high] of a number by its path, as in `ranges.0-25.mAP`.
    Scores by tag have none; another number without any is undefined. A single scene says nothing of others, so there
    are no bounds at all.
    """

    def bounds(draws: Array) -> dict[str, list[float]]:
        drawn = score_draws(scores.parts, draws)
        tree = drawn.overall.as_dict(interval) | {
            "ranges": {name: part.as_dict(interval) for name, part in drawn.ranges.items()},
            "speeds": {name: part.as_dict(interval) for name, part in drawn.speeds.items()},
            "measures": {name: interval(values) for name, values in drawn.measures.items()},
        }
        return dict(_paths(tree))

    return scores.as_dict() | {"intervals": intervals_of(scores.parts.ranking.evaluation_set.scenes, bounds)}


def intervals_of(
    scenes: Array,  # [S] of each sample, in any numbering
    bounds: Callable[[Array], dict[str, list[float]]],  # of [R, C] draws: how often each scene counts, ascending
) -> dict[str, object]:
    """`intervals` of metrics.json; without bounds where there is a single scene."""
    count = len(np.unique(scenes))
    drawn = {}
    if count > 1:
        drawn = bounds(np.random.default_rng(SEED).multinomial(count, np.full(count, 1 / count), NUM_DRAWS))
    return {"scenes": count, "draws": NUM_DRAWS, "level": LEVEL, "bounds": drawn}


def interval(
    values: Array,  # [R] of the draws, NaN where undefined
) -> list[float] | None:
    """The middle LEVEL of the draws that have the number."""
    values = values[~np.isnan(values)]
    if not len(values):
        return None
    return np.quantile(values, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2]).tolist()


def _paths(tree: dict[str, object], prefix: str = "") -> Iterator[tuple[str, list[float]]]:
    """Every interval of a tree with its dotted path."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _paths(value, f"{prefix}{name}.")
        elif value is not None:
            yield prefix + name, value


@dataclass
class DrawnScores:
    """Scores of R draws of scenes, each with the leading axis [R]."""

    overall: PartScores
    ranges: dict[str, PartScores]
    speeds: dict[str, PartScores]
    measures: dict[str, Array]  # [R] each


def score_draws(
    parts: MatchedParts,
    draws: Array,  # [R, C] how often each scene counts, in ascending order of EvaluationSet.scenes
) -> DrawnScores:
    """What `score_detections` would give for each draw."""
    evaluation_set = parts.ranking.evaluation_set
    _, scenes = np.unique(evaluation_set.scenes, return_inverse=True)  # [S]
    measures = {}
    if parts.moving is not None:
        boxes = draws @ _count_by_scene(parts.moving, scenes, draws.shape[1]).sum(axis=1)
        every = draws @ _count_by_scene(parts.overall, scenes, draws.shape[1])[:, MOVING].sum(axis=1)
        for name, part in (("moving_AP", parts.moving), ("moving_AP_normalized", parts.moving.by_place)):
            precision = np.zeros((len(draws), len(parts.ranking.protocol.thresholds_m), len(RECALLS)))
            for listed in part.pooled_lists():
                for some in _portions(listed, len(draws)):
                    precision[some, listed.threshold], _ = _curves(part, listed, scenes, draws[some], boxes[some])
            if part is not parts.moving:
                precision = normalized_precision(precision, boxes[:, None], every[:, None])
            measures[name] = np.where(boxes > 0, average_precision(precision).mean(axis=1), np.nan)
    return DrawnScores(
        overall=_score_part(parts.overall, scenes, draws),
        ranges={name: _score_part(part, scenes, draws) for name, part in parts.ranges.items()},
        speeds={name: _score_speed(parts, part, scenes, draws) for name, part in parts.speeds.items()},
        measures=measures | ratios(parts.sums, draws[:, scenes]),
    )


def _score_part(
    part: Part,
    scenes: Array,  # [S] of each sample
    draws: Array,  # [R, C]
    totals: Array | None = None,  # [R, 12] objects of each class that precision is normalised to, without errors then
) -> PartScores:
    thresholds_m = part.ranking.protocol.thresholds_m
    num_gt = draws @ _count_by_scene(part, scenes, draws.shape[1])  # [R, 12]
    ap = np.zeros((len(draws), len(CLASSES), len(thresholds_m)))
    errors = np.ones((len(draws), len(CLASSES), len(ERRORS)))
    for listed in part.lists():
        c = listed.label
        for some in _portions(listed, len(draws)):
            precision, confidence = _curves(part, listed, scenes, draws[some], num_gt[some, c])
            if totals is not None:
                precision = normalized_precision(precision, num_gt[some, c], totals[some, c])
            ap[some, c, listed.threshold] = average_precision(precision)
            if listed.errors is not None and totals is None:
                errors[some, c] = _errors(part, listed, scenes, draws[some], confidence)
    return PartScores(thresholds_m, num_gt, ap, np.where(UNDEFINED_ERRORS, np.nan, errors))


def _score_speed(
    parts: MatchedParts,
    part: SpeedPart,
    scenes: Array,  # [S] of each sample
    draws: Array,  # [R, C]
) -> PartScores:
    totals = draws @ _count_by_scene(parts.overall, scenes, draws.shape[1])  # [R, 12]
    normalized = _score_part(part.by_place, scenes, draws, totals)
    return replace(_score_part(part, scenes, draws), normalized_ap=normalized.ap)


def _portions(listed: RankedList, num_draws: int) -> Iterator[slice]:
    """Parts of the draws, see CHUNK."""
    steps = max(1, CHUNK // max(1, len(listed.matched)))
    return (slice(begin, begin + steps) for begin in range(0, num_draws, steps))


def _count_by_scene(part: Part, scenes: Array, num_scenes: int) -> Array:  # [C, 12]
    """Ground truth of each class in each scene."""
    truth = part.ranking.truth
    keys = scenes[truth.samples[part.truth_members]] * len(CLASSES) + truth.labels[part.truth_members]
    return np.bincount(keys, minlength=num_scenes * len(CLASSES)).reshape(num_scenes, len(CLASSES))


def _curves(
    part: Part,
    listed: RankedList,
    scenes: Array,  # [S] of each sample
    draws: Array,  # [R, C]
    num_gt: Array,  # [R]
) -> tuple[Array, Array]:
    """`precision_and_confidence` of each draw: [R, 101] twice."""
    if not len(listed.matched):
        return np.zeros((len(draws), len(RECALLS))), np.zeros((len(draws), len(RECALLS)))
    owners, scores = scenes[part.ranking.samples[listed.places]], part.ranking.scores[listed.places]  # [n]
    places, hits_before, previous, last = _by_scene(owners, listed.matched, draws)
    weights = draws[:, owners[listed.matched]]  # [R, m] copies of each match
    hits = hits_before + weights
    total_hits = hits[:, -1:]
    recalls, truth = RECALLS[None], np.maximum(num_gt, 1)[:, None].astype(float)
    reached = np.floor(
        recalls * truth
    )  # [R, 101] hits at each recall; rounding must fall as in a comparison of recalls
    reached += (reached + 1) / truth <= recalls
    reached -= reached / truth > recalls
    # The match whose copy is the next hit: one search over all draws, each with its own range of keys.
    offsets = np.arange(len(draws))[:, None] * (total_hits.max() + 1)
    wanted = np.minimum(reached + 1, total_hits) + offsets
    match = np.searchsorted((hits + offsets).ravel(), wanted.ravel()).reshape(wanted.shape)
    match = np.minimum(match - np.arange(len(draws))[:, None] * hits.shape[1], hits.shape[1] - 1)
    copies_before = reached - np.take_along_axis(hits_before, match, 1)
    rank = np.take_along_axis(places, match, 1) + copies_before  # predictions before the next hit
    share = (recalls - reached / truth) / ((reached + 1) / truth - reached / truth)  # 0 exactly at a hit
    right = (reached + 1) / (rank + 1)
    left = np.divide(reached, rank, out=right.copy(), where=rank > 0)
    inside = (reached < total_hits) & (num_gt[:, None] > 0)
    at_end = (reached == total_hits) & (reached / truth == recalls) & (total_hits > 0) & (num_gt[:, None] > 0)
    total = (draws @ np.bincount(owners, minlength=draws.shape[1]))[:, None]
    ends = total_hits / np.maximum(total, 1)
    precision = np.where(inside, left + (right - left) * share, np.where(at_end, ends, 0.0))
    after = scores[listed.matched][match]
    before = scores[np.take_along_axis(previous, match, 1)]
    before = np.where((copies_before > 0) | (rank == 0), after, before)
    ends = scores[last][:, None]
    return precision, np.where(inside, before + (after - before) * share, np.where(at_end, ends, 0.0))


def _by_scene(
    owners: Array,  # [n] scene of each prediction
    matched: Array,  # [m]
    draws: Array,  # [R, C]
) -> tuple[Array, Array, Array, Array]:
    """Of each draw: the predictions before each match, the hits before it, the place of the last drawn prediction
    before it (any where there is none), all [R, m]; and the last drawn prediction's place [R]."""
    before = np.zeros((draws.shape[1], len(matched)))
    hits = np.zeros_like(before)
    previous = np.full((len(draws), len(matched)), -1)
    last = np.full(len(draws), -1)
    for scene in range(draws.shape[1]):
        places = np.flatnonzero(owners == scene)
        before[scene] = found = np.searchsorted(places, matched)
        hits[scene] = np.cumsum(owners[matched] == scene) - (owners[matched] == scene)
        nearest = np.append(places, -1)[found - 1]  # -1 for none, as found is 0 then
        drawn = draws[:, scene] > 0
        previous[drawn] = np.maximum(previous[drawn], nearest)
        last[drawn] = np.maximum(last[drawn], places[-1] if len(places) else -1)
    return draws @ before, draws @ hits, previous, last


def _errors(
    part: Part,
    listed: RankedList,
    scenes: Array,  # [S] of each sample
    draws: Array,  # [R, C]
    confidence: Array,  # [R, 101]
) -> Array:  # [R, 5]
    """`mean_error` of the `error_curve` of each draw and error."""
    places = listed.places[listed.matched]
    scores = part.ranking.scores[places]  # [m] descending
    weights = draws[:, scenes[part.ranking.samples[places]]]  # [R, m]
    m = len(scores)
    rank = np.arange(m)
    pad = np.full((len(draws), 1), m)
    following = np.minimum.accumulate(np.where(weights > 0, rank, m)[:, ::-1], axis=1)[:, ::-1]
    following = np.concatenate([following, pad], axis=1)  # [R, m + 1] first drawn match from each place on, m for none
    preceding = np.maximum.accumulate(np.where(weights > 0, rank, -1), axis=1)
    preceding = np.concatenate([0 * pad - 1, preceding], axis=1)  # last drawn match before each place, -1 for none
    start = np.searchsorted(-scores, -confidence)  # [R, 101] first match whose score is not above
    low, high = np.take_along_axis(following, start, 1), np.take_along_axis(preceding, start, 1)
    below, above = scores[np.minimum(low, m - 1)], scores[np.maximum(high, 0)]
    between = (low < m) & (high >= 0)
    share = np.divide(confidence - below, above - below, out=np.zeros_like(confidence), where=between)
    scored = confidence > 0
    last = np.where(scored.any(axis=1), len(RECALLS) - 1 - scored[:, ::-1].argmax(axis=1), 0)
    counted = (np.arange(len(RECALLS)) >= FIRST_POINT) & (np.arange(len(RECALLS)) <= last[:, None])
    found = np.ones((len(draws), len(ERRORS)))
    for e, values in enumerate(listed.errors.T):
        valid = ~np.isnan(values)
        values = np.where(valid, values, 0.0)
        sums, counts = np.cumsum(weights * values, axis=1), np.cumsum(weights * valid, axis=1)
        more = np.maximum(weights - 1, 0)
        first_copy, last_copy = _mean(sums - more * values, counts - more * valid), _mean(sums, counts)
        curve = np.take_along_axis(first_copy, np.minimum(low, m - 1), 1)
        curve += share * (np.take_along_axis(last_copy, np.maximum(high, 0), 1) - curve)
        curve = np.where(low < m, curve, last_copy[:, -1:])
        means = _mean((curve * counted).sum(axis=1), counted.sum(axis=1))
        found[:, e] = np.where((last >= FIRST_POINT) & (counts[:, -1] > 0), means, 1.0)
    return found


def _mean(totals: Array, counts: Array) -> Array:
    return np.divide(totals, counts, out=np.zeros_like(totals), where=counts > 0)
