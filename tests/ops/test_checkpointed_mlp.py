import pytest
import torch

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
