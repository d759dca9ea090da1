from functools import partial

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.splat import splat_gaussians

GRID = BEVGrid(cells=(9, 11), cell_m=0.8, centre_m=(0.4, -0.2), z_range_m=(-3.0, 5.0))
splat = partial(splat_gaussians, threshold=0.1, max_cells=32768, support_sigmas=3.0)
NAMES = ("means", "scales", "directions", "opacity_logits", "features")


def random_gaussians(num, device, seed=0, channels=3):
    generator = torch.Generator().manual_seed(seed)

    def uniform(*size):
        return torch.rand(*size, generator=generator)

    half = torch.tensor(GRID.half_extent_m)
    means = (uniform(num, 2) * 2.4 - 1.2) * half + torch.tensor(GRID.centre_m)  # some outside
    yaw = uniform(num) * 7
    directions = torch.stack([yaw.cos(), yaw.sin()], 1)
    gaussians = (means, 0.2 + 1.2 * uniform(num, 2), directions, 6 * uniform(num) - 3, uniform(num, channels) - 0.5)
    return [x.to(device) for x in gaussians]


def run(gaussians, batch, batch_size, dtype, **choices):
    """The splat in the given type, and the gradients of a loss that reaches both its outputs."""
    inputs = [x.to(dtype).requires_grad_() for x in gaussians]
    out = splat(*inputs, batch, GRID, batch_size, **choices)
    generator = torch.Generator().manual_seed(5)
    loss = 0
    for value in (out.log_free, out.features):
        assert value.dtype == dtype
        loss = loss + (value * torch.randn(value.shape, generator=generator).to(value)).sum()
    return out, torch.autograd.grad(loss, inputs)


def compare(gaussians, batch, batch_size, **choices):
    """Float32 against float64: the same sets, values within 2e-5, gradients within 1e-4 of the largest."""
    found, grads = run(gaussians, batch, batch_size, torch.float32, **choices)
    expected, expected_grads = run(gaussians, batch, batch_size, torch.float64, **choices)
    for name in ("support", "occupied_rows", "peak_cell", "num_cut"):
        value, wanted = getattr(found, name), getattr(expected, name)
        assert torch.equal(value, wanted) if isinstance(value, torch.Tensor) else value == wanted, name
    assert torch.equal(found.occupied.keys, expected.occupied.keys)
    torch.testing.assert_close(found.log_free.double(), expected.log_free, rtol=2e-5, atol=1e-7)
    torch.testing.assert_close(found.peak_contribution.double(), expected.peak_contribution, rtol=2e-5, atol=1e-7)
    torch.testing.assert_close(found.features.double(), expected.features, rtol=0, atol=2e-5)
    for name, grad, wanted in zip(NAMES, grads, expected_grads, strict=True):
        assert grad.shape == wanted.shape
        largest = wanted.abs().max().item() if wanted.numel() else 0.0
        torch.testing.assert_close(grad.double(), wanted, rtol=0, atol=1e-4 * largest, msg=name)
    return found


@pytest.mark.parametrize("sigmas", [1.5, 3.0])
def test_values_and_gradients_of_two_samples(device, sigmas):
    batch = torch.arange(24, device=device) % 2
    out = compare(random_gaussians(24, device), batch, 2, support_sigmas=sigmas)
    assert 20 < len(out.occupied) < len(out.support) and not (out.peak_cell >= 0).all()


@pytest.mark.parametrize("channels", [1, 20, 130])
def test_any_number_of_channels(device, channels):
    compare(random_gaussians(12, device, 1, channels), torch.zeros(12, dtype=torch.int64, device=device), 1)


def test_a_gaussian_over_more_cells_than_a_program_takes_at_once(device):
    gaussians = random_gaussians(3, device, seed=2)
    gaussians[0][:] = torch.tensor([0.4, -0.2])
    gaussians[1][:] = 3.0
    out = compare(gaussians, torch.tensor([0, 1, 1], device=device), 2)
    assert len(out.support) == 2 * 99


def test_faint_and_opaque_contributions(device):
    """log(1 - a) keeps its digits from a = 1e-9 to where the cap binds; each Gaussian has its own sample."""
    num = 16
    logits = torch.linspace(-20, 20, num)
    gaussians = [
        GRID.centre_of(torch.tensor([[4, 5]])).repeat(num, 1) + 0.001,
        torch.full((num, 2), 0.3),
        torch.tensor([[1.0, 0.0]]).repeat(num, 1),
        logits,
        torch.ones(num, 2),
    ]
    batch = torch.arange(num, device=device)
    out = compare([x.to(device) for x in gaussians], batch, num, threshold=1e-12)
    assert (out.peak_cell >= 0).all() and out.log_free.min() < -9 and out.log_free.max() > -1e-8


def test_the_guard_cuts_the_same_cells(device):
    batch = torch.arange(40, device=device) % 2
    out = compare(random_gaussians(40, device), batch, 2, max_cells=7)
    assert out.num_cut > 0 and out.occupied.indices()[:, 0].bincount(minlength=out.occupied.shape[0]).tolist() == [7, 7]


def test_equal_distances_go_to_the_first_cell(device):
    """A mean on the corner of four cells is equally near to all of them."""
    grid = BEVGrid(cells=(6, 8), cell_m=0.5, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    ones = torch.ones(1, 2, device=device)
    gaussian = (ones * 0.5, ones, ones * torch.tensor([1, 0], device=device), ones[:, 0], ones)
    out = splat(*gaussian, torch.zeros(1, dtype=torch.int64, device=device), grid, 1)
    assert out.peak_cell.tolist() == [3 * 8 + 4]


def test_no_cell_is_occupied(device):
    gaussians = random_gaussians(5, device)
    gaussians[3] -= 12
    out = compare(gaussians, torch.zeros(5, dtype=torch.int64, device=device), 1)
    assert len(out.support) > 0 and len(out.occupied) == 0 and not (out.peak_cell >= 0).any()


@pytest.mark.parametrize("num", [0, 2])
def test_nothing_reaches_the_grid(device, num):
    gaussians = random_gaussians(num, device, channels=4)
    gaussians[0] += 1000
    out = compare(gaussians, torch.zeros(num, dtype=torch.int64, device=device), 1)
    assert len(out.support) == 0 and out.features.shape == (0, 4)


def test_one_output_alone_gives_its_gradient(device):
    batch = torch.zeros(10, dtype=torch.int64, device=device)
    for name in ("log_free", "features"):
        grads = []
        for dtype in (torch.float32, torch.float64):
            inputs = [x.to(dtype).requires_grad_() for x in random_gaussians(10, device, seed=3)]
            value = getattr(splat(*inputs, batch, GRID, 1), name)
            grads.append(torch.autograd.grad(value.sum(), inputs, allow_unused=True))
        for grad, expected in zip(*grads, strict=True):
            expected = torch.zeros_like(grad, dtype=torch.float64) if expected is None else expected
            scale = expected.abs().max().item()
            torch.testing.assert_close(grad.double(), expected, rtol=0, atol=1e-4 * scale)
