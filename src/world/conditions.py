"""Weather and light of a scene: what the scene tags say and what the cameras see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

SAME_TAGS = ("structure.regular", "construction.roadworks")
"""Tags that every scene of this world has."""


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Tags of one scene with the light and air that belong to them."""

    weather: str
    daytime: str
    lighting: str
    season: str
    area: str
    ambient: float  # share of light that reaches shaded faces
    sun: float  # extra light on faces turned to the sun
    sun_azimuth_rad: float  # in local coordinates
    sky_low: list[float]  # RGB of 0..255, at the horizon
    sky_high: list[float]
    sight_m: float  # distance at which haze takes 63 % of the contrast
    noise: float  # grey levels, standard deviation
    precipitation_mm: float
    temperature_k: float
    wind_mps: float
    wind_rad: float

    @property
    def rain(self) -> bool:
        """Whether drops are in the air."""
        return self.weather == "weather.rain"

    @property
    def night(self) -> bool:
        """Whether headlights are on."""
        return self.daytime == "daytime.night"

    @property
    def tags(self) -> str:
        """The seven scene tags."""
        return ";".join((self.weather, self.area, self.daytime, self.season, self.lighting, *SAME_TAGS))


_LIGHT = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))

ORDER = ("day", "rain", "night", "overcast", "dusk", "day", "fog", "glare")
"""Scene number within a split -> light, so that even four scenes differ."""


def draw_conditions(rng: np.random.Generator, number: int) -> Conditions:
    """The conditions of the `number`-th scene of a split."""
    name = ORDER[number % len(ORDER)]
    rain = name == "rain"
    return Conditions(
        season=str(rng.choice(["season.summer", "season.autumn", "season.winter"], p=[0.5, 0.35, 0.15])),
        area=str(rng.choice(["area.highway", "area.terminal", "area.rural"], p=[0.7, 0.15, 0.15])),
        sun_azimuth_rad=float(rng.uniform(-np.pi, np.pi)),
        precipitation_mm=round(float(rng.uniform(0.5, 6.0)), 2) if rain else 0.0,
        temperature_k=round(float(rng.uniform(274.0, 301.0)), 2),
        wind_mps=round(float(rng.uniform(0.0, 9.0)), 2),
        wind_rad=round(float(rng.uniform(0.0, 2 * np.pi)), 3),
        **_LIGHT[name],
    )
