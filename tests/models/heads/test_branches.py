"""Branches of the head: layer by layer and as one checkpointed network."""

import copy

import pytest
import torch

from src.models.heads.branches import Branches, checkpointed_branches


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("rows", [0, 1, 2, 700])
def test_checkpointed_branches_agree_with_their_layers(rows, training):
    """Values, gradients and running statistics."""
    torch.manual_seed(0)
    parts = [Branches(8, widths).double().train(training) for widths in ((2,), (3, 1), (2, 1, 3))]
    for part in parts:
        torch.nn.init.uniform_(part.norm.weight, 0.5, 2.0)
        torch.nn.init.uniform_(part.norm.bias, -1.0, 1.0)
    plain, single = copy.deepcopy(parts), copy.deepcopy(parts)
    for part in plain:
        part.checkpointed = False
    forms = {
        "layers": (plain, lambda x: torch.cat([part(x) for part in plain], dim=1)),
        "each": (single, lambda x: torch.cat([part(x) for part in single], dim=1)),
        "all": (parts, lambda x: checkpointed_branches(parts, x)),
    }
    results = {}
    for name, (branches, evaluate) in forms.items():
        x = (torch.randn(rows, 8, generator=torch.Generator().manual_seed(1)).double() + 2.0).requires_grad_()
        out = evaluate(x)
        leaves = [x, *(p for part in branches for p in part.parameters())]
        pull = torch.randn(out.shape, generator=torch.Generator().manual_seed(2)).double()
        grads = torch.autograd.grad((out * pull).sum(), leaves)
        results[name] = (out, *grads, *(b.double() for part in branches for b in part.buffers()))
    torch.testing.assert_close(results["all"], results["layers"])
    torch.testing.assert_close(results["each"], results["layers"])


def test_layers_by_hand():
    """Two branches: a hidden layer each, side by side in one matrix."""
    torch.manual_seed(0)
    branches = Branches(4, (2, 3)).double().eval()
    x = torch.randn(5, 4, dtype=torch.float64)
    norm = branches.norm
    hidden = torch.relu(x @ branches.hidden.weight.t() / (norm.running_var + norm.eps).sqrt())
    first, second = branches.outputs
    expected = torch.cat(
        [hidden[:, :4] @ first.weight.t() + first.bias, hidden[:, 4:] @ second.weight.t() + second.bias], dim=1
    )
    for checkpointed in (False, True):
        branches.checkpointed = checkpointed
        torch.testing.assert_close(branches(x).double(), expected, rtol=1e-6, atol=1e-6)
