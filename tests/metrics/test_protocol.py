"""A protocol of one's own beside the official one: other matches, a rectangle about the ego, other bins."""

import numpy as np
import pytest

from src.errors import ConfigError
from src.metrics.bootstrap import score_report
from src.metrics.detection import score_detections
from src.metrics.protocol import OFFICIAL, Protocol
from src.structures.detections import DetectionTable
from tests.evaluation_sets import set_of
from tests.metrics.test_detection import boxes

LONG = {
    "thresholds_m": [6.0],
    "error_threshold_m": 6.0,
    "ranges_m": [[0.0, 50.0], [50.0, 150.0], [150.0, 250.0]],
    "region_m": [[-100.0, 250.0], [-100.0, 100.0]],
}
TO_THE_LEFT = np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])
"""An ego whose x axis is the global y axis."""


def score(truth, predictions, **columns):
    return score_detections(set_of(truth, **columns), predictions, by_speed=False, protocol=Protocol(**LONG))


def counts(scores):
    return scores.overall.num_gt.sum(), [part.num_gt.sum() for part in scores.ranges.values()]


def test_a_match_within_six_metres_is_right_and_its_errors_count():
    truth = boxes([(20, 0), (200, 0)])
    found = score(truth, boxes([(25.9, 0), (200, 6.1)], scores=[0.9, 0.8]))
    assert found.overall.ap.shape == (12, 1) and list(found.ranges) == ["0-50", "50-150", "150-250"]
    assert [part.class_ap[0] for part in found.ranges.values()] == [pytest.approx(1.0), 0.0, 0.0]
    assert found.overall.errors[0, 0] == pytest.approx(5.9)
    official = score_detections(set_of(truth), boxes([(25.9, 0), (200, 6.1)], scores=[0.9, 0.8]))
    assert official.overall.class_ap[0] == 0.0 and official.overall.num_gt[0] == 1, "a car counts up to 150 m there"


def test_the_region_is_a_rectangle_of_the_ego_and_bins_are_of_distance():
    truth = boxes([(249, 0), (-99, 0), (-101, 0), (249, 99), (0, 101), (60, 0)], label="pedestrian")
    nothing = DetectionTable.empty()
    assert counts(score(truth, nothing)) == (4, [0, 2, 1]), "249 m ahead and 99 m aside lies beyond all bins"
    assert counts(score(truth, nothing, ego_rotations=TO_THE_LEFT)) == (3, [0, 3, 0])  # the last two, and x = -99
    assert counts(score(truth, nothing, ego_centers=np.array([[1000.0, 0.0, 0.0]]))) == (0, [0, 0, 0])


def test_boxes_without_points_do_not_count():
    assert counts(score(boxes([(10, 0)], points=0), DetectionTable.empty())) == (0, [0, 0, 0])


def test_a_report_holds_both_scores_and_the_intervals_of_both():
    truth = boxes([(10, 0), (200, 0)] * 2, samples=[0, 0, 1, 1])
    evaluation_set = set_of(truth, "ab", scenes=np.array([0, 1]))
    predictions = boxes([(13, 0), (200, 0)], scores=[0.9, 0.8], samples=[0, 0])
    content = score_report(evaluation_set, predictions, score_detections(evaluation_set, predictions), Protocol(**LONG))
    assert content["classes"]["car"]["AP@4.0"] > 0 and content["ranges"].keys() == {*OFFICIAL.range_names}
    own = content["long_range"]
    assert own["classes"]["car"]["num_gt"] == 4 and own["classes"]["car"].keys() >= {"AP", "AP@6.0", "ATE"}
    assert own["ranges"]["150-250"]["classes"]["car"]["num_gt"] == 2 and own["mAP"] > content["mAP"]
    low, high = content["intervals"]["bounds"]["long_range.ranges.150-250.mAP"]
    assert 0 == low < own["ranges"]["150-250"]["mAP"] < high == pytest.approx(1 / 12)
    alone = score_report(evaluation_set, predictions, score_detections(evaluation_set, predictions), None)
    assert "long_range" not in alone and not [name for name in alone["intervals"]["bounds"] if "long" in name]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"thresholds_m": []}, "thresholds_m must be positive and ascending"),
        ({"thresholds_m": [6.0, 4.0]}, "positive and ascending, but got"),
        ({"error_threshold_m": 2.0}, "error_threshold_m=2.0 must be one of thresholds_m"),
        ({"ranges_m": [[0.0, 50.0], [60.0, 70.0]]}, "without gaps"),
        ({"ranges_m": []}, "ranges_m must be one or more"),
        ({"region_m": [[0.0, 1.0]]}, "region_m must be"),
    ],
)
def test_protocols_that_cannot_be(changes, words):
    with pytest.raises(ConfigError, match=words):
        Protocol(**LONG | changes)
