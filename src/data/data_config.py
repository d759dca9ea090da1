"""What is read of a data set and how."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields

from src.data.augment import AugmentationConfig
from src.data.reader import ReaderOptions, ReaderSettings
from src.errors import ConfigError, require_least
from src.structures.taxonomy import SENSORS


@dataclass(kw_only=True)
class DataConfig(ReaderOptions):
    """What is read and how (`data`). Raises ConfigError for values that cannot work."""

    root: str | None  # folder of the data set; null with a world: a folder under paths.outputs
    version: str  # table folder, e.g. v1.2-trainval
    train_split: str
    train_scenes: int | None  # the first so many of it; null: all
    split: str  # what validation and evaluation read
    batch_size: int  # total over all devices; the streams when clips are streamed
    groups_per_scene: int  # sequences a scene is cut into when clips are streamed for training; method 6.4
    stream_sets: int  # at most so many sets of streams take turns when clips are streamed; 1: all streams at every step
    past_frames: int  # 0: clips are streamed; else frames are shuffled, each with so many before it (of the timeline)
    past_window_s: float | None  # frames of an evaluation are in no stream and see nothing older; null: streams
    sensor_dropout: float  # share of frames with a past that come without any sensor data
    num_workers: int  # loader processes per device
    augmentation: AugmentationConfig | None

    def __post_init__(self) -> None:
        least_values = {
            "batch_size": 1,
            "groups_per_scene": 1,
            "stream_sets": 1,
            "past_frames": 0,
            "num_workers": 0,
            "num_sweeps": 1,
            "num_lidar_sweeps": 1,
            "num_future_frames": 0,
            "min_distance_m": 0,
        }
        require_least(self, "data", least_values)
        if self.train_scenes is not None and self.train_scenes < 1:
            raise ConfigError(f"data.train_scenes={self.train_scenes}: must be at least 1, or null for all")
        if not 0 <= self.sensor_dropout < 1:
            raise ConfigError(f"data.sensor_dropout={self.sensor_dropout}: must be at least 0 and below 1")
        if self.past_window_s is not None and not (self.past_window_s > 0 and self.timeline is None):
            raise ConfigError(
                f"data.past_window_s={self.past_window_s}: must be above 0, or null for streams"
                if self.timeline is None
                else f"data.past_window_s={self.past_window_s}: is of key frames, but data.timeline says what past its "
                "frames have; leave one of them null"
            )
        if self.num_future_frames and self.timeline is None:
            raise ConfigError(
                f"data.num_future_frames={self.num_future_frames}: the future is that of data.timeline, which is null"
            )
        if not -0.5 < self.test_resize_offset < 1:
            raise ConfigError(f"data.test_resize_offset={self.test_resize_offset}: must lie between -0.5 and 1")

    def reader_settings(
        self,
        sensors: Collection[str],  # of taxonomy.SENSORS: what is read
        image_size_px: tuple[int, int] | None,  # (height, width); None for a model without images
    ) -> ReaderSettings:
        """How a frame is read. Raises ValueError for sensors that are none, or a camera without an image size."""
        if not sensors or not set(sensors) <= set(SENSORS) or ("camera" in sensors and image_size_px is None):
            raise ValueError(f"sensors must be some of {SENSORS}, a camera with its image size, but got {sensors}")
        options = {field.name: getattr(self, field.name) for field in fields(ReaderOptions)}
        if self.timeline is not None and "lidar" not in sensors:
            raise ConfigError(
                f"data.timeline: its frames hold LiDAR alone, and this model reads {list(sensors)}; set it to null"
            )
        for sensor, sweeps in (("radar", "num_sweeps"), ("lidar", "num_lidar_sweeps")):
            options[sweeps] *= sensor in sensors
        return ReaderSettings(**options, image_size_px=image_size_px if "camera" in sensors else None)
