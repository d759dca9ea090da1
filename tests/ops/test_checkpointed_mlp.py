import pytest
import torch

from src.ops import products
from src.ops.checkpointed_mlp import checkpointed_mlp, projected_statistics


def operands(rows, dtype=torch.float64):
    torch.manual_seed(0)
    sizes = ((rows, 5), (5, 7), (7,), (7, 3), (3,))
    return [torch.randn(*size, dtype=dtype, requires_grad=True) for size in sizes]


@pytest.mark.parametrize("rows", [0, 1, 9])
def test_gradcheck_over_several_spans(rows, monkeypatch):
    monkeypatch.setattr("src.ops.checkpointed_mlp.CPU_ROWS", 4)
    values = operands(rows)
    x, w, b, v, c = values
    torch.testing.assert_close(checkpointed_mlp(*values), (x @ w + b).relu() @ v + c)
    assert torch.autograd.gradcheck(checkpointed_mlp, values)


def test_half_precision_sums_gradients_in_full():
    """1e5 equal rows: sums in bfloat16 would stop growing at 256."""
    x = torch.ones(100_000, 1, dtype=torch.bfloat16, requires_grad=True)
    one = torch.ones(1, 1, dtype=torch.bfloat16)
    w = one.clone().requires_grad_()
    zero = torch.zeros(1, dtype=torch.bfloat16)
    checkpointed_mlp(x, w, zero, one, zero).sum().backward()
    assert w.grad.item() == pytest.approx(100_000, rel=0.01)


def test_autocast_halves_the_hidden_layer_and_not_the_outputs():
    values = x, w, b, v, c = operands(9, torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        out = checkpointed_mlp(*values)
    hidden = torch.addmm(b.bfloat16(), x.bfloat16(), w.bfloat16()).relu()
    torch.testing.assert_close(out, hidden.float() @ v + c)
    assert not torch.equal(out, (x @ w + b).relu() @ v + c)
    out.sum().backward()
    assert all(value.grad.dtype == torch.float32 for value in values)


def test_statistics_of_a_projection_never_made():
    torch.manual_seed(0)
    x, weight = (torch.randn(*size, dtype=torch.float64, requires_grad=True) for size in ((9, 5), (7, 5)))
    projected = x @ weight.t()
    expected = torch.cat([projected.mean(0), projected.var(0, correction=0)])
    found = torch.cat(projected_statistics(x, weight))
    torch.testing.assert_close(found, expected)
    pull = torch.randn(14, dtype=torch.float64)
    torch.testing.assert_close(
        torch.autograd.grad(found, (x, weight), pull), torch.autograd.grad(expected, (x, weight), pull)
    )


def test_products_in_bfloat16_halve_the_hidden_layer_and_not_the_outputs(monkeypatch):
    monkeypatch.setattr(products, "multiplies_bfloat16", lambda: True)
    torch.manual_seed(0)
    sizes = ((1300, 64), (64, 96), (96,), (96, 3), (3,))
    values = x, w, b, v, c = [torch.randn(*size, requires_grad=True) for size in sizes]
    pull = torch.randn(1300, 3)
    exact = torch.autograd.grad(checkpointed_mlp(*values), values, pull)
    with products.bfloat16_products():
        out = checkpointed_mlp(*values)
        near = torch.autograd.grad(out, values, pull)
    hidden = torch.addmm(b.bfloat16(), x.bfloat16(), w.bfloat16()).relu()
    torch.testing.assert_close(out, hidden.float() @ v + c, atol=1e-4, rtol=0)
    for one, other in zip(exact, near, strict=True):
        assert other.dtype == torch.float32 and (one - other).norm() < 0.06 * one.norm()  # the ReLU may open or not
