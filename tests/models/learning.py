"""One training step of a detector, and what it must do to the parameters of any of them."""

import torch


def train_step(model, batch):
    output = model(batch)[0]
    terms = model.loss(output, batch).terms
    model.zero_grad()
    terms["total"].backward()
    return output, terms


def gradients_are_finite(model):
    """Every parameter has a gradient, zero where its part had nothing to do: DDP waits for each of them."""
    return all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def parameters_that_stay(model, batch, lr):
    """Names of those without a gradient in both of two steps, but for branches' biases.

    An L1 term pulls a bias by +-1 per object, which an even number of objects can cancel exactly.
    """
    optimizer = torch.optim.SGD(model.parameters(), lr=lr)
    moved = set()
    for _ in range(2):
        train_step(model, batch)
        moved |= {name for name, p in model.named_parameters() if p.grad is not None and p.grad.any()}
        optimizer.step()
    still = {name for name, _ in model.named_parameters()} - moved
    return [name for name in sorted(still) if not (name.startswith("head.regressions") and name.endswith("bias"))]
