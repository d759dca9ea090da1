"""What is read of a data set and how."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from src.data.augment import AugmentationConfig
from src.data.reader import OnBadFile, ReaderSettings
from src.errors import ConfigError, require_least
from src.structures.taxonomy import SENSORS


@dataclass(kw_only=True)
class DataConfig:
    """What is read and how (`data`). Raises ConfigError for values that cannot work."""

    root: str | None  # folder of the data set; null with a world: a folder under paths.outputs
    version: str  # table folder, e.g. v1.2-trainval
    train_split: str
    split: str  # what validation and evaluation read
    batch_size: int  # total over all devices; the streams when clips are streamed
    groups_per_scene: int  # sequences a scene is cut into when clips are streamed for training; method 6.4
    stream_sets: int  # at most so many sets of streams take turns when clips are streamed; 1: all streams at every step
    sensor_dropout: float  # share of streamed frames, never a clip's first, that come without any sensor data
    num_workers: int  # loader processes per device
    num_sweeps: int  # past sweeps of each radar
    num_lidar_sweeps: int  # past sweeps of each LiDAR
    lidar_origins: bool  # also where the ray of each LiDAR point began
    deskew_lidar: bool  # move LiDAR points by what was driven between their own times and their sweep's
    num_future_frames: int  # next key frames of the scene whose LiDAR comes along as supervision
    min_distance_m: float  # nearer points are the truck itself
    propagate_points: bool  # move points by their own radial velocity
    on_bad_file: OnBadFile
    test_resize_offset: float  # added to the image scale without augmentation
    augmentation: AugmentationConfig | None

    def __post_init__(self) -> None:
        least_values = {
            "batch_size": 1,
            "groups_per_scene": 1,
            "stream_sets": 1,
            "num_workers": 0,
            "num_sweeps": 1,
            "num_lidar_sweeps": 1,
            "num_future_frames": 0,
            "min_distance_m": 0,
        }
        require_least(self, "data", least_values)
        if not 0 <= self.sensor_dropout < 1:
            raise ConfigError(f"data.sensor_dropout={self.sensor_dropout}: must be at least 0 and below 1")
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
        return ReaderSettings(
            num_sweeps=self.num_sweeps if "radar" in sensors else 0,
            num_lidar_sweeps=self.num_lidar_sweeps if "lidar" in sensors else 0,
            lidar_origins=self.lidar_origins,
            deskew_lidar=self.deskew_lidar,
            num_future_frames=self.num_future_frames,
            min_distance_m=self.min_distance_m,
            propagate_points=self.propagate_points,
            on_bad_file=self.on_bad_file,
            image_size_px=image_size_px if "camera" in sensors else None,
            test_resize_offset=self.test_resize_offset,
        )
