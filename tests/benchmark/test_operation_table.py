"""Where time goes: shares add up, and arithmetic is counted as the shapes say."""

import pytest
import torch

from src.benchmark.operation_table import NUM_ROWS, operation_table


def test_shares_calls_and_arithmetic():
    a, b = torch.rand(256, 512), torch.rand(512, 384)
    rows = operation_table(lambda: [a @ b for _ in range(3)] + [a.exp()], torch.device("cpu"))
    by_name = {row["operation"]: row for row in rows}
    assert sum(row["% of time"] for row in rows) == pytest.approx(100)
    assert by_name["mm"]["calls"] == 3 and by_name["exp"]["calls"] == 1
    flops = by_name["mm"]["GFLOP/s"] * by_name["mm"]["ms"] * 1e6
    assert flops == pytest.approx(3 * 2 * 256 * 512 * 384)
    assert "GFLOP/s" not in by_name["exp"]


def test_longest_first_and_the_rest_in_one_row():
    x = torch.rand(400, 400)
    names = "exp log sin cos tan sqrt abs neg round floor ceil sigmoid tanh erf relu square atan asin".split()
    rows = operation_table(lambda: [getattr(x, name)() for name in names], torch.device("cpu"))
    times = [row["ms"] for row in rows[:-1]]
    assert len(rows) == NUM_ROWS + 1 and times == sorted(times, reverse=True)
    assert rows[-1]["operation"].endswith(" others") and rows[-1]["calls"] >= len(names) - NUM_ROWS


def test_the_call_before_is_not_counted():
    calls = []

    def function():
        calls.append(1)
        return torch.ones(3).exp()

    rows = operation_table(function, torch.device("cpu"))
    assert len(calls) == 2 and {row["operation"]: row["calls"] for row in rows}["exp"] == 1
