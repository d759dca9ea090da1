"""Turns, interquartile ranges and memory of what is measured."""

from pathlib import Path

import pytest
import torch

from src.benchmark.timing import added_mib, interleaved, median_iqr, milliseconds, timed_parts
from src.ops.scratch import scratch

CPU = torch.device("cpu")


class Ticking:
    """A clock that candidates push on, and the order in which they do."""

    def __init__(self):
        self.seconds, self.order = 0.0, []

    def now(self):
        return self.seconds

    def candidate(self, name, seconds):
        def run():
            self.order.append(name)
            self.seconds += seconds

        return run


def test_median_and_interquartile_range():
    assert median_iqr([5.0]) == (5.0, 0.0)
    assert median_iqr([1.0, 9.0, 2.0]) == (2.0, 8.0)  # the whole range of so few
    assert median_iqr([1.0, 2.0, 3.0, 4.0, 100.0]) == (3.0, 52.0 - 1.5)
    assert milliseconds([1.0, 9.0, 2.0], "step ") == {"step ms": 2000.0, "step ± ms": 8000.0}


def test_candidates_take_turns_and_warm_up():
    clock = Ticking()
    seconds = interleaved({"a": clock.candidate("a", 1.0), "b": clock.candidate("b", 2.0)}, clock.now, 2)
    order = clock.order
    assert order == ["a", "b"] * 3 and seconds == {"a": [1.0, 1.0], "b": [2.0, 2.0]}


def test_what_is_slow_has_fewer_rounds():
    clock, each = Ticking(), {"quick": 0.1, "slow": 2.0, "slower": 10.0, "endless": 50.0}
    made = {name: clock.candidate(name, seconds) for name, seconds in each.items()}
    seconds = interleaved(made, clock.now, rounds=6, budget_s=5.0)
    calls = {name: clock.order.count(name) for name in each}
    assert calls == {"quick": 7, "slow": 3, "slower": 2, "endless": 1}  # the first call of each shows how slow it is
    assert [len(values) for values in seconds.values()] == [6, 2, 1, 1]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux reports the peak of a process")
def test_added_memory_is_that_of_the_call():
    held = torch.ones(8 * 2**20)  # 32 MiB that were there before

    def call():
        first = torch.ones(16 * 2**20)  # 64 MiB, given back
        del first
        return torch.ones(4 * 2**20).sum() + held.sum()

    added = added_mib(call, CPU)
    if added is None:
        pytest.skip("the system does not let a process begin its peak anew")
    assert 60 < added < 96
    assert added_mib(lambda: None, CPU) < 8  # the peak of the call before is forgotten


@pytest.mark.slow
def test_memory_that_is_used_again_counts_for_every_call():
    def call():
        return scratch("of a test", 32 * 2**20, 1, torch.uint8, CPU).fill_(1)[0, 0]

    call()
    added = [added_mib(call, CPU) for _ in range(2)]
    if None in added:
        pytest.skip("the system does not let a process begin its peak anew")
    assert 30 < min(added) and max(added) < 60


def test_timed_parts_add_up_calls_and_leave_the_model_as_it_was():
    model = torch.nn.Module()
    model.first, model.second = torch.nn.Linear(2, 2), None
    before = dict(vars(model.first))
    parts = {"both": ("first.forward", "first.extra_repr"), "absent": ("second.forward", "third.forward")}
    ticks = iter(range(100))
    with pytest.raises(ZeroDivisionError), timed_parts(model, parts, lambda: next(ticks)) as seconds:
        model.first(torch.zeros(1, 2))
        model.first.extra_repr()
        1 / 0  # noqa: B018
    assert seconds == {"both": 2} and vars(model.first) == before
