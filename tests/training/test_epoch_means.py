"""Means of an epoch: weighted, over ranks that need not know the same names."""

import pytest
import torch

from src.training import epoch_means
from src.training.epoch_means import EpochMeans

CPU = torch.device("cpu")


def test_means_are_weighted_and_begin_anew():
    means = EpochMeans()
    means.update("loss/total", torch.tensor(1.0), 3)
    means.update("loss/total", 5.0, 1)
    assert means.compute(CPU) == {"loss/total": pytest.approx(2.0)}


def test_a_name_of_another_rank_alone_is_met_on_this_ranks_device(monkeypatch):
    means = EpochMeans()
    monkeypatch.setattr(epoch_means, "gather_by_rank", lambda names: [names, ["state/seen_elsewhere"]])
    (value,) = means.compute(torch.device("meta")).values()
    assert value.device.type == "meta", "a CPU tensor cannot be gathered among GPUs"


def test_several_ranks_are_taken_over_as_one():
    one, other, resumed = EpochMeans(), EpochMeans(), EpochMeans()
    one.update("a", 1.0, 1)
    other.update("a", 4.0, 2)
    other.update("b", 7.0, 1)
    resumed.adopt([one.state(), other.state()])
    assert resumed.compute(CPU) == {"a": pytest.approx(3.0), "b": pytest.approx(7.0)}
