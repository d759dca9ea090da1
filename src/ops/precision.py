"""In which types a model computes: the values of the key `precision`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

import torch

from src.ops.products import bfloat16_products


class Precision(StrEnum):
    """Precisions as the command line writes them; the first two are Lightning's names."""

    FULL = "32-true"
    MIXED = "bf16-mixed"  # autocast
    PRODUCTS = "bf16-products"  # float32, but for large products on CPUs that multiply bfloat16, see `product_type`


@contextmanager
def computing(precision: str, device: torch.device) -> Iterator[None]:
    """Within the context forward passes compute in a precision. Gradients follow, autocast or not."""
    mixed, products = precision == Precision.MIXED, precision == Precision.PRODUCTS
    with torch.autocast(device.type, torch.bfloat16, enabled=mixed), bfloat16_products(products):
        yield
