"""The region of interest of a model of space."""

from __future__ import annotations

import math

Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Lowest and highest x, y and z, m; neither square nor centred on the ego."""


def farthest_m(bounds: Bounds) -> float:
    """Distance of the farthest corner from the ego: 270 m for the region of the paper of LRS4Fusion."""
    return math.hypot(*(max(abs(low), abs(high)) for low, high in bounds))
