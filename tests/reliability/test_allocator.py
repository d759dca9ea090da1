import subprocess
import sys
from pathlib import Path

import pytest

from src.errors import ConfigError
from src.reliability.allocator import tune_cpu_allocator


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the switch belongs to glibc")
def test_switch_can_be_set_twice():
    assert tune_cpu_allocator() == tune_cpu_allocator()


GIVEN = Path("/sys/kernel/mm/transparent_hugepage/enabled")
LOOK = """
import torch
from src.reliability.allocator import tune_cpu_allocator
def pages():
    words = [line.split() for line in open("/proc/self/smaps_rollup")]
    return {word[0]: int(word[1]) for word in words if word[0] in ("Rss:", "AnonHugePages:")}
before = pages()
assert tune_cpu_allocator()
reserved = pages()
kept = torch.ones(16 << 20)
after = pages()
print(reserved["Rss:"] - before["Rss:"], after["Rss:"] - reserved["Rss:"], after["AnonHugePages:"])
"""


@pytest.mark.skipif(not GIVEN.exists() or "[never]" in GIVEN.read_text(), reason="no huge pages here")
def test_large_tensors_lie_in_huge_pages_and_what_is_reserved_takes_no_memory():
    """64 MiB in a fresh process."""
    found = subprocess.run([sys.executable, "-c", LOOK], capture_output=True, text=True, check=True)
    reserved_kib, taken_kib, huge_kib = map(int, found.stdout.split())
    assert reserved_kib < 4096 and 60000 < taken_kib < 80000 and huge_kib > 60000


def test_other_platforms_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert tune_cpu_allocator() is False


def test_the_variable_leaves_it_alone_or_is_refused(monkeypatch):
    monkeypatch.setenv("HORIZON3D_ALLOCATOR", "default")
    assert tune_cpu_allocator() is False
    monkeypatch.setenv("HORIZON3D_ALLOCATOR", "jemalloc")
    with pytest.raises(ConfigError, match="HORIZON3D_ALLOCATOR=jemalloc: must be tuned or default"):
        tune_cpu_allocator()
