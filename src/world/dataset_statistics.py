"""What the radars and cameras of a data set in the TruckScenes layout see of its labelled boxes.

Counted from the tables and the radar files alone, so the same code measures a synthetic world and a recorded release.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from src.data.pcd import read_radar_points
from src.data.schema import CHANNELS, DatasetIndex
from src.data.tables import Table
from src.geometry.transforms import pose_matrix, quaternion_to_matrix, yaw_of
from src.structures.taxonomy import CATEGORY_TO_CLASS, RADARS

Array = np.ndarray

GROWTH_M = 0.5
"""How far the faces of a grown box lie outside the label's."""


@dataclass(kw_only=True)
class DatasetCounts:
    """One row per labelled box (B), per key frame (F), by scene and time, and per point (P) of key sweeps."""

    classes: Array  # [B] name of the detection class, "" for ignored categories
    frames: Array  # [B] row of the key frame
    instances: Array  # [B]
    distance_m: Array  # [B] in the plane, from the ego origin
    ahead: Array  # [B] bool: in the front half
    speed_mps: Array  # [B] over ground, 0 where the box is alone
    levels: Array  # [B] visibility 1 to 4, 0 for none
    radar: Array  # [B] points of one key sweep of each radar inside the box
    radar_grown: Array  # [B] and inside the box grown by GROWTH_M
    accumulated: Array  # [B] points of the last `num_sweeps` sweeps inside the box where it was at their time
    lidar: Array  # [B] as stored
    scenes: Array  # [F]
    descriptions: Array  # [F] scene tags
    times_s: Array  # [F] since the first key frame of the scene
    points: Array  # [F] radar points of the key sweeps
    ego_speed_mps: Array  # [F] from one key frame to the next, NaN at a scene's end
    ego_yaw_rad: Array  # [F]
    channels: Array  # [P] number of the radar
    range_m: Array  # [P] in the sensor frame
    planar_m: Array  # [P] in the plane, from the ego origin
    elevation_rad: Array  # [P] in the sensor frame
    rcs_db: Array  # [P]


def count_dataset(index: DatasetIndex, num_sweeps: int) -> DatasetCounts:
    """Measure every key frame of a release. Raises DataError for tables or radar files that cannot be read."""
    chronological = np.lexsort((index.frame_times_us, index.sample_scenes))  # tables may be in any order
    scenes, times_us = index.sample_scenes[chronological], index.frame_times_us[chronological]
    boxes = _box_columns(index)
    boxes["frames"] = np.argsort(chronological)[boxes["frames"]]
    frames: dict[str, list[Array]] = {"radar": [], "radar_grown": [], "accumulated": [], "order": []}
    points: list[Array] = []
    poses = index.frame_poses[chronological]
    origins = index.pose_translations[poses]
    yaws = yaw_of(quaternion_to_matrix(index.pose_rotations[poses]))
    by_frame = np.argsort(boxes["frames"], kind="stable")
    starts = np.searchsorted(boxes["frames"][by_frame], np.arange(len(index) + 1))
    for place, frame in enumerate(chronological):
        rows = by_frame[starts[place] : starts[place + 1]]
        here = {name: column[rows] for name, column in boxes.items()}
        counts, seen = _count_frame(index, frame, here, num_sweeps)
        points.append(seen)
        frames["order"].append(rows)
        for name, column in counts.items():
            frames[name].append(column)
    order = np.argsort(np.concatenate(frames.pop("order")))
    counted = {name: np.concatenate(columns)[order] for name, columns in frames.items()}
    offset = boxes["centres"][:, :2] - origins[boxes["frames"], :2]
    times = 1e-6 * (times_us - times_us[np.searchsorted(scenes, scenes)])
    step = np.linalg.norm(np.diff(origins, axis=0)[:, :2], axis=1) / np.maximum(np.diff(times), 1e-3)
    speed = np.append(np.where(np.diff(scenes) == 0, step, np.nan), np.nan)
    heading = yaws[boxes["frames"]]
    every = np.concatenate(points)
    return DatasetCounts(
        **{name: boxes[name] for name in ("classes", "frames", "instances", "speed_mps", "levels", "lidar")},
        **counted,
        distance_m=np.hypot(*offset.T),
        ahead=np.cos(heading) * offset[:, 0] + np.sin(heading) * offset[:, 1] > 0,
        scenes=scenes,
        descriptions=index.scene_descriptions[scenes],
        times_s=times,
        points=np.array([len(seen) for seen in points]),
        ego_speed_mps=speed,
        ego_yaw_rad=yaws,
        channels=every[:, 0].astype(np.int64),
        **dict(zip(("range_m", "planar_m", "elevation_rad", "rcs_db"), every[:, 1:].T, strict=True)),
    )


def _box_columns(index: DatasetIndex) -> dict[str, Array]:
    """All annotations in table order, of whatever category."""
    folder = Path(index.root) / index.version
    table, samples = Table(folder / "sample_annotation.json"), Table(folder / "sample.json")
    instances, categories = Table(folder / "instance.json"), Table(folder / "category.json")
    levels = np.append(Table(folder / "visibility.json").integers("level"), 0)
    rows = np.arange(len(table))
    instance = table.links("instance_token", instances)
    names = np.array([CATEGORY_TO_CLASS.get(name, "") for name in categories.values("name")])
    frames = table.links("sample_token", samples)
    centres = table.vectors("translation", 3)
    ends = [np.where((link := table.links(name, table, optional=True)) < 0, rows, link) for name in ("prev", "next")]
    elapsed = np.maximum(1e-6 * np.diff(samples.times()[frames[np.stack(ends)]], axis=0)[0], 1e-3)
    velocity = (centres[ends[1]] - centres[ends[0]]) / elapsed[:, None]
    return {
        "classes": names[instances.links("category_token", categories)[instance]],
        "instances": instance,
        "frames": frames,
        "centres": centres,
        "half": 0.5 * table.vectors("size", 3)[:, [1, 0, 2]],
        "yaws": yaw_of(quaternion_to_matrix(table.rotations())),
        "velocity": velocity,
        "speed_mps": np.hypot(velocity[:, 0], velocity[:, 1]),
        "levels": levels[table.links("visibility_token", Table(folder / "visibility.json"), optional=True)],
        "lidar": table.integers("num_lidar_pts"),
    }


def _count_frame(
    index: DatasetIndex, frame: int, boxes: dict[str, Array], num_sweeps: int
) -> tuple[dict[str, Array], Array]:
    """Counts per box of one key frame, and its points: radar, range, planar range, elevation, RCS [P, 5]."""
    frame_pose = index.frame_poses[frame]
    origin, now_us = index.pose_translations[frame_pose], index.frame_times_us[frame]
    centres = boxes["centres"] - origin
    counts = {name: np.zeros(len(centres), dtype=np.int64) for name in ("radar", "radar_grown", "accumulated")}
    seen = [np.zeros((0, 5))]
    for number, channel in enumerate(RADARS):
        row = int(index.key_data[frame, CHANNELS.index(channel)])
        for age in range(num_sweeps):
            if row < 0:
                break
            points = read_radar_points(str(Path(index.root) / index.filename(row))).astype(np.float64)
            pose = index.data_poses[row]
            mount = index.ego_from_sensor[index.data_calibrations[row]]
            to_global = pose_matrix(index.pose_rotations[pose], index.pose_translations[pose] - origin) @ mount
            places = points[:, :3] @ to_global[:3, :3].T + to_global[:3, 3]
            earlier = centres - 1e-6 * (now_us - index.data_times_us[row]) * boxes["velocity"]
            counts["accumulated"] += count_inside(earlier, boxes["half"], boxes["yaws"], places)
            if age == 0:
                counts["radar"] += count_inside(centres, boxes["half"], boxes["yaws"], places)
                counts["radar_grown"] += count_inside(centres, boxes["half"] + GROWTH_M, boxes["yaws"], places)
                span = np.linalg.norm(points[:, :3], axis=1)
                elevation = np.arcsin(points[:, 2] / np.maximum(span, 1e-6))
                planar = np.hypot(places[:, 0], places[:, 1])
                columns = (np.full(len(points), number), span, planar, elevation, points[:, 6])
                seen.append(np.stack(columns, 1))
            row = int(index.data_previous[row])
    return counts, np.concatenate(seen)


def count_inside(
    centres: Array,  # [B, 3] m
    half: Array,  # [B, 3] half of length, width and height, m
    yaws: Array,  # [B] rad
    points: Array,  # [P, 3] m
) -> Array:  # [B]
    """How many of the points lie in each upright box, borders included."""
    points = points[np.argsort(points[:, 0])]
    around = np.hypot(half[:, 0], half[:, 1]) + 1e-6  # more than rounding takes off
    first, last = (np.searchsorted(points[:, 0], centres[:, 0] + side * around) for side in (-1, 1))
    counts = np.zeros(len(centres), dtype=np.int64)
    for box in np.flatnonzero(last > first):
        x, y, z = (points[first[box] : last[box]] - centres[box]).T
        cos, sin = np.cos(yaws[box]), np.sin(yaws[box])
        inside = (np.abs(cos * x + sin * y) <= half[box, 0]) & (np.abs(cos * y - sin * x) <= half[box, 1])
        counts[box] = np.count_nonzero(inside & (np.abs(z) <= half[box, 2]))
    return counts
