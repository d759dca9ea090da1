"""Masked errors against OpenPCDet's own."""

import json
from pathlib import Path

import numpy as np
import torch

from src.losses.regression import masked_l1, masked_smooth_l1

CASE = np.load(Path(__file__).parents[1] / "golden" / "voxelnext_head_targets" / "case.npz")
FIRST = np.searchsorted(CASE["cells"][:, 0], [0, 1])


def gathered(group: int, reg: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Predictions and targets [objects, 10] of a golden group, both samples."""
    mask = CASE[f"g{group}/mask"]
    rows = (CASE[f"g{group}/row"] + FIRST[:, None])[mask]
    return reg[torch.from_numpy(rows).long(), group], torch.from_numpy(CASE[f"g{group}/target"][mask])


def test_golden_l1() -> None:
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-4)):
        reg = torch.from_numpy(CASE["reg"]).to(dtype).requires_grad_()
        total = 0.0
        for group in range(7):
            prediction, target = gathered(group, reg)
            loss = masked_l1(prediction, target.to(dtype)).sum(0) / max(1, len(target))
            np.testing.assert_allclose(loss.detach(), CASE["l1_per_code"][group], rtol=tolerance)
            total = total + loss.sum()
        total.backward()
        sums = reg.grad.abs().sum((0, 2))
        np.testing.assert_allclose(sums, CASE["l1_grad_abs_sum_per_group"], rtol=tolerance)
        np.testing.assert_allclose(reg.grad[CASE["l1_grad_g0_rows"], 0], CASE["l1_grad_g0_values"], rtol=tolerance)


def test_golden_l1_with_an_unknown_velocity() -> None:
    reg = torch.from_numpy(CASE["reg"]).double().requires_grad_()
    prediction, target = gathered(0, reg)
    target[0, 8:] = torch.nan
    loss = masked_l1(prediction, target).sum(0) / len(target)
    np.testing.assert_allclose(loss.detach(), CASE["l1_per_code_g0_nan_masked"], rtol=1e-9)
    loss.sum().backward()
    assert reg.grad.isfinite().all()
    assert json.loads(str(CASE["meta_json"]))["names"][0] == "car"


def test_smooth_l1_by_hand() -> None:
    prediction = torch.tensor([0.5, 3.0, 1.0, -2.0], requires_grad=True)
    terms = masked_smooth_l1(prediction, torch.tensor([0.0, 0.0, torch.nan, -1.0]))
    terms.sum().backward()
    torch.testing.assert_close(terms, torch.tensor([0.125, 2.5, 0.0, 0.5]))
    torch.testing.assert_close(prediction.grad, torch.tensor([0.5, 1.0, 0.0, -1.0]))
