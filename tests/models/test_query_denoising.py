"""Queries near true objects: where they begin, who sees them, what they cost; nobody else notices them."""

import math
from dataclasses import replace

import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.models.heads.query_head import QueryPrediction, box_codes
from src.models.query_denoising import DenoisingConfig, NoisyQueries, denoising_loss, noisy_queries
from src.structures.boxes import Boxes3D
from src.structures.queries import Queries
from tests.models.frames import GRID, drive, make_batch
from tests.models.learning import gradients_are_finite, train_step
from tests.models.query_frames import FAMILIES, small_model

CPU = torch.device("cpu")
ON, OFF = "model.loss.denoising_weight=1.0", "model.loss.denoising_weight=null"


def config(**changes):
    return DenoisingConfig(**({"num_groups": 3, "extent": 1.0, "background_from": 0.75} | changes))


def test_each_object_has_a_query_within_its_box_in_every_group():
    batch = make_batch(boxes=(4, 2))
    torch.manual_seed(0)
    noisy = noisy_queries(config(), batch.boxes, GRID, 8, CPU)
    queries = noisy.queries
    assert queries.features.shape == (2, 12, 8) and not queries.features.any() and not queries.velocities.any()
    assert queries.valid.sum(1).tolist() == [12, 6]
    assert queries.groups[0].tolist() == [1] * 4 + [2] * 4 + [3] * 4
    for row, boxes in enumerate(batch.boxes):
        for group in range(3):
            mine = slice(4 * group, 4 * group + len(boxes))
            offsets = queries.centers[row, mine] - boxes.centers
            along = offsets[:, 0] * boxes.yaws.cos() + offsets[:, 1] * boxes.yaws.sin()
            across = offsets[:, 1] * boxes.yaws.cos() - offsets[:, 0] * boxes.yaws.sin()
            shares = torch.stack([along, across, offsets[:, 2]], dim=1) / (0.5 * boxes.sizes)
            assert (shares.abs() <= 1.0 + 1e-4).all() and (shares.abs() > 1e-3).any()
            assert torch.equal(noisy.foreground[row, mine], shares.norm(dim=1) <= 0.75)
            assert torch.equal(noisy.labels[row, mine], boxes.labels)
            torch.testing.assert_close(noisy.codes[row, mine], box_codes(boxes), equal_nan=True)
    assert not noisy.foreground[~queries.valid].any()
    torch.manual_seed(0)
    assert torch.equal(noisy_queries(config(), batch.boxes, GRID, 8, CPU).queries.centers, queries.centers)


def test_the_share_of_the_foreground_is_that_of_a_ball_in_a_cube():
    boxes = [Boxes3D.empty(), make_batch(boxes=(40, 0)).boxes[0]]
    torch.manual_seed(0)
    noisy = noisy_queries(config(num_groups=100), boxes, GRID, 1, CPU)
    assert noisy.queries.valid.sum(1).tolist() == [0, 100 * len(boxes[1])]
    share = noisy.foreground.sum() / noisy.queries.valid.sum()
    assert abs(share - math.pi / 6 * 0.75**3) < 0.02


def test_groups_see_group_0_and_themselves():
    valid = torch.tensor([[True, False]])
    own = Queries.unknown(torch.zeros(1, 2, 4), torch.zeros(1, 2, 3), valid)
    noisy = Queries.unknown(torch.zeros(1, 3, 4), torch.zeros(1, 3, 3), torch.tensor([[True, True, True]]))
    noisy = replace(noisy, groups=torch.tensor([[1, 1, 2]]))
    past = torch.tensor([[True, False]])
    assert torch.equal(own.seen(past), torch.tensor([[True, False, True, False]]))
    expected = [[1, 0, 0, 0, 0, 1, 0]] * 2 + [[1, 0, 1, 1, 0, 1, 0]] * 2 + [[1, 0, 0, 0, 1, 1, 0]]
    assert own.beside(noisy).seen(past).int().tolist() == [expected]


def test_the_loss_by_hand():
    """One object of class 2 seen in the foreground and as background; both boxes count, one class does."""
    head = small_model("petr").head
    codes = torch.zeros(1, 3, 10)
    codes[0, :, 0] = torch.tensor([5.0, 5.0, 100.0])
    valid = torch.tensor([[True, True, False]])
    queries = Queries.unknown(torch.zeros(1, 3, 4), torch.zeros(1, 3, 3), valid)
    foreground, labels = torch.tensor([[True, False, False]]), torch.full((1, 3), 2)
    noisy = NoisyQueries(queries, labels, codes, foreground)
    logits = torch.full((1, 3, 12), -40.0)
    logits[0, :, 2] = 0.0
    said = codes.clone()
    said[0, 0, 0], said[0, 1, 1] = 7.0, 4.0
    layer = QueryPrediction(logits, said, valid)
    focal = (0.25 + 0.75) * 0.25 * math.log(2)  # half a chance for a yes and for a no
    once = 2.0 * focal / 1 + 0.25 * (2.0 + 4.0) / 2
    torch.testing.assert_close(denoising_loss(noisy, [layer, layer], head, 2.0, 0.25), torch.tensor(2 * once))
    torch.testing.assert_close(denoising_loss(noisy, [layer], head, None, 0.25), torch.tensor(0.75))
    torch.testing.assert_close(denoising_loss(noisy, [layer], head, 2.0, None), torch.tensor(2.0 * focal))


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_nobody_else_notices_them(family, phase):
    """The same predictions and the same memory as without; in evaluation there are none."""
    results = []
    frames = [drive(0), drive(1)]
    for settings in (ON, OFF):
        model, memory = small_model(family, settings, phase=phase).train(), None
        for batch in frames:
            output, memory = model(batch, memory)
        results.append((output, memory))
        assert (output.denoised is None) == (settings != ON)
        assert model.eval()(batch, None)[0].denoised is None
    (own, remembered), (plain, expected) = results
    assert own.denoised.noisy.queries.valid.any()
    for one, other in zip(own.layers, plain.layers, strict=True):
        torch.testing.assert_close(one.logits, other.logits)
        torch.testing.assert_close(one.codes, other.codes)
        assert torch.equal(one.valid, other.valid)
    if phase == "phase2":
        torch.testing.assert_close(remembered.frames[0].features, expected.frames[0].features)


@pytest.mark.parametrize("family", FAMILIES)
def test_frames_without_objects_have_none(family):
    model = small_model(family, ON)
    output, terms = train_step(model, make_batch(boxes=(0, 0)))
    assert len(output.denoised.noisy.queries) == 0 and terms["denoising"] == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_they_teach(family):
    """Their term is part of the total, and its gradients are finite; at full size it is on."""
    model = small_model(family, ON)
    _, terms = train_step(model, make_batch())
    assert terms["denoising"] > 0 and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(value for name, value in terms.items() if name != "total"))
    twice = small_model(family, ON.replace("1.0", "2.0"))
    torch.testing.assert_close(train_step(twice, make_batch())[1]["denoising"], 2 * terms["denoising"])
    full = compose_config(["scale=paper", f"model={family}", "data.root=x"])[0].model
    assert full.denoising == config(num_groups=10) and full.loss.denoising_weight == 1.0


@pytest.mark.parametrize(("key", "value"), [("num_groups", 0), ("extent", 0), ("extent", -1)])
def test_mistakes_are_named(key, value):
    with pytest.raises(ConfigError, match=f"model.denoising.{key}={value}"):
        config(**{key: value})
