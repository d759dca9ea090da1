"""Submission files: read, refused, written; and boxes on their way into the global frame."""

import json
import math
import os

import numpy as np
import pytest
import torch

from src.errors import DataError
from src.geometry.transforms import pose_matrix
from src.metrics.detection import score_detections
from src.metrics.submission import load_submission, to_ego, to_global, write_submission
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable

META = {"use_camera": True, "use_radar": True, "method_name": "ours"}


@pytest.fixture
def written(tmp_path):
    def write(content) -> str:
        path = tmp_path / "submission.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write


def equal(left: DetectionTable, right: DetectionTable) -> None:
    for name in DetectionTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)


def test_recorded_submission_scores_as_recorded(golden, golden_set, golden_predictions, submission, written):
    table = load_submission(written(submission), golden_set.tokens)
    equal(table, golden_predictions)
    expected = golden["expected"]["all"]
    scores = score_detections(golden_set, table, by_tag=False)
    assert scores.overall.nds == pytest.approx(expected["nd_score"], abs=1e-9)


def test_file_order_is_kept(golden_set, submission, written):
    submission["results"] = dict(reversed(submission["results"].items()))
    table = load_submission(written(submission), golden_set.tokens)
    assert table.samples[0] == len(golden_set.tokens) - 1 and (np.diff(table.samples) <= 0).all()


def test_accepted_oddities(golden_set, submission, written):
    box = next(boxes for boxes in submission["results"].values() if boxes)[0]
    box |= {"velocity": [math.nan, None], "detection_score": 2, "num_pts": 0, "attribute_name": "cycle.with_rider"}
    box["tracking_id"] = "7"
    table = load_submission(written(submission), golden_set.tokens)
    assert np.isnan(table.velocities[0]).all() and table.scores[0] == 2.0 and table.num_points[0] == 0


HUGE = 10**400  # JSON has no largest integer


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("translation", [1.0, 2.0], "'translation' must be a list of 3 finite numbers .*, but got list"),
        ("translation", None, "'translation' must be a list of 3 finite numbers .*, but got NoneType None"),
        ("translation", [1.0, 2.0, math.nan], "'translation' must be a list of 3 finite numbers .*, but got float nan"),
        ("translation", [1.0, 2.0, "3"], "'translation' must be a list of 3 finite numbers .*, but got str '3'"),
        ("translation", [1.0, 2.0, HUGE], "'translation' must be a list of 3 finite numbers .*, but got int 1000"),
        ("translation", [1.0, 2.0, True], "'translation' must be a list of 3 finite numbers .*, but got bool True"),
        ("size", [1.0, 2.0, 3.0, 4.0], "'size' must be a list of 3 positive numbers of at most 1e.09, but got list"),
        ("size", [1.0, 2.0, 0.0], "'size' must be a list of 3 positive numbers .*, but got float 0.0"),
        ("translation", [1.0, 2.0, 1e10], "'translation' must be .*numbers of at most 1e.09 in size, .*float 1"),
        ("rotation", [0.0, 1e-200, 0.0, 0.0], "'rotation' must be a quaternion"),
        ("size", [1.0, 2.0, math.inf], "'size' must be a list of 3 positive numbers .*, but got float inf"),
        ("rotation", [1.0, 0.0, 0.0], "'rotation' must be a quaternion .*, but got list"),
        ("rotation", [1.0, 0.0, 0.0, math.nan], "'rotation' must be a quaternion .* finite .*, but got float nan"),
        ("rotation", [0.0, 0.0, 0.0, 0.0], r"'rotation' must be a quaternion \(w, x, y, z\)"),
        ("velocity", [1.0], "'velocity' must be a list of 2 numbers"),
        ("velocity", [1.0, -math.inf], "'velocity' must be a list of 2 numbers of at most 1e.09 in size, .*-inf"),
        ("velocity", "fast", "'velocity' must be a list of 2 numbers .*, but got str 'fast'"),
        ("detection_name", "lorry", "'detection_name' must be one of car, truck, .*but got str 'lorry'"),
        ("detection_name", ["car"], "'detection_name' must be one of"),
        ("attribute_name", "vehicle.flying", "'attribute_name' must be one of .*'' .none.*but got str 'vehicle.fly"),
        ("attribute_name", None, "'attribute_name' must be one of .*but got NoneType None"),
        ("detection_score", math.nan, "'detection_score' must be a finite number of at least 0 .*, but got float nan"),
        ("detection_score", math.inf, "'detection_score' must be a finite number"),
        ("detection_score", "0.5", "'detection_score' must be .*but got str '0.5'"),
        ("detection_score", -0.5, "'detection_score' must be .*but got float -0.5"),
        ("sample_token", "other", "'sample_token' must be the sample it is listed under, but got str 'other'"),
        ("num_pts", "5", "'num_pts' must be a number of points, but got str '5'"),
        ("num_pts", math.nan, "'num_pts' must be a number of points"),
    ],
)
def test_a_bad_field_is_named(golden_set, submission, written, field, value, message):
    token = golden_set.tokens[1]
    submission["results"][token][3][field] = value
    path = written(submission)
    with pytest.raises(DataError, match=f"{path}: sample {token}, box 3: {message}"):
        load_submission(path, golden_set.tokens)


FIELDS = "sample_token translation size rotation velocity detection_name detection_score attribute_name".split()


@pytest.mark.parametrize("field", FIELDS)
def test_a_missing_field_is_named(golden_set, submission, written, field):
    token = golden_set.tokens[2]
    del submission["results"][token][0][field]
    with pytest.raises(DataError, match=f"sample {token}, box 0: '{field}' is missing"):
        load_submission(written(submission), golden_set.tokens)


@pytest.mark.parametrize("box", [None, 5, "box", [1, 2]])
def test_a_box_that_is_no_object_is_named(golden_set, submission, written, box):
    token = golden_set.tokens[1]
    submission["results"][token].append(box)
    with pytest.raises(DataError, match=f"sample {token}, box 12: must be an object, but got"):
        load_submission(written(submission), golden_set.tokens)


def test_samples_must_be_those_of_the_split(golden_set, submission, written):
    results = submission["results"]
    results["x"] = results.pop(golden_set.tokens[4])
    message = f"1 missing .the first is '{golden_set.tokens[4]}'.*1 not in the split .the first is 'x'"
    with pytest.raises(DataError, match=message):
        load_submission(written(submission), golden_set.tokens)


def test_too_many_boxes_are_counted_before_any_filter(golden_set, submission, written):
    token = golden_set.tokens[0]
    submission["results"][token] = submission["results"][token][:1] * 501
    with pytest.raises(DataError, match=f"sample {token}: at most 500 boxes are allowed, but got 501"):
        load_submission(written(submission), golden_set.tokens)


def test_a_file_without_any_box_is_refused(golden_set, submission, written):
    submission["results"] = {token: [] for token in golden_set.tokens}
    with pytest.raises(DataError, match="no sample has a box"):
        load_submission(written(submission), golden_set.tokens)


def test_wrong_outer_structure(golden_set, submission, written):
    cases = {
        '{"results": {': "not valid JSON: .* at line 1 column",
        "[1]": "must be an object with 'meta' and 'results', but got list",
        '{"meta": {}}': "'results' must be an object, but got nothing",
        '{"results": {}}': "'meta' must be an object, but got nothing",
        '{"results": [], "meta": {}}': "'results' must be an object, but got list",
        "[" * 100_000: "not valid JSON",
        json.dumps(submission | {"results": dict.fromkeys(golden_set.tokens)}): "must be a list of boxes, but got None",
    }
    for content, message in cases.items():
        with pytest.raises(DataError, match=message):
            load_submission(written(content), golden_set.tokens)
    path = written("")
    path.write_bytes(b"\xff\xfe{")
    with pytest.raises(DataError, match="not valid JSON"):
        load_submission(path, golden_set.tokens)
    with pytest.raises(DataError, match="cannot be read .No such file"):
        load_submission(path.with_name("absent.json"), golden_set.tokens)


def test_thousands_of_wrong_samples_are_counted(golden_set, submission, written):
    submission["results"] |= {f"x{number}": None for number in range(10_001)}
    with pytest.raises(DataError, match=r"submission\.json: 10001 samples are not lists of boxes"):
        load_submission(written(submission), golden_set.tokens)


# ------------------------------------------------------------------ writing


def test_written_file_reads_back_exactly(golden_set, golden_predictions, tmp_path):
    path = tmp_path / "new" / "submission.json"
    write_submission(path, golden_set.tokens, golden_predictions, META)
    equal(load_submission(path, golden_set.tokens), golden_predictions)
    assert os.listdir(path.parent) == ["submission.json"]
    meta = json.loads(path.read_text())["meta"]
    assert meta["use_camera"] is True and meta["use_lidar"] is False and meta["paper_url"] == "" and len(meta) == 13


def test_written_file_is_loaded_by_the_official_evaluator(golden_set, golden_predictions, tmp_path):
    pytest.importorskip("truckscenes", reason="truckscenes-devkit is not installed (extra: oracle)")
    from truckscenes.eval.common.loaders import load_prediction
    from truckscenes.eval.detection.data_classes import DetectionBox

    path = tmp_path / "submission.json"
    write_submission(path, golden_set.tokens, golden_predictions, META)
    boxes, meta = load_prediction(str(path), 500, DetectionBox)
    assert meta["method_name"] == "ours" and boxes.sample_tokens == golden_set.tokens
    np.testing.assert_array_equal([box.translation for box in boxes.all], golden_predictions.centers)


def test_samples_out_of_order_are_grouped(golden_set, golden_predictions, tmp_path):
    path = tmp_path / "submission.json"
    order = np.random.default_rng(0).permutation(len(golden_predictions))
    write_submission(path, golden_set.tokens, golden_predictions[order], META)
    table = load_submission(path, golden_set.tokens)
    equal(table, golden_predictions[order[np.argsort(golden_predictions.samples[order], kind="stable")]])


def test_what_would_be_refused_is_not_written(golden_set, golden_predictions, tmp_path):
    path = tmp_path / "submission.json"
    path.write_text("old")
    crowd = golden_predictions[np.zeros(501, np.int64)]
    nan = golden_predictions[np.arange(5)]
    nan.centers[3, 1] = np.nan
    for table, message in ((crowd, "at most 500"), (nan, "prediction 3"), (DetectionTable.empty(), "no sample has")):
        with pytest.raises(DataError, match=message):
            write_submission(path, golden_set.tokens, table, META)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["submission.json"]


def test_a_failed_write_leaves_the_old_file(golden_set, golden_predictions, tmp_path, monkeypatch):
    path = tmp_path / "submission.json"
    path.write_text("old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DataError, match="cannot be written .No space left on device"):
        write_submission(path, golden_set.tokens, golden_predictions, META)
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["submission.json"]


# ------------------------------------------------------------------ to the global frame


def test_ego_boxes_reach_the_global_frame():
    turn, place = math.radians(90), np.array([7.0e5, 5.3e6, 0.25])
    global_from_ego = pose_matrix(np.array([math.cos(turn / 2), 0, 0, math.sin(turn / 2)]), place)
    boxes = Boxes3D(
        centers=torch.tensor([[100.125, 2.0, 1.0]]),
        sizes=torch.tensor([[4.0, 2.0, 1.5]]),
        yaws=torch.tensor([math.radians(30)]),
        velocities=torch.tensor([[10.0, float("nan")]]),
        labels=torch.tensor([1]),
        attributes=torch.tensor([-1]),
        scores=torch.tensor([0.5]),
    )
    table = to_global(boxes, global_from_ego, 7)
    np.testing.assert_allclose(table.centers, [place + [-2.0, 100.125, 1.0]], rtol=0, atol=1e-8)
    assert table.sizes.tolist() == [[2.0, 4.0, 1.5]], "width, length, height"
    half = math.radians(60)
    np.testing.assert_allclose(table.rotations, [[math.cos(half), 0, 0, math.sin(half)]], atol=1e-7)
    assert table.samples.tolist() == [7] and table.scores.tolist() == [0.5] and table.num_points.tolist() == [-1]
    assert np.isnan(table.velocities).all() or np.isnan(table.velocities[0, 0])
    assert all(getattr(table, name).dtype == np.float64 for name in ("centers", "rotations", "velocities", "scores"))


def test_a_tilted_ego_tilts_its_boxes():
    rng = np.random.default_rng(0)
    global_from_ego = pose_matrix(rng.normal(size=4), np.zeros(3))
    boxes = Boxes3D(
        centers=torch.zeros(1, 3),
        sizes=torch.ones(1, 3),
        yaws=torch.tensor([0.7]),
        velocities=torch.tensor([[3.0, -1.0]]),
        labels=torch.tensor([0]),
        attributes=torch.tensor([0]),
    )
    table = to_global(boxes, global_from_ego, 0)
    heading = global_from_ego[:3, :3] @ [math.cos(0.7), math.sin(0.7), 0]
    np.testing.assert_allclose(pose_matrix(table.rotations[0], np.zeros(3))[:3, 0], heading, atol=1e-6)
    np.testing.assert_allclose(table.velocities[0], (global_from_ego[:3, :3] @ [3.0, -1.0, 0.0])[:2], atol=1e-6)


def test_no_boxes_reach_the_global_frame():
    assert len(to_global(Boxes3D.empty(), np.eye(4), 0)) == 0


def test_boxes_come_back_to_the_ego_frame():
    pose = pose_matrix(np.array([0.98, 0.02, -0.03, 0.2]), np.array([7.0e5, 5.3e6, 0.25]))  # tilted
    rng = np.random.default_rng(1)
    boxes = Boxes3D(
        centers=torch.from_numpy(rng.uniform(-150, 150, (5, 3)).astype(np.float32)),
        sizes=torch.rand(5, 3) + 0.5,
        yaws=torch.linspace(-3, 3, 5),
        velocities=torch.tensor([[20.0, -3.0]]).repeat(5, 1),
        labels=torch.arange(5),
        attributes=torch.arange(-1, 4),
        scores=torch.linspace(0, 1, 5),
        num_points=torch.arange(5),
    )
    back = to_ego(to_global(boxes, pose, 0), pose)
    for name in ("centers", "sizes", "yaws", "velocities", "labels", "attributes", "scores", "num_points"):
        torch.testing.assert_close(getattr(back, name), getattr(boxes, name), rtol=0, atol=1e-5)
    assert len(to_ego(DetectionTable.empty(), np.eye(4))) == 0
