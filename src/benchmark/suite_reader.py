"""suite=reader: frames per second of the reader on one core, stage by stage, beside naive implementations."""

from __future__ import annotations

import math
import resource
import statistics
import time
from collections.abc import Callable
from functools import partial
from itertools import chain, cycle, islice, repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from src.assembly import build_datamodule, data_root
from src.benchmark.timing import interleaved, milliseconds, timed_parts
from src.config import Config
from src.data import images
from src.data.augment import AugmentationConfig
from src.data.datamodule import DetectionDataModule
from src.data.frame_loader import collate
from src.data.images import width_fit
from src.data.jpeg import decoder_name
from src.data.pcd import RADAR_FIELDS, read_radar_points
from src.data.schema import CHANNELS
from src.data.sensor_files import sweeps_before
from src.data.splits import split_samples
from src.structures.taxonomy import CAMERAS, LIDARS, RADARS

Array = np.ndarray

READER_FRAMES = 60
WARM_UP_FRAMES = 4
LOADER_FRAMES = 60
COMPARISON_ROUNDS = 8
STAGES = {
    "JPEG decode": ("src.data.images:decode",),
    "resample": ("src.data.images:resample",),
    "mirror and rotate": ("src.data.images:turn",),
    "radar files": ("src.data.sensor_files:read_radar_points",),
    "radar compensation": ("src.data.point_tensors:compensate_clouds",),
    "LiDAR files": ("src.data.sensor_files:read_lidar_points",),
    "LiDAR compensation": ("src.data.point_tensors:place_sweep",),
}
"""Functions of the reader by the names under which it calls them; what is in none of them is `assembling`."""


def measure(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """CPU seconds of reading, augmenting and batching in this process, on one thread; then beside a loader's worker.

    The frames are the training split's, over and over with other draws of the augmentation, from the system's file
    cache.
    """
    torch.set_num_threads(1)
    datamodule = build_datamodule(config, data_root(config))
    samples = full_samples(datamodule)
    # A world for measurements may have fewer frames than a batch.
    config.data.batch_size = min(config.data.batch_size, len(split_samples(datamodule.index, config.data.train_split)))
    runs = {"training": config.data.augmentation, "test": None}
    measured = {name: time_frames(datamodule, samples, augmentation) for name, augmentation in runs.items()}
    settings, frame = datamodule.settings, samples[0]
    comparisons = {}
    if settings.image_size_px:
        comparisons["images of one frame"] = compare_decoding(datamodule, frame)
    if settings.num_sweeps:
        comparisons["radar files of one frame"] = compare_parsing(datamodule, frame)
    stages = [stage for stage, seconds in measured["training"].items() if stage not in ("all", "wall") and any(seconds)]
    return {
        "decoder": decoder_name(),
        "image_px": "x".join(map(str, datamodule.index.data_sizes[datamodule.index.key_data[frame, 0]][::-1])),
        "network_px": "x".join(map(str, (settings.image_size_px or (0, 0))[::-1])),
        "radar_files": len(sweep_paths(datamodule, frame, RADARS, settings.num_sweeps)),
        "lidar_files": len(sweep_paths(datamodule, frame, LIDARS, settings.num_lidar_sweeps)),
        "frames with and without augmentation": [frame_row(name, columns) for name, columns in measured.items()],
        "stages": [stage_row(stage, measured) for stage in stages],
        **comparisons,
        "loader": [loader_row(config)],
        "notes": [
            "CPU time of one thread, medians over frames; ± is the interquartile range; files come from the system's "
            "cache. A loader's worker also sends its batches: the row `loader` is a training epoch through one worker, "
            "its start included."
        ],
    }


def full_samples(datamodule: DetectionDataModule) -> list[int]:
    """Frames of the training split with as many sweeps as any has: early frames of a scene have fewer."""
    samples = [int(sample) for sample in split_samples(datamodule.index, datamodule.config.train_split)]
    settings = datamodule.settings
    read = ((RADARS, settings.num_sweeps), (LIDARS, settings.num_lidar_sweeps))
    counts = [sum(len(sweep_paths(datamodule, sample, *sweeps)) for sweeps in read) for sample in samples]
    return [sample for sample, count in zip(samples, counts, strict=True) if count == max(counts)]


def sweep_paths(datamodule: DetectionDataModule, sample: int, channels: tuple[str, ...], num_sweeps: int) -> list[str]:
    """Files of a frame's sweeps."""
    index = datamodule.index
    rows = index.key_data[sample, [CHANNELS.index(channel) for channel in channels]]
    return [str(index.root / index.filename(row)) for row in sweeps_before(index, rows, num_sweeps)]


# -------------------------------------------------------------------- stages


def time_frames(
    datamodule: DetectionDataModule, samples: list[int], augmentation: AugmentationConfig | None
) -> dict[str, list[float]]:
    """CPU seconds of every frame by stage, of `all` stages, and its `wall` seconds; a batch's collation is shared."""
    columns: dict[str, list[float]] = {stage: [] for stage in (*STAGES, "assembling", "collate", "all", "wall")}
    frames = []
    for number, sample in enumerate(islice(cycle(samples), WARM_UP_FRAMES + READER_FRAMES)):
        wall, begin = time.perf_counter(), time.process_time()
        with timed_parts(torch.nn.Module(), STAGES, time.process_time) as called:
            frames.append(datamodule.reader.read(sample, augmentation, datamodule.seed, number))
        read = time.process_time()
        if len(frames) == datamodule.config.batch_size:
            collate(frames)
            frames = []
        end, wall = time.process_time(), time.perf_counter() - wall
        seconds = dict.fromkeys(STAGES, 0.0) | called
        seconds["resample"] -= seconds["mirror and rotate"]  # which it calls
        seconds["assembling"] = read - begin - sum(seconds.values())
        seconds |= {"collate": end - read, "all": end - begin, "wall": wall}
        if number >= WARM_UP_FRAMES:
            for stage, column in columns.items():
                column.append(seconds[stage])
    columns["collate"] = [statistics.mean(columns["collate"])] * READER_FRAMES
    return columns


def frame_row(name: str, columns: dict[str, list[float]]) -> dict[str, Any]:
    """One line: how fast frames come, with or without augmentation."""
    return {
        "pipeline": name,
        "frames/s (CPU)": len(columns["all"]) / sum(columns["all"]),
        "frames/s (wall)": len(columns["wall"]) / sum(columns["wall"]),
        **milliseconds(columns["all"]),
    }


def stage_row(stage: str, measured: dict[str, dict[str, list[float]]]) -> dict[str, Any]:
    """One line: a stage's milliseconds in a frame."""
    row: dict[str, Any] = {"stage": stage}
    for name, columns in measured.items():
        row |= milliseconds(columns[stage], f"{name} ")
        row |= {f"{name} share": sum(columns[stage]) / sum(columns["all"])}
    return row


# -------------------------------------------------------------------- naive implementations


def compare(candidates: dict[str, Callable[[], Any]]) -> list[dict[str, Any]]:
    """CPU milliseconds of each candidate, timed in turns, and its share of the first one's in the same round."""
    seconds = interleaved(candidates, time.process_time, COMPARISON_ROUNDS)
    first = next(iter(seconds.values()))
    return [
        {"path": name, **milliseconds(values)}
        | {"ratio": statistics.median(b / a for a, b in zip(first, values, strict=True))}
        for name, values in seconds.items()
    ]


def compare_decoding(datamodule: DetectionDataModule, sample: int) -> list[dict[str, Any]]:
    """The frame's images without augmentation: naively by Pillow, the reader with Pillow, the reader as it is."""
    index, size_px = datamodule.index, datamodule.settings.image_size_px
    rows = [int(row) for row in index.key_data[sample, [CHANNELS.index(channel) for channel in CAMERAS]] if row >= 0]
    files = [(str(index.root / index.filename(row)), tuple(map(int, index.data_sizes[row]))) for row in rows]

    def with_decoder(decode: Callable[..., Image.Image]) -> None:
        for path, source_px in files:
            crop = width_fit(source_px, size_px, datamodule.settings.test_resize_offset)
            images.resample(decode(path, source_px, images.reduction_for(source_px, crop)), crop, source_px)

    candidates: dict[str, Callable[[], Any]] = {
        "decode, resize, crop": lambda: [naive_image(path, size_px) for path, _ in files],
        "decode at 1/2^n, resize the crop: Pillow": partial(with_decoder, partial(images.decode, fast=False)),
    }
    if not decoder_name().startswith("Pillow"):
        candidates[f"the same: {decoder_name()}"] = partial(with_decoder, images.decode)
    return compare(candidates)


def naive_image(
    path: str,
    size_px: tuple[int, int],  # (height, width)
) -> Array:  # [3, H, W] uint8
    """Everything decoded and resized, then the bottom kept."""
    with Image.open(path) as image:
        scale = size_px[1] / image.width
        whole = image.convert("RGB").resize((size_px[1], math.floor(scale * image.height)), Image.Resampling.BILINEAR)
    part = whole.crop((0, whole.height - size_px[0], whole.width, whole.height))
    return np.ascontiguousarray(np.asarray(part).transpose(2, 0, 1))


def compare_parsing(datamodule: DetectionDataModule, sample: int) -> list[dict[str, Any]]:
    """The frame's radar files: field by field, as general readers do, and as one view."""
    paths = sweep_paths(datamodule, sample, RADARS, datamodule.settings.num_sweeps)
    candidates = {
        "header and fields one by one": lambda: [fields_one_by_one(path) for path in paths],
        "known headers, one view": lambda: [read_radar_points(path) for path in paths],
    }
    return compare(candidates)


def fields_one_by_one(path: str) -> Array:  # [n, 7] float32
    """A binary file read as general readers of the format do."""
    content = Path(path).read_bytes()
    start = content.index(b"\n", content.index(b"\nDATA ") + 1) + 1
    header = dict(line.split(maxsplit=1) for line in content[:start].decode("ascii").splitlines() if line[:1] != "#")
    kinds = [
        f"<{kind.lower()}{size}" for kind, size in zip(header["TYPE"].split(), header["SIZE"].split(), strict=True)
    ]
    dtype = np.dtype(list(zip(header["FIELDS"].split(), kinds, strict=True)))
    table = np.frombuffer(content, dtype, int(header["POINTS"]), start)
    return np.stack([table[name].astype(np.float32) for name in RADAR_FIELDS], axis=1)


# -------------------------------------------------------------------- loader


def loader_row(config: Config) -> dict[str, Any]:
    """One worker beside this process: the CPU milliseconds of either for a frame."""
    config.data.num_workers = 1
    batches = chain.from_iterable(repeat(build_datamodule(config, data_root(config)).train_dataloader()))
    counts, wall = [], time.perf_counter()
    own, workers = time.process_time(), children_seconds()
    for batch in islice(batches, max(1, LOADER_FRAMES // config.data.batch_size)):
        counts.append(len(batch))
    own, wall = time.process_time() - own, time.perf_counter() - wall
    del batches  # the loader's worker ends, and its time is known
    frames = sum(counts)
    return {
        "batch": config.data.batch_size,
        "frames": frames,
        "worker CPU ms/frame": 1e3 * (children_seconds() - workers) / frames,
        "training process CPU ms/frame": 1e3 * own / frames,
        "wall ms/frame": 1e3 * wall / frames,
    }


def children_seconds() -> float:
    """CPU seconds of the processes that this one has started and that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
