"""Scores against the official evaluator's recorded numbers, and the rules it does not record."""

import json
from dataclasses import replace

import numpy as np
import pytest

from src.errors import DataError
from src.metrics.curves import RECALLS, error_curve, precision_and_confidence
from src.metrics.detection import score_detections
from src.metrics.protocol import OFFICIAL
from src.metrics.score_text import format_scores
from src.metrics.scores import DISTANCE_THRESHOLDS_M, ERRORS
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import ATTRIBUTES, CLASSES, SCENE_TAGS, TAGS_WITHOUT_SCORE
from tests.evaluation_sets import set_of

OFFICIAL_ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")


@pytest.fixture(scope="module")
def scores(golden_set, golden_predictions):
    return score_detections(golden_set, golden_predictions)


def number(value):
    return np.nan if value is None else value


def assert_same(ours, expected):
    close = {"rtol": 0, "atol": 1e-9, "equal_nan": True}
    np.testing.assert_allclose(ours.mean_ap, number(expected["mean_ap"]), **close)
    np.testing.assert_allclose(ours.nds, number(expected["nd_score"]), **close)
    np.testing.assert_allclose(ours.mean_errors, [number(expected["tp_errors"][e]) for e in OFFICIAL_ERRORS], **close)
    np.testing.assert_allclose(ours.class_ap, [number(expected["mean_dist_aps"][c]) for c in CLASSES], **close)
    for row, name in enumerate(CLASSES):
        if "label_aps" in expected:
            aps = [expected["label_aps"][name][str(threshold)] for threshold in DISTANCE_THRESHOLDS_M]
            np.testing.assert_allclose(ours.ap[row], [number(ap) for ap in aps], **close)
        if "label_tp_errors" in expected:
            errors = [number(expected["label_tp_errors"][name][error]) for error in OFFICIAL_ERRORS]
            np.testing.assert_allclose(ours.errors[row], errors, **close)


def test_overall_agrees_with_official_numbers(golden, scores):
    assert_same(scores.overall, golden["expected"]["all"])


def test_ranges_agree_with_official_numbers(golden, scores):
    assert list(scores.ranges) == ["0-25", "25-50", "50-100", "100-150"]
    for name, part in scores.ranges.items():
        assert_same(part, golden["expected"]["ranges"][name])


def test_tags_agree_with_official_numbers(golden, scores):
    assert set(scores.tags) == set(golden["expected"]["tags"]) and len(SCENE_TAGS) == 34
    for name, part in scores.tags.items():
        assert_same(part, golden["expected"]["tags"][name])
    assert all(np.isnan(scores.tags[name].nds) for name in TAGS_WITHOUT_SCORE)


def curves_of(part):
    """Precision and confidence [12, 4, 101] and error curves [12, 5, 101] of a part, from the functions that score."""
    counts = np.bincount(part.ranking.truth.labels[part.truth_members], minlength=len(CLASSES))
    precision = np.zeros((len(CLASSES), len(DISTANCE_THRESHOLDS_M), len(RECALLS)))
    confidence, errors = np.zeros_like(precision), np.ones((len(CLASSES), len(ERRORS), len(RECALLS)))
    for listed in part.lists():
        c, t, scores = listed.label, listed.threshold, part.ranking.scores[listed.places]
        precision[c, t], confidence[c, t] = precision_and_confidence(listed.matched, scores, counts[c])
        if listed.errors is not None:
            errors[c] = [error_curve(values, scores[listed.matched], confidence[c, t]) for values in listed.errors.T]
    return precision, confidence, errors


def test_curves_agree_with_official_curves(golden, scores):
    precision, confidence, errors = curves_of(scores.parts.overall)
    for c, name in enumerate(CLASSES):
        for t, threshold in enumerate(DISTANCE_THRESHOLDS_M):
            curves = golden["expected"]["curves"][name][str(threshold)]
            np.testing.assert_allclose(precision[c, t], curves["precision"], rtol=0, atol=1e-10)
            np.testing.assert_allclose(confidence[c, t], curves["confidence"], rtol=0, atol=1e-10)
        curves = golden["expected"]["curves"][name]["2.0"]
        for e, error in enumerate(OFFICIAL_ERRORS):
            np.testing.assert_allclose(errors[c, e], curves[error], rtol=0, atol=1e-10)


def test_filters_keep_the_official_boxes(golden, golden_set, golden_predictions, scores):
    for table, kept, expected in (
        (golden_set.ground_truth, scores.parts.truth_kept, golden["expected"]["gt_kept"]),
        (golden_predictions, OFFICIAL.counted(golden_set, golden_predictions), golden["expected"]["pred_kept"]),
    ):
        for sample, token in enumerate(golden_set.tokens):
            assert np.flatnonzero(kept[table.samples == sample]).tolist() == expected[token]


def test_as_dict_is_plain_json(scores):
    content = scores.as_dict()
    numbers = ["mAP", "NDS", "mATE", "mASE", "mAOE", "mAVE", "mAAE"]
    assert list(content) == [*numbers, "classes", "ranges", "tags", "speeds", "measures"]
    car = ["AP", "AP@0.5", "AP@1.0", "AP@2.0", "AP@4.0", *ERRORS, "num_gt"]
    assert list(content["classes"]) == list(CLASSES) and list(content["classes"]["car"]) == car
    assert content["classes"]["traffic_cone"]["AVE"] is None
    assert content["tags"]["weather.snow"]["mAP"] is None
    assert set(content["ranges"]["0-25"]) == {*numbers, "classes"}
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert {name: content[name] for name in scores.overall.headline()} == scores.overall.headline()


def test_table_for_the_terminal(scores):
    lines = format_scores(scores.as_dict()).splitlines()
    assert lines[2].split()[:3] == ["all", "21.6", "25.6"]  # 0.21646, 0.25596
    cone = next(line for line in lines if line.startswith("traffic_cone")).split()
    assert cone[1] == "34.2" and cone.count("-") == 3
    assert len({len(line) for line in lines[:6]}) == 1, "columns are aligned"


# ------------------------------------------------------------------ small problems by hand


def boxes(xy, label="car", scores=None, points=10, samples=None) -> DetectionTable:
    n = len(xy)
    return DetectionTable(
        samples=np.zeros(n, np.int64) if samples is None else np.array(samples),
        labels=np.full(n, CLASSES.index(label)),
        centers=np.concatenate([np.array(xy, float).reshape(n, 2), np.zeros((n, 1))], axis=1),
        sizes=np.ones((n, 3)),
        rotations=np.tile([1.0, 0, 0, 0], (n, 1)),
        velocities=np.zeros((n, 2)),
        attributes=np.full(n, ATTRIBUTES.index("vehicle.moving")),
        scores=np.zeros(n) if scores is None else np.array(scores, float),
        num_points=np.full(n, points),
    )


def one_sample(truth, racks=None) -> EvaluationSet:
    return set_of(truth, tags=("weather.clear",), racks=racks or DetectionTable.empty())


def car_ap(evaluation_set, predictions):
    return score_detections(evaluation_set, predictions).overall.ap[CLASSES.index("car")]


def test_perfect_predictions_score_one():
    truth = boxes([(10, 0), (20, 5)])
    found = score_detections(one_sample(truth), boxes([(10, 0), (20, 5)], scores=[0.9, 0.8], points=-1))
    assert found.overall.class_ap[0] == pytest.approx(1.0)
    assert found.overall.errors[0] == pytest.approx(0.0)
    assert found.overall.mean_ap == pytest.approx(1 / 12), "classes without ground truth count 0"
    assert found.overall.num_gt.tolist() == [2] + [0] * 11


def test_equal_scores_let_the_later_box_go_first():
    truth = boxes([(10, 0)])
    near_last = boxes([(13, 0), (10, 0)], scores=[0.5, 0.5])
    near_first = boxes([(10, 0), (13, 0)], scores=[0.5, 0.5])
    # Match, then false positive: precision is 1 up to recall 1, where the last prediction's 1/2 counts.
    match_first = (89 * 0.9 + 0.4) / 90 / 0.9
    assert car_ap(one_sample(truth), near_last).tolist() == pytest.approx([match_first] * 4)
    # The later box, 3 m off, takes the ground truth at 4 m; at 2 m it is a false positive before the match.
    found = score_detections(one_sample(truth), near_first).overall
    assert found.ap[0, 3] == pytest.approx(match_first) and found.errors[0, 0] < 1
    # Recall is 0 at the false positive and 1 at the match, so precision is r / 2 at recall r in between.
    expected = np.maximum(np.linspace(0, 1, 101)[11:] / 2 - 0.1, 0).mean() / 0.9
    assert found.ap[0, 2] == pytest.approx(expected)


def test_a_match_is_nearer_than_the_threshold():
    truth = boxes([(10, 0)])
    assert car_ap(one_sample(truth), boxes([(12, 0)], scores=[0.5])).tolist() == pytest.approx([0, 0, 0, 1])
    assert car_ap(one_sample(truth), boxes([(11.999, 0)], scores=[0.5])).tolist() == pytest.approx([0, 0, 1, 1])


def test_range_is_exclusive_and_zero_points_are_dropped():
    truth = boxes([(150, 0), (149.9, 0)])
    kept = score_detections(one_sample(truth), boxes([(150, 0)], scores=[0.5])).parts.truth_kept
    assert kept.tolist() == [False, True]
    kept = OFFICIAL.counted(one_sample(truth), boxes([(10, 0)], scores=[0.5], points=0))
    assert kept.tolist() == [False]


def test_a_rack_holds_its_border_in_all_three_directions():
    rack = boxes([(10, 0)])
    rack.sizes[:] = (2.0, 4.0, 2.0)  # width along y, length along x
    xy = [(12, 0), (12.001, 0), (10, 1), (10, 1.001), (10, 0)]
    cycles = boxes(xy, label="bicycle", scores=[0.5] * 5)
    cycles.centers[4, 2] = 1.001
    cars = boxes([(10, 0)], scores=[0.5])
    kept = OFFICIAL.counted(one_sample(boxes([(50, 0)]), rack), DetectionTable.concatenate([cycles, cars]))
    assert kept.tolist() == [False, True, False, True, True, True]


def test_ranges_match_within_the_bin_only():
    # The prediction lies 1 m from its ground truth, across the border of two bins.
    found = score_detections(one_sample(boxes([(24.5, 0)])), boxes([(25.5, 0)], scores=[0.5]))
    assert found.overall.ap[0, 3] == pytest.approx(1.0)
    assert found.ranges["0-25"].num_gt[0] == 1 and found.ranges["0-25"].ap[0, 3] == 0
    assert found.ranges["25-50"].num_gt[0] == 0 and found.ranges["25-50"].ap[0, 3] == 0


def test_nothing_at_all():
    empty = DetectionTable.empty()
    for truth, predictions in ((empty, empty), (boxes([(1, 1)]), empty), (empty, boxes([(1, 1)], scores=[1.0]))):
        found = score_detections(one_sample(truth), predictions)
        assert found.overall.mean_ap == 0 and found.overall.mean_errors.tolist() == [1.0] * 5 and found.overall.nds == 0


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("scores", np.nan, "scores must be at least 0 and finite, .*, but got nan"),
        ("scores", -0.1, "scores must be at least 0 and finite"),
        ("centers", np.inf, "centers must be finite"),
        ("centers", 1e10, "centers must be finite, at most 1e.09 in size, but got"),
        ("sizes", 0.0, "sizes must be positive and finite"),
        ("rotations", 0.0, "rotations must be finite, .*, not all 0"),
        ("rotations", 1e-200, "rotations must be finite, .*, not all 0"),  # their squares are 0
        ("velocities", np.inf, "velocities must be finite, .*, or NaN"),
        ("velocities", -1e10, "velocities must be finite, .*, or NaN"),
        ("labels", 12, "labels must be 0..11"),
        ("attributes", 11, r"attributes must be -1..10"),
        ("samples", 1, r"samples must be 0..0, but got 1"),
    ],
)
def test_predictions_without_meaning_are_refused(column, value, message):
    predictions = boxes([(10, 0), (20, 0)], scores=[0.5, 0.5])
    getattr(predictions, column)[1] = value
    with pytest.raises(DataError, match=f"prediction 1 .*{message}"):
        score_detections(one_sample(boxes([(10, 0)])), predictions)


def test_more_than_500_boxes_of_a_sample_are_refused():
    predictions = boxes([(10, 0)] * 501, scores=[0.5] * 501)
    with pytest.raises(DataError, match="sample a: at most 500 boxes, but got 501"):
        score_detections(one_sample(boxes([(10, 0)])), predictions)
    score_detections(one_sample(boxes([(10, 0)])), predictions[np.arange(500)])


def test_flat_ground_truth_is_refused_only_when_matched():
    truth = boxes([(10, 0)])
    truth = replace(truth, sizes=np.array([[1.0, 0.0, 1.0]]))
    score_detections(one_sample(truth), boxes([(30, 0)], scores=[0.5]))
    with pytest.raises(DataError, match=r"ground truth at .* \(sample a\): size must be positive"):
        score_detections(one_sample(truth), boxes([(10, 0)], scores=[0.5]))
