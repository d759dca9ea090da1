"""What a synthetic world is made of; the values live in `conf/data/synthetic.yaml`."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass

from src.errors import ConfigError

GENERATOR = "highway-3"
"""Changes whenever the same config would give other bytes, so that old worlds are not mistaken for new ones."""

LIDAR_GENERATOR = "lidar-3"
"""As GENERATOR, for what is written only with `lidar`; worlds without LiDAR keep their digest."""

RADAR_RATE_HZ = 20
CAMERA_RATE_HZ = 10
LIDAR_RATE_HZ = 10
KEY_FRAME_RATE_HZ = 2

LIMITS = {
    "num_train_scenes": (0, math.inf),
    "num_val_scenes": (0, math.inf),
    "key_frames_per_scene": (1, 60),
    "seed": (0, math.inf),
    "num_workers": (0, math.inf),
    "image_width_px": (32, 8192),
    "image_height_px": (32, 8192),
    "camera_fov_deg": (10.0, 150.0),
    "jpeg_quality": (1, 95),
    "radar_sweeps_per_key_frame": (1, RADAR_RATE_HZ // KEY_FRAME_RATE_HZ),
    "radar_reach_m": (10.0, 1000.0),
    "returns_density": (0.0, 100_000.0),
    "scattering_centres": (1, 100),
    "scatter_m": (0.0, 10.0),
    "gain_db": (0.0, 40.0),
    "gain_s": (0.001, math.inf),
    "past_occluder": (0.0, 1.0),
    "clutter_density": (0.0, 100.0),
    "tarmac_returns": (0.0, 1000.0),
    "ghost_fraction": (0.0, 1.0),
    "mirror_fraction": (0.0, 1.0),
    "false_alarms_per_sweep": (0.0, 1000.0),
    "aliased_fraction": (0.0, 1.0),
    "doppler_span_mps": (1.0, 1000.0),
    "range_noise_m": (0.0, math.inf),
    "azimuth_noise_deg": (0.0, math.inf),
    "elevation_noise_deg": (0.0, math.inf),
    "doppler_noise_mps": (0.0, math.inf),
    "mount_error_deg": (0.0, 10.0),
    "outage_fraction": (0.0, 0.9),
    "soiled_fraction": (0.0, 1.0),
    "vehicles_per_lane_km": (0.0, 40.0),
    "least_radius_m": (200.0, math.inf),
    "screened_fraction": (0.0, 1.0),
    "rare_objects": (0.0, 10.0),
    "annotation_range_m": (1.0, 250.0),
    "lidar_sweeps_per_key_frame": (1, LIDAR_RATE_HZ // KEY_FRAME_RATE_HZ),
    "lidar_step_deg": (0.05, 10.0),
    "ego_rate_hz": (1, 1000),
}
"""The least and the largest value of every number."""


@dataclass(kw_only=True)
class WorldConfig:
    """Size, sensors and difficulty of a world. Raises ConfigError for values that cannot be simulated."""

    num_train_scenes: int  # scenes of the split "train"
    num_val_scenes: int  # scenes of the split "val", on roads of their own
    key_frames_per_scene: int  # labelled frames, 2 Hz
    seed: int  # of everything random
    num_workers: int  # processes that write scenes side by side; changes no byte

    image_width_px: int  # the real cameras have 1980 x 943
    image_height_px: int
    camera_fov_deg: float  # horizontal field of view of all four cameras
    jpeg_quality: int  # 1..95
    camera_sweeps: bool  # also write the 10 Hz images between key frames

    radar_sweeps_per_key_frame: int  # sweeps written up to and including a key frame, 10 = all of the 20 Hz
    radar_reach_m: float  # nothing comes back from farther away
    returns_density: float  # scales the returns of objects; 1 = the real sensor's
    scattering_centres: int  # fixed places on each face of an object that returns come from
    scatter_m: float  # of these places about the label's faces, standard deviation of x and of y
    gain_db: float  # of what an object reflects over time, standard deviation
    gain_s: float  # time constant of that: within it a dropout stays one
    past_occluder: float  # share of returns that arrive past something in the way, mostly under it
    clutter_density: float  # scales the number of clutter points and of look-alikes; 1 = the real sensor's
    tarmac_returns: float  # mean number of returns of the road close by, per sweep at a clutter_density of 1
    ghost_fraction: float  # multipath copies per real return
    mirror_fraction: float  # copies behind the outer guard rail per return of something that moves
    false_alarms_per_sweep: float  # mean number of returns from nowhere
    aliased_fraction: float  # of returns whose Doppler is off by doppler_span_mps either way
    doppler_span_mps: float
    range_noise_m: float
    azimuth_noise_deg: float
    elevation_noise_deg: float  # real radars know height poorly
    doppler_noise_mps: float

    mount_error_deg: float  # standard deviation of each angle of cameras and radars about the stored calibration
    outage_fraction: float  # of the time in which a camera shows nothing, or a radar, for 0.5 to 2 s at a stretch
    soiled_fraction: float  # of scenes in which one camera is dirty

    vehicles_per_lane_km: float  # traffic density
    least_radius_m: float  # of curves
    screened_fraction: float  # of scenes with an opaque median
    rare_objects: float  # scales how many of the rare classes a scene gets
    annotation_range_m: float  # objects farther away are not labelled
    lidar: bool  # ray-cast six lidars and write the true geometry; otherwise only the empty LIDAR_LEFT key frames
    lidar_sweeps_per_key_frame: int  # sweeps written up to and including a key frame, 5 = all of the 10 Hz
    lidar_step_deg: float  # azimuth step of the ray-cast lidars
    ego_rate_hz: int  # ego_pose and ego_motion rows per second besides those of the sensors

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            if not (math.isfinite(value) and low <= value <= high):
                raise ConfigError(f"data.world.{name} must be a number from {low} to {high}, but got {value}")
        if self.num_scenes == 0:
            raise ConfigError("data.world: num_train_scenes and num_val_scenes are both 0; a world needs a scene")

    @property
    def num_scenes(self) -> int:
        """Scenes of both splits, train first."""
        return self.num_train_scenes + self.num_val_scenes

    @property
    def duration_s(self) -> float:
        """From the first to the last key frame."""
        return (self.key_frames_per_scene - 1) / KEY_FRAME_RATE_HZ


def stored_config(config: WorldConfig) -> dict[str, object]:
    """What decides the bytes of a world: the config without `num_workers`, with the generator's name."""
    values = asdict(config)
    del values["num_workers"]
    return {"generator": f"{GENERATOR}, {LIDAR_GENERATOR}" if config.lidar else GENERATOR, **values}


def world_digest(config: WorldConfig) -> str:
    """16 hex digits that name a world: equal exactly when the bytes of the world are."""
    text = json.dumps(stored_config(config), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
