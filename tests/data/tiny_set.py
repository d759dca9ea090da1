"""A hand-made data set in the TruckScenes layout, small and analytic: a truck on a circle among known points."""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lzf
import numpy as np
from PIL import Image

from src.data.cache import load_index
from src.data.reader import FrameReader, ReaderSettings
from src.data.sensor_files import OnBadFile
from src.data.timeline import RadialSpeeds, TimelineConfig
from src.geometry.camera import pixels_from_points
from src.geometry.transforms import invert_rigid, matrix_to_quaternion, rigid
from src.structures.taxonomy import ATTRIBUTES, BICYCLE_RACK, CAMERAS, CATEGORY_TO_CLASS, IGNORED_CATEGORIES, RADARS

VERSION = "v1.2-trainval"
IMAGE_PX = (114, 240)  # height, width
SPEED_MPS, YAW_RATE = 20.0, 0.2
START_S = 1_695_473_000.0
ORIGIN = np.array([691_000.0, 5_334_000.0, 0.0])
TARGET_VELOCITY = np.array([14.0, 9.0, 0.0])  # global
STATIC = ORIGIN + np.random.default_rng(3).uniform([-80, -80, 0], [80, 80, 6], size=(20, 3))
BLOB = ORIGIN + np.array([36.0, 17.0, 1.5])  # seen by both front cameras of the first frames


def project(
    points: np.ndarray,  # [..., 3] m, source frame
    pix_from_src: np.ndarray,  # [4, 4] as from pixels_from_points
) -> tuple[np.ndarray, np.ndarray]:  # [..., 2] pixels (u, v), [...] depth d in m along the optical axis
    """Pixels and depths of points; behind the camera (d <= 0) the pixels mean nothing."""
    homogeneous = points @ pix_from_src[:3, :3].T + pix_from_src[:3, 3]
    depth = homogeneous[..., 2]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return homogeneous[..., :2] / safe[..., None], depth


def token(*names: object) -> str:
    return hashlib.md5("/".join(map(str, names)).encode()).hexdigest()


def rotation(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    matrix, i, j = np.eye(3), (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def ego_pose(time_s: float) -> np.ndarray:
    """global_from_ego on the circle; z and tilt are not zero, so that 3D mistakes show."""
    heading = 0.3 + YAW_RATE * (time_s - START_S)
    radius = SPEED_MPS / YAW_RATE
    tilt = rotation(1, 0.03) @ rotation(0, -0.02)
    centre = ORIGIN + radius * np.array([-np.sin(0.3), np.cos(0.3), 0.0])
    return rigid(rotation(2, heading) @ tilt, centre + radius * np.array([np.sin(heading), -np.cos(heading), 0.0]))


def mount(channel: str) -> np.ndarray:
    """ego_from_sensor; RADAR_RIGHT_BACK is upside down, as on the truck."""
    side = 1 if "LEFT" in channel else -1
    front = "FRONT" in channel
    if channel.startswith("CAMERA"):
        axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # optical axes in ego axes
        return rigid(rotation(2, side * (0.15 if front else 2.6)) @ axes, [4.0, side * 1.1, 2.1])
    yaw = side * {"FRONT": 0.34, "SIDE": 1.6, "BACK": 2.5}.get(channel.rsplit("_", 1)[1], 0.0)
    turned = rotation(0, np.pi) if channel == "RADAR_RIGHT_BACK" else rotation(1, 0.02)
    return rigid(rotation(2, yaw) @ turned, [5.1, side * 1.3, 2.0])


LIDAR_CHANNELS = ("LIDAR_LEFT", "LIDAR_REAR")
LIDAR_STEP_US = 5_000
"""Between two points of a sweep, whose tenth is measured at the sweep's own time."""


def lidar_cloud(time_us: int, channel: str) -> tuple[np.ndarray, np.ndarray]:  # [20, 4], [20] us
    """Every static point where a LiDAR sees it that has driven on since the point before."""
    times_us = time_us + LIDAR_STEP_US * np.arange(-10, len(STATIC) - 10)
    points = []
    for number, (place, stamp) in enumerate(zip(STATIC, times_us, strict=True)):
        sensor_from_global = invert_rigid(ego_pose(1e-6 * stamp) @ mount(channel))
        points.append([*(sensor_from_global[:3, :3] @ place + sensor_from_global[:3, 3]), number])
    return np.array(points), times_us


def lidar_bytes(points: np.ndarray, times_us: np.ndarray) -> bytes:
    """A compressed LiDAR file, by the compressor that other writers use."""
    kind = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "intensity")), ("timestamp", "<u8")])
    columns = [*np.asarray(points, dtype="<f4").T, np.asarray(times_us).astype("<u8")]
    data = b"".join(column.tobytes() for column in columns)
    packed = lzf.compress(data, 2 * len(data) + 100) if data else b""
    sizes = " ".join(str(kind[name].itemsize) for name in kind.names)
    n = len(points)
    header = (
        f"VERSION 0.7\nFIELDS {' '.join(kind.names)}\nSIZE {sizes}\nTYPE F F F F U\nCOUNT 1 1 1 1 1\nWIDTH {n}\n"
        f"HEIGHT 1\nVIEWPOINT 0.0 0.0 0.0 1.0 0.0 0.0 0.0\nPOINTS {n}\nDATA binary_compressed\n"
    )
    return header.encode() + struct.pack("<II", len(packed), len(data)) + packed


INTRINSICS = np.array([[130.0, 0.0, 121.0], [0.0, 130.0, 60.0], [0.0, 0.0, 1.0]])


def camera_image(time_s: float, channel: str) -> Image.Image:
    """Dark picture with one soft bright spot where BLOB is."""
    cam_from_global = invert_rigid(ego_pose(time_s) @ mount(channel))
    (u, v), depth = project(BLOB, pixels_from_points(INTRINSICS, cam_from_global))
    y, x = np.mgrid[: IMAGE_PX[0], : IMAGE_PX[1]] + 0.5
    spot = np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18) if depth > 1 else np.zeros(IMAGE_PX)
    return Image.fromarray((np.stack([spot, spot, 0 * spot], -1) * 250).astype(np.uint8))


def radar_cloud(time_s: float, channel: str) -> np.ndarray:  # [21, 7]
    """Every static point and one moving target, with the analytic Doppler of a sensor on the moving truck."""
    global_from_ego = ego_pose(time_s)
    global_from_sensor = global_from_ego @ mount(channel)
    rate = np.array([0.0, 0.0, YAW_RATE])  # global axes
    heading = 0.3 + YAW_RATE * (time_s - START_S)
    velocity = SPEED_MPS * np.array([np.cos(heading), np.sin(heading), 0.0])
    sensor_velocity = velocity + np.cross(rate, global_from_sensor[:3, 3] - global_from_ego[:3, 3])
    target = ORIGIN + [40, 20, 1] + TARGET_VELOCITY * ((time_s - START_S) % 10)
    positions = np.concatenate([STATIC, target[None]])
    velocities = np.concatenate([np.zeros_like(STATIC), TARGET_VELOCITY[None]]) - sensor_velocity
    points = (positions - global_from_sensor[:3, 3]) @ global_from_sensor[:3, :3]
    unit = points / np.linalg.norm(points, axis=1, keepdims=True)
    radial = ((velocities @ global_from_sensor[:3, :3]) * unit).sum(1, keepdims=True) * unit
    rcs = np.arange(len(points))[:, None]
    return np.concatenate([points, radial, rcs], axis=1)


def pcd_bytes(points: np.ndarray, fields: str = "x y z vrel_x vrel_y vrel_z rcs", data: str = "binary") -> bytes:
    n, width = len(points), len(fields.split())
    header = [
        "VERSION 0.7", f"FIELDS {fields}", "SIZE" + " 4" * width, "TYPE" + " F" * width, "COUNT" + " 1" * width,
        f"WIDTH {n}", "HEIGHT 1", "VIEWPOINT 0.0 0.0 0.0 1.0 0.0 0.0 0.0", f"POINTS {n}", f"DATA {data}",
    ]  # fmt: skip
    body = points.astype("<f4").tobytes()
    if data == "ascii":
        body = "".join(" ".join(f"{v:.9g}" for v in row) + "\n" for row in points).encode()
    return ("\n".join(header) + "\n").encode() + body


class Writer:
    """Collects tables and writes sensor files."""

    def __init__(self, root: Path) -> None:
        self.root, self.tables, self.lidars = root, {}, ()

    def add(self, table: str, key: str, **fields: Any) -> str:
        self.tables.setdefault(table, []).append({"token": token(table, key), **fields})
        return token(table, key)

    def pose(self, time_us: int) -> str:
        matrix = ego_pose(1e-6 * time_us)
        known = {record["token"] for record in self.tables.get("ego_pose", [])}
        if token("ego_pose", time_us) in known:
            return token("ego_pose", time_us)
        return self.add("ego_pose", time_us, timestamp=time_us, translation=matrix[:3, 3].tolist(),
                        rotation=matrix_to_quaternion(matrix[:3, :3]).tolist())  # fmt: skip


def write_data_set(root: Path, lidar: bool = False) -> None:
    """Two scenes (train, val) of three key frames, ten radar sweeps between them, four cameras, perhaps two LiDARs.

    Without LiDAR there are the records of the key frames of LIDAR_LEFT, which place the frames.
    """
    writer = Writer(root)
    writer.lidars = LIDAR_CHANNELS if lidar else ()
    add = writer.add
    for name in ATTRIBUTES:
        add("attribute", name, name=name, description="")
    for index, name in enumerate((*CATEGORY_TO_CLASS, *IGNORED_CATEGORIES)):
        add("category", name, name=name, description="", index=index)
    for level in range(1, 5):
        add("visibility", level, level=level, description="")
    for channel in (*CAMERAS, *RADARS, *(writer.lidars or ("LIDAR_LEFT",))):
        matrix = mount(channel)
        sensor = add("sensor", channel, channel=channel, modality=channel.split("_")[0].lower())
        add("calibrated_sensor", channel, sensor_token=sensor, translation=matrix[:3, 3].tolist(),
            rotation=matrix_to_quaternion(matrix[:3, :3]).tolist(),
            camera_intrinsic=INTRINSICS.tolist() if channel in CAMERAS else [])  # fmt: skip
    for number, split in enumerate(("train", "val")):
        write_scene(writer, number, split)
    for name in ("ego_motion_cabin", "ego_motion_chassis", "weather_annotation"):
        add(name, 0, timestamp=int(START_S * 1e6))
    folder = root / VERSION
    folder.mkdir(parents=True)
    for name, records in writer.tables.items():
        (folder / f"{name}.json").write_text(json.dumps(records))
    (root / "splits.json").write_text(json.dumps({"train": ["scene-train-0"], "val": ["scene-val-0"]}))


def write_scene(writer: Writer, number: int, split: str) -> None:
    base = int((START_S + 10 * number) * 1e6)
    keys = [base + 500_000 * k for k in range(3)]
    names = [f"{split}-{k}" for k in range(3)]
    links = ["", *(token("sample", name) for name in names), ""]
    for k, name in enumerate(names):
        writer.add("sample", name, timestamp=keys[k], scene_token=token("scene", split), prev=links[k],
                   next=links[k + 2])  # fmt: skip
    writer.add("scene", split, name=f"scene-{split}-0", description="weather.clear;area.highway", log_token="",
               nbr_samples=3, first_sample_token=links[1], last_sample_token=links[3],
               weather_annotation_token="")  # fmt: skip
    for step in range(-60, 115, 5):  # 100 Hz would be finer; 20 Hz keeps the fixture small
        writer.pose(base + step * 10_000)
    for order, channel in enumerate((*CAMERAS, *RADARS, *(writer.lidars or ("LIDAR_LEFT",)))):
        radar, swept = channel in RADARS, channel in writer.lidars
        # Radar key frames lie up to 7 ms beside the sample, the first one after it.
        shift = 0 if channel == "LIDAR_LEFT" else 19_000 - 3_000 * order
        stamps = [base + 50_000 * j + shift for j in range(-10 if radar or swept else 0, 21)]
        stamps = [t for t in stamps if radar or (t - base - shift) % (100_000 if swept else 500_000) == 0]
        tokens = ["", *(token("sample_data", channel, t) for t in stamps), ""]
        for j, stamp in enumerate(stamps):
            key = stamp >= base + shift and (stamp - base - shift) % 500_000 == 0
            write_file(writer, channel, stamp, key, tokens[j], tokens[j + 2],
                       names[max(0, -((base + shift - stamp) // 500_000))])  # fmt: skip
    write_boxes(writer, split, names)


def write_file(writer: Writer, channel: str, stamp: int, key: bool, prev: str, following: str, sample: str) -> None:
    camera = channel in CAMERAS
    suffix = "jpg" if camera else "pcd"
    name = f"{'samples' if key else 'sweeps'}/{channel}/{channel}_{stamp}.{suffix}"
    path = writer.root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if camera:
        camera_image(1e-6 * stamp, channel).save(path, quality=95)
    elif channel in RADARS:
        path.write_bytes(pcd_bytes(radar_cloud(1e-6 * stamp, channel)))
    elif channel in writer.lidars:
        path.write_bytes(lidar_bytes(*lidar_cloud(stamp, channel)))
    writer.tables.setdefault("sample_data", []).append(
        {
            "token": token("sample_data", channel, stamp), "sample_token": token("sample", sample),
            "ego_pose_token": writer.pose(stamp), "calibrated_sensor_token": token("calibrated_sensor", channel),
            "timestamp": stamp, "fileformat": suffix, "is_key_frame": key, "filename": name,
            "height": IMAGE_PX[0] if camera else 1, "width": IMAGE_PX[1] if camera else 21,
            "prev": prev, "next": following,
        }
    )  # fmt: skip


def write_boxes(writer: Writer, split: str, names: list[str]) -> None:
    """A driving car in all frames, a sign in one (no velocity), a rack, an ignored stroller; frame 2 has no more."""
    plan = [
        ("car", "vehicle.car", [0, 1, 2], "vehicle.moving", [1.9, 4.6, 1.6]),
        ("sign", "static_object.traffic_sign", [0], "traffic_sign.pole_mounted", [0.8, 0.1, 0.9]),
        ("rack", BICYCLE_RACK, [1], None, [2.0, 4.0, 1.5]),
        ("stroller", "human.pedestrian.stroller", [0, 1], None, [0.5, 0.9, 1.1]),
    ]
    for name, category, frames, attribute, size in plan:
        tokens = ["", *(token("sample_annotation", split, name, k) for k in frames), ""]
        writer.add("instance", f"{split}/{name}", category_token=token("category", category),
                   nbr_annotations=len(frames), first_annotation_token=tokens[1],
                   last_annotation_token=tokens[-2])  # fmt: skip
        for at, k in enumerate(frames):
            centre = ORIGIN + [30.0, -8.0, 1.0] + 0.5 * k * TARGET_VELOCITY
            turn = matrix_to_quaternion(rotation(2, 2.1))
            writer.add("sample_annotation", f"{split}/{name}/{k}", sample_token=token("sample", names[k]),
                       instance_token=token("instance", f"{split}/{name}"),
                       attribute_tokens=[token("attribute", attribute)] if attribute else [],
                       visibility_token=token("visibility", 4) if k else "", translation=centre.tolist(), size=size,
                       rotation=turn.tolist(), num_lidar_pts=5, num_radar_pts=k,
                       prev=tokens[at], next=tokens[at + 2])  # fmt: skip
            writer.tables["sample_annotation"][-1]["token"] = tokens[at + 1]


@dataclass
class DataSet:
    """A writable copy: break something, then open it."""

    root: Path

    def table(self, name: str) -> Path:
        return self.root / VERSION / f"{name}.json"

    def edit(self, table: str, row: int, /, **fields: Any) -> dict[str, Any]:
        records = json.loads(self.table(table).read_text())
        records[row].update(fields)
        self.table(table).write_text(json.dumps(records))
        return records[row]

    def records(self, name: str) -> list[dict[str, Any]]:
        return json.loads(self.table(name).read_text())

    def reader(self, **settings: Any) -> FrameReader:
        return FrameReader(load_index(self.root, VERSION, None), reader_settings(**settings))


FIVE_HERTZ = TimelineConfig(
    interval_s=0.2, tolerance_s=0.06, history_stride=1, horizon_s=3.0, num_past_targets=1,
    scored_frames=1, score_stride=1, scored_rays=100, radial_speeds=RadialSpeeds.none,
)  # fmt: skip


def reader_settings(**changes: Any) -> ReaderSettings:
    values = dict(num_sweeps=10, min_distance_m=1.0, propagate_points=False, on_bad_file=OnBadFile.error,
                  image_size_px=(64, 160), test_resize_offset=0.0, num_lidar_sweeps=0, lidar_origins=False,
                  deskew_lidar=True, timeline=None, num_future_frames=0)  # fmt: skip
    return ReaderSettings(**(values | changes))
