"""Focal losses against OpenPCDet's own and finite behaviour at the ends."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from src.losses.classification import depth_cross_entropy, penalty_reduced_focal, sigmoid_focal

CASE = np.load(Path(__file__).parents[1] / "golden" / "voxelnext_head_targets" / "case.npz")
META = json.loads(str(CASE["meta_json"]))


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_golden_focal(dtype: torch.dtype, tolerance: float) -> None:
    logits = torch.from_numpy(CASE["logits"]).to(dtype).requires_grad_()
    target = torch.from_numpy(CASE["heatmap"]).to(dtype)
    terms = penalty_reduced_focal(logits, target)
    column, total = 0, 0.0
    for group, names in enumerate(META["groups"]):
        columns = slice(column, column + len(names))
        positives = int((target[:, columns] == 1).sum())
        # Two cars of sample 0 share a cell: two objects, one positive.
        assert positives == META["positives_per_group"][group] - (group == 0)
        loss = terms[:, columns].sum() / max(1, positives)
        np.testing.assert_allclose(loss.item(), CASE["focal_loss"][group], rtol=tolerance)
        total, column = total + loss, columns.stop
    total.backward()
    np.testing.assert_allclose(logits.grad, CASE["focal_grad_logits"], rtol=tolerance, atol=tolerance * 1e-2)


def test_penalty_reduced_focal_has_no_gradient_where_clamped() -> None:
    logits = torch.tensor([20.0, -20.0, 20.0, -20.0], requires_grad=True)
    terms = penalty_reduced_focal(logits, torch.tensor([1.0, 1.0, 0.5, 0.5]))
    terms.sum().backward()
    assert terms.isfinite().all() and logits.grad.tolist() == [0, 0, 0, 0]
    expected = -((1 - 1e-4) ** 2) * math.log(1e-4)
    torch.testing.assert_close(terms[1].item(), expected, rtol=1e-4, atol=0)


def test_sigmoid_focal_by_definition_and_at_extreme_logits() -> None:
    logits = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
    target = torch.tensor([True, False, False])
    p = logits.sigmoid()
    p_t, weight = torch.where(target, p, 1 - p), torch.where(target, 0.25, 0.75)
    torch.testing.assert_close(sigmoid_focal(logits, target), -weight * (1 - p_t) ** 2 * p_t.log())
    extreme = torch.tensor([200.0, -200.0, 200.0, -200.0], requires_grad=True)
    terms = sigmoid_focal(extreme, torch.tensor([True, True, False, False]))
    terms.sum().backward()
    torch.testing.assert_close(terms, torch.tensor([0.0, 50.0, 150.0, 0.0]))
    assert extreme.grad.isfinite().all()


def test_depth_loss_by_hand() -> None:
    logits = torch.randn(2, 3, 2, 2, generator=torch.Generator().manual_seed(0)).double().requires_grad_()
    target = torch.tensor([[[0, -1], [-1, -1]], [[-1, -1], [-1, 2]]])
    loss = depth_cross_entropy(logits, target)
    expected = 0.0
    for view, row, col, wanted in ((0, 0, 0, 0), (1, 1, 1, 2)):
        p = logits[view, :, row, col].softmax(0).detach()
        expected -= sum(math.log(p[i] if i == wanted else 1 - p[i]) for i in range(3))
    torch.testing.assert_close(loss.item(), float(expected))
    loss.backward()
    assert float(logits.grad[0, :, 0, 1].abs().sum()) == 0 and float(logits.grad[0, :, 0, 0].abs().sum()) > 0


def test_depth_loss_is_finite_for_a_certain_mistake_and_zero_without_foreground() -> None:
    logits = torch.tensor([300.0, 0.0, 0.0]).reshape(1, 3, 1, 1).requires_grad_()
    loss = depth_cross_entropy(logits, torch.tensor([[[1]]]))
    loss.backward()
    assert loss.isfinite() and logits.grad.isfinite().all()
    assert depth_cross_entropy(logits, torch.tensor([[[-1]]])).item() == 0


def test_losses_leave_half_precision() -> None:
    logits = torch.tensor([0.5, -3.0], dtype=torch.bfloat16)
    assert penalty_reduced_focal(logits, torch.tensor([1.0, 0.0])).dtype == torch.float32
    assert sigmoid_focal(logits, torch.tensor([True, False])).dtype == torch.float32
    assert depth_cross_entropy(logits.reshape(1, 2, 1, 1), torch.tensor([[[0]]])).dtype == torch.float32


@pytest.mark.parametrize("clamped", [False, True])
def test_gradients_of_focal_losses(clamped: bool) -> None:
    draw = torch.Generator().manual_seed(0)
    logits = (3 * torch.randn(40, generator=draw)).double().requires_grad_()
    target = torch.rand(40, generator=draw).double()
    target[target > 0.8] = 1.0
    if clamped:
        assert torch.autograd.gradcheck(lambda x: penalty_reduced_focal(x, target), logits)
    else:
        assert torch.autograd.gradcheck(lambda x: sigmoid_focal(x, target == 1), logits)
