import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from src.data.cache import load_index
from src.data.evaluation_set import evaluation_set
from src.errors import DataError
from src.structures.taxonomy import ATTRIBUTES, CLASSES
from tests.data.tiny_set import VERSION

GOLDEN = Path(__file__).resolve().parents[1] / "golden/truckscenes_eval/public_medium.json"


@pytest.fixture(scope="module")
def golden():
    return json.loads(GOLDEN.read_text())


@pytest.fixture(scope="module")
def golden_set(golden, tmp_path_factory):
    root = tmp_path_factory.mktemp("golden")
    (root / VERSION).mkdir()
    for name, records in golden["tables"].items():
        (root / VERSION / f"{name}.json").write_text(json.dumps(records))
    return evaluation_set(load_index(root, VERSION, root / "cache"), "val")


def test_samples_in_scoring_order(golden, golden_set):
    """One scene is outside the split, and other sensors' poses are metres away, both on purpose."""
    assert golden_set.tokens == [sample["token"] for sample in golden["samples"]]
    np.testing.assert_array_equal(golden_set.ego_centers, [sample["ego_translation"] for sample in golden["samples"]])
    assert [";".join(tags) for tags in golden_set.scene_tags] == [s["scene_description"] for s in golden["samples"]]


def test_ground_truth_is_the_devkits_to_the_last_bit(golden, golden_set):
    boxes = [(row, box) for row, token in enumerate(golden_set.tokens) for box in golden["gt"][token]]
    table = golden_set.ground_truth
    assert len(table) == len(boxes) > 50
    assert table.samples.tolist() == [row for row, _ in boxes]
    for name, key in (("centers", "translation"), ("sizes", "size"), ("rotations", "rotation")):
        np.testing.assert_array_equal(getattr(table, name), [box[key] for _, box in boxes])
    np.testing.assert_array_equal(table.velocities, np.array([box["velocity"] for _, box in boxes], float))
    assert [CLASSES[label] for label in table.labels] == [box["detection_name"] for _, box in boxes]
    names = ["" if attribute < 0 else ATTRIBUTES[attribute] for attribute in table.attributes]
    assert names == [box["attribute_name"] for _, box in boxes]
    assert table.num_points.tolist() == [box["num_pts"] for _, box in boxes]


def test_scenes_times_and_objects_are_those_of_the_tables(golden, golden_set):
    tables = {name: {record["token"]: record for record in records} for name, records in golden["tables"].items()}
    scene_of = {token: tables["sample"][token]["scene_token"] for token in golden_set.tokens}
    pairs = set(zip(golden_set.scenes.tolist(), scene_of.values(), strict=True))
    assert len(pairs) == len(set(scene_of.values())) == len({number for number, _ in pairs}) > 1
    times = {token: 1e-6 * tables["sample"][token]["timestamp"] for token in golden_set.tokens}
    np.testing.assert_allclose(golden_set.times_s, list(times.values()), rtol=0, atol=0.1)  # of the key frame's LiDAR
    annotations = {(r["sample_token"], tuple(r["translation"])): r for r in golden["tables"]["sample_annotation"]}
    truth = golden_set.ground_truth
    objects = [
        annotations[golden_set.tokens[sample], tuple(center)]["instance_token"]
        for sample, center in zip(truth.samples, truth.centers.tolist(), strict=True)
    ]
    pairs = set(zip(golden_set.instances.tolist(), objects, strict=True))
    assert len(pairs) == len(set(objects)) == len({number for number, _ in pairs}) > 1


def test_racks(golden, golden_set):
    racks = [(row, box) for row, token in enumerate(golden_set.tokens) for box in golden["bicycle_racks"][token]]
    assert racks and golden_set.racks.samples.tolist() == [row for row, _ in racks]
    for name, key in (("centers", "translation"), ("sizes", "size"), ("rotations", "rotation")):
        np.testing.assert_array_equal(getattr(golden_set.racks, name), [box[key] for _, box in racks])
    assert not golden_set.racks.labels.any()


def test_release_without_annotations(broken_tables):
    shutil.move(broken_tables.root / VERSION, broken_tables.root / "v1.2-test")
    (broken_tables.root / "v1.2-test/sample_annotation.json").write_text("[]")
    with pytest.raises(DataError, match="no annotations"):
        evaluation_set(load_index(broken_tables.root, "v1.2-test", None), "val")
