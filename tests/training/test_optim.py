import math

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.models.layers.sparse import SubmanifoldConv
from src.training.optim import CyclicSchedule, OptimConfig, cycle_value, parameter_groups


def config(**changes):
    values = dict(
        lr=1e-4, weight_decay=0.01, clip_norm=35.0, peak_lr_ratio=10.0, final_lr_ratio=1e-4, rise_fraction=0.4,
        betas=[0.95, 0.99], cycled_beta1=[0.95, 0.85], ema_decay=None,
    )  # fmt: skip
    return OptimConfig(**(values | changes))


def test_cycle_reaches_the_papers_corners():
    layer = nn.Linear(2, 2)
    optimizer = torch.optim.AdamW(layer.parameters(), lr=1e-4, betas=(0.95, 0.99))
    schedule = CyclicSchedule(optimizer, config(), total_steps=100)
    rates, betas = [], []
    for _ in range(101):
        rates.append(optimizer.param_groups[0]["lr"])
        betas.append(optimizer.param_groups[0]["betas"][0])
        optimizer.step()
        schedule.step()
    assert rates[0] == pytest.approx(1e-4) and rates[40] == pytest.approx(1e-3) and rates[100] == pytest.approx(1e-8)
    assert betas[0] == pytest.approx(0.95) and betas[40] == pytest.approx(0.85) and betas[100] == pytest.approx(0.95)
    assert rates[20] == pytest.approx(0.5 * (1e-4 + 1e-3))  # half-way up a cosine


def test_constant_betas_stay():
    layer = nn.Linear(2, 2)
    optimizer = torch.optim.AdamW(layer.parameters(), lr=1e-4, betas=(0.85, 0.95))
    schedule = CyclicSchedule(optimizer, config(cycled_beta1=None, betas=[0.85, 0.95]), total_steps=10)
    for _ in range(10):
        optimizer.step()
        schedule.step()
        assert optimizer.param_groups[0]["betas"] == (0.85, 0.95)


def test_a_resumed_schedule_continues_where_it_was():
    def make():
        optimizer = torch.optim.AdamW(nn.Linear(2, 2).parameters(), lr=1e-4, betas=(0.95, 0.99))
        return optimizer, CyclicSchedule(optimizer, config(), total_steps=50)

    optimizer, schedule = make()
    for _ in range(7):
        optimizer.step()
        schedule.step()
    other, resumed = make()
    resumed.load_state_dict(schedule.state_dict())
    for pair in ((optimizer, schedule), (other, resumed)):
        pair[0].step()
        pair[1].step()
    assert other.param_groups[0]["lr"] == optimizer.param_groups[0]["lr"]


def test_only_weights_of_layers_decay():
    model = nn.ModuleDict(
        {
            "conv": nn.Conv2d(2, 2, 3),
            "norm": nn.BatchNorm2d(2),
            "sparse": SubmanifoldConv(2, 2, kernel_size=3, ndim=2, bias=True),
            "slots": nn.Embedding(3, 2),
            "along_rays": nn.Conv1d(2, 2, 4),
        }
    )
    groups = parameter_groups(model, config(), backbone=model["conv"], backbone_lr_multiplier=0.1)
    found = {(g["weight_decay"], round(g["lr"], 9)): sum(p.numel() for p in g["params"]) for g in groups}
    conv, sparse, along_rays = 2 * 2 * 9, 2 * 2 * 9, 2 * 2 * 4
    assert found == {(0.01, 1e-5): conv, (0.0, 1e-5): 2, (0.01, 1e-4): sparse + along_rays, (0.0, 1e-4): 4 + 2 + 6 + 2}


def test_end_points_of_the_cycle_without_a_rise():
    assert cycle_value(0, 10, 0.0, 1.0, 10.0, 0.1) == 10.0
    assert math.isclose(cycle_value(10, 10, 0.0, 1.0, 10.0, 0.1), 0.1)


@pytest.mark.parametrize(
    "change", [{"lr": 0.0}, {"clip_norm": -1.0}, {"rise_fraction": 1.5}, {"betas": [0.9]}, {"ema_decay": 1.0}]
)
def test_impossible_settings_are_named(change):
    with pytest.raises(ConfigError, match=f"optim.{next(iter(change))}"):
        config(**change)
