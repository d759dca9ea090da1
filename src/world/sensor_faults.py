"""What is wrong with a scene's sensors: mounts that differ from their calibration, outages, dirt on a lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from src.geometry.transforms import rotation_zyx
from src.structures.taxonomy import CAMERAS, RADARS
from src.world.motion import LEAD_IN_S
from src.world.rig import Mount
from src.world.world_config import WorldConfig

Array = np.ndarray

OUTAGE_S = (0.5, 2.0)
DIRT = np.array([58.0, 48.0, 38.0], dtype=np.float32)


class SensorFaults:
    """Drawn once for a scene; everything follows from `rng`."""

    def __init__(self, config: WorldConfig, rig: dict[str, Mount], rng: np.random.Generator) -> None:
        spread = np.radians(config.mount_error_deg)
        errors = {name: rotation_zyx(*rng.normal(0.0, spread, 3)) for name in (*CAMERAS, *RADARS)}
        self.mounts = {name: replace(rig[name], rotation=rig[name].rotation @ turn) for name, turn in errors.items()}
        """Where cameras and radars really look; the stored calibration is the rig's."""
        self._outages = {name: _draw_outages(config, rng) for name in (*CAMERAS, *RADARS)}
        self.soiled = str(rng.choice(CAMERAS)) if rng.random() < config.soiled_fraction else None
        self.dirt = _draw_dirt(config.image_width_px, config.image_height_px, rng)

    def is_out(self, channel: str, time_s: float) -> bool:
        """Whether a sensor gives nothing at this time."""
        begins, ends = self._outages[channel]
        return bool(((begins <= time_s) & (time_s < ends)).any())

    def soil(self, channel: str, rgb: Array) -> Array:
        """The image [H, W, 3] uint8 through the dirt on its lens."""
        if channel != self.soiled:
            return rgb
        return (rgb + self.dirt[..., None] * (DIRT - rgb)).astype(np.uint8)


def _draw_outages(config: WorldConfig, rng: np.random.Generator) -> tuple[Array, Array]:
    """Begins and ends of one sensor's outages: working and failing stretches that take turns."""
    share, mean = config.outage_fraction, 0.5 * sum(OUTAGE_S)
    begins, ends = [], []
    now, last = -LEAD_IN_S - 10.0 * mean * rng.random(), config.duration_s + LEAD_IN_S
    while share > 0 and now < last:
        begins.append(now + rng.exponential(mean * (1.0 - share) / share))
        ends.append(begins[-1] + rng.uniform(*OUTAGE_S))
        now = ends[-1]
    return np.array(begins), np.array(ends)


def _draw_dirt(width: int, height: int, rng: np.random.Generator) -> Array:
    """Opacity [H, W] of splashes: a few large and soft ones, many small ones."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    clear = np.ones((height, width), dtype=np.float32)
    for share in (*rng.uniform(0.06, 0.14, 5), *rng.uniform(0.01, 0.03, 14)):
        away = ((x - rng.uniform(0, width)) ** 2 + (y - rng.uniform(0, height)) ** 2) / (share * width) ** 2
        clear *= 1.0 - np.float32(rng.uniform(0.6, 0.95)) * np.exp(-(away.astype(np.float32) ** 2))
    return 1.0 - clear
