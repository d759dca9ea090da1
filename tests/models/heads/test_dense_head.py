"""The head on whole maps is the sparse head whose sites are all cells."""

from dataclasses import fields, replace

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.heads.center_head import CenterHead, HeadConfig, TrainRegression
from src.models.heads.decode import AttributeSource, Suppression
from src.models.layers.dense import DenseToSparse, map_of_rows, rows_of_map
from src.structures.boxes import Boxes3D

GRID = BEVGrid(cells=(24, 32), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
C = 8


def head_of(dense, train_regression=TrainRegression.all, nms=Suppression.per_group):
    config = HeadConfig(
        nms=nms,
        score_threshold=0.005,
        max_boxes=500,
        attributes=AttributeSource.rule,
        train_regression=train_regression,
    )
    torch.manual_seed(0)
    return CenterHead(config, C, GRID, velocity_code_weight=0.2, dense=dense)


def twins(**changes):
    """A dense and a sparse head of the same weights."""
    dense, sparse = head_of(True, **changes), head_of(False, **changes)
    state = {}
    for key, value in dense.state_dict().items():
        if key.startswith("shared.0."):
            key = key.replace("shared.0.", "shared.")
            if key == "shared.conv.weight":  # [out, in, 3, 3] to [9, in, out]
                value = value.permute(2, 3, 1, 0).reshape(9, C, C)
        state[key] = value
    sparse.load_state_dict(state)
    return dense, sparse


def boxes_of(count, seed):
    generator = torch.Generator().manual_seed(seed)
    return Boxes3D(
        centers=(torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([22.0, 17.0, 2.0]),
        sizes=torch.rand(count, 3, generator=generator) * 2 + 0.5,
        yaws=torch.rand(count, generator=generator) * 6 - 3,
        velocities=torch.randn(count, 2, generator=generator),
        labels=torch.arange(count) % 12,
        attributes=torch.full((count,), -1),
        num_points=torch.full((count,), 5),
    )


@pytest.mark.parametrize("train_regression", list(TrainRegression))
def test_outputs_losses_gradients_and_boxes_are_the_sparse_heads(train_regression):
    dense, sparse = twins(train_regression=train_regression)
    x = torch.randn(2, C, 24, 32, generator=torch.Generator().manual_seed(1))
    x = x.contiguous(memory_format=torch.channels_last)
    boxes = [boxes_of(12, 2), boxes_of(5, 3)]
    found = []
    for head, bev in ((dense, x.clone().requires_grad_()), (sparse, x.clone().requires_grad_())):
        output = head(bev if head is dense else DenseToSparse()(bev))
        terms = head.loss(output, boxes, 1.0, 0.25).terms
        sum(terms.values()).backward()
        found.append(
            (output.logits, terms, bev.grad, head.eval().decode(head(bev if head is dense else DenseToSparse()(bev))))
        )
    (logits, terms, grad, decoded), (logits2, terms2, grad2, decoded2) = found
    torch.testing.assert_close(logits, logits2, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(terms, terms2, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(grad, grad2, rtol=1e-3, atol=1e-5)
    for one, two in zip(decoded, decoded2, strict=True):
        assert len(one) == len(two)
        for field in fields(one):
            a, b = getattr(one, field.name), getattr(two, field.name)
            assert (a is None) == (b is None) and (a is None or torch.allclose(a.float(), b.float(), atol=1e-3))


@pytest.mark.parametrize("train_regression", list(TrainRegression))
def test_velocities_are_regressed_on_top_of_known_motion(train_regression):
    """Here x of a velocity is known to be the row of a cell, y its column, in the first sample."""
    head, x = head_of(True, train_regression), torch.randn(2, C, 24, 32, generator=torch.Generator().manual_seed(1))
    rows, cols = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    motion, boxes = (
        torch.stack([rows, cols]) * torch.tensor([1.0, 0.0])[:, None, None, None],
        [boxes_of(12, 2), boxes_of(5, 3)],
    )
    lower = GRID.to_cells(boxes[0].centers[:, :2]).round().flip(1)  # of the nearest corner
    rest = [replace(boxes[0], velocities=boxes[0].velocities - lower), boxes[1]]
    torch.testing.assert_close(
        head.loss(head(x, base_velocities=motion), boxes, 1.0, 0.25).terms, head.loss(head(x), rest, 1.0, 0.25).terms
    )
    head.eval()
    moved, still = head.decode(head(x, base_velocities=motion)), head.decode(head(x))
    assert torch.equal(moved[1].velocities, still[1].velocities) and torch.equal(moved[0].centers, still[0].centers)
    known = moved[0].velocities - still[0].velocities
    torch.testing.assert_close(known, known.round(), atol=1e-4, rtol=0)
    offsets = GRID.to_cells(moved[0].centers[:, :2]).flip(1) - known  # as regressed, a small number of cells
    assert len(known) > 20 and known[:, 1].max() > 24 and offsets.abs().max() < 3


def test_an_untrained_map_is_nearly_empty():
    """Or the focal loss of a hundred thousand free cells would drown the rest."""
    with torch.no_grad():
        scores = head_of(True).eval()(torch.zeros(1, C, 24, 32)).logits.sigmoid()
    assert 0.005 < float(scores.mean()) < 0.02


def test_every_object_has_its_own_cell():
    """Unlike on sparse sites nothing is too far from a cell."""
    head, boxes = head_of(True), [boxes_of(12, 5)]
    output = head(torch.zeros(1, C, 24, 32))
    targets = head.targets(output, boxes)
    assert targets.num_distant == 0 and len(targets.rows) == 12
    cells = output.bev.indices[targets.rows, 1:]
    lower = GRID.to_cells(boxes[0].centers[:, :2]).flip(1)
    assert (lower - cells).abs().max() <= 0.5 + 1e-5


def test_local_maxima_suppress_on_whole_maps():
    head = head_of(True, nms=Suppression.maxpool).eval()
    with torch.no_grad():
        x = torch.randn(1, C, 24, 32)
        output = head(x)
        (boxes,) = head.decode(output)
        scores = output.logits.sigmoid().t().view(12, 24, 32)
        peaks = (scores == torch.nn.functional.max_pool2d(scores, 3, 1, 1)) & (scores > 0.005)
    assert 0 < len(boxes) <= int(peaks.sum())


def test_maps_and_rows_are_views_of_each_other():
    x = torch.randn(2, 3, 4, 5).contiguous(memory_format=torch.channels_last)
    rows = rows_of_map(x)
    assert rows.data_ptr() == x.data_ptr() and torch.equal(rows[1 * 20 + 2 * 5 + 3], x[1, :, 2, 3])
    again = map_of_rows(rows, (2, 4, 5))
    assert again.data_ptr() == x.data_ptr() and torch.equal(again, x)


def test_sites_are_made_once_per_size():
    cells = DenseToSparse()
    first, again = cells(torch.zeros(2, 3, 4, 5)), cells(torch.ones(2, 3, 4, 5))
    assert first.sites is again.sites and first.indices[-1].tolist() == [1, 3, 4] and len(first) == 40
    assert cells(torch.zeros(1, 3, 4, 5)).sites is not first.sites
