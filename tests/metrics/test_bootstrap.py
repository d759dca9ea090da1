"""Intervals over scenes: a case by hand, and draws against the plain metric on the drawn scenes laid end to end."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from src.benchmark.suite_metric import random_problem
from src.metrics import bootstrap
from src.metrics.bootstrap import interval, score_draws, with_intervals
from src.metrics.detection import score_detections
from src.metrics.diagnostics import FrameDiagnosis
from src.metrics.score_text import format_scores
from src.metrics.scores import plain_number
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.taxonomy import CLASSES
from tests.evaluation_sets import set_of
from tests.metrics.test_speed_classes import boxes


def on_samples(samples, table) -> DetectionTable:
    return replace(table, samples=np.array(samples))


def test_a_draw_by_hand():
    # Scene 0: a hit at 0.9 and a false positive at 0.8; scene 1: a hit at 0.7, off by 3 m/s, and a miss.
    truth = on_samples([0, 1, 1], boxes([(10, 5, 0), (10, 5, 0), (40, 5, 0)]))
    predictions = on_samples([0, 0, 1], boxes([(10, 5, 0.9), (40, 5, 0.8), (10, 8, 0.7)]))
    scores = score_detections(set_of(truth, "ab", scenes=np.array([4, 9])), predictions)
    drawn = score_draws(scores.parts, np.array([[1, 1], [2, 0], [0, 2]])).overall
    recall = np.linspace(0, 1, 101)[11:]
    assert drawn.num_gt[:, 0].tolist() == [3, 2, 4]
    # Two copies of scene 0: both hits come before the false positives. Two of scene 1: half of four is found.
    once = np.where(recall < 1 / 3, 1.0, 0.5 + (2 / 3 - 0.5) * (recall * 3 - 1)) * (recall <= 2 / 3)
    half = np.where(recall <= 0.5, 0.9, 0).mean() / 0.9
    expected = [np.maximum(once - 0.1, 0).mean() / 0.9, (89 * 0.9 + 0.4) / 90 / 0.9, half]
    assert drawn.class_ap[:, 0].tolist() == pytest.approx(expected)
    assert drawn.errors[1:, 0, 3].tolist() == pytest.approx([0.0, 3.0])
    assert drawn.errors[0, 0, 3] == pytest.approx(scores.overall.errors[0, 3])


# ------------------------------------------------------------------ against the plain metric


@pytest.fixture(scope="module")
def problem():
    """Five scenes of four samples, crowded, scores that differ, and what some frames were made of."""
    evaluation_set, predictions = random_problem(20, 40, 70, 3)
    rng = np.random.default_rng(0)
    truth = evaluation_set.ground_truth
    for table in (truth, predictions):
        table.labels = rng.choice([0, 1, CLASSES.index("barrier"), CLASSES.index("bus")], len(table))
        table.velocities *= rng.choice([0.02, 0.3, 1.0, 4.0], len(table))[:, None]
        ego = evaluation_set.ego_centers[table.samples]
        table.centers = ego + (table.centers - ego) * 0.15
    # One class is in one scene alone, so that some draws are without it.
    truth.labels[(truth.labels == CLASSES.index("bus")) & (truth.samples >= 4)] = 0
    predictions.scores = rng.permutation(len(predictions)) / len(predictions)
    sums = {"radar_near": (1.0, 3), "history_gaussians": (5.0, 1)}
    diagnoses = {
        s: FrameDiagnosis(
            *(rng.integers(0, high, size) for high, size in ((5, 40), (2, 40), (2, 40), (2, (40, 4)))),
            {k: (v[0] + s, v[1]) for k, v in sums.items()},
        )
        for s in range(18)
    }
    scenes, instances = np.arange(20) // 4, np.tile(np.arange(40), 20) + 40 * np.repeat(np.arange(20) // 4, 40)
    return replace(evaluation_set, scenes=scenes, instances=instances), predictions, diagnoses


def laid_end_to_end(evaluation_set, predictions, diagnoses, draw):
    """The problem that a draw of scenes stands for, copy after copy."""
    truths, found, racks, new_diagnoses, rows, instances = [], [], [], {}, [], []
    for scene, copies in enumerate(draw):
        for copy in range(copies):
            for old in np.flatnonzero(evaluation_set.scenes == scene):
                new = len(rows)
                for tables, table in (
                    (truths, evaluation_set.ground_truth), (found, predictions), (racks, evaluation_set.racks)
                ):  # fmt: skip
                    own = table[table.samples == old]
                    tables.append(replace(own, samples=np.full(len(own), new)))
                instances.append(evaluation_set.instances[evaluation_set.ground_truth.samples == old] + 10_000 * copy)
                if old in diagnoses:
                    new_diagnoses[new] = diagnoses[old]
                rows.append((old, 10 * scene + copy))
    samples, scenes = np.array(rows).T
    columns = {
        "tokens": [str(row) for row in range(len(rows))],
        "ego_centers": evaluation_set.ego_centers[samples],
        "ego_rotations": evaluation_set.ego_rotations[samples],
        "scene_tags": [evaluation_set.scene_tags[sample] for sample in samples],
        "ground_truth": DetectionTable.concatenate(truths),
        "racks": DetectionTable.concatenate(racks),
        "scenes": scenes,
        "times_s": evaluation_set.times_s[samples],
        "instances": np.concatenate(instances),
    }
    assert set(columns) == {field.name for field in fields(EvaluationSet)}
    return EvaluationSet(**columns), DetectionTable.concatenate(found), new_diagnoses


def test_draws_agree_with_the_plain_metric(problem):
    draws = np.array([[1, 1, 1, 1, 1], [0, 2, 1, 2, 0], [5, 0, 0, 0, 0], [0, 0, 0, 0, 5], [2, 0, 3, 0, 0]])
    drawn = score_draws(score_detections(*problem).parts, draws)
    for row, draw in enumerate(draws):
        plain = score_detections(*laid_end_to_end(*problem, draw))
        pairs = [(drawn.overall, plain.overall)]
        for kind in ("ranges", "speeds"):
            assert getattr(drawn, kind).keys() == getattr(plain, kind).keys()
            pairs += [(part, getattr(plain, kind)[name]) for name, part in getattr(drawn, kind).items()]
        for part, expected in pairs:
            np.testing.assert_array_equal(part.num_gt[row], expected.num_gt)
            np.testing.assert_allclose(part.ap[row], expected.ap, rtol=0, atol=1e-12)
            np.testing.assert_allclose(part.errors[row], expected.errors, rtol=0, atol=1e-9)
            np.testing.assert_allclose(part.nds[row], expected.nds, rtol=0, atol=1e-9)
        for name, part in drawn.speeds.items():
            expected = plain.speeds[name]
            np.testing.assert_allclose(part.normalized_ap[row], expected.normalized_ap, rtol=0, atol=1e-12)
            means = {name: plain_number(values[row]) for name, values in part.present_means().items()}
            assert means == pytest.approx({name: plain_number(v) for name, v in expected.present_means().items()})
        measures = {name: plain_number(values[row]) for name, values in drawn.measures.items()}
        counts = {name: plain.measures.pop(name) for name in ("moving_boxes", "hidden_boxes")}
        assert measures == pytest.approx(plain.measures) and min(counts.values()) > 0
    assert (drawn.overall.num_gt[:, CLASSES.index("bus")] == 0).any()


def test_long_lists_are_drawn_in_parts(problem, monkeypatch):
    parts = score_detections(*problem).parts
    draws = np.random.default_rng(1).multinomial(5, [0.2] * 5, 7)
    whole, curves, held = score_draws(parts, draws), bootstrap._curves, []

    def counted(part, listed, scenes, draws, num_gt):
        held.append((len(draws), len(draws) * len(listed.matched)))
        return curves(part, listed, scenes, draws, num_gt)

    monkeypatch.setattr(bootstrap, "CHUNK", 100)
    monkeypatch.setattr(bootstrap, "_curves", counted)
    cut = score_draws(parts, draws)
    assert all(draws == 1 or numbers <= 100 for draws, numbers in held) and max(numbers for _, numbers in held) > 100
    np.testing.assert_array_equal(whole.overall.ap, cut.overall.ap)
    np.testing.assert_array_equal(whole.overall.errors, cut.overall.errors)
    for name, values in whole.measures.items():
        np.testing.assert_array_equal(values, cut.measures[name])


def test_metrics_with_intervals_are_plain_json(problem):
    scores = score_detections(*problem)
    content = with_intervals(scores)
    assert json.loads(json.dumps(content, allow_nan=False)) == content == with_intervals(scores), (
        "drawn alike each time"
    )
    intervals = content.pop("intervals")
    assert content == scores.as_dict()
    assert (intervals["scenes"], intervals["level"]) == (5, 0.95)
    bounds = intervals["bounds"]
    for name in ("mAP", "NDS", "mAVE"):
        low, high = bounds[name]
        assert low < content[name] < high
    assert content["tags"] and not any(name.startswith("tags.") for name in bounds)
    measured = {name for name in content["measures"] if not name.endswith("_boxes")}
    assert {name for name in bounds if name.startswith("measures.")} == {f"measures.{name}" for name in measured}
    assert bounds["ranges.0-25.classes.traffic_cone.AP"] == [0.0, 0.0] and "classes.barrier.AVE" not in bounds


def test_the_terminal_says_how_sure_scores_are(problem):
    content = with_intervals(score_detections(*problem))
    low, high = content["intervals"]["bounds"]["mAP"]
    line = format_scores(content).splitlines()[-1]
    assert line.startswith(f"95 % intervals over 5 scenes: mAP {100 * low:.1f} to {100 * high:.1f}, NDS ")
    del content["intervals"]
    assert "intervals" not in format_scores(content), "files written before there were any can be shown"


def test_one_scene_says_nothing_of_others(problem):
    evaluation_set, predictions, diagnoses = problem
    single = replace(evaluation_set, scenes=np.zeros(20, np.int64))
    intervals = with_intervals(score_detections(single, predictions))["intervals"]
    assert intervals["scenes"] == 1 and intervals["bounds"] == {}


def test_the_middle_of_the_draws():
    low, high = interval(np.append(np.arange(1001.0), np.nan))
    assert (low, high) == pytest.approx((25, 975)) and interval(np.full(3, np.nan)) is None


def test_no_boxes_at_all():
    empty = DetectionTable.empty()
    evaluation_set = set_of(empty, "ab", scenes=np.array([0, 1]))
    for truth, predictions in ((empty, empty), (empty, boxes([(1, 0, 0.5)])), (boxes([(1, 0, 0)]), empty)):
        content = with_intervals(
            score_detections(replace(evaluation_set, ground_truth=truth, instances=np.arange(len(truth))), predictions)
        )
        bounds = content["intervals"]["bounds"]
        assert bounds["mAP"] == [0.0, 0.0] and "measures.moving_AP" not in bounds
