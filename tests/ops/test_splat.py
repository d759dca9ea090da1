import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.splat import log1mexp
from src.ops.splat import splat_gaussians as splat

ROOT = Path(__file__).parents[2]
GOLDEN = np.load(ROOT / "tests" / "golden" / "splat" / "case.npz")
DEMO = ROOT.parent / "shared" / "real" / "horizon3d_page" / "ocsf_demo.json"
GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
SMALL = BEVGrid(cells=(6, 8), cell_m=0.8, centre_m=(0.4, -0.2), z_range_m=(-3.0, 5.0))

splat_gaussians = partial(splat, threshold=0.1, max_cells=32768, support_sigmas=3.0)  # as in conf/ at full size


def golden(key):
    return torch.from_numpy(GOLDEN[key])


def directions_of(theta):
    return torch.stack([theta.cos(), theta.sin()], 1)


def random_gaussians(num, grid, seed=0, channels=3, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)

    def uniform(*size):
        return torch.rand(*size, generator=generator, dtype=dtype)

    half = torch.tensor(grid.half_extent_m, dtype=dtype)
    means = (uniform(num, 2) * 2.4 - 1.2) * half + torch.tensor(grid.centre_m, dtype=dtype)  # some outside
    scales, directions = 0.2 + 1.2 * uniform(num, 2), directions_of(uniform(num) * 7)
    return means, scales, directions, 4 * uniform(num) - 2, uniform(num, channels) - 0.5


def brute_force(means, scales, directions, logits, features, batch, grid, batch_size, threshold=0.1, sigmas=3.0):
    """Every Gaussian at every cell: S [B, cells], occupancy mask, F_G on all cells."""
    rows, cols = torch.meshgrid(torch.arange(grid.rows), torch.arange(grid.cols), indexing="ij")
    centres = grid.centre_of(torch.stack([rows, cols], -1).view(-1, 2), means.dtype)
    offset = centres - means[:, None]
    along = (offset * directions[:, None]).sum(2)
    across = offset[..., 1] * directions[:, None, 0] - offset[..., 0] * directions[:, None, 1]
    q = (along / scales[:, :1]) ** 2 + (across / scales[:, 1:]) ** 2
    kernel = torch.where(q <= sigmas**2, torch.exp(-q / 2), 0.0)
    contribution = (torch.sigmoid(logits)[:, None] * kernel).clamp(max=1 - 1e-4)
    own = (batch[:, None] == torch.arange(batch_size)).to(means.dtype)
    log_free = torch.einsum("gb,gp->bp", own, torch.log1p(-contribution))
    out = torch.einsum("gb,gp,gc->bpc", own, kernel, features)
    return log_free, -torch.expm1(log_free) > threshold, out, contribution


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_golden_case(dtype):
    names = ("means", "scales", "theta", "opacity_logit", "feats")
    inputs = [golden(name).to(dtype).requires_grad_() for name in names]
    means, scales, theta, logits, features = inputs
    batch = torch.zeros(len(means), dtype=torch.int64)
    out = splat_gaussians(means, scales, directions_of(theta), logits, features, batch, GRID, 1)
    exact = dtype == torch.float64
    assert torch.equal(out.support, golden("support_cells").long())
    assert torch.equal(out.occupied.linear(), golden("omega_cells").long())
    assert torch.equal(out.support[out.occupied_rows], out.occupied.linear())
    torch.testing.assert_close(out.occupancy.double(), golden("alpha"), rtol=0, atol=1e-10 if exact else 2e-5)
    torch.testing.assert_close(out.log_free.double(), golden("S"), rtol=1e-10 if exact else 2e-4, atol=1e-10)
    torch.testing.assert_close(out.features.double(), golden("F_G"), rtol=0, atol=1e-10 if exact else 1e-4)
    torch.testing.assert_close(log1mexp(-out.log_free).double(), golden("alpha").log(), rtol=1e-3, atol=1e-6)
    assert torch.equal(out.peak_cell >= 0, golden("active"))
    clear = golden("argmax_margin") >= 1e-5
    assert torch.equal(out.peak_cell[clear], golden("argmax_cell").long()[clear])
    assert out.peak_cell[6] == -1 and out.num_cut == 0

    weighted = {"alpha": (out.occupancy, "w_alpha"), "S": (out.log_free, "w_S"), "F": (out.features, "w_F")}
    for kind, (value, weight) in weighted.items():
        loss = (value * golden(weight).to(dtype)).sum()
        grads = torch.autograd.grad(loss, inputs, retain_graph=True, allow_unused=True)
        for name, grad in zip(names, grads, strict=True):
            expected = golden(f"grad_{kind}/{name}")
            grad = torch.zeros_like(expected) if grad is None else grad.double()
            tolerance = 1e-8 if exact else 1e-4 * expected.abs().max().item()
            torch.testing.assert_close(grad, expected, rtol=0, atol=max(tolerance, 1e-12), msg=f"{kind} {name}")


@pytest.mark.parametrize("sigmas", [1.0, 3.0])
def test_equals_brute_force_with_two_samples(sigmas):
    gaussians, batch = random_gaussians(40, SMALL), torch.arange(40) % 2
    out = splat_gaussians(*gaussians, batch, SMALL, 2, support_sigmas=sigmas)
    log_free, occupied, features, contribution = brute_force(*gaussians, batch, SMALL, 2, sigmas=sigmas)
    assert torch.equal(out.support, (log_free.flatten() != 0).nonzero().squeeze(1))
    torch.testing.assert_close(out.log_free, log_free.flatten()[out.support])
    assert torch.equal(out.occupied.linear(), occupied.flatten().nonzero().squeeze(1))
    torch.testing.assert_close(out.features, features.flatten(0, 1)[out.occupied.linear()])
    best = torch.where(occupied[batch], contribution, -1.0).max(1)
    assert torch.equal(out.peak_cell >= 0, best.values > 0)
    assert torch.equal(out.peak_cell, torch.where(best.values > 0, best.indices + batch * 48, -1))
    torch.testing.assert_close(out.peak_contribution, best.values.clamp(min=0), rtol=0, atol=1e-4)  # uncapped


def test_gradcheck():
    means, scales, directions, logits, features = random_gaussians(6, SMALL, seed=3, channels=2)
    batch = torch.tensor([0, 1, 0, 1, 0, 1])
    inputs = [x.requires_grad_() for x in (means, scales, directions, logits, features)]

    def run(*values):
        out = splat_gaussians(*values, batch, SMALL, 2)
        assert len(out.support) > 20 and len(out.occupied) > 5
        return out.log_free, out.features

    assert torch.autograd.gradcheck(run, inputs)


def test_samples_alone_give_the_same_as_together():
    gaussians, batch = random_gaussians(30, SMALL), torch.arange(30) % 3
    together = splat_gaussians(*gaussians, batch, SMALL, 3)
    for sample in range(3):
        mine = batch == sample
        alone = splat_gaussians(*(x[mine] for x in gaussians), batch[mine] * 0, SMALL, 1)
        rows = together.occupied.indices()[:, 0] == sample
        assert torch.equal(together.features[rows], alone.features)
        assert torch.equal(together.occupied.indices()[rows, 1:], alone.occupied.indices()[:, 1:])


def test_order_of_the_gaussians_does_not_matter():
    gaussians, batch = random_gaussians(40, SMALL), torch.arange(40) % 2
    shuffle = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    first = splat_gaussians(*gaussians, batch, SMALL, 2)
    second = splat_gaussians(*(x[shuffle] for x in gaussians), batch[shuffle], SMALL, 2)
    assert torch.equal(first.support, second.support)
    torch.testing.assert_close(first.log_free, second.log_free)
    torch.testing.assert_close(first.features, second.features)
    assert torch.equal(first.peak_cell[shuffle], second.peak_cell)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_full_opacity_on_a_cell_centre_stays_finite(dtype):
    centre = SMALL.centre_of(torch.tensor([[2, 3]]), dtype)
    inputs = [
        centre,
        torch.full((1, 2), 0.5, dtype=dtype),
        torch.tensor([[1.0, 0.0]], dtype=dtype),
        torch.tensor([40.0], dtype=dtype),
        torch.ones(1, 2, dtype=dtype),
    ]
    inputs = [x.requires_grad_() for x in inputs]
    out = splat_gaussians(*inputs, torch.zeros(1, dtype=torch.int64), SMALL, 1)
    peak = (out.support == out.peak_cell[0]).nonzero().item()
    assert out.support[peak] == 2 * 8 + 3
    assert out.log_free[peak].item() == pytest.approx(math.log(1e-4), rel=1e-3)
    assert out.occupancy[peak].item() == pytest.approx(1 - 1e-4, abs=1e-7)
    (out.log_free.sum() + log1mexp(-out.log_free).sum() + out.features.sum()).backward()
    assert all(x.grad.isfinite().all() for x in inputs)


def test_the_cap_stops_the_gradient_where_it_binds_alone():
    centre, ones = SMALL.centre_of(torch.tensor([[2, 3]]), torch.float64), torch.ones(1, 2, dtype=torch.float64)
    grads = []
    for logit in (15.0, 5.0):
        logits = torch.tensor([logit], dtype=torch.float64, requires_grad=True)
        out = splat_gaussians(
            centre, ones * 0.2, ones * torch.tensor([1, 0]), logits, ones, torch.zeros(1, dtype=torch.int64), SMALL, 1
        )
        grads.append(torch.autograd.grad(out.log_free[out.occupied_rows[0]], logits)[0].item())
    assert grads[0] == 0 and grads[1] < 0


def test_no_gaussians():
    empty = [torch.zeros(0, *size, requires_grad=True) for size in ((2,), (2,), (2,), (), (4,))]
    out = splat_gaussians(*empty, torch.zeros(0, dtype=torch.int64), SMALL, 2)
    assert len(out.support) == len(out.log_free) == len(out.occupied) == len(out.peak_cell) == 0
    assert out.features.shape == (0, 4) and out.occupied.shape == (2, 6, 8) and out.num_cut == 0
    (out.log_free.sum() + out.features.sum()).backward()
    assert all(x.grad is not None for x in empty)


def test_gaussians_outside_or_not_finite_light_nothing():
    means = torch.tensor([[100.0, 0.0], [0.0, -50.0], [math.nan, 0.0], [0.0, math.inf]])
    out = splat_gaussians(
        means,
        torch.ones(4, 2),
        torch.tensor([[1.0, 0.0]]).repeat(4, 1),
        torch.ones(4),
        torch.ones(4, 2),
        torch.zeros(4, dtype=torch.int64),
        SMALL,
        1,
    )
    assert len(out.support) == 0 and (out.peak_cell == -1).all()


def test_smallest_scale_always_reaches_a_cell():
    """0.2 m is the lower bound of the scales because of this."""
    torch.manual_seed(0)
    means = (torch.rand(500, 2) - 0.5) * torch.tensor([6.0, 4.4]) + torch.tensor([0.4, -0.2])
    batch = torch.arange(500)
    gaussians = (means, torch.full((500, 2), 0.2), directions_of(torch.rand(500) * 7), torch.ones(500))
    out = splat_gaussians(*gaussians, torch.ones(500, 1), batch, SMALL, 500)
    assert len(torch.unique(out.support // 48)) == 500


def test_guard_keeps_the_most_occupied_cells_of_each_sample():
    gaussians, batch = random_gaussians(40, SMALL), torch.arange(40) % 2
    full = splat_gaussians(*gaussians, batch, SMALL, 2)
    cut = splat_gaussians(*gaussians, batch, SMALL, 2, max_cells=7)
    assert cut.occupied.indices()[:, 0].bincount(minlength=cut.occupied.shape[0]).tolist() == [7, 7]
    assert cut.num_cut == len(full.occupied) - 14
    assert torch.equal(cut.log_free, full.log_free)
    for sample in range(2):
        mine = full.support[full.occupied_rows] // 48 == sample
        best = full.occupancy[full.occupied_rows][mine].topk(7).values.sort().values
        kept = cut.support[cut.occupied_rows] // 48 == sample
        torch.testing.assert_close(cut.occupancy[cut.occupied_rows][kept].sort().values, best)
    rows = full.occupied.rows_of(cut.occupied.indices())
    torch.testing.assert_close(cut.features, full.features[rows])


def test_geometry_stays_float32_under_autocast():
    means, scales, directions, logits, features = random_gaussians(20, SMALL, dtype=torch.float32)
    batch = torch.zeros(20, dtype=torch.int64)
    plain = splat_gaussians(means, scales, directions, logits, features, batch, SMALL, 1)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = splat_gaussians(means, scales, directions, logits, features, batch, SMALL, 1)
    assert out.log_free.dtype == out.features.dtype == torch.float32
    assert torch.equal(out.log_free, plain.log_free) and torch.equal(out.features, plain.features)


def test_no_row_per_pair_is_kept_for_backward():
    channels = 64
    inputs = [x.float().requires_grad_() for x in random_gaussians(40, SMALL, channels=channels)]
    largest = []

    def note(x):
        largest.append(x.numel())
        return x

    with torch.autograd.graph.saved_tensors_hooks(note, lambda x: x):
        out = splat_gaussians(*inputs, torch.zeros(40, dtype=torch.int64), SMALL, 1)
    assert len(out.support) == 48  # many pairs per cell
    assert max(largest) <= 40 * channels


def test_wrong_shapes_are_named():
    means, scales, directions, logits, features = random_gaussians(4, SMALL)
    batch = torch.zeros(4, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"directions: expected \[4, 2\], got \[4\]"):
        splat_gaussians(means, scales, logits, logits, features, batch, SMALL, 1)
    with pytest.raises(ValueError, match="batch"):
        splat_gaussians(means, scales, directions, logits, features, batch[:3], SMALL, 1)


def test_log1mexp_against_float64():
    u = torch.logspace(-6, 1.9, 200)
    exact = torch.log1p(-torch.exp(-u.double()))
    exact = torch.where(u < 1e-2, torch.log(-torch.expm1(-u.double())), exact)
    torch.testing.assert_close(log1mexp(u).double(), exact, rtol=1e-5, atol=0)


def test_real_gaussians_light_up_the_real_predictions():
    if not DEMO.exists():
        pytest.skip(f"{DEMO} is absent: the authors' demo frame is not part of the repository")
    frame = json.loads(DEMO.read_text())["frame"]
    gaussians = {key: torch.tensor(value) for key, value in frame["gaussians"].items() if key != "sources"}
    num = len(gaussians["means"])
    out = splat_gaussians(
        gaussians["means"],
        gaussians["scales"],
        gaussians["rotations"],
        torch.logit(gaussians["opacities"].clamp(max=1 - 1e-6)),
        torch.ones(num, 1),
        torch.zeros(num, dtype=torch.int64),
        GRID,
        1,
    )
    assert num == 450 and (out.peak_cell >= 0).all()
    centres = torch.tensor([box[:2] for box in frame["pred_boxes"]])
    assert len(centres) == 29
    lit = out.occupied.indices()[:, 1:]
    distance = (GRID.cell_of(centres)[:, None] - lit).abs().amax(2).amin(1)
    assert (distance <= 2).sum() >= 27
