"""Pages: tables of rows, numbers, and a warning where the machine was busy."""

import json
from pathlib import Path

import pytest

from src.benchmark import machine
from src.benchmark.machine import busy_cores, busy_warning, describe_machine, gemm_rate
from src.benchmark.page import markdown, number, page_of, table, write_page

MACHINE = {"processor": "abacus", "cores": 4, "threads": 2, "gpu": None, "load": 0.4}


def test_page(tmp_path):
    result = {
        "notes": ["First this."], "picture": "p.png", "rows": [{"part": "a", "x": 2.0}, {"part": "b", "ms": 1234.5}],
        "state": {"cells": 12345, "share": 0.12345}, "nothing": None,
    }  # fmt: skip
    page = page_of("model", ["suite=model", "scale=debug"], MACHINE, result)
    write_page(tmp_path, "model_debug", page)
    assert json.loads((tmp_path / "model_debug.json").read_text()) == page
    assert (tmp_path / "model_debug.md").read_text().splitlines() == [
        "# Benchmark: model", "", "`python -m src.benchmark suite=model scale=debug`", "",
        "- processor: abacus", "- cores: 4", "- threads: 2", "- load: 0.4", "", "First this.", "",
        "![model](p.png)", "", "## rows", "", "| part | x | ms |", "|---|---|---|", "| a | 2 |  |", "| b |  | 1,234 |",
        "", "- state: cells 12,345, share 0.123",
    ]  # fmt: skip


def test_numbers():
    assert [number(value) for value in (0.01234, 999.4, 1e6, 7, True, "x")] == [
        "0.0123", "999", "1,000,000", "7", "True", "x"
    ]  # fmt: skip
    assert table([{"a": 1}, {"b": None}]) == "| a | b |\n|---|---|\n| 1 |  |\n|  |  |"


def test_a_busy_machine_is_warned_of():
    assert busy_warning(MACHINE | {"load": 2.0}) is None  # half of it is not
    warning = busy_warning(MACHINE | {"load": 2.1})
    assert "2.1 of 4 cores were at work" in warning
    page = page_of("ops", [], MACHINE | {"load": 2.1}, {})
    assert f"**{warning}**" in markdown(page)


@pytest.mark.slow
def test_the_machine_says_what_it_is():
    described = describe_machine()
    assert described["processor"] and described["cores"] >= 1 and described["load"] >= 0


def test_busy_cores_are_those_at_work_now(monkeypatch):
    """Ticks of user, nice, system, idle, iowait, irq, softirq, steal, guest: 150 of 200 were work, on two cores."""
    lines = iter(["cpu  100 10 20 900 30 1 2 3 50 0\ncpu0 9", "cpu  170 20 50 930 50 11 12 23 90 0\ncpu0 9"])
    monkeypatch.setattr(Path, "read_text", lambda path: next(lines))
    monkeypatch.setattr(machine, "BUSY_WINDOW_S", 0.0)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    assert busy_cores() == pytest.approx(2 * 150 / 200)


def test_work_in_bfloat16_is_held_against_its_own_rate():
    both = {"fp32_gflops": 100.0, "bf16_gflops": 250.0}
    assert gemm_rate(both, "32-true") == 100.0 and gemm_rate(both, "bf16-mixed") == 250.0
    assert gemm_rate({"fp32_gflops": 100.0}, "bf16-mixed") == 100.0  # a processor without it
