"""Writes the sensor files of one scene and returns its table rows."""

from __future__ import annotations

import io
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np
from PIL import Image

from src.geometry.transforms import matrix_to_quaternion, yaw_of
from src.structures.taxonomy import CAMERAS, LIDARS, RADARS, REFERENCE_CHANNEL
from src.world.camera_render import Studio
from src.world.catalogue import attribute_of
from src.world.labels import (
    FrameTruth,
    count_points,
    estimate_lidar_points,
    frame_truth,
    labelled,
    visibility_level,
)
from src.world.lidar import Lidars
from src.world.motion import LEAD_IN_S
from src.world.pcd_writer import LIDAR_TYPE, lidar_pcd, radar_pcd
from src.world.radar import Radars
from src.world.rig import Mount, sensor_rig
from src.world.scenery import make_scenery
from src.world.sensor_faults import SensorFaults
from src.world.simulate import Scene, make_scene, scene_rng
from src.world.solid import true_geometry
from src.world.table_rows import Row, Tables, link_chain, link_sensors, rounded, token
from src.world.world_config import (
    CAMERA_RATE_HZ,
    KEY_FRAME_RATE_HZ,
    LIDAR_RATE_HZ,
    RADAR_RATE_HZ,
    WorldConfig,
)

Array = np.ndarray

EPOCH_US = 1_695_000_000_000_000
SCENE_GAP_US = 3_600_000_000
JITTER_S = 0.0015
CAMERA_SWEEPS = CAMERA_RATE_HZ // KEY_FRAME_RATE_HZ


class SceneWriter:
    """One scene on its way to disk. `write()` does everything; the other methods are its steps."""

    def __init__(self, config: WorldConfig, index: int, folder: Path) -> None:
        self.config, self.index, self.folder = config, index, folder
        self.rig = sensor_rig(config)
        self.scene: Scene = make_scene(config, index)
        scene = self.scene
        at_start = np.stack([scene.tracks.s[:, 0], scene.tracks.d[:, 0]], 1)
        scenery_rng = scene_rng(config, index, 1)
        reach = float(scene.ego.tracks.s[0, -1])
        self.scenery = make_scenery(config, scene.road, scene.actors, at_start, reach, scenery_rng)
        self.studio = Studio(
            scene, self.scenery, config.image_width_px, config.image_height_px, scene_rng(config, index, 2)
        )
        self.clock = scene_rng(config, index, 3)
        self.start_us = EPOCH_US + index * SCENE_GAP_US + int(self.clock.integers(0, 1_000_000_000))
        self.key_times = [
            self._quantised(k / KEY_FRAME_RATE_HZ + self._jitter()) for k in range(config.key_frames_per_scene)
        ]
        self.faults = SensorFaults(config, self.rig, scene_rng(config, index, 9))
        self.data: list[tuple[float, str, Row]] = []  # time (s), channel and row of sample_data of every file
        self.name = f"scene-{self._token('drive')}-1"

    def write(self) -> Tables:
        """Simulate, render and store the scene; returns its rows of every table."""
        key_points = self._write_radars()
        pixels = self._write_cameras()
        lidar_points = self._write_lidars()
        frames = self._truths(pixels, key_points, lidar_points)
        if self.config.lidar:
            true_geometry(self.scene, self.config.duration_s, self.start_us).write(self.folder, self.name)
        return self._annotation_tables(frames) | self._sample_tables() | self._motion_tables()

    def _token(self, *parts: object) -> str:
        return token(self.config.seed, "scene", self.index, *parts)

    def _quantised(self, time_s: float) -> float:
        return round(time_s * 1e6) / 1e6

    def _jitter(self) -> float:
        return float(np.clip(self.clock.normal(0, JITTER_S / 2), -JITTER_S, JITTER_S))

    def _stamp(self, time_s: float) -> int:
        return self.start_us + round(time_s * 1e6)

    def _store(self, channel: str, frame: int, is_key: bool, time_s: float, content: bytes, points: int = 0) -> None:
        """Write what a sensor gives at a time, for a key frame, and keep its row; `points` only of point clouds."""
        camera, stamp = channel in CAMERAS, self._stamp(time_s)
        ending = "jpg" if camera else "pcd"
        filename = f"{'samples' if is_key else 'sweeps'}/{channel}/{channel}_{stamp}.{ending}"
        (self.folder / filename).write_bytes(content)
        row: Row = {
            "token": self._token("data", channel, stamp),
            "sample_token": self._token("sample", frame),
            "ego_pose_token": self._token("pose", stamp),
            "calibrated_sensor_token": token(self.config.seed, "calibration", channel),
            "timestamp": stamp,
            "fileformat": ending,
            "is_key_frame": is_key,
            "width": self.config.image_width_px if camera else points,
            "height": self.config.image_height_px if camera else 1,
            "filename": filename,
        }
        self.data.append((time_s, channel, row))

    def _firings(self, rate_hz: int, sweeps: int) -> Iterator[tuple[int, bool, float]]:
        """Key frame, whether it is the key frame itself, and time of a sensor's sweeps, those before it first."""
        for frame, key_time in enumerate(self.key_times):
            for back in range(sweeps - 1, -1, -1):
                yield frame, back == 0, key_time if back == 0 else frame / KEY_FRAME_RATE_HZ - back / rate_hz

    def _write_radars(self) -> list[Array]:
        """All radar sweeps; returns the points of each key frame in local coordinates."""
        mounts = [self.rig[name] for name in RADARS]
        really = [self.faults.mounts[name] for name in RADARS]
        radars = Radars(self.config, self.scene, self.scenery, really, scene_rng(self.config, self.index, 4))
        key_points = []
        for frame, is_key, base in self._firings(RADAR_RATE_HZ, self.config.radar_sweeps_per_key_frame):
            times = [self._quantised(base + m.delay_s + self._jitter()) for m in mounts]
            sweeps = [
                points[: 0 if self.faults.is_out(mount.channel, time) else None]
                for mount, time, points in zip(mounts, times, radars.sweep(times), strict=True)
            ]
            for mount, time, points in zip(mounts, times, sweeps, strict=True):
                self._store(mount.channel, frame, is_key, time, radar_pcd(points), len(points))
            if is_key:
                here = [
                    self._to_local(mount, points[:, :3], np.full(len(points), time))
                    for mount, time, points in zip(mounts, times, sweeps, strict=True)
                ]
                key_points.append(np.concatenate(here))
        return key_points

    def _write_cameras(self) -> list[tuple[Array, Array]]:
        """All images; returns each actor's own and seen pixels over all cameras of each key frame."""
        rng = scene_rng(self.config, self.index, 5)
        pixels = []
        for frame, is_key, base in self._firings(CAMERA_RATE_HZ, CAMERA_SWEEPS if self.config.camera_sweeps else 1):
            photos = []
            for name in CAMERAS:
                mount = self.faults.mounts[name]
                time = self._quantised(base + mount.delay_s + self._jitter())
                photo = self.studio.photograph(mount, time, rng)
                dark = self.faults.is_out(name, time)
                shown = np.zeros_like(photo.rgb) if dark else self.faults.soil(name, photo.rgb)
                buffer = io.BytesIO()
                Image.fromarray(shown).save(buffer, "JPEG", quality=self.config.jpeg_quality)
                self._store(name, frame, is_key, time, buffer.getvalue())
                photos.append(photo)
            if is_key:
                pixels.append((sum(photo.own_pixels for photo in photos), sum(photo.seen_pixels for photo in photos)))
        return pixels

    def _write_lidars(self) -> list[Array] | None:
        """All sweeps of six lidars, or empty key frames of LIDAR_LEFT; returns, if scanned, the points of each key
        frame in local coordinates.
        """
        mounts = [self.rig[name] for name in LIDARS]
        lidars = Lidars(self.config, self.scene, mounts, scene_rng(self.config, self.index, 6))
        sweeps = self.config.lidar_sweeps_per_key_frame if self.config.lidar else 1
        points = []
        for frame, is_key, base in self._firings(LIDAR_RATE_HZ, sweeps):
            time = self._quantised(base + self.rig[REFERENCE_CHANNEL].delay_s)
            clouds = {REFERENCE_CHANNEL: np.zeros(0, dtype=LIDAR_TYPE)}
            if self.config.lidar:
                clouds = lidars.sweep(time, self._stamp(time))
            for name, cloud in clouds.items():
                self._store(name, frame, is_key, time, lidar_pcd(cloud), len(cloud))
            if is_key:
                here = []
                for name, cloud in clouds.items():
                    xyz = np.stack([cloud["x"], cloud["y"], cloud["z"]], 1)
                    own_times = 1e-6 * (cloud["timestamp"].astype(np.int64) - self.start_us)
                    here.append(self._to_local(self.rig[name], xyz, own_times))
                points.append(np.concatenate(here))
        return points if self.config.lidar else None

    def _to_local(self, mount: Mount, points: Array, times_s: Array) -> Array:
        """Each point [P, 3] of a sensor by the ego pose at its own time."""
        moments, which = np.unique(times_s, return_inverse=True)
        rotations, translations = self.scene.ego.poses(moments)
        in_ego = points.astype(np.float64) @ mount.rotation.T + mount.translation
        return np.einsum("pij,pj->pi", rotations[which], in_ego) + translations[which]

    def _truths(
        self, pixels: list[tuple[Array, Array]], radar: list[Array], lidar: list[Array] | None
    ) -> list[FrameTruth]:
        rng = scene_rng(self.config, self.index, 7)
        sizes = self.scene.sizes
        frames = []
        for k, time in enumerate(self.key_times):
            truth = frame_truth(self.scene, time, *pixels[k])
            truth.radar_points = count_points(truth, sizes, radar[k])
            if lidar is None:
                truth.lidar_points = estimate_lidar_points(truth, sizes, self.scene.ego.pose(time)[1], rng)
            else:
                truth.lidar_points = count_points(truth, sizes, lidar[k])
            frames.append(truth)
        return frames

    def _annotation_tables(self, frames: list[FrameTruth]) -> Tables:
        """sample_annotation and instance."""
        seed, scene = self.config.seed, self.scene
        present = labelled(self.config, scene, frames)
        annotations: list[Row] = []
        instances: list[Row] = []
        for n in np.flatnonzero(present.any(0)):
            actor, own_rows = scene.actors[n], []
            for k in np.flatnonzero(present[:, n]):
                truth = frames[k]
                attribute = attribute_of(
                    actor.kind, float(truth.speeds[n]), has_rider=actor.has_rider, parked=actor.parked
                )
                level = visibility_level(int(truth.own_pixels[n]), int(truth.seen_pixels[n]))
                half = 0.5 * truth.yaws[n]
                length, width, height = actor.size
                own_rows.append(
                    {
                        "token": self._token("annotation", n, k),
                        "sample_token": self._token("sample", k),
                        "instance_token": self._token("instance", n),
                        "attribute_tokens": [] if attribute is None else [token(seed, "attribute", attribute)],
                        "visibility_token": token(seed, "visibility", level),
                        "translation": rounded(truth.centres[n] + scene.utm_offset, 4),
                        "size": rounded(np.array([width, length, height]), 4),
                        "rotation": rounded(np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), 12),
                        "num_lidar_pts": max(1, int(truth.lidar_points[n])),  # as every label of the released data
                        "num_radar_pts": int(truth.radar_points[n]),
                    }
                )
            link_chain(own_rows)
            annotations += own_rows
            instances.append(
                {
                    "token": self._token("instance", n),
                    "category_token": token(seed, "category", actor.kind.category),
                    "nbr_annotations": len(own_rows),
                    "first_annotation_token": own_rows[0]["token"],
                    "last_annotation_token": own_rows[-1]["token"],
                }
            )
        order = {self._token("sample", k): k for k in range(len(frames))}
        annotations.sort(key=lambda row: order[str(row["sample_token"])])
        return {"sample_annotation": annotations, "instance": instances}

    def _sample_tables(self) -> Tables:
        """scene, sample, sample_data, ego_pose and weather_annotation."""
        scene = self.scene
        samples: list[Row] = [
            {"token": self._token("sample", k), "timestamp": self._stamp(time), "scene_token": self._token()}
            for k, time in enumerate(self.key_times)
        ]
        link_chain(samples)
        data = [row for *_, row in sorted(self.data, key=itemgetter(0, 1))]
        link_sensors(data)
        times = sorted({time for time, *_ in self.data} | set(self._ego_times()))
        rotations, translations = scene.ego.poses(np.array(times))
        poses = [
            {
                "token": self._token("pose", self._stamp(time)),
                "timestamp": self._stamp(time),
                "rotation": rounded(rotation, 12),
                "translation": rounded(place, 6),
            }
            for time, rotation, place in zip(
                times, matrix_to_quaternion(rotations), translations + scene.utm_offset, strict=True
            )
        ]
        sky = scene.conditions
        weather = {
            "token": self._token("weather"),
            "precipitation": sky.precipitation_mm,
            "temperature": sky.temperature_k,
            "wind_speed": sky.wind_mps,
            "wind_direction": sky.wind_rad,
        }
        row = {
            "token": self._token(),
            "name": self.name,
            "description": sky.tags,
            "log_token": "",
            "nbr_samples": len(samples),
            "first_sample_token": samples[0]["token"],
            "last_sample_token": samples[-1]["token"],
            "weather_annotation_token": weather["token"],
        }
        rest = {"sample": samples, "sample_data": data, "ego_pose": poses, "weather_annotation": [weather]}
        return {"scene": [row], **rest}

    def _ego_times(self) -> list[float]:
        step = 1.0 / self.config.ego_rate_hz
        return [
            self._quantised(i * step)
            for i in range(-int((LEAD_IN_S - 0.1) / step), int((self.config.duration_s + 0.1) / step) + 1)
        ]

    def _motion_tables(self) -> Tables:
        """Both ego_motion tables. The chassis one reads zero speed for stretches, as in the real data."""
        times = self._ego_times()
        speed, spin = self.scene.ego.rates(np.array(times))
        accel = np.gradient(speed, np.array(times), axis=0) if len(times) > 1 else np.zeros_like(speed)
        rotations, _ = self.scene.ego.poses(np.array(times))
        pitch, roll = -np.arcsin(rotations[:, 2, 0]), np.arctan2(rotations[:, 2, 1], rotations[:, 2, 2])
        angles = np.stack([yaw_of(rotations), pitch, roll], 1)
        rng = scene_rng(self.config, self.index, 8)
        silent = np.zeros(len(times), dtype=bool)
        for _ in range(int(rng.integers(0, 4))):
            first = int(rng.integers(0, len(times)))
            silent[first : first + int(rng.uniform(0.05, 0.3) * len(times))] = True
        names = ("vx", "vy", "vz", "ax", "ay", "az", "yaw", "pitch", "roll", "roll_rate", "pitch_rate", "yaw_rate")
        tables: Tables = {}
        for table, noise in (("ego_motion_cabin", 0.02), ("ego_motion_chassis", 0.01)):
            values = np.concatenate([speed + noise * rng.standard_normal(speed.shape), accel, angles, spin], 1)
            if table == "ego_motion_chassis":
                values[silent, :2] = 0.0
            tables[table] = [
                {"token": self._token(table, i), "timestamp": self._stamp(time)}
                | dict(zip(names, rounded(row, 5), strict=True))
                for i, (time, row) in enumerate(zip(times, values, strict=True))
            ]
        return tables


def write_scene(config: WorldConfig, index: int, folder: Path) -> Tables:
    """Write the sensor files of scene `index` under `folder` (its channel folders exist) and return its table rows."""
    return SceneWriter(config, index, folder).write()
