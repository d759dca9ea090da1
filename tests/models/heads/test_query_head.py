"""The set-prediction head: assignments and losses by hand, targets that decode to their boxes, what is missing."""

import math
from dataclasses import replace

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.heads.decode import DecodeConfig
from src.models.heads.query_head import QueryPrediction, SetPredictionHead, box_codes
from src.structures.boxes import Boxes3D
from src.structures.queries import UNKNOWN_LOGIT, Queries

GRID = BEVGrid(cells=(100, 100), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


def make_head(threshold=0.0, max_boxes=300, velocity_weight=0.2):
    torch.manual_seed(0)
    return SetPredictionHead(DecodeConfig(score_threshold=threshold, max_boxes=max_boxes), 8, GRID, velocity_weight)


def make_boxes(places, labels, speed=3.0):
    count = len(places)
    return Boxes3D(
        centers=torch.tensor([[x, y, 1.0] for x, y in places]).view(-1, 3),
        sizes=torch.tensor([4.0, 2.0, 1.5]).repeat(count, 1),
        yaws=torch.full((count,), 0.5),
        velocities=torch.tensor([speed, 0.0]).repeat(count, 1),
        labels=torch.tensor(labels, dtype=torch.int64),
        attributes=torch.full((count,), -1),
        num_points=torch.full((count,), 5),
    )


def predict(boxes, extra=2, logit=3.0):
    """Exactly these boxes of B samples, in reverse, behind `extra` queries that say nothing."""
    size = extra + max(len(one) for one in boxes)
    logits = torch.full((len(boxes), size, 12), -6.0)
    codes = torch.zeros(len(boxes), size, 10)
    codes[..., 0] = 35.0
    valid = torch.zeros(len(boxes), size, dtype=torch.bool)
    for sample, one in enumerate(boxes):
        n = len(one)
        valid[sample, : extra + n] = True
        codes[sample, extra : extra + n] = box_codes(one).flip(0)
        logits[sample, torch.arange(extra, extra + n), one.labels.flip(0)] = logit
    return QueryPrediction(logits, codes, valid)


def test_right_predictions_are_assigned_to_their_objects_and_cost_nothing():
    boxes = [make_boxes([(1, 2), (9, 9), (-5, 3)], [0, 5, 0]), make_boxes([(4, 4)], [1])]
    head, right = make_head(), predict(boxes, logit=20.0)
    layers, rows, own = head.match([right, right], torch.cat([b.labels for b in boxes]), torch.cat(
        [box_codes(b) for b in boxes]), torch.tensor([0, 0, 0, 1]))  # fmt: skip
    assert sorted(zip(layers.tolist(), rows.tolist(), own.tolist(), strict=True)) == [
        (layer, row, k) for layer in range(2) for row, k in ((2, 2), (3, 1), (4, 0), (7, 3))
    ]
    terms, counts = head.loss([right], boxes, 1.0, 1.0)
    assert terms["box"] == 0 and terms["class"] < 1e-4 and counts == {"objects": 2.0, "missed_objects": 0.0}


def test_losses_by_hand():
    """One query half a metre off in x, 2 m/s too slow, with probability 1/2; another one says 1/2 for nothing."""
    boxes = [make_boxes([(1, 2)], [4])]
    prediction = predict(boxes, extra=1)
    prediction.logits[:] = -100.0
    prediction.logits[0, :, 4] = 0.0
    prediction.codes[0, 1, 0] += 0.5
    prediction.codes[0, 1, 8] -= 2.0
    terms, _ = make_head(velocity_weight=0.2).loss([prediction, prediction], boxes, 2.0, 0.25)
    assert terms["box"].item() == pytest.approx(2 * 0.25 * (0.5 + 0.2 * 2.0))
    focal = 0.25 * math.log(2) * (0.25 + 0.75)
    assert terms["class"].item() == pytest.approx(2 * 2.0 * focal, rel=1e-5)
    assert set(make_head().loss([prediction], boxes, None, 1.0).terms) == {"box"}


def test_the_class_decides_between_queries_at_one_place():
    boxes = [make_boxes([(0, 0), (0, 0)], [3, 7])]
    prediction = predict(boxes)
    _, rows, own = make_head().match([prediction], boxes[0].labels, box_codes(boxes[0]), torch.tensor([0, 0]))
    assert dict(zip(own.tolist(), rows.tolist(), strict=True)) == {0: 3, 1: 2}


def test_padding_is_neither_assigned_nor_counted_nor_decoded():
    boxes = [make_boxes([(1, 2)], [0])]
    prediction = predict(boxes)
    hidden = replace(prediction, valid=torch.tensor([[True, True, False]]))
    _, rows, _ = make_head().match([hidden], boxes[0].labels, box_codes(boxes[0]), torch.tensor([0]))
    assert rows.item() in (0, 1)
    hidden.logits[0, 2] = 50.0
    terms, _ = make_head().loss([hidden], boxes, 1.0, None)
    assert terms["class"] < 5 and all(box.scores.max() < 0.1 for box in make_head().decode(hidden))


def test_more_objects_than_queries_none_at_all_and_unknown_velocities():
    many = [make_boxes([(k, 0) for k in range(9)], [k % 12 for k in range(9)], speed=math.nan)]
    prediction = predict([make_boxes([(0, 0)], [0])])
    prediction.logits.requires_grad_()
    terms, counts = make_head().loss([prediction], many, 1.0, 1.0)
    assert counts == {"objects": 9, "missed_objects": 6} and all(t.isfinite() for t in terms.values())
    terms, counts = make_head().loss([prediction], [make_boxes([], [])], 1.0, 1.0)
    assert terms["box"] == 0 and counts == {"objects": 0, "missed_objects": 0}
    terms["class"].backward()
    assert prediction.logits.grad.isfinite().all()
    with pytest.raises(ValueError, match="FrameBatch.boxes is None"):
        make_head().loss([prediction], None, 1.0, 1.0)


def test_predictions_that_are_not_finite_reach_the_loss():
    boxes = [make_boxes([(1, 2)], [0])]
    prediction = predict(boxes)
    prediction.codes[:] = math.nan
    assert make_head().loss([prediction], boxes, 1.0, 1.0).terms["box"].isnan()


def test_decoding_gives_the_boxes_back():
    boxes = [make_boxes([(1.3, 2.2), (-9.1, 9.7)], [0, 5]), make_boxes([], [])]
    found = make_head(threshold=0.3).decode(predict(boxes))
    assert [len(one) for one in found] == [2, 0]
    order = found[0].labels.argsort()
    for name in ("centers", "sizes", "yaws", "velocities", "labels"):
        torch.testing.assert_close(getattr(found[0], name)[order].float(), getattr(boxes[0], name).float(),
                                   atol=1e-4, rtol=1e-4)  # fmt: skip
    assert len(make_head(max_boxes=1).decode(predict(boxes))[0]) == 1


def test_untrained_a_query_says_what_it_brings():
    head = make_head()
    torch.nn.init.zeros_(head.classes[-1].weight)
    torch.nn.init.zeros_(head.box[-1].weight)
    logits = torch.full((1, 2, 12), UNKNOWN_LOGIT)
    queries = Queries(torch.randn(1, 2, 8), torch.randn(1, 2, 3), torch.randn(1, 2, 2), logits, torch.ones(1, 2) > 0)
    found = head(queries.features, queries)
    torch.testing.assert_close(found.logits, logits)
    torch.testing.assert_close(found.codes[..., :3], queries.centers)
    torch.testing.assert_close(found.codes[..., 8:], queries.velocities)
    torch.testing.assert_close(found.codes[0, 0, 3:6].exp(), torch.tensor([4.5, 2.0, 1.8]))
