"""A temporal model's memory: history Gaussians and BEV cells, by ego motion alone and with velocity (Fig. 4)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, PowerNorm, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from src.pictures.bev import bev_panel, paint_arrows, paint_label, upright
from src.pictures.canvas import DPI, GAP_PX, HALF_PX, MARGIN_PX, SHEET_PX, Canvas
from src.pictures.contents import INK, MUTED, PictureBoxes, PictureGrid, PictureMemory, Window
from src.pictures.legends import arrow_key
from src.structures.taxonomy import MOVING_MPS

Array = np.ndarray

HEADER_PX = 92
CAPTION_PX = 48  # of two lines
HEAD = (4.0, 4.5, 4.0)  # of arrows
CLOSE_PX = 720
CLOSE_PX_PER_M = 7.0
TRAIL_S = 2.0
"""The close-up shows the trails of the fastest objects over this time, the reach of the Gaussian path's memory."""
EDGE_M = 6.0
"""Room between an object or its trail and the border of the close-up."""
REMEMBERED_M = 4.0
"""Anything remembered this near to an object's trail counts as a memory of it."""
ARROW_BLOCK_M = 3.2
"""What moves within a block of this edge shares one arrow: the mean velocity of the freshest there."""

AGE_COLOURS = LinearSegmentedColormap.from_list("age", ("#241571", "#7B1FA2", "#C2327F", "#EE6A4A", "#F7C548"))
"""From fresh, dark, to old, pale; by the root of the age, so that the fresh ones, which both paths hold, stay apart."""
TRUTH_COLOUR = "#0B8F62"
STANDING_COLOUR = "#5A636D"
MOST_KEYS = 8
"""Ages in a legend."""


@dataclass
class MemoryScene:
    """What lies on the ground around one ego vehicle and what is remembered of it; None for a path the model lacks."""

    grid: PictureGrid
    ground_truth: PictureBoxes = field(default_factory=PictureBoxes.empty)
    gaussians: PictureMemory | None = None
    cells: PictureMemory | None = None
    queries: PictureMemory | None = None

    def drawable(self) -> MemoryScene:
        """The scene with what can be drawn, in the order of drawing."""
        parts = (None if part is None else part.drawable() for part in (self.gaussians, self.cells, self.queries))
        return MemoryScene(self.grid, self.ground_truth.drawable(), *parts)

    def paths(self) -> list[tuple[str, PictureMemory]]:
        """The memories there are, with their names."""
        named = (("History Gaussians", self.gaussians), ("BEV cells", self.cells), ("Queries", self.queries))
        return [(name, memory) for name, memory in named if memory is not None]

    def moving(self) -> PictureBoxes:
        """True boxes known to move."""
        return self.ground_truth[self.ground_truth.moving()]


@dataclass(frozen=True)
class AgeScale:
    """Colours of the ages in one picture."""

    ages_s: tuple[float, ...]  # ascending, to a tenth of a second

    @classmethod
    def of(cls, scene: MemoryScene) -> AgeScale:
        """The ages of everything in a scene."""
        elapsed = [memory.elapsed_s for _, memory in scene.paths()]
        return cls(tuple(np.unique(np.concatenate([*elapsed, np.zeros(0)]).round(1)).tolist()))

    def colours(
        self,
        elapsed_s: Array,  # [n]
    ) -> Array:  # [n, 4]
        """One colour for each age."""
        first, last = (self.ages_s[0], self.ages_s[-1]) if self.ages_s else (0.0, 0.0)
        return AGE_COLOURS(PowerNorm(0.5, first, max(last, first + 0.5))(np.asarray(elapsed_s)))

    def keys(self) -> list[Artist]:
        """Legend keys of at most MOST_KEYS ages, spread evenly."""
        picks = np.unique(np.linspace(0, len(self.ages_s) - 1, MOST_KEYS).round().astype(int)) if self.ages_s else []
        ages = [self.ages_s[pick] for pick in picks]
        return [
            Patch(facecolor=colour, edgecolor="none", label=f"{age:.1f} s")
            for age, colour in zip(ages, self.colours(np.array(ages)), strict=True)
        ]


def close_window(
    scene: MemoryScene,
    width_m: float,
    height_m: float,
) -> Window:
    """A window of this size around the fastest true objects of which something is remembered, and their trails.

    Starts from the fastest and takes in the next fastest as long as all fit; the surroundings of the ego where nothing
    moves. Objects of which nothing is remembered count only where that holds for all.
    """
    size, moving = np.array([width_m, height_m]), scene.moving()
    low = high = now = np.array([0.0, 0.15 * height_m])
    if len(moving):
        remembered = np.array([_is_remembered(scene, moving[[row]]) for row in range(len(moving))])
        moving = moving[remembered] if remembered.any() else moving
        moving = moving[np.argsort(-np.linalg.norm(moving.velocities, axis=1), kind="stable")]
        centres = upright(moving.centers[:, :2])
        trails = np.stack([centres, centres - TRAIL_S * upright(moving.velocities)])  # [2, K, 2]
        lows, highs, now = trails.min(axis=0), trails.max(axis=0), centres[0]
        low, high = lows[0], highs[0]
        for row in range(1, len(moving)):
            lower, upper = np.minimum(low, lows[row]), np.maximum(high, highs[row])
            if (upper - lower <= size - 2 * EDGE_M).all():
                low, high = lower, upper
    slack = np.maximum(size / 2 - EDGE_M, 0)
    centre = np.clip((low + high) / 2, now - slack, now + slack)
    (left, right), (down, up) = scene.grid.window
    lower, upper = np.array([left, down]) + size / 2, np.array([right, up]) - size / 2
    centre = np.where(lower < upper, np.clip(centre, lower, np.maximum(lower, upper)), (lower + upper) / 2)
    (left, down), (right, up) = centre - size / 2, centre + size / 2
    return (float(left), float(right)), (float(down), float(up))


def _is_remembered(scene: MemoryScene, box: PictureBoxes) -> bool:
    """Whether anything remembered lies near the trail of one box."""
    back = -TRAIL_S * box.velocities[0]
    for _, memory in scene.paths():
        xy = np.concatenate([memory.moved, memory.stayed]) - box.centers[0, :2]
        along = np.clip(xy @ back / (back @ back), 0, 1)
        if (np.linalg.norm(xy - along[:, None] * back, axis=1) < REMEMBERED_M).any():
            return True
    return False


def paint_truth(axes: Axes, scene: MemoryScene, close: bool) -> None:
    """True boxes: moving ones filled and with their velocity, the others dashed."""
    moving, everything = scene.moving(), scene.ground_truth
    standing = everything[~everything.moving()]
    corners = [upright(boxes.corners()[:, :4, :2]) for boxes in (standing, moving)]
    dashes = {"facecolors": "none", "edgecolors": STANDING_COLOUR, "linewidths": 0.9, "linestyles": (0, (2.6, 1.6))}
    axes.add_collection(PolyCollection(corners[0], zorder=4, **dashes), autolim=False)
    axes.add_collection(
        PolyCollection(corners[1], facecolors=to_rgba(TRUTH_COLOUR, 0.22), edgecolors="none", zorder=1), autolim=False
    )
    for colour, extra in (("white", 1.6), (TRUTH_COLOUR, 0.0)):
        edge = {"facecolors": "none", "edgecolors": colour, "linewidths": (2.0 if close else 1.0) + extra}
        axes.add_collection(PolyCollection(corners[1], zorder=4.1, **edge), autolim=False)
    if close:
        paint_arrows(axes, moving.centers[:, :2], moving.velocities, TRUTH_COLOUR, 3.2, HEAD, 4.2)


def paint_memory(
    axes: Axes,
    memory: PictureMemory,
    ages: AgeScale,
    moved: bool,  # where they lie with their velocity, or without
    cell_m: float,
    close: bool,
) -> None:
    """Gaussians as one-sigma ellipses, others as squares, in the colour of their age; close up also with velocities."""
    xy = memory.moved if moved else memory.stayed
    (left, right), (down, up) = axes.get_xlim(), axes.get_ylim()
    plot, reach = upright(xy), 10.0  # m beyond the border that may still touch the window
    seen = ((plot > (left - reach, down - reach)) & (plot < (right + reach, up + reach))).all(axis=1)
    xy, plot, memory = xy[seen], plot[seen], memory[seen]
    if len(memory) == 0:
        return
    colours = ages.colours(memory.elapsed_s)
    if memory.gaussians is not None:
        outlines = upright(replace(memory.gaussians, means=xy).outlines())
        opacity = np.clip(memory.gaussians.opacities, 0, 1)
        edge, face = colours.copy(), colours.copy()
        edge[:, 3], face[:, 3] = 0.45 + 0.55 * opacity, 0.3 * opacity
        width = 1.2 if close else 0.8
        axes.add_collection(
            PolyCollection(outlines, facecolors=face, edgecolors=edge, linewidths=width, zorder=2), autolim=False
        )
    else:
        scale = axes.get_window_extent().width / (right - left)  # pixels per metre
        points = max(cell_m * scale, 2.0) * 72 / DPI
        axes.scatter(*plot.T, s=points**2, c=colours, marker="s", linewidths=0, antialiased=False, zorder=2)
    if close:
        paint_arrows(axes, *arrow_means(xy, memory), INK, 1.4, HEAD, 4.4)


def arrow_means(
    xy: Array,  # [n, 2] m
    memory: PictureMemory,
) -> tuple[Array, Array]:  # [m, 2] m, [m, 2] m/s
    """Places and velocities of the arrows: the mean of the freshest that move in each block."""
    moving = np.linalg.norm(memory.velocities, axis=1) >= MOVING_MPS
    values, elapsed = np.c_[xy, memory.velocities][moving], memory.elapsed_s[moving].round(1)
    _, block = np.unique(np.floor(values[:, :2] / ARROW_BLOCK_M), axis=0, return_inverse=True)
    block = block.reshape(-1)
    freshest = np.full(len(values), np.inf)
    np.minimum.at(freshest, block, elapsed)
    chosen = elapsed == freshest[block]
    sums, counts = np.zeros((len(values), 4)), np.bincount(block[chosen], minlength=len(values))
    np.add.at(sums, block[chosen], values[chosen])
    means = sums[counts > 0] / counts[counts > 0, None]
    return means[:, :2], means[:, 2:]


def paint_scale(axes: Axes) -> None:
    """A bar of 20 m in the lower left corner."""
    left, down = axes.get_xlim()[0] + 3, axes.get_ylim()[0] + 3
    axes.plot([left, left + 20], [down, down], color=INK, linewidth=2, zorder=6)
    paint_label(axes, left + 10, down + 1.8, "20 m", INK)


def hits_line(name: str, memory: PictureMemory, moving: PictureBoxes) -> str:
    """How many of the remembered lie on moving true boxes, by ego motion alone and with their velocity."""
    before, after = (int(moving.cover(xy).sum()) for xy in (memory.stayed, memory.moved))
    return f"{name}: {len(memory)}, on moving boxes {before} without velocity → {after} with"


def paint_header(canvas: Canvas, scene: MemoryScene, ages: AgeScale, title: str) -> None:
    """Title, counts and legend in the top HEADER_PX pixels."""
    canvas.text(MARGIN_PX, 8, title if len(title) <= 110 else f"{title[:109]}…", 22, bold=True)
    moving = scene.moving()
    truth = f"{len(moving)} of {len(scene.ground_truth)} true boxes move" if len(scene.ground_truth) else None
    parts = [truth or "no ground truth"]
    for name, memory in scene.paths():
        parts.append(hits_line(name, memory, moving) if truth else f"{name}: {len(memory)}")
    canvas.text(MARGIN_PX, 40, "   ·   ".join(parts), 15)
    face = to_rgba(TRUTH_COLOUR, 0.22)
    keys: list[Artist] = [
        Patch(facecolor=face, edgecolor=TRUTH_COLOUR, linewidth=1.8, label="moving ground truth"),
        Line2D([], [], color=STANDING_COLOUR, linewidth=1.0, linestyle=(0, (2.6, 1.6)), label="standing ground truth"),
        arrow_key("true travel", TRUTH_COLOUR),
        arrow_key("predicted travel", INK),
    ]
    canvas.legend(MARGIN_PX, 66, keys)
    canvas.text(890, 66, "age" if ages.ages_s else "", 13, bold=True)
    canvas.legend(925, 66, ages.keys())
    canvas.text(SHEET_PX - MARGIN_PX, 12, "forward is up", 12, colour=MUTED, align="right")


def caption(memory: PictureMemory, moved: bool) -> str:
    """Where a panel shows a memory, and whether the model read it there."""
    how = "with velocity" if moved else "without velocity, ego motion only"
    return f"{how} (used by the model)" if memory.compensated == moved else how


def draw_memory(path: Path | str, scene: MemoryScene, title: str) -> None:
    """Write one PNG, SHEET_PX wide: close-ups of each path's memory without and with velocity, and the whole range.

    Without velocity, what is remembered stays where it was seen and only the ego has moved on; with it, it has also
    travelled by its own predicted velocity. Everything is in ego metres of the present, forward is up, coloured by
    age. What the model dropped, because it left the grid where the model read it, is not there to be drawn.
    Raises OSError when the file cannot be written.
    """
    scene = scene.drawable()
    ages, paths = AgeScale.of(scene), scene.paths()
    wide = SHEET_PX - 2 * MARGIN_PX
    closes = [(name, memory, moved) for name, memory in paths for moved in (False, True)]
    overviews = closes if len(paths) == 1 else [(name, memory, memory.compensated) for name, memory in paths]
    high = HALF_PX * scene.grid.cols / scene.grid.rows
    below = HEADER_PX + CAPTION_PX + CLOSE_PX + GAP_PX
    canvas = Canvas(SHEET_PX, round(below + CAPTION_PX + high + MARGIN_PX) if paths else HEADER_PX + MARGIN_PX)
    paint_header(canvas, scene, ages, title)
    each = (wide - GAP_PX * (len(closes) - 1)) / max(len(closes), 1)
    window = close_window(scene, each / CLOSE_PX_PER_M, CLOSE_PX / CLOSE_PX_PER_M)
    for column, (name, memory, moved) in enumerate(closes):
        area = (MARGIN_PX + column * (each + GAP_PX), HEADER_PX + CAPTION_PX, each, CLOSE_PX)
        axes = bev_panel(canvas, area, window, name, note=caption(memory, moved))
        paint_memory(axes, memory, ages, moved, scene.grid.cell_m, close=True)
        paint_truth(axes, scene, close=True)
        paint_scale(axes)
    for column, (name, memory, moved) in enumerate(overviews):
        area = (MARGIN_PX + column * (HALF_PX + GAP_PX), below + CAPTION_PX, HALF_PX, high)
        axes = bev_panel(canvas, area, scene.grid.window, f"{name}, whole range", note=caption(memory, moved))
        paint_memory(axes, memory, ages, moved, scene.grid.cell_m, close=False)
        paint_truth(axes, scene, close=False)
        (left, right), (down, up) = window
        axes.add_patch(Rectangle((left, down), right - left, up - down, fill=False, edgecolor=INK, zorder=6))
    canvas.save(path, photographs=False)
