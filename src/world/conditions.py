"""Weather and light of a scene: what the scene tags say and what the cameras see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Tags of one scene with the light and air that belong to them."""

    name: str
    weather: str
    daytime: str
    lighting: str
    season: str
    area: str
    ambient: float  # share of light that reaches shaded faces
    sun: float  # extra light on faces turned to the sun
    sun_azimuth_rad: float  # in local coordinates
    sky_low: Colour  # 0..255, at the horizon
    sky_high: Colour
    sight_m: float  # distance at which haze takes 63 % of the contrast
    noise: float  # grey levels, standard deviation
    night: bool
    precipitation_mm: float
    temperature_k: float
    wind_mps: float
    wind_rad: float

    @property
    def rain(self) -> bool:
        """Whether drops are in the air."""
        return self.weather == "weather.rain"

    @property
    def tags(self) -> str:
        """The seven scene tags; structure and construction are the same in every scene of this world."""
        groups = (
            self.weather,
            self.area,
            self.daytime,
            self.season,
            self.lighting,
            "structure.regular",
            "construction.roadworks",
        )
        return ";".join(groups)


_LIGHT: dict[str, dict[str, object]] = {
    "day": {
        "weather": "weather.clear",
        "daytime": "daytime.noon",
        "lighting": "lighting.illuminated",
        "ambient": 0.62,
        "sun": 0.5,
        "sky_low": (196, 214, 232),
        "sky_high": (92, 142, 208),
        "sight_m": 900.0,
        "noise": 2.0,
        "night": False,
    },
    "overcast": {
        "weather": "weather.overcast",
        "daytime": "daytime.morning",
        "lighting": "lighting.illuminated",
        "ambient": 0.72,
        "sun": 0.14,
        "sky_low": (206, 208, 212),
        "sky_high": (164, 170, 178),
        "sight_m": 500.0,
        "noise": 2.5,
        "night": False,
    },
    "dusk": {
        "weather": "weather.clear",
        "daytime": "daytime.evening",
        "lighting": "lighting.twilight",
        "ambient": 0.36,
        "sun": 0.26,
        "sky_low": (232, 158, 104),
        "sky_high": (58, 72, 118),
        "sight_m": 600.0,
        "noise": 4.0,
        "night": False,
    },
    "rain": {
        "weather": "weather.rain",
        "daytime": "daytime.noon",
        "lighting": "lighting.illuminated",
        "ambient": 0.56,
        "sun": 0.05,
        "sky_low": (168, 172, 178),
        "sky_high": (128, 134, 142),
        "sight_m": 170.0,
        "noise": 4.0,
        "night": False,
    },
    "night": {
        "weather": "weather.clear",
        "daytime": "daytime.night",
        "lighting": "lighting.dark",
        "ambient": 0.13,
        "sun": 0.0,
        "sky_low": (26, 28, 40),
        "sky_high": (8, 9, 16),
        "sight_m": 700.0,
        "noise": 6.0,
        "night": True,
    },
    "fog": {
        "weather": "weather.fog",
        "daytime": "daytime.morning",
        "lighting": "lighting.illuminated",
        "ambient": 0.68,
        "sun": 0.06,
        "sky_low": (200, 202, 204),
        "sky_high": (188, 190, 194),
        "sight_m": 75.0,
        "noise": 2.5,
        "night": False,
    },
    "glare": {
        "weather": "weather.clear",
        "daytime": "daytime.evening",
        "lighting": "lighting.glare",
        "ambient": 0.6,
        "sun": 0.6,
        "sky_low": (255, 236, 200),
        "sky_high": (128, 160, 206),
        "sight_m": 450.0,
        "noise": 2.5,
        "night": False,
    },
}

ORDER = ("day", "rain", "night", "overcast", "dusk", "day", "fog", "glare")
"""Scene number within a split -> light, so that even four scenes differ."""


def draw_conditions(rng: np.random.Generator, number: int) -> Conditions:
    """The conditions of the `number`-th scene of a split."""
    name = ORDER[number % len(ORDER)]
    rain = name == "rain"
    return Conditions(
        name=name,
        season=str(rng.choice(["season.summer", "season.autumn", "season.winter"], p=[0.5, 0.35, 0.15])),
        area=str(rng.choice(["area.highway", "area.terminal", "area.rural"], p=[0.7, 0.15, 0.15])),
        sun_azimuth_rad=float(rng.uniform(-np.pi, np.pi)),
        precipitation_mm=round(float(rng.uniform(0.5, 6.0)), 2) if rain else 0.0,
        temperature_k=round(float(rng.uniform(274.0, 301.0)), 2),
        wind_mps=round(float(rng.uniform(0.0, 9.0)), 2),
        wind_rad=round(float(rng.uniform(0.0, 2 * np.pi)), 3),
        **_LIGHT[name],  # type: ignore[arg-type]
    )
