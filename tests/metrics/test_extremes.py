"""What a gallery shows: choices by hand."""

from dataclasses import replace

import numpy as np

from src.metrics.detection import match_parts
from src.metrics.extremes import frames_by_condition, worst_false_positives, worst_misses
from src.structures.detections import DetectionTable
from src.structures.taxonomy import CLASSES
from tests.evaluation_sets import set_of
from tests.metrics.test_speed_classes import boxes


def test_a_scene_stands_for_its_rarest_tag_and_shows_its_middle():
    clear, rain, night = (
        ("weather.clear", "area.highway"),
        ("weather.rain", "daytime.noon"),
        ("weather.rain", "daytime.night"),
    )
    scenes = np.array([7, 7, 7, 8, 8, 9, 9, 9, 9, 5])
    tags = [clear] * 3 + [rain] * 2 + [night] * 4 + [clear]
    set_ = replace(set_of(DetectionTable.empty(), tokens=[*"abcdefghij"]), scenes=scenes, scene_tags=tags)
    # daytime.night is of scene 9 alone and daytime.noon of 8; rain has no other scene left, clear comes first in 7.
    assert frames_by_condition(set_, 6) == {1: "weather.clear", 4: "daytime.noon", 7: "daytime.night"}
    assert frames_by_condition(set_, 2) == {4: "daytime.noon", 7: "daytime.night"}
    assert frames_by_condition(set_of(DetectionTable.empty(), tags=("area.city",)), 6) == {}


def parts_of(truth, predictions):
    return match_parts(set_of(truth), predictions, {}, by_range=False, by_speed=False)


def test_the_worst_miss_of_a_class_has_the_most_returns():
    labels = [CLASSES.index(name) for name in ("car", "car", "car", "truck", "bus", "car")]
    columns = {"labels": np.array(labels), "num_points": np.array([9, 9, 9, 9, 9, 0])}
    truth = boxes([(x, 0, 0) for x in (10, 20, 30, 40, 50, 60)], **columns)
    # The first car is found, the second lies 2.5 m off, the last does not count.
    predictions = boxes([(10, 0, 0.1), (22.5, 0, 0.9), (40, 0, 0.9)])
    returns = np.array([90, 3, 8, 5, 40, 70])
    assert worst_misses(parts_of(truth, predictions), returns, 6).tolist() == [4, 2, 3]
    assert worst_misses(parts_of(truth, predictions), returns, 2).tolist() == [4, 2]


def test_the_worst_false_positive_of_a_class_has_the_highest_score():
    truth = boxes([(10, 0, 0), (20, 0, 0)])
    labels = [CLASSES.index(name) for name in ("car", "car", "car", "car", "bus", "truck")]
    places = [(13.9, 0, 0.99), (24.1, 0, 0.5), (60, 0, 0.6), (400, 0, 0.9), (20, 0, 0.7), (90, 0, 0.2)]
    predictions = boxes(places, labels=np.array(labels))
    # The first is within 4 m of its car, the fourth out of range; a bus where a car is counts as one.
    assert worst_false_positives(parts_of(truth, predictions), 6).tolist() == [4, 2, 5]
    assert worst_false_positives(parts_of(truth, predictions), 1).tolist() == [4]
    assert worst_false_positives(parts_of(truth, predictions[[0]]), 6).tolist() == []
