"""Shares of the roofline bound: whichever of arithmetic and memory takes longer bounds a part."""

import pytest

from src.benchmark.suite_model import time_columns


@pytest.mark.parametrize(
    ("flops", "compulsory_bytes", "roofline_ms", "bound"),
    [(4e9, 1e9, 40.0, "compute"), (1e9, 3e9, 60.0, "memory"), (0, 1e9, 20.0, "memory")],
)
def test_the_roofline_bound_is_the_longer_of_compute_and_memory(flops, compulsory_bytes, roofline_ms, bound):
    found = {"seconds": [0.1, 0.2, 0.3], "flops": flops, "compulsory_bytes": compulsory_bytes}
    row = time_columns("forward", found, rate=100.0, bandwidth=50.0)  # GFLOP/s, GB/s
    assert row["forward ms"] == pytest.approx(200.0) and row["forward roofline ms"] == pytest.approx(roofline_ms)
    assert row["forward % of roofline"] == pytest.approx(roofline_ms / 2) and row["forward bound by"] == bound
