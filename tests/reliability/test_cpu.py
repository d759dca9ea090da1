import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from src.errors import ConfigError
from src.reliability import cpu
from src.reliability.cpu import tune_allocator


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the switch belongs to glibc")
def test_switch_can_be_set_twice():
    assert tune_allocator() == tune_allocator()


GIVEN = Path("/sys/kernel/mm/transparent_hugepage/enabled")
LOOK = """
import torch
from src.reliability.cpu import tune_allocator
def resident_kib():
    return next(int(line.split()[1]) for line in open("/proc/self/smaps_rollup") if line.startswith("Rss:"))
before = resident_kib()
assert tune_allocator()
reserved = resident_kib()
kept = torch.ones(16 << 20)
after = resident_kib()
middle = kept.data_ptr() + kept.nbytes // 2
for line in open("/proc/self/smaps"):
    ends = line.split()[0].split("-")
    if len(ends) == 2:
        inside = int(ends[0], 16) <= middle < int(ends[1], 16)
    elif inside and line.startswith("VmFlags:"):
        flags = line.split()
print(reserved - before, after - reserved, "hg" in flags)
"""


@pytest.mark.skipif(not GIVEN.exists() or "[never]" in GIVEN.read_text(), reason="no huge pages here")
def test_large_tensors_lie_where_huge_pages_are_asked_for_and_what_is_reserved_takes_no_memory():
    """64 MiB in a fresh process. How many huge pages Linux then gives depends on how broken up free memory is."""
    found = subprocess.run([sys.executable, "-c", LOOK], capture_output=True, text=True, check=True)
    reserved_kib, taken_kib, asked = found.stdout.split()
    assert int(reserved_kib) < 4096 and 60000 < int(taken_kib) < 80000 and asked == "True"


def test_other_platforms_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert tune_allocator() is False


def test_the_variable_leaves_it_alone_or_is_refused(monkeypatch):
    monkeypatch.setenv("HORIZON3D_ALLOCATOR", "default")
    assert tune_allocator() is False
    monkeypatch.setenv("HORIZON3D_ALLOCATOR", "jemalloc")
    with pytest.raises(ConfigError, match="HORIZON3D_ALLOCATOR=jemalloc: must be tuned or default"):
        tune_allocator()


DENORMAL = """
import torch
from src.reliability.cpu import tune_cpu
tune_cpu()
torch.set_num_threads(2)
weight = torch.full((1 << 20,), 1e-20, requires_grad=True)
(weight * 1e-20).sum().backward(torch.tensor(1e-20))
print(int((weight.detach() * 1e-20).count_nonzero()), int(weight.grad.count_nonzero()))
"""


def test_denormal_numbers_are_zero_in_every_thread_forwards_and_backwards():
    """In a fresh process: 1e-40 is no longer a number."""
    found = subprocess.run([sys.executable, "-c", DENORMAL], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["0", "0"]


@pytest.mark.parametrize(("platform", "unit"), [("linux", 1024), ("darwin", 1)])
def test_peak_memory_is_in_bytes_on_every_system(monkeypatch, platform, unit):
    monkeypatch.setattr(cpu.sys, "platform", platform)
    monkeypatch.setattr(cpu.resource, "getrusage", lambda who: SimpleNamespace(ru_maxrss=7 * (who + 1)))
    assert cpu.peak_resident_bytes(0) == 7 * unit and cpu.peak_resident_bytes(1) == 14 * unit
