"""Keys of the pictures' legends."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from src.pictures.bev import ARROW_S, LIDAR_COLOUR, MISSED_COLOUR, SPEED_COLOURS, STANDING_COLOUR, BevScene
from src.pictures.contents import CLASS_COLOURS, CLASS_MARKERS, INK, OCCUPANCY_COLOUR, SOURCE_COLOURS
from src.structures.taxonomy import CLASSES, SOURCES


def class_keys(present: set[int]) -> list[Artist]:
    """Legend keys of the classes in a picture, in the official order."""
    keys: list[Artist] = []
    for label in sorted(present):
        name, colour = CLASSES[label], CLASS_COLOURS[CLASSES[label]]
        text = name.replace("_", " ")
        if name in CLASS_MARKERS:
            marker = CLASS_MARKERS[name]
            keys.append(Line2D([], [], linestyle="none", marker=marker, markersize=8, color=colour, label=text))
        else:
            keys.append(Patch(facecolor=to_rgba(colour, 0.35), edgecolor=colour, linewidth=1.8, label=text))
    return keys


def reading_keys(missed: bool, truth_alone: bool) -> list[Artist]:
    """Legend keys that say how boxes are drawn."""
    what = f"{'ground truth' if truth_alone else 'prediction'} (class colour, front marked)"
    keys: list[Artist] = [Line2D([], [], color=CLASS_COLOURS["car"], linewidth=2.2, label=what)]
    if not truth_alone:
        keys.append(Line2D([], [], color=INK, linewidth=1.4, linestyle=(0, (2.6, 1.6)), label="ground truth"))
    if missed:
        ring = Line2D([], [], linestyle="none", marker="o", markersize=11, mfc="none", mec=MISSED_COLOUR)
        ring.set_label("missed")
        keys.append(ring)
    return [*keys, arrow_key("travel", INK)]


def arrow_key(what: str, colour: str) -> Artist:
    """Legend key of arrows."""
    arrow = {"linestyle": "none", "marker": r"$\longrightarrow$", "markersize": 20}
    return Line2D([], [], color=colour, label=f"{what} in {ARROW_S:g} s", **arrow)


def radar_keys() -> list[Artist]:
    """Legend keys of the radar points."""
    shades = {"approaching": SPEED_COLOURS(0.1), "standing": to_rgba(STANDING_COLOUR), "receding": SPEED_COLOURS(0.9)}
    return [
        Line2D([], [], linestyle="none", marker="o", markersize=5, color=colour, mew=0, label=f"radar, {name}")
        for name, colour in shades.items()
    ]


def point_keys(scene: BevScene) -> list[Artist]:
    """Legend keys of the points among the detections."""
    if scene.radar_points is not None or scene.lidar_points is None:
        return radar_keys()
    return [Line2D([], [], linestyle="none", marker="o", markersize=3, color=LIDAR_COLOUR, mew=0, label="LiDAR")]


def gaussian_keys(scene: BevScene) -> list[Artist]:
    """Legend keys of the Gaussians, with their number by source, and of the occupancy."""
    keys: list[Artist] = []
    if scene.gaussians is not None:
        counts = np.bincount(scene.gaussians.sources, minlength=len(SOURCES))
        for name, count in zip(SOURCES, counts, strict=True):
            colour = SOURCE_COLOURS[name]
            form = r"$\odot$" if name == "history" and count else "o"
            key = Line2D([], [], linestyle="none", marker=form, markersize=10, mec=colour, mfc=to_rgba(colour, 0.35))
            key.set_label(f"{name} {count}")
            keys.append(key)
    if scene.occupancy is not None:
        keys.append(Patch(facecolor=(*OCCUPANCY_COLOUR, 0.7), edgecolor="none", label="occupancy"))
    return keys
