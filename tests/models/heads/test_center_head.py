"""The head as a module: parameters, evaluation at chosen cells, loss, and decoding of its own targets."""

from dataclasses import replace

import pytest
import torch

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.heads.branches import checkpointed_branches
from src.models.heads.center_head import CenterHead, HeadConfig, HeadOutput, TrainRegression
from src.models.heads.decode import AttributeSource, Suppression
from src.ops.sites import Sites
from src.structures.boxes import Boxes3D
from src.structures.sparse_bev import SparseBEV
from src.structures.taxonomy import CLASSES
from src.targets.heatmap import CODE_SIZE, GROUP_OF_CLASS

GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
CONFIG = HeadConfig(
    nms=Suppression.per_group,
    score_threshold=0.1,
    max_boxes=500,
    attributes=AttributeSource.rule,
    train_regression=TrainRegression.all,
)


def make_bev(cells: int = 400) -> SparseBEV:
    """A patch of active cells around the origin of two samples with random features."""
    generator = torch.Generator().manual_seed(0)
    indices = torch.randint(150, 234, (cells, 3), generator=generator)
    indices[:, 0] %= 2
    sites, _ = Sites.unique(indices, (2, 384, 384))
    return SparseBEV(sites, torch.randn(len(sites), 8, generator=generator))


def make_boxes(seed: int = 0, labels: tuple[int, ...] = tuple(range(12))) -> Boxes3D:
    """One box per class, 8 m apart, at least 1 m/s fast."""
    generator = torch.Generator().manual_seed(seed)
    count = len(labels)
    centers = torch.rand(count, 3, generator=generator)
    centers[:, 0] += 8.0 * (torch.arange(count) % 4) - 12
    centers[:, 1] += 8.0 * torch.div(torch.arange(count), 4, rounding_mode="floor") - 12
    sizes = torch.rand(count, 3, generator=generator) * 2 + 0.5
    yaws = torch.rand(count, generator=generator) * 6 - 3
    velocities = torch.rand(count, 2, generator=generator) * 9 + 1
    names = torch.tensor(labels, dtype=torch.int64)
    attributes = torch.where((names == 0) | (names == 7), torch.where(names == 0, 1, 6), -1)
    return Boxes3D(centers, sizes, yaws, velocities, names, attributes, num_points=names * 0 + 5)


def head_of(channels: int = 8, **changes: object) -> CenterHead:
    torch.manual_seed(0)
    return CenterHead(replace(CONFIG, **changes), channels, GRID, velocity_code_weight=0.2)


def test_parameters_at_full_size() -> None:
    total = sum(parameter.numel() for parameter in head_of(128).parameters())
    assert abs(total / 0.86e6 - 1) < 0.02


def test_initial_scores_are_about_a_tenth_for_every_class() -> None:
    logits = head_of()(make_bev()).logits
    assert logits.shape[1] == len(CLASSES)
    assert (logits.mean(0) + 2.19).abs().max() < 1.0


def test_columns_follow_the_classes() -> None:
    head = head_of()
    for label in range(len(CLASSES)):
        branches = head.heatmaps[GROUP_OF_CLASS[label]]
        torch.nn.init.zeros_(branches.outputs[0].weight)
    truck, other = CLASSES.index("truck"), CLASSES.index("other_vehicle")
    head.heatmaps[1].outputs[0].bias.data = torch.tensor([3.0, 5.0])
    logits = head(make_bev()).logits
    assert (logits[:, truck] == 3).all() and (logits[:, other] == 5).all()
    assert (logits[:, [c for c in range(12) if c not in (truck, other)]] < 0).all()


def test_regressing_top_cells_equals_regressing_all() -> None:
    head = head_of()
    bev = make_bev()
    head(bev)
    head.eval()
    output = head(bev)
    assert output.codes is None
    every = torch.stack([branches(output.bev.features) for branches in head.regressions], dim=1)
    rows, groups = torch.randint(0, len(bev), (30,)), torch.randint(0, 7, (30,))
    torch.testing.assert_close(head.regress(output, rows, groups), every[rows, groups])


def test_all_groups_at_once_equal_one_after_the_other() -> None:
    """As on a GPU and as on a CPU, with the statistics of a training step."""
    head, features = head_of().train(), make_bev().features
    one_by_one = torch.stack([checkpointed_branches([part], features) for part in head.regressions], dim=1)
    at_once = checkpointed_branches(list(head.regressions), features).unflatten(1, (7, -1))
    torch.testing.assert_close(at_once, one_by_one)


def test_sampled_training_equals_all_where_the_sample_is_everything() -> None:
    bev, boxes = make_bev(), [make_boxes(0), make_boxes(1)]
    head, sampled = head_of().train(), head_of(train_regression=TrainRegression.sampled).train()
    sampled.load_state_dict(head.state_dict())
    rows, groups = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
    output = head(bev)
    sampled.regress(sampled(bev), rows, groups)
    for one, other in zip(head.buffers(), sampled.buffers(), strict=True):
        torch.testing.assert_close(one, other)
    terms = sampled.loss(sampled(bev), boxes, 1.0, 0.25).terms
    torch.testing.assert_close(terms["heatmap"], head.loss(output, boxes, 1.0, 0.25).terms["heatmap"])


def test_sampled_training_reads_objects_beside_an_even_sample_of_all_cells() -> None:
    """Their codes are those of one pass of their group's branches over both, with the statistics of that."""
    bev, boxes = make_bev(), [make_boxes(0), make_boxes(1)]
    head = head_of(train_regression=TrainRegression.sampled).train()
    output = head(bev)
    targets = head.targets(output, boxes)
    found = head.regress(output, targets.rows, targets.groups)
    features = output.bev.features
    for group, branches in enumerate(head.regressions):
        own = targets.rows[targets.groups == group]
        expected = branches(torch.cat([features[own], features]))[: len(own)]
        torch.testing.assert_close(found[targets.groups == group], expected)


def test_attribute_loss_is_a_mean_over_objects_that_have_one_among_those_of_their_class() -> None:
    """Of two cars one is parked and one unknown, a barrier has none, a bicycle is ridden."""
    head, bev = head_of(attributes=AttributeSource.learned).eval(), make_bev()
    boxes = make_boxes(labels=(0, 0, 9, 7))
    boxes.attributes = torch.tensor([1, -1, -1, 6])
    output = head(bev)
    targets = head.targets(output, [boxes, Boxes3D.empty()])
    scores = head.regress(output, targets.rows, targets.groups)[:, CODE_SIZE:].detach()
    parked, ridden = (scores[targets.attributes == one].squeeze(0) for one in (1, 6))
    vehicle, cycle = parked[:3].softmax(0)[1].log(), ridden[6:8].softmax(0)[0].log()
    found = head.loss(output, [boxes, Boxes3D.empty()], None, None).terms
    assert found.keys() == {"attribute"}
    torch.testing.assert_close(found["attribute"].detach(), -0.2 * (vehicle + cycle) / 2)


@pytest.mark.parametrize("mode", TrainRegression)
@pytest.mark.parametrize("attributes", AttributeSource)
def test_every_parameter_learns(mode: TrainRegression, attributes: AttributeSource) -> None:
    head = head_of(train_regression=mode, attributes=attributes).train()
    bev = make_bev()
    bev.features.requires_grad_()
    terms = head.loss(head(bev), [make_boxes(0), make_boxes(1)], 1.0, 0.25).terms
    assert set(terms) == {"heatmap", "box"} | ({"attribute"} if attributes is AttributeSource.learned else set())
    sum(terms.values()).backward()
    for name, parameter in head.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        last = name.startswith("regressions") and ".outputs." in name
        silent = last and name.endswith("bias")  # the signs of two L1 errors may cancel there
        silent |= ".outputs.5." in name and int(name.split(".")[1]) not in (
            0,
            4,
        )  # only car and bicycle have attributes
        assert silent or name == "shared.conv.bias" or parameter.grad.abs().sum() > 0, name
    assert bev.features.grad.abs().sum() > 0


@pytest.mark.parametrize("mode", TrainRegression)
@pytest.mark.parametrize("cells", [0, 1, 300])
def test_batch_without_objects(mode: TrainRegression, cells: int) -> None:
    head = head_of(train_regression=mode, attributes=AttributeSource.learned).train()
    terms = head.loss(head(make_bev(cells)), [Boxes3D.empty(), Boxes3D.empty()], 1.0, 0.25).terms
    sum(terms.values()).backward()
    assert all(term.isfinite() for term in terms.values()) and terms["box"].item() == 0
    for name, parameter in head.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert not name.startswith("regressions") or parameter.grad.abs().sum() == 0, name
    head.eval()
    found = head.decode(head(make_bev(cells)))
    assert len(found) == 2 and all(boxes.scores is not None for boxes in found)


def test_loss_by_hand() -> None:
    head = head_of().train()
    output = head(make_bev())
    boxes = [make_boxes(0), make_boxes(1, labels=(0, 0, 1))]
    boxes[0].velocities[3] = torch.nan
    targets = head.targets(output, boxes)
    assert targets.num_distant == 0
    box, heatmap = 0.0, 0.0
    weights = torch.tensor([1.0] * 8 + [0.2] * 2)
    for group in range(7):
        mine = targets.groups == group
        errors = (output.codes[targets.rows[mine], group] - targets.codes[mine]).abs().nan_to_num() * weights
        box += errors.sum() / max(1, int(mine.sum()))
        columns = [label for label in range(12) if GROUP_OF_CLASS[label] == group]
        y, p = targets.heatmap[:, columns], output.logits[:, columns].sigmoid()
        terms = torch.where(y == 1, (1 - p) ** 2 * p.log(), (1 - y) ** 4 * p**2 * (1 - p).log())
        heatmap -= terms.sum() / max(1, int((y == 1).sum()))
    terms = head.loss(output, boxes, 2.0, 0.25).terms
    torch.testing.assert_close(terms["box"], 0.25 * box)
    torch.testing.assert_close(terms["heatmap"], 2.0 * heatmap)
    assert set(head.loss(output, boxes, None, 0.25).terms) == {"box"}
    assert head.loss(output, boxes, None, None).terms == {}


def output_of_targets(head: CenterHead, bev: SparseBEV, boxes: list[Boxes3D]) -> HeadOutput:
    """What a perfect head would predict."""
    targets = head.targets(HeadOutput(bev, bev.features, None), boxes)
    codes = torch.zeros(len(bev), 7, CODE_SIZE)
    codes[targets.rows, targets.groups] = targets.codes.float()
    logits = torch.full((len(bev), 12), -9.0)
    logits[targets.rows, targets.labels] = 4 - targets.labels.float() / 10
    return HeadOutput(bev, logits, codes)


AUGMENTATIONS = {"none": torch.eye(2), "mirrored and turned": torch.tensor([[0.96, 0.28], [0.28, -0.96]]) * 1.03}


@pytest.mark.parametrize("method", Suppression)
@pytest.mark.parametrize("augmentation", AUGMENTATIONS)
def test_decoding_the_targets_returns_the_boxes(method: Suppression, augmentation: str) -> None:
    aug_from_ego = torch.eye(4)
    aug_from_ego[:2, :2] = AUGMENTATIONS[augmentation]
    aug_from_ego[2, 2] = torch.linalg.det(AUGMENTATIONS[augmentation]).abs().sqrt()
    wanted = [make_boxes(0).transform(aug_from_ego), make_boxes(1).transform(aug_from_ego)]
    head = head_of(nms=method).eval()
    found = head.decode(output_of_targets(head, make_bev(4000), wanted))
    for boxes, expected in zip(found, wanted, strict=True):
        assert boxes.labels.tolist() == expected.labels.tolist()
        for name in ("centers", "sizes", "yaws", "velocities"):
            torch.testing.assert_close(getattr(boxes, name), getattr(expected, name), rtol=1e-5, atol=1e-4)
    assert found[0].attributes[0] == 0 and found[0].attributes[CLASSES.index("barrier")] == -1


def test_never_more_than_500_boxes() -> None:
    head = head_of(score_threshold=0.0, nms=Suppression.maxpool).eval()
    grid_cells = torch.stack(torch.meshgrid(torch.arange(142, 242), torch.arange(142, 242), indexing="ij"), -1)
    indices = torch.cat([torch.zeros(10000, 1), grid_cells.reshape(-1, 2)], 1).long()
    sites, _ = Sites.from_indices(indices, (1, 384, 384))
    bev = SparseBEV(sites, torch.randn(len(sites), 8))
    output = HeadOutput(bev, torch.randn(len(sites), 12), torch.zeros(len(sites), 7, CODE_SIZE))
    (boxes,) = head.decode(output)
    assert len(boxes) == 500
    assert (boxes.scores.diff() <= 0).all()
    head = head_of(max_boxes=20, score_threshold=0.0, nms=Suppression.maxpool).eval()
    assert torch.equal(head.decode(output)[0].scores, boxes.scores[:20])


def test_samples_do_not_mix() -> None:
    head = head_of().eval()
    bev = make_bev(600)
    both = head.decode(head(bev))
    for sample in range(2):
        mine = bev.indices[:, 0] == sample
        alone = torch.cat([torch.zeros(int(mine.sum()), 1).long(), bev.indices[mine, 1:]], dim=1)
        single = SparseBEV(Sites.from_indices(alone, (1, 384, 384))[0], bev.features[mine])
        (boxes,) = head.decode(head(single))
        torch.testing.assert_close(boxes.scores, both[sample].scores)
        torch.testing.assert_close(boxes.centers, both[sample].centers)


@pytest.mark.parametrize("regression", list(TrainRegression))
def test_autocast_changes_little(regression: TrainRegression) -> None:
    bev = make_bev()
    head = head_of(train_regression=regression).train()
    plain = head.loss(head(bev), [make_boxes(0), make_boxes(1)], 1.0, 0.25).terms
    with torch.autocast("cpu", torch.bfloat16):
        output = head(bev)
        assert output.logits.dtype == torch.float32
        assert output.codes is None or output.codes.dtype == torch.float32
    halved = head.loss(output, [make_boxes(0), make_boxes(1)], 1.0, 0.25).terms
    for name, term in plain.items():
        torch.testing.assert_close(halved[name], term, rtol=0.05, atol=0)
    head.eval()
    with torch.autocast("cpu", torch.bfloat16):
        output = head(bev)
        inside = head.decode(output)
    for boxes in (*inside, *head.decode(output)):
        assert len(boxes) and boxes.centers.dtype == torch.float32


@pytest.mark.parametrize("wrong", [{"score_threshold": 1.0}, {"max_boxes": 501}, {"max_boxes": 0}])
def test_impossible_settings(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"model.head.{next(iter(wrong))}"):
        replace(CONFIG, **wrong)
