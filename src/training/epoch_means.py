"""Means over an epoch of loss terms and diagnostics, on all ranks and across a resume."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric

from src.reliability.processes import gather_by_rank


class EpochMeans(nn.Module):
    """Weighted means by name. A name may be missing on a rank that never saw its objects."""

    def __init__(self) -> None:
        super().__init__()
        self.metrics = nn.ModuleDict()

    def update(self, name: str, value: Tensor | float, weight: int) -> None:
        """Take a value into the mean of its name."""
        self._metric(name, value.device if isinstance(value, Tensor) else None).update(value, weight)

    def compute(self, device: torch.device) -> dict[str, Tensor]:
        """Means over all ranks by name, on the rank's device, after which they begin anew. All ranks must call it."""
        values = {}
        for name in sorted(set().union(*gather_by_rank(list(self.metrics)))):  # each compute is a meeting of all ranks
            metric = self._metric(name, device)
            values[name] = metric.compute()
            metric.reset()
        return values

    def state(self) -> dict[str, list[float]]:
        """Sum and weight of each mean of this rank, as plain values."""
        sums = {name: [float(metric.mean_value), float(metric.weight)] for name, metric in self.metrics.items()}
        return {name: values for name, values in sums.items() if values[1] > 0}

    def restore(self, state: dict[str, list[float]]) -> None:
        """Resume from what `state` gave."""
        for name, (total, weight) in state.items():
            metric = self._metric(name)
            metric.update(0.0, 0.0)  # so that it knows it has values
            metric.mean_value.fill_(total)
            metric.weight.fill_(weight)

    def adopt(self, states: Iterable[dict[str, list[float]]]) -> None:
        """Resume on one rank from the states of several: the means stay right in total."""
        totals: dict[str, list[float]] = {}
        for state in states:
            for name, values in state.items():
                totals[name] = [a + b for a, b in zip(totals.get(name, [0.0, 0.0]), values, strict=True)]
        self.restore(totals)

    def _metric(self, name: str, device: Any = None) -> MeanMetric:
        key = name.replace(".", "_")  # as a module's name must be
        if key not in self.metrics:
            self.metrics[key] = MeanMetric() if device is None else MeanMetric().to(device)
        return self.metrics[key]
