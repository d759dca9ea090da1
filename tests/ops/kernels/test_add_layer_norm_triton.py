import pytest
import torch

from src.ops.add_layer_norm import (
    add_layer_norm,
    add_layer_norm_reference,
    relu_norm_columns,
    relu_norm_columns_reference,
)


@pytest.mark.parametrize(("shape", "relu"), [((2, 0, 24), False), ((2, 45, 24), True), ((19, 32), False)])
@pytest.mark.parametrize("asked", [(), ("added",), ("then",), ("added", "then", "aged")])
def test_sums(device, shape, relu, asked):
    draw = torch.Generator().manual_seed(sum(shape))
    x, added, then, embedded = (3 * torch.randn(shape, generator=draw) for _ in range(4))
    affine = tuple(torch.randn(shape[-1], generator=draw) for _ in range(2))
    ages = torch.randint(0, 3, shape[:-1], generator=draw) / 2
    given = {"added": added, "then": then, "aged": (embedded, ages)}
    given = {name: given[name] for name in asked}
    wanted = add_layer_norm_reference(x, affine, 1e-5, relu=relu, **given)
    moved = {
        name: tuple(y.to(device) for y in value) if name == "aged" else value.to(device)
        for name, value in given.items()
    }
    with torch.no_grad():
        found = add_layer_norm(x.to(device), tuple(y.to(device) for y in affine), 1e-5, relu=relu, **moved)
    assert (found[1] is None) == ("then" not in asked)
    for value, expected in zip(found, wanted, strict=True):
        if expected is not None:
            torch.testing.assert_close(value.cpu(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rows", [0, 21])
def test_columns(device, rows):
    hidden = torch.randn(5, rows, 24, generator=torch.Generator().manual_seed(0)) + 0.5
    wanted = relu_norm_columns_reference(hidden.clone(), 1e-5)
    torch.testing.assert_close(relu_norm_columns(hidden.to(device), 1e-5).cpu(), wanted, rtol=1e-4, atol=1e-5)
