"""One key frame of a written world as plain arrays, read back from its files for a picture."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from src.errors import DataError
from src.geometry.transforms import pose_matrix, quaternion_to_matrix, yaw_of
from src.structures.taxonomy import CAMERAS, CATEGORY_TO_CLASS, CLASSES, RADARS, REFERENCE_CHANNEL
from src.world.table_rows import Row
from src.world.write import VERSION

Array = np.ndarray

SWEEPS = 3


@dataclass(kw_only=True)
class PreviewFrame:
    """What a picture of one key frame shows, in the ego frame of LIDAR_LEFT."""

    title: str
    images: list[Array]  # of CAMERAS, [H, W, 3] uint8
    pix_from_ego: Array  # [4, 4, 4], rows 0-2 of each: ego metres -> (u*d, v*d, d)
    centers: Array  # [K, 3] m
    sizes: Array  # [K, 3] m (length, width, height)
    yaws: Array  # [K] rad
    velocities: Array  # [K, 2] m/s, NaN where unknown
    labels: Array  # [K] index into CLASSES
    radar_points: Array  # [P, 7] x, y, z (m), rcs (dB), vx, vy (m/s, compensated, radial), dt (s)


def _matrix(row: Row) -> Array:
    return pose_matrix(row["rotation"], row["translation"])


class WorldPreview:
    """Reads the tables of a world once; `frames` gives one frame per scene."""

    def __init__(self, root: Path) -> None:
        self.root = Path(root)
        names = (
            "scene",
            "sample",
            "sample_data",
            "ego_pose",
            "calibrated_sensor",
            "sensor",
            "sample_annotation",
            "instance",
            "category",
        )
        try:
            tables = {
                name: json.loads((self.root / VERSION / f"{name}.json").read_text(encoding="utf-8")) for name in names
            }
        except (OSError, ValueError) as error:
            raise DataError(f"{self.root}: no world to draw: {error}") from error
        self.rows = {name: {row["token"]: row for row in table} for name, table in tables.items()}
        self.samples: dict[str, list[Row]] = defaultdict(list)
        for row in tables["sample"]:
            self.samples[row["scene_token"]].append(row)
        self.data: dict[str, list[Row]] = defaultdict(list)
        for row in tables["sample_data"]:
            self.data[row["sample_token"]].append(row)
        self.annotations: dict[str, list[Row]] = defaultdict(list)
        for row in tables["sample_annotation"]:
            self.annotations[row["sample_token"]].append(row)

    def frames(self, place: float = 0.5) -> Iterator[tuple[str, PreviewFrame]]:
        """Scene name and its frame at a share `place` (0 to 1) of the scene, for every scene."""
        for scene in self.rows["scene"].values():
            samples = self.samples[scene["token"]]
            yield scene["name"], self.frame(samples[round(place * (len(samples) - 1))], scene)

    def frame(self, sample: Row, scene: Row) -> PreviewFrame:
        """One key frame."""
        files = {self._channel(row): row for row in self.data[sample["token"]] if row["is_key_frame"]}
        reference = files[REFERENCE_CHANNEL]
        ego_from_global = np.linalg.inv(self._pose(reference))
        projections = [self._projection(files[name]) @ np.linalg.inv(ego_from_global) for name in CAMERAS]
        boxes = [row for row in self.annotations[sample["token"]] if self._label(row) is not None]
        turns = [ego_from_global[:3, :3] @ quaternion_to_matrix(row["rotation"]) for row in boxes]
        centres = np.array([row["translation"] for row in boxes]).reshape(-1, 3)
        velocities = np.array([self._velocity(row) for row in boxes]).reshape(-1, 3)
        width, length, height = np.array([row["size"] for row in boxes]).reshape(-1, 3).T
        sweeps = [
            self._radar_points(row, reference["timestamp"], ego_from_global)
            for row in self.data[sample["token"]]
            if self._channel(row) in RADARS and reference["timestamp"] - row["timestamp"] < SWEEPS * 50_000
        ]
        return PreviewFrame(
            title=f"{scene['name'][:14]}…  "
            + "  ".join(tag.split(".")[1] for tag in str(scene["description"]).split(";")),
            images=[np.asarray(Image.open(self.root / files[name]["filename"]).convert("RGB")) for name in CAMERAS],
            pix_from_ego=np.stack(projections),
            centers=centres @ ego_from_global[:3, :3].T + ego_from_global[:3, 3],
            sizes=np.stack([length, width, height], 1),
            yaws=np.array([yaw_of(turn) for turn in turns]),
            velocities=(velocities @ ego_from_global[:3, :3].T)[:, :2],
            labels=np.array([self._label(row) for row in boxes], dtype=np.int64),
            radar_points=np.concatenate(sweeps) if sweeps else np.zeros((0, 7)),
        )

    def _calibration(self, row: Row) -> Row:
        return self.rows["calibrated_sensor"][row["calibrated_sensor_token"]]

    def _channel(self, row: Row) -> str:
        return self.rows["sensor"][self._calibration(row)["sensor_token"]]["channel"]

    def _pose(self, row: Row) -> Array:
        return _matrix(self.rows["ego_pose"][row["ego_pose_token"]])

    def _projection(self, row: Row) -> Array:
        """[4, 4] pixels from global."""
        pix_from_cam = np.eye(4)
        pix_from_cam[:3, :3] = self._calibration(row)["camera_intrinsic"]
        return pix_from_cam @ np.linalg.inv(self._pose(row) @ _matrix(self._calibration(row)))

    def _label(self, row: Row) -> int | None:
        category = self.rows["category"][self.rows["instance"][row["instance_token"]]["category_token"]]["name"]
        klass = CATEGORY_TO_CLASS.get(category)
        return None if klass is None else CLASSES.index(klass)

    def _velocity(self, row: Row) -> Array:
        """Finite difference between the neighbouring annotations, m/s; NaN where there is none."""
        annotations = self.rows["sample_annotation"]
        before, after = annotations.get(row["prev"], row), annotations.get(row["next"], row)
        times = [self.rows["sample"][r["sample_token"]]["timestamp"] for r in (before, after)]
        if times[0] == times[1]:
            return np.full(3, np.nan)
        return (np.array(after["translation"]) - np.array(before["translation"])) / ((times[1] - times[0]) * 1e-6)

    def _radar_points(self, row: Row, reference_us: int, ego_from_global: Array) -> Array:
        """[P, 7] of one sweep; the sensor's own motion is taken from the poses before and after it."""
        raw = (self.root / row["filename"]).read_bytes()
        points = np.frombuffer(raw[raw.index(b"DATA binary\n") + 12 :], "<f4").reshape(-1, 7).astype(np.float64)
        global_from_sensor = self._pose(row) @ _matrix(self._calibration(row))
        neighbours = [self.rows["sample_data"].get(row[name], row) for name in ("prev", "next")]
        ends = [(self._pose(n) @ _matrix(self._calibration(n)))[:3, 3] for n in neighbours]
        elapsed = max((neighbours[1]["timestamp"] - neighbours[0]["timestamp"]) * 1e-6, 1e-3)
        sight = points[:, :3] @ global_from_sensor[:3, :3].T
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        range_rate = (points[:, 3:6] @ global_from_sensor[:3, :3].T * sight).sum(1) + sight @ (
            (ends[1] - ends[0]) / elapsed
        )
        dst = ego_from_global @ global_from_sensor
        moved = points[:, :3] @ dst[:3, :3].T + dst[:3, 3]
        velocity = (range_rate[:, None] * sight) @ ego_from_global[:3, :3].T
        age = np.full((len(points), 1), (reference_us - row["timestamp"]) * 1e-6)
        return np.concatenate([moved, points[:, 6:], velocity[:, :2], age], 1)


def radar_in_sensor_frame(root: Path, channel: str, limit: int) -> list[Array]:
    """The first `limit` key sweeps [n, 7] of a channel as stored, for comparison with a real file."""
    files = sorted((Path(root) / "samples" / channel).glob("*.pcd"))[:limit]
    blobs = (path.read_bytes() for path in files)
    return [
        np.frombuffer(raw[raw.index(b"DATA binary\n") + 12 :], "<f4").reshape(-1, 7).astype(np.float64) for raw in blobs
    ]
