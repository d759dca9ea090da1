"""The road of one scene: a curved, sloped centre line with lanes on both sides (right-hand traffic)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from src.world.world_config import WorldConfig

Array = np.ndarray

LANE_M = 3.6
MEDIAN_HALF_M = 2.0
SHOULDER_M = 2.8
START_M = -800.0
END_M = 1500.0
SLAT_M, SLAT_STEP_M = 0.36, 2.0
"""Width across the road and distance of the slats of an anti-glare screen: opaque along the road, open across it."""
SLAT_THICK_M = 0.05
SIDE_ROAD_GAP_M = 13.0
SIDE_ROAD_HALF_M = 3.2
APRON_GAP_M = 10.0
APRON_DEPTH_M = 34.0


@dataclass(kw_only=True)
class Road:
    """Centre line sampled every metre; positions along it are (s, d), d to the left, both in metres.

    Traffic with d < 0 drives towards larger s, traffic with d > 0 comes back. `side_road` is the sign of d of a
    parallel minor road (0 for none); `apron` the s interval of a parking area on the right (None for none).
    """

    xy: Array  # [S, 2] m, local coordinates
    heading_rad: Array  # [S] unwrapped
    z: Array  # [S] m
    lanes: int  # each way
    side_road: int
    apron: tuple[float, float] | None
    screen_m: float  # height of the anti-glare screen on the median, 0 for a median with rails alone

    @property
    def edge_m(self) -> float:
        """Distance of the outer edge of the outermost lane from the centre line."""
        return MEDIAN_HALF_M + self.lanes * LANE_M

    @property
    def rail_m(self) -> float:
        """Distance of the outer guard rails from the centre line."""
        return self.edge_m + SHOULDER_M + 0.5

    def lane_centre(self, direction: int, lane: int) -> float:
        """Lateral position of a lane; lane 0 is the fast one beside the median, direction +1 is the ego's."""
        return -direction * (MEDIAN_HALF_M + (lane + 0.5) * LANE_M)

    def side_road_centre(self) -> float:
        """Lateral position of the side road's middle."""
        return self.side_road * (self.edge_m + SIDE_ROAD_GAP_M + SIDE_ROAD_HALF_M)

    def apron_band(self) -> tuple[float, float]:
        """Lateral interval (far, near) of the parking area; both are negative."""
        near = -(self.edge_m + APRON_GAP_M)
        return near - APRON_DEPTH_M, near

    def _lookup(self, values: Array, s: Array) -> Array:
        index = np.clip(np.asarray(s, dtype=np.float64) - START_M, 0.0, len(self.z) - 1.001)
        low = index.astype(np.int64)
        part = index - low
        if values.ndim == 2:
            part = part[..., None]
        return values[low] * (1.0 - part) + values[low + 1] * part

    def heading_at(self, s: Array) -> Array:
        """Direction of the centre line, rad, shape of s."""
        return self._lookup(self.heading_rad, s)

    def height_at(self, s: Array) -> Array:
        """Height of the ground, m; level across the road."""
        return self._lookup(self.z, s)

    def slope_at(self, s: Array) -> Array:
        """dz/ds, upwards positive."""
        return (self.height_at(np.asarray(s) + 1.0) - self.height_at(np.asarray(s) - 1.0)) / 2.0

    @cached_property
    def _profile(self) -> tuple[Array, Array]:
        """Rows x, y, heading, height and slope at every metre, and what each gains until the next: [5, S], [5, S]."""
        slope = self.slope_at(START_M + np.arange(len(self.z)))
        rows = np.stack([*self.xy.T, self.heading_rad, self.z, slope])
        return rows, np.diff(rows, append=rows[:, -1:])

    def profile_at(self, s: Array) -> tuple[Array, Array]:
        """Rows x, y (m), heading (rad), height (m) and slope at places [K], and what each gains in a metre there:
        [5, K] both. The values of `place(s, 0)`, `heading_at` and `slope_at` in one look-up.
        """
        rows, gains = self._profile
        index = np.minimum(np.maximum(s - START_M, 0.0), len(self.z) - 1.001)
        low = index.astype(np.int64)
        gain = gains.take(low, axis=1)
        return rows.take(low, axis=1) + (index - low) * gain, gain

    def curvature_at(self, s: Array) -> Array:
        """1/m, left turns positive."""
        return (self.heading_at(np.asarray(s) + 1.0) - self.heading_at(np.asarray(s) - 1.0)) / 2.0

    def along(
        self,
        xy: Array,  # [..., 2] m
        guess_s: Array,  # [...] m, where to look first
        rounds: int = 20,
    ) -> Array:  # [...] m
        """The place along the road that points lie beside: `place(along, d)` leads back to them for some d."""
        s = np.asarray(guess_s, dtype=np.float64)
        for _ in range(rounds):
            heading = self.heading_at(s)
            away = xy - self._lookup(self.xy, s)
            s = s + away[..., 0] * np.cos(heading) + away[..., 1] * np.sin(heading)
        return s

    def slats(self, first_m: float, last_m: float) -> tuple[Array, Array, Array]:
        """Middles [N, 3], sizes [N, 3] and headings [N] of the anti-glare screen's slats between two places."""
        s = SLAT_STEP_M * np.arange(first_m // SLAT_STEP_M, last_m // SLAT_STEP_M + 1) if self.screen_m else np.zeros(0)
        size = np.tile([SLAT_THICK_M, SLAT_M, self.screen_m], (len(s), 1))
        return self.place(s, np.zeros_like(s), 0.5 * self.screen_m), size, self.heading_at(s)

    def place(self, s: Array, d: Array, height: Array | float = 0.0) -> Array:
        """Local xyz [..., 3] of road positions, `height` metres above the ground."""
        heading = self.heading_at(s)
        xy = self._lookup(self.xy, s) + np.stack([-np.sin(heading), np.cos(heading)], -1) * np.asarray(d)[..., None]
        return np.concatenate([xy, (self.height_at(s) + height)[..., None]], -1)


def make_road(config: WorldConfig, rng: np.random.Generator) -> Road:
    """Draw a road: radius above `least_radius_m`, slope within 2 %, heading anywhere."""
    s = np.arange(START_M, END_M + 1.0)
    waves = np.array([rng.uniform(500, 900), rng.uniform(900, 1600), rng.uniform(300, 500)])
    phases = rng.uniform(0, 2 * np.pi, 3)
    shares = rng.dirichlet(np.ones(3))
    strength = np.exp(rng.uniform(np.log(1 / 8000), np.log(1 / config.least_radius_m)))
    curvature = strength * (shares * np.sin(2 * np.pi * s[:, None] / waves + phases)).sum(1)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(curvature)
    xy = np.stack([np.cumsum(np.cos(heading)), np.cumsum(np.sin(heading))], 1)
    slopes = rng.uniform(0.003, 0.016) * np.sin(2 * np.pi * s / rng.uniform(800, 1600) + rng.uniform(0, 6.28))
    z = np.cumsum(slopes)
    origin = int(-START_M)
    apron_start = rng.uniform(-20, 160)
    return Road(
        xy=xy - xy[origin],
        heading_rad=heading,
        z=z - z[origin],
        lanes=int(rng.integers(2, 5)),
        side_road=int(rng.choice([-1, 1, 1, 0])) if rng.random() < 0.85 else 0,
        apron=(apron_start, apron_start + rng.uniform(70, 110)),
        screen_m=float(rng.uniform(1.8, 3.4)) if rng.random() < config.screened_fraction else 0.0,
    )
