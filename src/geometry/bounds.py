"""The region of interest of a model of space."""

from __future__ import annotations

Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Lowest and highest x, y and z, m; neither square nor centred on the ego."""
