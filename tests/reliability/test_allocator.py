import sys

import pytest

from src.errors import ConfigError
from src.reliability.allocator import tune_cpu_allocator


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the switch belongs to glibc")
def test_switch_can_be_set_twice():
    assert tune_cpu_allocator() == tune_cpu_allocator()


def test_other_platforms_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert tune_cpu_allocator() is False


def test_the_variable_leaves_it_alone_or_is_refused(monkeypatch):
    monkeypatch.setenv("HORIZON3D_ALLOCATOR", "default")
    assert tune_cpu_allocator() is False
    monkeypatch.setenv("HORIZON3D_ALLOCATOR", "jemalloc")
    with pytest.raises(ConfigError, match="HORIZON3D_ALLOCATOR=jemalloc: must be tuned or default"):
        tune_cpu_allocator()
