"""Contents of pictures as plain numpy arrays (boxes, Gaussians, memory, grid), and the colours of each."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from src.structures.taxonomy import CLASSES, MOVING_MPS

Array = np.ndarray
Window = tuple[tuple[float, float], tuple[float, float]]
"""Part of the ground that a plot shows (right, up), m: forward is up, left is left."""

# Hues are spread over lightness as well, after Okabe & Ito (2008) and P. Tol, so that they stay apart for colour-blind
# readers; the seven small classes also differ by marker.
CLASS_COLOURS: dict[str, str] = {
    "car": "#0072B2",
    "truck": "#D55E00",
    "bus": "#E6A000",
    "trailer": "#8C2D7E",
    "other_vehicle": "#3E4A00",
    "pedestrian": "#D81B7A",
    "motorcycle": "#2BC4A2",
    "bicycle": "#3DA5D9",
    "traffic_cone": "#FF8F6B",
    "barrier": "#5C5C5C",
    "animal": "#6B3E1E",
    "traffic_sign": "#4B3BB5",
}
CLASS_MARKERS: dict[str, str] = {
    "pedestrian": "o",
    "motorcycle": "s",
    "bicycle": "D",
    "traffic_cone": "^",
    "barrier": "X",
    "animal": "P",
    "traffic_sign": "v",
}
"""Classes whose footprint is too small to be seen from above at 150 m; the others show as rectangles."""

SOURCE_COLOURS: dict[str, str] = {
    "radar": "#D55E00",
    "camera": "#0072B2",
    "random": "#A3A3A3",
    "history": "#00674C",
}
INK = "#1B1F24"
MUTED = "#8A929B"
AXIS_INK = "#495057"
"""Colour of the numbers and names of axes."""
FRAME_COLOUR, GRID_COLOUR, PANEL_COLOUR = "#C9CED4", "#E3E6EA", "#FBFBFC"
"""Colours of a plot's frame, of the lines within it, and of the ground of a view."""
OCCUPANCY_COLOUR = (0.62, 0.47, 0.82)
BOX_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
FRONT_FACE = (0, 1, 5, 4)
MATCH_DISTANCE_M = 2.0
OUTLINE_CORNERS = 24
"""Corners of the polygon that an ellipse is drawn as."""


class Rows:
    """Arrays of one length, a row for each thing; an index (a boolean mask or numbers) takes rows of all of them."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not isinstance(value, bool | Rows):
                kind = np.int64 if field.name in ("labels", "sources") else np.float64
                setattr(self, field.name, np.asarray(value, dtype=kind))

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, rows: Array) -> Self:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: value[rows] for name, value in values.items() if hasattr(value, "__len__")})


@dataclass
class PictureBoxes(Rows):
    """K boxes in ego metres (x forward, y left, z up)."""

    centers: Array  # [K, 3] m, box centre
    sizes: Array  # [K, 3] m (length, width, height)
    yaws: Array  # [K] rad, counter-clockwise from +x
    velocities: Array  # [K, 2] m/s over ground, NaN where unknown
    labels: Array  # [K] integer, index into taxonomy.CLASSES
    scores: Array | None = None  # [K] in 0..1, for predictions

    @classmethod
    def empty(cls) -> PictureBoxes:
        """No box at all."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), np.zeros(0), np.zeros(0))

    def drawable(self, score_threshold: float = 0.0) -> PictureBoxes:
        """The finite boxes, of those with scores the ones at or above the threshold, weakest first."""
        keep = np.isfinite(np.concatenate([self.centers, self.sizes, self.yaws[:, None]], axis=1)).all(axis=1)
        if self.scores is None:
            return self[keep]
        kept = self[keep & (self.scores >= score_threshold)]
        return kept[np.argsort(kept.scores, kind="stable")]

    def corners(self) -> Array:
        """Corners [K, 8, 3] m: bottom front-left, front-right, back-right, back-left, then the same on top."""
        along = np.array([1, 1, -1, -1, 1, 1, -1, -1]) / 2
        across = np.array([1, -1, -1, 1, 1, -1, -1, 1]) / 2
        upward = np.array([-1, -1, -1, -1, 1, 1, 1, 1]) / 2
        x, y, z = (self.sizes[:, i, None] * part for i, part in enumerate((along, across, upward)))
        cos, sin = np.cos(self.yaws)[:, None], np.sin(self.yaws)[:, None]
        return self.centers[:, None] + np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)

    def cover(
        self,
        xy: Array,  # [n, 2] m
    ) -> Array:  # [n] bool
        """Which points lie on the footprint of at least one box."""
        cos, sin = np.cos(self.yaws), np.sin(self.yaws)
        away = xy[:, None] - self.centers[:, :2]  # [n, K, 2]
        along = cos * away[..., 0] + sin * away[..., 1]
        across = cos * away[..., 1] - sin * away[..., 0]
        return ((np.abs(along) <= self.sizes[:, 0] / 2) & (np.abs(across) <= self.sizes[:, 1] / 2)).any(axis=1)

    def moving(self) -> Array:
        """Which boxes are known to move [K] bool."""
        return np.linalg.norm(self.velocities, axis=1) >= MOVING_MPS  # NaN is not

    def colours(self) -> list[str]:
        """The class colour of each box."""
        return [CLASS_COLOURS[CLASSES[label]] for label in self.labels]


@dataclass
class PictureGaussians(Rows):
    """G Gaussians on the ground plane, ego metres (Eq. 1)."""

    means: Array  # [G, 2] m
    scales: Array  # [G, 2] m, standard deviation along and across `directions`
    directions: Array  # [G, 2] (cos, sin)
    opacities: Array  # [G] in 0..1
    sources: Array  # [G] integer, index into SOURCES

    def outlines(self) -> Array:
        """The one-sigma ellipses as polygons [G, OUTLINE_CORNERS, 2] m."""
        turn = np.linspace(0, 2 * np.pi, OUTLINE_CORNERS, endpoint=False)
        along, across = self.scales[:, :1] * np.cos(turn), self.scales[:, 1:] * np.sin(turn)  # [G, corners]
        length = np.linalg.norm(self.directions, axis=1, keepdims=True)
        cos, sin = (self.directions / np.where(length > 0, length, 1)).T[..., None]
        return self.means[:, None] + np.stack([cos * along - sin * across, sin * along + cos * across], axis=-1)


@dataclass
class PictureMemory(Rows):
    """n things remembered from past key frames, in today's ego metres: BEV cells, or Gaussians where given."""

    xy: Array  # [n, 2] m, where the model read them
    velocities: Array  # [n, 2] m/s over ground, today's axes
    elapsed_s: Array  # [n] s since each was seen
    gaussians: PictureGaussians | None = None  # n, their shapes; means as in `xy`
    compensated: bool = True  # whether the model read them at `moved`, or at `stayed`

    @property
    def moved(self) -> Array:
        """Where they lie carried along by the ego motion and by their own velocity [n, 2] m (Eq. 8)."""
        return self.xy if self.compensated else self.xy + self._travel

    @property
    def stayed(self) -> Array:
        """Where they would lie by the ego motion alone [n, 2] m: exact, as velocities hold over ground."""
        return self.xy - self._travel if self.compensated else self.xy

    @property
    def _travel(self) -> Array:
        return self.velocities * self.elapsed_s[:, None]

    def drawable(self) -> PictureMemory:
        """The finite ones, oldest first, so that the freshest come out on top."""
        finite = np.isfinite(np.c_[self.xy, self.velocities, self.elapsed_s]).all(axis=1)
        if self.gaussians is not None:
            shapes = (self.gaussians.scales, self.gaussians.directions, self.gaussians.opacities)
            finite &= np.isfinite(np.column_stack(shapes)).all(axis=1)
        rows = np.flatnonzero(finite)
        return self[rows[np.argsort(-self.elapsed_s[rows], kind="stable")]]


@dataclass(frozen=True)
class PictureGrid:
    """Extent of the BEV: rows run along y, columns along x."""

    x_min_m: float
    y_min_m: float
    cell_m: float
    rows: int
    cols: int

    @property
    def window(self) -> Window:
        """Plot window of the whole grid."""
        x_max_m, y_max_m = self.x_min_m + self.cols * self.cell_m, self.y_min_m + self.rows * self.cell_m
        return (-y_max_m, -self.y_min_m), (self.x_min_m, x_max_m)


def match_boxes(
    predictions: PictureBoxes,
    ground_truth: PictureBoxes,
) -> tuple[Array, Array]:
    """Which predictions [P] and which true boxes [K] found a partner (bool): the evaluation's greedy rule at 2 m.

    By falling score, each prediction takes the nearest free true box of its class closer than 2 m on the ground.
    """
    found = np.zeros(len(predictions), dtype=bool)
    taken = np.zeros(len(ground_truth), dtype=bool)
    scores = np.zeros(len(predictions)) if predictions.scores is None else predictions.scores
    for row in np.argsort(-scores, kind="stable"):
        distance = np.linalg.norm(ground_truth.centers[:, :2] - predictions.centers[row, :2], axis=1)
        distance[taken | (ground_truth.labels != predictions.labels[row])] = np.inf
        if len(distance) and distance.min() < MATCH_DISTANCE_M:
            found[row] = taken[distance.argmin()] = True
    return found, taken
