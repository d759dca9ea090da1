"""What measurements wait for, kept short: the collector's pass over all modules, the second of watching the machine."""

import gc

import pytest

from src.benchmark import machine


@pytest.fixture(autouse=True)
def quick_looks(monkeypatch):
    """The collector sees only what the test makes, and the machine is watched for a moment."""
    monkeypatch.setattr(machine, "BUSY_WINDOW_S", 0.02)
    gc.freeze()
    yield
    gc.unfreeze()
