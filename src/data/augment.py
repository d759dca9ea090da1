"""Image augmentation per frame and view (IDA) and BEV augmentation per frame or clip (BDA) (method 6.4, 9)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from src.data.images import ImageCrop, width_fit
from src.errors import ConfigError

Array = np.ndarray


@dataclass(kw_only=True)
class ImageAugmentationConfig:
    """IDA: drawn for every frame and view."""

    resize: list[float]  # [low, high], added to the scale that fits the width
    rotation_deg: float  # +- about the crop's centre
    flip_probability: float

    def __post_init__(self) -> None:
        _check_range("data.augmentation.image.resize", self.resize, above=-1.0)
        _check_not_negative("data.augmentation.image.rotation_deg", self.rotation_deg)
        _check_probability("data.augmentation.image.flip_probability", self.flip_probability)


@dataclass(kw_only=True)
class BevAugmentationConfig:
    """BDA: drawn for every frame, or once for a clip."""

    scale: list[float]  # [low, high]
    rotation_rad: float  # +-
    flip_probability: Any  # of x and of y, each: a number, or [of x, of y]

    def __post_init__(self) -> None:
        _check_range("data.augmentation.bev.scale", self.scale, above=0.0)
        _check_not_negative("data.augmentation.bev.rotation_rad", self.rotation_rad)
        name, given = "data.augmentation.bev.flip_probability", self.flip_probability
        if isinstance(given, list) and len(given) != 2:
            raise ConfigError(f"{name}={given}: must be one number, or [of x, of y]")
        for value in given if isinstance(given, list) else [given]:
            _check_probability(name, value)


@dataclass(kw_only=True)
class AugmentationConfig:
    """Training augmentation; null switches a part off."""

    image: ImageAugmentationConfig | None
    bev: BevAugmentationConfig | None


def frame_generator(seed: int, epoch: int, token: str) -> np.random.Generator:
    """Random numbers of one frame in one epoch: the same whatever the worker, the rank or a resume."""
    digest = hashlib.sha256(f"{seed}/{epoch}/{token}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:16], "little"))


def draw_crop(
    config: ImageAugmentationConfig,
    rng: np.random.Generator,
    source_px: tuple[int, int],  # (height, width)
    size_px: tuple[int, int],  # (height, width)
) -> ImageCrop:
    """One view's IDA."""
    offset = rng.uniform(*config.resize)
    shift = rng.uniform()
    flip = bool(rng.uniform() < config.flip_probability)
    rotation = np.deg2rad(rng.uniform(-config.rotation_deg, config.rotation_deg))
    return width_fit(source_px, size_px, offset, shift, flip, float(rotation))


def draw_bev_transform(
    config: BevAugmentationConfig,
    rng: np.random.Generator,
) -> Array:  # [4, 4] float64
    """A_t = S R F: flips first, then the rotation about z, then the uniform scale."""
    flips = rng.uniform(size=2) < config.flip_probability
    angle = rng.uniform(-config.rotation_rad, config.rotation_rad)
    scale = rng.uniform(*config.scale)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    mirror = np.diag([-1.0 if flips[0] else 1.0, -1.0 if flips[1] else 1.0, 1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation @ mirror
    return matrix


def _check_range(name: str, value: list[float], above: float) -> None:
    if len(value) != 2 or not above < value[0] <= value[1] < float("inf"):
        raise ConfigError(f"{name}={value}: must be [low, high] with {above} < low <= high, both finite")


def _check_not_negative(name: str, value: float) -> None:
    if not 0 <= value < float("inf"):
        raise ConfigError(f"{name}={value}: must be a finite number of at least 0")


def _check_probability(name: str, value: Any) -> None:
    if not (isinstance(value, int | float) and 0 <= value <= 1):
        raise ConfigError(f"{name}={value}: must lie in [0, 1]")
