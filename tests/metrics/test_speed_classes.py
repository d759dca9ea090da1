"""Scores by speed class: the convention by hand, and against a slow evaluation written from its text."""

from dataclasses import replace

import numpy as np
import pytest

from src.benchmark.suite_metric import random_problem
from src.metrics.detection import score_detections
from src.metrics.filtering import speed_classes
from src.metrics.protocol import OFFICIAL
from src.metrics.score_text import format_scores
from src.metrics.scores import DISTANCE_THRESHOLDS_M
from src.structures.detections import DetectionTable
from src.structures.taxonomy import ATTRIBUTES, CLASSES
from tests.evaluation_sets import set_of

NAMES = ["0-0.5", "0.5-10", "10-25", "25+"]
NAN = float("nan")


def boxes(rows, label="car", **columns) -> DetectionTable:
    """Boxes at (x, speed along x, score), all at y = 0."""
    n = len(rows)
    x, speed, score = np.array(rows, float).T
    zeros = np.zeros(n)
    table = DetectionTable(
        samples=np.zeros(n, np.int64),
        labels=np.full(n, CLASSES.index(label)),
        centers=np.stack([x, zeros, zeros], 1),
        sizes=np.ones((n, 3)),
        rotations=np.tile([1.0, 0, 0, 0], (n, 1)),
        velocities=np.stack([speed, zeros], 1),
        attributes=np.full(n, ATTRIBUTES.index("vehicle.moving")),
        scores=score,
        num_points=np.full(n, 10),
    )
    return replace(table, **columns)


def speeds_of(truth, predictions):
    evaluation_set = set_of(truth)
    return score_detections(evaluation_set, predictions).speeds


def test_a_class_begins_at_its_border():
    velocities = np.array(
        [[0, 0], [0.4, 0.2], [0.3, -0.4], [-9.99, 0], [6, 8], [0, 24.99], [15, 20], [90, 0], [NAN, 0]]
    )
    assert speed_classes(velocities).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, -1]


def test_a_wrong_speed_costs_velocity_error_and_no_precision():
    speeds = speeds_of(boxes([(10, 30, 0)]), boxes([(10, 1, 0.9)]))
    assert list(speeds) == NAMES
    assert [part.num_gt[0] for part in speeds.values()] == [0, 0, 0, 1]
    assert speeds["25+"].class_ap[0] == pytest.approx(1.0)
    assert speeds["25+"].errors[0, 3] == pytest.approx(29.0)
    # It is no false positive in the class of the speed it states either.
    both = speeds_of(boxes([(10, 30, 0), (40, 1, 0)]), boxes([(10, 1, 0.9), (40, 1, 0.8)]))
    assert both["0.5-10"].class_ap[0] == pytest.approx(1.0)
    assert both["0.5-10"].errors[0, 3] == pytest.approx(0.0)


def test_a_false_positive_counts_in_the_class_of_the_speed_it_states():
    truth = boxes([(10, 5, 0), (40, 30, 0)])
    speeds = speeds_of(truth, boxes([(80, 7, 0.9), (10, 5, 0.8), (40, 30, 0.7)]))
    # The false positive goes first: precision is r / 2 at recall r; the fast class does not see it.
    behind = np.maximum(np.linspace(0, 1, 101)[11:] / 2 - 0.1, 0).mean() / 0.9
    assert speeds["0.5-10"].class_ap[0] == pytest.approx(behind)
    assert speeds["25+"].class_ap[0] == pytest.approx(1.0)


def test_a_match_outside_is_ignored_at_that_threshold_only():
    # 3 m from a slow car and stating 30 m/s: the slow car's match at 4 m, a fast false positive below.
    speeds = speeds_of(boxes([(10, 5, 0), (40, 30, 0)]), boxes([(13, 30, 0.9), (40, 30, 0.8)]))
    behind = np.maximum(np.linspace(0, 1, 101)[11:] / 2 - 0.1, 0).mean() / 0.9
    assert speeds["25+"].ap[0].tolist() == pytest.approx([behind, behind, behind, 1.0])
    assert speeds["0.5-10"].ap[0].tolist() == pytest.approx([0, 0, 0, 1.0])


def test_normalised_precision_asks_no_speed_of_false_positives_and_no_share_of_the_objects():
    truth = boxes([(10, 5, 0), (40, 30, 0), (60, 30, 0), (90, 30, 0)])
    found = [(10, 5, 0.8), (40, 30, 0.7), (60, 30, 0.6), (90, 30, 0.5)]
    for stated in (5, 30, NAN):
        speeds = speeds_of(truth, boxes([(25, stated, 0.9), *found]))
        # At recall r of the one slow car, r TP beside 1 FP: as 4 r of 4 cars, hence 4 r / (4 r + 1). The same at 30 m/s
        # of the three, but that the curve begins with their first match, with a third of the recall.
        rs = np.arange(11, 101) / 100
        slow = np.interp(rs, [0, 1], [0, 1 / 2])  # of plain precision
        slow = 4 * slow / (4 * slow + 1 - slow)
        fast = np.interp(rs, [0, 1 / 3, 2 / 3, 1], [0, 1 / 2, 2 / 3, 3 / 4])
        fast = 4 * fast / (4 * fast + 3 * (1 - fast))
        for name, precision in (("0.5-10", slow), ("25+", fast)):
            content = speeds[name].as_dict(float)["classes"]["car"]
            assert content["AP_normalized"] == pytest.approx(np.maximum(precision - 0.1, 0).mean() / 0.9), stated
    assert speeds["0.5-10"].class_ap[0] == pytest.approx(1.0), "stating no speed, it counts nowhere"


def test_what_lies_at_an_object_is_no_false_positive_at_other_speeds():
    """Boxes of objects, near misses and second boxes; of the last two, what they state."""
    truth = boxes([(10, 5, 0), (40, 30, 0)])
    speeds = speeds_of(truth, boxes([(40, 5, 0.9), (10, 30, 0.8)]))
    for name in ("0.5-10", "25+"):
        assert speeds[name].normalized_ap[0].tolist() == pytest.approx([1.0] * 4)
    assert speeds["0-0.5"].normalized_ap.sum() == 0
    speeds = speeds_of(truth, boxes([(41.5, 5, 0.9), (10, 5, 0.8), (42.5, NAN, 0.95)]))
    assert speeds["0.5-10"].normalized_ap[0].tolist() == pytest.approx([1.0] * 4)
    # At 2 m the nearer one is found behind the other, r TP beside 1 FP, as 2 r of 2 cars; at 4 m the other is found,
    # and the nearer one is a FP behind it, which the curve meets at recall 1 alone: 2 of 3 there.
    found = np.interp(np.arange(11, 101) / 100, [0, 1], [0, 1 / 2])
    found = 2 * found / (2 * found + 1 - found)
    behind = np.maximum(found - 0.1, 0).mean() / 0.9
    assert speeds["25+"].normalized_ap[0].tolist() == pytest.approx([0, 0, behind, 1 - (1 - 2 / 3) / 90 / 0.9])


def test_normalised_ap_of_moving_vehicles():
    """A detector that states no speed has no lucky hits for free."""
    truth = boxes([(10, 30, 0), (40, 0, 0), (60, 0, 0)])
    for stated in (0, 30, NAN):
        predictions = boxes([(20, stated, 0.9), (10, stated, 0.8), (40, stated, 0.7)])
        measures = score_detections(set_of(truth), predictions).as_dict()["measures"]
        plain = np.interp(np.arange(11, 101) / 100, [0, 1], [0, 1 / 2])
        found = 3 * plain / (3 * plain + 1 - plain)  # 1 of 3 vehicles moves
        expected = np.maximum(found - 0.1, 0).mean() / 0.9
        assert measures["moving_AP_normalized"] == pytest.approx(expected) and measures["moving_boxes"] == 1
        plain = 1.0 if stated != 30 else np.maximum(plain - 0.1, 0).mean() / 0.9
        assert measures["moving_AP"] == pytest.approx(plain)


def test_matching_is_done_once_over_all_speeds():
    # The better prediction takes the standing car; the second one is left with nothing and is a false positive,
    # though it would match within its class were classes matched apart.
    speeds = speeds_of(boxes([(10, 0, 0), (40, 5, 0)]), boxes([(10.1, 5, 0.9), (10.2, 0, 0.8)]))
    first = (89 * 0.9 + 0.4) / 90 / 0.9  # match, then false positive
    assert speeds["0-0.5"].class_ap[0] == pytest.approx(first)
    assert speeds["0.5-10"].class_ap[0] == 0 and speeds["0.5-10"].num_gt[0] == 1


def measures_of(truth, predictions):
    return score_detections(set_of(truth), predictions).measures


def test_moving_vehicles_are_ranked_as_one_class():
    truth = DetectionTable.concatenate(
        [
            boxes([(10, 30, 0)]),
            boxes([(40, 12, 0)], "truck"),
            boxes([(60, 9, 0)], "bus"),
            boxes([(30, 20, 0)], "bicycle"),
        ]
    )
    # A false positive of a truck between the two hits: precision is 1 to recall 0.5, then rises to 2/3 at 1.
    found = [boxes([(10, 1, 0.9)]), boxes([(90, 15, 0.8), (40, 12, 0.7)], "truck"), boxes([(60, 9, 0.95)], "bus")]
    measures = measures_of(truth, DetectionTable.concatenate(found))
    recall = np.linspace(0, 1, 101)[11:]
    precision = np.where(recall < 0.5, 1.0, 0.5 + (2 / 3 - 0.5) * (recall - 0.5) / 0.5)
    assert (measures["moving_AP"], measures["moving_boxes"]) == (pytest.approx((precision - 0.1).mean() / 0.9), 2)
    slow = measures_of(boxes([(60, 9, 0)]), boxes([(60, 9, 0.9)]))
    assert slow["moving_boxes"] == 0 and {slow[name] for name in slow if name != "moving_boxes"} == {None}


def test_how_wrongly_vehicles_move():
    quarter = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # to the left
    still = np.tile([1.0, 0, 0, 0], (3, 1))
    truth = boxes([(10, 30, 0), (40, 12, 0), (60, 9, 0)], rotations=still)
    found = boxes([(10, 0, 0.9), (40, 0, 0.2), (60, 0, 0.5)], rotations=np.array([*still[:2], quarter]))
    found.rotations[1] = quarter
    found.velocities[:] = [[30, 4], [15, 0], [0, 0]]  # 4 m/s across the ray, 3 along it; what is slow is not asked
    moving = {name: value for name, value in measures_of(truth, found).items() if name.startswith("moving_")}
    assert moving["moving_velocity_error"] == pytest.approx(3.5)
    assert moving["moving_radial_error"] == pytest.approx(1.5)
    assert moving["moving_heading_error"] == pytest.approx(45)
    assert "velocity off by 3.50 m/s, 1.50 along the ray, heading by 45.0 deg" in format_scores(
        score_detections(set_of(truth), found).as_dict()
    )
    found.velocities[1] = NAN
    assert measures_of(truth, found)["moving_velocity_error"] == pytest.approx(4), "of what states a velocity"


def test_unknown_velocities():
    truth = boxes([(10, NAN, 0), (40, 5, 0), (60, 5, 0)])
    predictions = boxes([(10, 5, 0.9), (80, NAN, 0.85), (40, 5, 0.8), (60, NAN, 0.7)])
    speeds = speeds_of(truth, predictions)
    # Left out: the ground truth without velocity with its match, and the unmatched prediction without velocity.
    assert [part.num_gt[0] for part in speeds.values()] == [0, 2, 0, 0]
    assert speeds["0.5-10"].class_ap[0] == pytest.approx(1.0), "a prediction without velocity matches as any other"
    assert speeds["0.5-10"].errors[0, 3] == pytest.approx(0.0), "and its velocity error is undefined"


def test_means_over_the_classes_that_are_there():
    truth = DetectionTable.concatenate([boxes([(10, 5, 0)]), boxes([(40, 5, 0)], label="truck")])
    part = speeds_of(truth, boxes([(10.5, 7, 0.9)]))["0.5-10"]
    means = part.present_means()
    errors = (f"m{error}_present" for error in ("ATE", "ASE", "AOE", "AVE", "AAE"))
    assert list(means) == ["mAP_present", *errors, "mAP_normalized"]
    assert part.mean_ap == pytest.approx(0.75 / 12) and means["mAP_present"] == pytest.approx(0.75 / 2)
    assert means["mAP_normalized"] == pytest.approx(0.75 / 2), "there is no false positive, and no other speed"
    assert means["mATE_present"] == pytest.approx((0.5 + 1) / 2), "the truck is missed: error 1"
    assert means["mAVE_present"] == pytest.approx((2 + 1) / 2)


def test_means_where_nothing_is_there_are_undefined():
    cones = boxes([(10, 0, 0.5)], label="traffic_cone")
    evaluation_set = set_of(cones)
    content = score_detections(evaluation_set, cones).as_dict()
    assert set(content["speeds"]["25+"].keys() - content["ranges"]["0-25"].keys()) == {
        *(f"m{name}_present" for name in ("AP", "ATE", "ASE", "AOE", "AVE", "AAE")),
        "mAP_normalized",
    }
    assert content["speeds"]["25+"]["mAP_present"] is None and content["speeds"]["25+"]["mAP"] == 0
    standing = content["speeds"]["0-0.5"]
    assert standing["mAP_present"] == pytest.approx(1.0) and standing["mAVE_present"] is None
    assert standing["mATE_present"] == pytest.approx(0.0)


def test_table_for_the_terminal():
    truth = boxes([(10, 5, 0)])
    evaluation_set = set_of(truth)
    content = score_detections(evaluation_set, boxes([(10, 7, 0.9)])).as_dict()
    table = [line.split() for line in format_scores(content).split("\n\n")[2].splitlines()]
    numbers = ["100.0", "100.0", "0.000", "0.000", "0.000", "2.000", "0.000", "100.0", "2.000", "1", "1"]
    assert table[3] == ["0.5-10", *numbers]
    assert table[4] == ["10-25", *["-"] * 9, "0", "0"]
    last = [line.split() for line in format_scores(content).splitlines()[-2:]]
    assert last == [[*words, "AP", "of", "moving", "vehicles", "-", "0"] for words in ([], ["normalised"])]
    del content["speeds"], content["measures"]
    assert len(format_scores(content).split("\n\n")) == 2, "files written before there were such tables can be shown"


# ------------------------------------------------------------------ written again, box by box


def slow_scores(truth, predictions, label, low, high):
    """AP and normalised AP by threshold and (translation, velocity) error of one class and speed class, box after
    box."""

    def inside(velocity):
        return low <= float(np.hypot(*velocity)) < high  # False for NaN

    rows = [row for row in range(len(predictions)) if predictions.labels[row] == label]
    rows.sort(key=lambda row: (-predictions.scores[row], -row))
    candidates = [row for row in range(len(truth)) if truth.labels[row] == label]
    count = sum(inside(truth.velocities[row]) for row in candidates)
    aps, normalized, errors = [], [], (1.0, 1.0)
    for threshold in DISTANCE_THRESHOLDS_M:
        taken, listed, every = set(), [], []  # listed: (score, hit, translation error, velocity error); every: hit
        for row in rows:
            best, nearest = np.inf, None
            for other in candidates:
                if truth.samples[other] != predictions.samples[row] or other in taken:
                    continue
                distance = float(np.linalg.norm(truth.centers[other, :2] - predictions.centers[row, :2]))
                if distance < best:
                    best, nearest = distance, other
            if best < threshold:
                taken.add(nearest)
                if inside(truth.velocities[nearest]):
                    difference = float(np.hypot(*(truth.velocities[nearest] - predictions.velocities[row])))
                    listed.append((predictions.scores[row], True, best, difference))
                    every.append(True)
                continue
            near = [
                (float(np.linalg.norm(truth.centers[other, :2] - predictions.centers[row, :2])), other)
                for other in candidates
                if truth.samples[other] == predictions.samples[row]
            ]
            if not near or min(near)[0] >= 4.0 or inside(truth.velocities[min(near)[1]]):
                every.append(False)
            if inside(predictions.velocities[row]):
                listed.append((predictions.scores[row], False, NAN, NAN))
        hits = [entry for entry in listed if entry[1]]
        if not hits:
            aps.append(0.0)
            normalized.append(0.0)
            continue
        grid = np.linspace(0, 1, 101)
        found = np.cumsum(every).astype(float)
        precision = np.interp(grid, found / count, found / np.arange(1, len(every) + 1), right=0)
        right, wrong = precision / count, (1 - precision) / len(candidates)  # in shares of their objects
        normalized.append(np.clip((right / (right + wrong))[11:] - 0.1, 0, None).mean() / 0.9)
        found = np.cumsum([entry[1] for entry in listed]).astype(float)
        recall = found / count
        precision = np.interp(grid, recall, found / np.arange(1, len(listed) + 1), right=0)
        confidence = np.interp(grid, recall, [entry[0] for entry in listed], right=0)
        aps.append(np.clip(precision[11:] - 0.1, 0, None).mean() / 0.9)
        if threshold == 2.0:
            errors = tuple(slow_error([(entry[0], entry[k]) for entry in hits], confidence) for k in (2, 3))
    return count, aps, normalized, errors


def slow_error(hits, confidence):
    values = [value for _, value in hits]
    if all(np.isnan(value) for value in values):
        return 1.0
    means = []
    for end in range(1, len(values) + 1):
        valid = [value for value in values[:end] if not np.isnan(value)]
        means.append(sum(valid) / len(valid) if valid else 0.0)
    curve = np.interp(confidence[::-1], [score for score, _ in hits][::-1], means[::-1])[::-1]
    last = max(np.flatnonzero(confidence), default=0)
    return 1.0 if last < 11 else float(np.mean(curve[11 : last + 1]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_agrees_with_the_evaluation_written_again(seed):
    evaluation_set, predictions = random_problem(4, 90, 160, seed)
    rng = np.random.default_rng(seed)
    truth = evaluation_set.ground_truth
    for table in (truth, predictions):  # crowded: three classes near the ego, speeds over all four speed classes
        table.labels = rng.choice([0, 1, CLASSES.index("barrier")], len(table))
        table.velocities *= rng.choice([0.02, 0.3, 1.0, 4.0], len(table))[:, None]
        ego = evaluation_set.ego_centers[table.samples]
        table.centers = ego + (table.centers - ego) * 0.1
    scores = score_detections(evaluation_set, predictions)
    truth, predictions = truth[scores.parts.truth_kept], predictions[OFFICIAL.counted(evaluation_set, predictions)]
    seen = 0
    for (low, high), part in zip(
        [(0, 0.5), (0.5, 10), (10, 25), (25, np.inf)], (scores.speeds[name] for name in NAMES), strict=True
    ):
        for label in range(len(CLASSES)):
            count, aps, normalized, (translation, velocity) = slow_scores(truth, predictions, label, low, high)
            assert part.num_gt[label] == count
            np.testing.assert_allclose(part.ap[label], aps, rtol=0, atol=1e-12)
            np.testing.assert_allclose(part.normalized_ap[label], normalized, rtol=0, atol=1e-12)
            np.testing.assert_allclose(part.errors[label, 0], translation, rtol=0, atol=1e-9)
            if not np.isnan(part.errors[label, 3]):
                np.testing.assert_allclose(part.errors[label, 3], velocity, rtol=0, atol=1e-9)
            seen += aps[3] > 0 and translation != 1.0
    assert seen >= 6, "the problem must exercise several classes at several speeds"


def test_classes_of_speed_share_out_all_ground_truth_of_known_velocity():
    evaluation_set, predictions = random_problem(10, 40, 80, seed=7)
    scores = score_detections(evaluation_set, predictions)
    known = ~np.isnan(evaluation_set.ground_truth.velocities).any(axis=1) & scores.parts.truth_kept
    assert sum(part.num_gt.sum() for part in scores.speeds.values()) == known.sum() < scores.parts.truth_kept.sum()
    assert score_detections(evaluation_set, predictions, by_speed=False).speeds == {}
