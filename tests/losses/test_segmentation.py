"""Occupancy losses against the full map and Lovasz-Softmax against its authors' code."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from src.losses.segmentation import dice, lovasz_foreground, occupancy_losses

CASES = np.load(Path(__file__).parents[1] / "golden" / "lovasz_softmax" / "cases.npz")
NAMES = json.loads(str(CASES["meta_json"]))["cases"]


@pytest.mark.parametrize("name", [name for name in NAMES if name != "batch"])
def test_golden_lovasz(name: str) -> None:
    y = torch.from_numpy(CASES[f"{name}/y"]).bool()
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-5)):
        p = torch.from_numpy(CASES[f"{name}/p"]).to(dtype).requires_grad_()
        loss = lovasz_foreground(p, y, torch.zeros(len(y), dtype=torch.int64), 1)
        loss.backward()
        # Without foreground ours is 0 where the authors' list form takes the largest score.
        expected = CASES[f"{name}/loss"] if y.any() else 0.0
        np.testing.assert_allclose(loss.item(), expected, rtol=0, atol=tolerance)
        if name != "ties":
            gradient = CASES[f"{name}/grad_p"] if y.any() else np.zeros(len(y))
            np.testing.assert_allclose(p.grad, gradient, rtol=0, atol=tolerance)


def test_golden_lovasz_of_a_batch() -> None:
    p = torch.from_numpy(CASES["batch/p"]).double().requires_grad_()
    y = torch.from_numpy(CASES["batch/y"]).bool()
    sample = torch.arange(3).repeat_interleave(40)
    loss = lovasz_foreground(p.flatten(), y.flatten(), sample, 3)
    loss.backward()
    np.testing.assert_allclose(loss.item(), CASES["batch/loss"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(p.grad, CASES["batch/grad_p"], rtol=0, atol=1e-9)


def test_samples_without_cells_count_as_zero() -> None:
    p = torch.tensor([0.3, 0.8], requires_grad=True)
    y, sample = torch.tensor([True, False]), torch.tensor([1, 1])
    torch.testing.assert_close(lovasz_foreground(p, y, sample, 2) * 2, lovasz_foreground(p, y, sample - 1, 1))
    none = torch.zeros(0, dtype=torch.int64)
    loss = lovasz_foreground(p[:0], y[:0], none, 2) + dice(p[:0], y[:0], none, 2)
    loss.backward()
    assert float(loss.detach()) == 0 and p.grad.tolist() == [0, 0]


def test_dice_by_hand() -> None:
    score = torch.tensor([0.5, 0.25, 1.0])
    loss = dice(score, torch.tensor([True, False, True]), torch.tensor([0, 0, 2]), 3)
    expected = (1 - 2 / 2.75 + 0 + 1 - 3 / 3) / 3
    torch.testing.assert_close(loss.item(), expected)


def full_map(alpha: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Focal and Dice on [B, cells] with every cell written out."""
    p = alpha.clamp(min=1e-4)
    focal = torch.where(target, -0.25 * (1 - p) ** 2 * p.log(), -0.75 * alpha**2 * torch.log1p(-alpha)).sum()
    y = target.double()
    return focal, (1 - (2 * (alpha * y).sum(1) + 1) / (alpha.sum(1) + y.sum(1) + 1)).mean()


def test_sparse_evaluation_equals_the_full_map() -> None:
    generator = torch.Generator().manual_seed(0)
    cells = 200
    free = -torch.rand(3, cells, generator=generator, dtype=torch.float64).mul(4).sub(3).exp()  # S from -2.7 to -0.05
    covered = torch.rand(3, cells, generator=generator) < 0.4
    target = torch.rand(3, cells, generator=generator) < 0.3
    target[1] = False
    free[0, covered[0].nonzero()[:4, 0]] = -1e-6  # alpha below the clamp
    target[0, covered[0].nonzero()[:2, 0]] = True
    dense_free = torch.where(covered, free, 0.0).requires_grad_()
    expected = full_map(-torch.expm1(dense_free), target)
    (expected[0] + 3 * expected[1]).backward()

    support = covered.flatten().nonzero().squeeze(1)
    log_free = free.flatten()[support].requires_grad_()
    found = occupancy_losses(log_free, support, target.flatten().nonzero().squeeze(1), 3, cells)
    (found[0] + 3 * found[1]).backward()
    torch.testing.assert_close(found[0], expected[0].detach(), rtol=1e-9, atol=0)
    torch.testing.assert_close(found[1], expected[1].detach(), rtol=1e-9, atol=0)
    torch.testing.assert_close(log_free.grad, dense_free.grad.flatten()[support], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("log_free", [0.0, -1e-30, -1e-8, -100.0])
@pytest.mark.parametrize("positive", [True, False])
def test_occupancy_gradients_stay_finite_at_the_ends(log_free: float, positive: bool) -> None:
    free = torch.tensor([log_free], requires_grad=True)
    occupied = torch.tensor([5]) if positive else torch.zeros(0, dtype=torch.int64)
    focal, overlap = occupancy_losses(free, torch.tensor([5]), occupied, 1, 10)
    (focal + overlap).backward()
    assert focal.isfinite() and overlap.isfinite() and free.grad.isfinite().all()


def test_a_missed_positive_costs_a_constant() -> None:
    none = torch.zeros(0, dtype=torch.int64)
    focal, overlap = occupancy_losses(torch.zeros(0), none, torch.tensor([3]), 1, 10)
    torch.testing.assert_close(focal.item(), -0.25 * (1 - 1e-4) ** 2 * math.log(1e-4))
    torch.testing.assert_close(overlap.item(), 0.5)
    focal, overlap = occupancy_losses(torch.zeros(0), none, none, 2, 10)
    assert float(focal) == 0 and float(overlap) == 0
