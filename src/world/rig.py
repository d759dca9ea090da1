"""Where the ego truck's sensors sit and how they look: extrinsics, intrinsics and firing times of all channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.geometry.transforms import rotation_zyx
from src.structures.taxonomy import CAMERAS, LIDARS, RADARS
from src.world.world_config import WorldConfig

Array = np.ndarray

RADAR_AZIMUTH_RAD = np.radians(60.0)
RADAR_ELEVATION_RAD = np.radians(11.0)


@dataclass(frozen=True, kw_only=True)
class Beams:
    """How one kind of lidar looks around, about its own x axis."""

    half_width_rad: float
    elevations_rad: Array  # [E]
    reach_m: float  # nothing comes back from farther away; there a reflectivity of 0.1 has a chance of 0.9


LONG_BEAMS = Beams(
    half_width_rad=np.radians(135.0),
    elevations_rad=np.radians(
        np.concatenate([np.linspace(-22, -4, 16), np.linspace(-3.5, 3.5, 22), np.linspace(4.5, 10, 6)])
    ),
    reach_m=200.0,
)
SHORT_BEAMS = Beams(half_width_rad=np.radians(90.0), elevations_rad=np.radians(np.linspace(-45, 45, 32)), reach_m=35.0)
LONG_LIDARS = ("LIDAR_LEFT", "LIDAR_RIGHT")
"""The others are of the short kind: Pandar64 and Ouster OS0 on the real trucks."""
CAB_M = np.array([[3.5, -1.25, 0.6], [5.3, 1.25, 3.3]])
"""Lowest and highest corner of what the truck's own lidars do not see through, ego frame."""


@dataclass(frozen=True, kw_only=True)
class Mount:
    """One sensor: point_ego = rotation @ point_sensor + translation."""

    channel: str
    modality: str  # camera, radar, lidar or imu
    rotation: Array  # [3, 3]
    translation: Array  # [3] m
    intrinsic: Array | None  # [3, 3] px, cameras only
    delay_s: float  # from the key frame's time to this sensor's firing


# x forward, y left, z up -> x right, y down, z forward
_EGO_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

IMUS = ("XSENSE_CABIN", "XSENSE_CHASSIS")
_PLACES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float], float]] = {
    "CAMERA_LEFT_FRONT": ((5.05, 1.25, 2.12), (42.0, 1.5, 0.0), 0.008),
    "CAMERA_RIGHT_FRONT": ((5.05, -1.25, 2.12), (-42.0, 1.5, 0.0), 0.011),
    "CAMERA_RIGHT_BACK": ((4.85, -1.30, 2.10), (-138.0, 1.5, 0.0), -0.006),
    "CAMERA_LEFT_BACK": ((4.85, 1.30, 2.10), (138.0, 1.5, 0.0), -0.003),
    # Two of the six are published (RADAR_LEFT_FRONT and RADAR_RIGHT_BACK, the latter upside down); the others mirror
    # them.
    "RADAR_LEFT_FRONT": ((5.26, 1.23, 2.01), (-19.6, 0.3, 0.4), -0.011),
    "RADAR_RIGHT_FRONT": ((5.26, -1.23, 2.00), (19.4, -0.2, -0.3), 0.006),
    "RADAR_RIGHT_SIDE": ((5.12, -1.38, 2.02), (-88.0, 0.4, 0.2), -0.004),
    "RADAR_RIGHT_BACK": ((5.01, -1.40, 2.00), (-146.0, 0.2, 180.0), 0.013),
    "RADAR_LEFT_BACK": ((5.01, 1.40, 2.01), (147.0, -0.3, 0.3), -0.017),
    "RADAR_LEFT_SIDE": ((5.12, 1.38, 2.02), (89.0, 0.1, -0.4), 0.009),
    "LIDAR_LEFT": ((4.95, 1.45, 1.95), (45.0, 0.0, 0.5), 0.001),
    "LIDAR_RIGHT": ((4.95, -1.45, 1.95), (-45.0, 0.0, -0.5), 0.001),
    "LIDAR_REAR": ((-0.86, 0.0, 1.10), (180.0, 0.0, 0.0), 0.001),
    "LIDAR_TOP_FRONT": ((4.90, 0.0, 3.70), (0.0, 8.0, 0.0), 0.001),
    "LIDAR_TOP_LEFT": ((4.70, 1.10, 3.65), (90.0, 8.0, 0.0), 0.001),
    "LIDAR_TOP_RIGHT": ((4.70, -1.10, 3.65), (-90.0, 8.0, 0.0), 0.001),
    "XSENSE_CABIN": ((4.4, 0.0, 1.9), (0.0, 0.0, 0.0), 0.0),
    "XSENSE_CHASSIS": ((0.2, 0.0, 0.9), (0.0, 0.0, 0.0), 0.0),
}
"""Place (m), yaw, pitch and roll (degrees; a camera's of its optical axis) and delay (s) of each channel."""


def sensor_rig(config: WorldConfig) -> dict[str, Mount]:
    """All 18 channels by name: four cameras, six radars, six lidars, two IMUs."""
    width, height = config.image_width_px, config.image_height_px
    focal = 0.5 * width / np.tan(0.5 * np.radians(config.camera_fov_deg))
    # The optical axis meets the middle of the image, pixel centres lie at halves.
    intrinsic = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    mounts = {}
    for modality, channels in (("camera", CAMERAS), ("radar", RADARS), ("lidar", LIDARS), ("imu", IMUS)):
        for channel in channels:
            place, angles_deg, delay_s = _PLACES[channel]
            rotation = rotation_zyx(*np.radians(angles_deg))
            mounts[channel] = Mount(
                channel=channel,
                modality=modality,
                rotation=rotation @ _EGO_FROM_OPTICAL if modality == "camera" else rotation,
                translation=np.array(place),
                intrinsic=intrinsic if modality == "camera" else None,
                delay_s=delay_s,
            )
    return mounts
