"""Decoding against OpenPCDet's own, suppression, limits and attributes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.heads.decode import (
    ATTRIBUTE_RULES,
    CIRCLE_GROUPS,
    CIRCLE_RADII_M,
    Suppression,
    learned_attributes,
    suppress,
    top_candidates,
)
from src.ops.box_codes import attributes_by_rule, box_geometry
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import ATTRIBUTES, CLASS_RANGE_M, CLASSES
from src.targets.heatmap import HEAD_GROUPS
from tests.ops.test_nms import nms_rotated

GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
CASE = np.load(Path(__file__).parents[2] / "golden" / "voxelnext_head_targets" / "case.npz")
META = json.loads(str(CASE["meta_json"]))


def make_boxes(*rows: tuple[str, float, float, float, float, float]) -> Boxes3D:
    """Boxes of 4 x 2 x 2 m from rows name, x, y, z, speed, score."""
    values = torch.tensor([row[1:] for row in rows], dtype=torch.float32).reshape(-1, 5)
    labels = torch.tensor([CLASSES.index(row[0]) for row in rows])
    sizes = torch.tensor([[4.0, 2.0, 2.0]]).repeat(len(rows), 1)
    velocities = torch.stack([values[:, 3], torch.zeros(len(rows))], 1)
    return Boxes3D(values[:, :3], sizes, values[:, 3] * 0, velocities, labels, labels * 0 - 1, values[:, 4])


def thinned(
    boxes: Boxes3D, group: int, method: Suppression, max_boxes: int = 500, class_ranges: bool = True
) -> Boxes3D:
    """What is left of one sample's candidates of one group."""
    counts = [[len(boxes) if number == group else 0] for number in range(len(HEAD_GROUPS))]
    return suppress(boxes, counts, method, max_boxes, class_ranges)[0]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_golden_decoding(dtype: torch.dtype, tolerance: float) -> None:
    assert META["groups"] == [list(names) for names in HEAD_GROUPS]
    scores = torch.from_numpy(CASE["decode/logits"]).to(dtype).sigmoid()[:, [META["names"].index(c) for c in CLASSES]]
    codes = torch.from_numpy(CASE["decode/reg"]).to(dtype)
    cells = torch.from_numpy(CASE["cells"].astype(np.int64))
    best = top_candidates(scores, cells[:, 0], int(cells[-1, 0]) + 1, META["score_thresh"], META["K"])
    groups = torch.arange(7).repeat_interleave(torch.tensor([sum(counts) for counts in best.counts]))
    codes = codes[best.rows, groups]
    centers, sizes, yaws = box_geometry(cells[best.rows, 1:], codes, GRID)
    boxes = torch.cat([centers, sizes, yaws[:, None], codes[:, 8:10]], dim=1)
    blocks = torch.arange(len(boxes)).split(sum(best.counts, []))
    for block, rows in enumerate(blocks):
        group, sample = divmod(block, len(best.counts[0]))
        names, key = HEAD_GROUPS[group], f"decode/g{group}/b{sample}"
        np.testing.assert_allclose(boxes[rows], CASE[f"{key}/boxes"], rtol=0, atol=tolerance)
        np.testing.assert_allclose(best.scores[rows], CASE[f"{key}/scores"], rtol=0, atol=tolerance)
        assert [names.index(CLASSES[label]) for label in best.labels[rows]] == CASE[f"{key}/labels"].tolist()


def test_equal_scores_come_in_the_order_of_the_cells_and_only_the_best_of_a_group_and_sample() -> None:
    scores = torch.full((6, 12), 0.05)
    car, truck, other = (CLASSES.index(name) for name in ("car", "truck", "other_vehicle"))
    scores[:, car] = torch.tensor([0.5, 0.7, 0.5, 0.2, 0.9, 0.1])
    scores[2:5, truck] = scores[2:5, other] = 0.6
    best = top_candidates(scores, torch.tensor([0, 0, 0, 0, 2, 2]), 3, threshold=0.1, limit=3)
    assert best.counts == [[3, 0, 1], [3, 0, 2], *[[0, 0, 0]] * 5]
    assert best.rows.tolist() == [1, 0, 2, 4, 2, 2, 3, 4, 4]
    assert best.labels.tolist() == [car] * 4 + [truck, other, truck, truck, other]
    assert best.scores.tolist() == pytest.approx([0.7, 0.5, 0.5, 0.9, *[0.6] * 5])


@pytest.mark.parametrize("method", Suppression)
@pytest.mark.parametrize("at_once", ["each block", "all blocks"])
def test_all_groups_at_once_equal_one_after_the_other(method: Suppression, at_once: str, monkeypatch) -> None:
    """Against the plain loop: each sample and group alone, then limits."""
    if at_once == "all blocks":
        monkeypatch.setattr("src.ops.nms._blocks_at_once", lambda count, device: max(count, 1))
    generator = torch.Generator().manual_seed(0)
    counts = [[30, 120], [0, 1], [40, 40], [25, 0], [2, 3], [200, 60], [1, 9]]
    number = sum(map(sum, counts))
    draws = torch.rand(number, 10, generator=generator)
    groups = torch.arange(7).repeat_interleave(torch.tensor([sum(pair) for pair in counts]))
    labels = torch.tensor([CLASSES.index(HEAD_GROUPS[group][0]) for group in groups])
    blocks = torch.arange(number).split(sum(counts, []))
    scores = torch.cat([draws[rows, 9].sort(descending=True).values.mul(20).round().div(20) for rows in blocks])
    centers = (draws[:, :3] - 0.5) * torch.tensor([60.0, 60.0, 4.0])
    centers[::17, 0] += 120.0
    boxes = Boxes3D(centers, draws[:, 3:6] * 5 + 0.5, draws[:, 6] * 6, draws[:, 7:9], labels, labels * 0, scores)

    def alone(rows: torch.Tensor, group: int) -> torch.Tensor:
        mine = boxes[rows]
        circle = method is Suppression.circle or (method is Suppression.per_group and group in CIRCLE_GROUPS)
        kept = torch.arange(len(rows))
        if method is not Suppression.maxpool:
            kept = nms_rotated(mine.bev(), mine.scores, 0.2, CIRCLE_RADII_M[group] if circle else None)
        return rows[kept[:83]]

    found = suppress(boxes, counts, method, 100)
    for sample in range(2):
        rows = torch.cat([alone(blocks[2 * group + sample], group) for group in range(7)])
        far = torch.tensor([CLASS_RANGE_M[CLASSES[label]] for label in boxes.labels[rows]])
        rows = rows[boxes.centers[rows, :2].norm(dim=1) < far]
        rows = rows[boxes.scores[rows].argsort(descending=True, stable=True)[:100]]
        assert len(rows) > 20 and torch.equal(found[sample].centers, boxes.centers[rows])
        assert torch.equal(found[sample].labels, boxes.labels[rows])


@pytest.mark.parametrize("radius", [0.4, 1.0, 2.5])
def test_golden_circle_suppression(radius: float) -> None:
    table = torch.from_numpy(CASE["circle/xy_score"])
    bev = torch.nn.functional.pad(table[:, :2], (0, 3))
    assert nms_rotated(bev, table[:, 2], 0.2, radius).tolist() == CASE[f"circle/keep_{radius}"].tolist()


def test_log_sizes_are_clamped() -> None:
    codes = torch.zeros(1, 10)
    codes[0, 3:6] = torch.tensor([9.0, -9.0, 1.0])
    _, sizes, _ = box_geometry(torch.zeros(1, 2).long(), codes, GRID)
    torch.testing.assert_close(sizes[0].log(), torch.tensor([5.0, -5.0, 1.0]))


@pytest.mark.parametrize(
    ("method", "group", "kept"),
    [
        # 1.2 m apart along a length of 4 m: IoU 0.54.
        (Suppression.rotated, 3, 2),
        (Suppression.circle, 3, 3),
        (Suppression.per_group, 3, 3),
        (Suppression.per_group, 0, 2),
        (Suppression.circle, 0, 2),
        (Suppression.maxpool, 0, 3),
    ],
)
def test_suppression_of_each_group(method: Suppression, group: int, kept: int) -> None:
    name = HEAD_GROUPS[group][0]
    boxes = make_boxes((name, 0, 0, 0, 0, 0.9), (name, 1.2, 0, 0, 0, 0.8), (name, 30, 0, 0, 0, 0.7))
    assert len(thinned(boxes, group, method)) == kept


def test_groups_of_the_table() -> None:
    assert [HEAD_GROUPS[number][0] for number in CIRCLE_GROUPS] == ["barrier", "pedestrian", "traffic_sign"]


def test_at_most_83_boxes_of_a_group_and_the_best() -> None:
    boxes = make_boxes(*[("car", 10.0 * (k % 10), 10.0 * (k // 10), 0, 0, 1 - k / 200) for k in range(100)])
    kept = thinned(boxes, 0, Suppression.rotated)
    assert len(kept) == 83 and torch.equal(kept.scores, boxes.scores[:83])


def test_ranges_by_class_and_the_best_of_all_groups() -> None:
    boxes = make_boxes(
        ("car", 149, 0, 0, 0, 0.3),
        ("car", 120, 120, 0, 0, 0.9),
        ("pedestrian", 60, -50, 0, 0, 0.9),
        ("pedestrian", 50, -50, 0, 0, 0.5),
        ("truck", 0, 0, 0, 0, 0.4),
    )
    kept = thinned(boxes, 0, Suppression.maxpool, max_boxes=2)
    assert kept.scores.tolist() == pytest.approx([0.5, 0.4])
    assert len(thinned(boxes, 0, Suppression.maxpool)) == 3
    everywhere = thinned(boxes, 0, Suppression.maxpool, max_boxes=3, class_ranges=False)
    assert everywhere.scores.tolist() == pytest.approx([0.9, 0.9, 0.5])


def test_attribute_rule() -> None:
    expected = {
        ("car", 0.0, 3.0): "vehicle.moving",
        ("car", 0.0, 0.1): "vehicle.parked",
        ("trailer", 0.0, 0.0): "vehicle.parked",
        ("bus", 0.0, 0.0): "vehicle.stopped",
        ("bus", 0.0, 0.3): "vehicle.moving",
        ("pedestrian", 0.0, 1.0): "pedestrian.moving",
        ("pedestrian", 0.0, 0.0): "pedestrian.standing",
        ("bicycle", 0.0, 1.0): "cycle.with_rider",
        ("motorcycle", 0.0, 0.0): "cycle.without_rider",
        ("traffic_sign", 4.6, 0.0): "traffic_sign.overhanging",
        ("traffic_sign", 4.4, 5.0): "traffic_sign.pole_mounted",
        ("barrier", 9.0, 0.0): None,
        ("traffic_cone", 0.0, 5.0): None,
        ("animal", 0.0, 5.0): None,
    }
    boxes = make_boxes(*[(name, 0, 0, z, speed, 0.5) for name, z, speed in expected])
    found = attributes_by_rule(boxes.velocities, boxes.centers, boxes.sizes, boxes.labels, ATTRIBUTE_RULES)
    names = [None if index < 0 else ATTRIBUTES[index] for index in found.tolist()]
    assert names == list(expected.values())


def test_learned_attributes_stay_within_the_class() -> None:
    logits = torch.zeros(3, 11)
    logits[:, ATTRIBUTES.index("vehicle.moving")] = 9
    logits[:, ATTRIBUTES.index("cycle.without_rider")] = 5
    labels = torch.tensor([CLASSES.index(name) for name in ("car", "bicycle", "barrier")])
    found = learned_attributes(logits, labels).tolist()
    assert found == [ATTRIBUTES.index("vehicle.moving"), ATTRIBUTES.index("cycle.without_rider"), -1]
