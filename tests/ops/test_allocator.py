import sys

import pytest

from src.ops import tune_cpu_allocator


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the switch belongs to glibc")
def test_switch_can_be_set_twice():
    assert tune_cpu_allocator() == tune_cpu_allocator()


def test_other_platforms_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert tune_cpu_allocator() is False
