"""The whole of RadarGNN: messages, gradients, bad input, samples that must not mix, invariance, learning."""

import math
from dataclasses import fields, replace

import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from src.models.radargnn.graph import GraphConfig, Invariance, build_graph
from src.models.radargnn.model import MessagePassing, RadarGNNLossConfig, RadarGNNOutput
from src.structures.boxes import Boxes3D
from tests.models.frames import make_batch
from tests.models.learning import (
    autocast_step,
    gradients_are_finite,
    little_input_gives_finite_losses,
    overfitted_precision,
    parameters_that_stay,
    train_step,
    weight_multiplies_or_switches_off,
)
from tests.models.radargnn.gnn_frames import SMALL, gnn_model

TERMS = {"class", "box", "total"}


def on_boxes(batch, per_box=6):
    """The frames with more points, spread over the footprint of each box."""
    generator = torch.Generator().manual_seed(0)
    clouds = []
    for sample, boxes in enumerate(batch.boxes):
        own = batch.radar_points[batch.radar_batch == sample]
        place = (torch.rand(len(boxes), per_box, 2, generator=generator) - 0.5) * 0.9 * boxes.sizes[:, None, :2]
        c, s = boxes.yaws.cos()[:, None], boxes.yaws.sin()[:, None]
        x, y = c * place[..., 0] - s * place[..., 1], s * place[..., 0] + c * place[..., 1]
        more = torch.zeros(len(boxes), per_box, 7)
        more[..., :3] = boxes.centers[:, None]
        more[..., :2] += torch.stack([x, y], dim=2)
        more[..., 3] = boxes.labels[:, None] * 2.0
        more[..., 4:6] = boxes.velocities[:, None]
        clouds.append(torch.cat([own, more.flatten(0, 1)]))
    counts = torch.tensor([len(one) for one in clouds])
    return replace(
        batch, radar_points=torch.cat(clouds), radar_batch=torch.arange(len(clouds)).repeat_interleave(counts)
    )


def without_images(batch):
    return replace(batch, images=None, image_valid=None, pix_from_aug=None)


def test_messages_are_those_of_a_literal_loop():
    torch.manual_seed(0)
    layer = MessagePassing(6, 5, 3).double()
    points, sample = torch.randn(12, 7) * 9, torch.tensor([0] * 8 + [1] + [2] * 3)
    graph = build_graph(GraphConfig(num_neighbours=4, invariance=Invariance.rigid), points, sample, 3)
    x, edges = torch.randn(12, 6).double(), torch.randn(12, 4, 3).double()
    found = layer.aggregate(x, edges, graph)
    for i in range(12):
        messages = [
            layer.message(torch.cat([x[i], x[graph.neighbours[i, place]], edges[i, place]]))
            for place in range(4)
            if graph.present[i, place]
        ]
        wanted = torch.stack(messages).amax(0) if messages else torch.zeros(15).double()
        torch.testing.assert_close(found[i], wanted)
    assert layer(x, edges, graph).shape == (12, 5)


def test_a_layer_of_the_same_width_adds_its_input():
    layer = MessagePassing(6, 6, 3)
    graph = build_graph(
        GraphConfig(num_neighbours=2, invariance=Invariance.rigid), torch.randn(5, 7), torch.zeros(5).long(), 1
    )
    torch.nn.init.zeros_(layer.norm.weight)
    x = torch.randn(5, 6)
    torch.testing.assert_close(layer(x, torch.randn(5, 2, 3), graph), x)


@pytest.mark.parametrize("invariance", ["rigid", "translation"])
def test_named_terms_and_one_entry_per_sample(invariance):
    model, batch = gnn_model(f"model.graph.invariance={invariance}"), on_boxes(make_batch())
    output, terms = train_step(model, without_images(batch))
    assert set(terms) == TERMS and terms["box"] > 0 and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], terms["class"] + terms["box"])
    assert output.head.logits.shape == (len(output.head.graph.points), 12)
    assert len(model.eval().decode(model(batch)[0])) == 2
    assert model.image_backbone is None and model.config.sensors == ("radar",) and model.config.memory_frames == 0


def test_every_parameter_learns():
    assert parameters_that_stay(gnn_model(), on_boxes(make_batch(boxes=(12, 12))), lr=1e-2) == []


@pytest.mark.parametrize(
    "shape", [{"points": (0, 0)}, {"points": (150, 0)}, {"boxes": (0, 0)}, {"points": (1,), "boxes": (1,)}]
)
def test_empty_inputs_give_finite_losses(shape):
    model, batch = gnn_model(), without_images(make_batch(**shape))
    little_input_gives_finite_losses(model, batch)


def test_two_samples_do_not_mix():
    model, pair = gnn_model().eval(), make_batch(points=(150, 40), seed=3)
    both = model(pair)[0].head
    for sample in range(2):
        rows = pair.radar_batch == sample
        single = make_batch(points=(0,), boxes=(0,))
        single.radar_points, single.radar_batch = pair.radar_points[rows], pair.radar_batch[rows] * 0
        alone = model(single)[0].head
        own = both.graph.sample == sample
        torch.testing.assert_close(alone.logits, both.logits[own], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(alone.codes, both.codes[own], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("invariance", "angle"), [("rigid", 0.6), ("translation", 0.0)])
def test_boxes_move_along_with_the_scene(invariance, angle):
    """Turned and shifted within the grid: the same scores, boxes where the scene has gone."""
    model = gnn_model(f"model.graph.invariance={invariance}", "model.head.score_threshold=0").eval()
    batch = make_batch(points=(60,), boxes=(0,))
    batch.radar_points[:, :2] *= 0.4
    c, s = math.cos(angle), math.sin(angle)
    motion = torch.eye(4)
    motion[:2, :2], motion[:2, 3] = torch.tensor([[c, -s], [s, c]]), torch.tensor([1.5, -0.7])
    there = batch.radar_points.clone()
    there[:, :2] = there[:, :2] @ motion[:2, :2].T + motion[:2, 3]
    there[:, 4:6] = there[:, 4:6] @ motion[:2, :2].T
    before, after = (model(one)[0].head for one in (batch, replace(batch, radar_points=there)))
    assert len(before.logits) == len(after.logits) == 60
    torch.testing.assert_close(after.logits, before.logits, atol=1e-4, rtol=1e-4)
    stay, found = (model.decode(RadarGNNOutput(one))[0] for one in (before, after))
    wanted = stay.transform(motion)
    assert len(wanted) == len(found) > 0
    for name in ("centers", "sizes", "velocities", "scores"):
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(found.yaws.cos(), wanted.yaws.cos(), atol=1e-3, rtol=1e-3)


def test_points_belong_to_the_box_they_lie_in():
    """Of two boxes, 4 m by 2 m, one turned by 90 degrees about (10, 0); the last point is another sample's."""
    model = gnn_model()
    boxes = Boxes3D(
        centers=torch.tensor([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [1.5, 0.0, 0.0]]),
        sizes=torch.tensor([[4.0, 2.0, 2.0]]).repeat(3, 1), yaws=torch.tensor([0.0, math.pi / 2, 0.0]),
        velocities=torch.zeros(3, 2), labels=torch.tensor([0, 1, 2]), attributes=torch.full((3,), -1),
    )  # fmt: skip
    xy = torch.tensor([[-1.9, 0.9], [10.9, 1.9], [11.9, 0.9], [0.7, 0.0], [0.8, 0.0], [10.0, 0.0]])
    points = torch.cat([xy, torch.zeros(6, 5)], dim=1)
    sample = torch.tensor([0, 0, 0, 0, 0, 1])
    graph = build_graph(model.config.graph, points, sample, 2)
    owner, held = model.head.owners(graph, boxes, torch.zeros(3, dtype=torch.int64))
    assert owner.tolist() == [0, 1, -1, 0, 2, -1] and held.tolist() == [True, True, True]


@pytest.mark.parametrize("name", [field.name for field in fields(RadarGNNLossConfig)])
def test_weights_multiply_and_null_switches_a_term_off(name):
    weight_multiplies_or_switches_off(gnn_model().eval(), on_boxes(make_batch()), name, TERMS)


def test_autocast_keeps_positions_and_losses_in_float32():
    model, batch = gnn_model(), on_boxes(make_batch())
    output = autocast_step(model, batch)
    assert output.head.codes.dtype == output.head.logits.dtype == output.head.graph.edges.dtype == torch.float32


def test_annotations_are_needed():
    model, batch = gnn_model(), make_batch()
    with pytest.raises(ValueError, match="FrameBatch.boxes is None"):
        model.loss(model(batch)[0], replace(batch, boxes=None))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.graph.num_neighbours=0", "num_neighbours=0"),
        ("model.graph.invariance=none", "invariance"),
        ("model.node_channels=[]", "model.node_channels=.*one or more positive widths"),
        ("model.layer_channels=[8,0]", r"model.layer_channels=\[8, 0\]: must be one or more positive widths"),
        ("model.head.nms=maxpool", "model.head.nms=maxpool: works on cells"),
        ("model.head.hidden_channels=0", "hidden_channels=0"),
        ("model.loss.class_weight=-1", "model.loss.class_weight=-1"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        gnn_model(overrides)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 1.2e6, 1.3e6), ("mini", 1e5, 2e5), ("debug", 0, 1e4)])
def test_it_composes_at_every_scale_without_cameras(scale, low, high):
    config, _ = compose_config([f"scale={scale}", *SMALL[1:]])
    assert config.image_size_px is None and config.grid.cells == [384, 384]
    model = build_model(config.model, config.grid.build(), None, config.phase.options)
    assert low < sum(p.numel() for p in model.parameters()) < high


def test_there_is_no_second_phase():
    with pytest.raises(ConfigError, match="model=radargnn has no memory to train in phase=phase2; use phase=phase1"):
        compose_config([*SMALL[:3], "phase=phase2"])


@pytest.mark.slow
@pytest.mark.parametrize("invariance", ["rigid", "translation"])
def test_two_frames_are_overfitted(invariance):
    """Over 0.9 AP at one cell, averaged over the classes present; objects of which there are returns."""
    wide = (
        "model.channels=64", "model.layer_channels=[64]", "model.node_channels=[32,64]", "model.edge_channels=[8,16]",
        "model.head.hidden_channels=64", "model.graph.num_neighbours=8", f"model.graph.invariance={invariance}",
    )  # fmt: skip
    model, batch = gnn_model(*wide), on_boxes(make_batch(points=(60, 50), boxes=(5, 4)))
    assert overfitted_precision(model, batch, 300, 3e-3, 150) > 0.9
