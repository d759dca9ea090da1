"""Frames into batches: data sets, order, workers. Independent of the model."""

from __future__ import annotations

import difflib
import hashlib
import json
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from src.data.augment import AugmentationConfig, frame_generator
from src.data.cache import load_index
from src.data.clips import (
    FrameKey,
    Schedule,
    ScheduleSampler,
    frames_in_order,
    scenes_of,
    shuffled_frames,
    streamed_groups,
    whole_scenes,
)
from src.data.data_config import DataConfig
from src.data.evaluation_set import evaluation_set
from src.data.frame_loader import FrameLoader, collate, collate_in_worker, init_worker
from src.data.reader import FrameReader
from src.data.schema import CHANNELS, DatasetIndex
from src.data.sensor_files import OnBadFile
from src.data.splits import first_scenes, split_samples
from src.errors import ConfigError, DataError, HorizonError
from src.structures.batch import FrameBatch
from src.structures.detections import EvaluationSet
from src.structures.taxonomy import LIDARS


class FrameDataset(Dataset[FrameBatch]):
    """Frames by key: its epoch and clip seed the augmentation, also in worker processes.

    A fault comes back as a value rather than an exception: a loader would wrap an exception of a worker into a
    traceback and lose its message. `frame_loader.collate` passes it on and `FrameLoader` raises it.
    """

    def __init__(
        self,
        reader: FrameReader,
        augmentation: AugmentationConfig | None,
        seed: int,
        sensor_dropout: float = 0.0,
        past_frames: int = 0,  # that each frame brings along
        past_window_s: float | None = None,  # age of the oldest point of frames that do, at the time of the frame
        training: bool = False,  # times whose rays supervise are drawn
    ) -> None:
        self.reader, self.augmentation, self.seed, self.sensor_dropout = reader, augmentation, seed, sensor_dropout
        self.past_frames, self.past_window_s, self.training = past_frames, past_window_s, training

    def __getitem__(self, key: FrameKey) -> FrameBatch | HorizonError:
        clip = None if key.clip is None else str(self.reader.index.sample_tokens[key.clip])
        try:
            steps = self._steps(key)
            frame = self.reader.read(key.sample, self.augmentation, self.seed, key.epoch, clip, *steps)
            if self.past_frames and self.reader.timeline is None:
                frame = self._with_past(frame, key)
        except HorizonError as error:
            return error
        # In a validation the same frames in every run and epoch, so that scores compare.
        draw = (key.sample, self.seed, key.epoch) if self.training else (key.sample,)
        if key.stream is not None:
            frame = in_stream(frame, key.stream, key.starts)
        return drop_sensors(frame, self.sensor_dropout, draw)

    def _steps(self, key: FrameKey) -> tuple[list[int], list[int]]:
        """Of the timeline: the frames of the past, and those whose rays supervise."""
        timeline, num_future = self.reader.timeline, self.reader.settings.num_future_frames
        if timeline is None:
            return [], []
        token = str(self.reader.index.sample_tokens[key.sample])
        rng = frame_generator(self.seed, key.epoch, f"{token}/targets") if self.training else None
        targets = timeline.targets(key.sample, self.past_frames, num_future, rng) if num_future else []
        return timeline.config.history(self.past_frames), targets

    def _with_past(self, frame: FrameBatch, key: FrameKey) -> FrameBatch:
        """The frame with the key frames before it, augmented as it is; they supervise nothing."""
        (token,), nothing = frame.tokens, replace(without_sensors(frame), boxes=None, skipped={}, bad_files=[])
        past = [
            replace(self.reader.read(row, self.augmentation, self.seed, key.epoch, token), boxes=None)
            if row >= 0
            else nothing
            for row in self.reader.before(key.sample, self.past_frames)
        ]
        if self.past_window_s is not None:
            now_s = float(frame.timestamps_s)
            past = [one if now_s - float(one.timestamps_s) <= self.past_window_s else nothing for one in past]
            frame, *past = (without_older_points(one, now_s - self.past_window_s) for one in (frame, *past))
        return replace(frame, past=tuple(past))


def in_stream(frame: FrameBatch, stream: int, starts: bool) -> FrameBatch:
    """A batch of one, marked as the next frame of a stream."""
    return replace(frame, streams=torch.tensor([stream]), starts=torch.tensor([starts]))


def drop_sensors(frame: FrameBatch, share: float, draw: tuple[int, ...]) -> FrameBatch:
    """The frame, or with the probability `share` the same without points and images, unless nothing came before it."""
    first = frame.past[-1].tokens == frame.tokens if frame.past else frame.starts is None or frame.starts[0]
    if first or np.random.default_rng(draw).random() >= share:
        return frame
    return without_sensors(frame)


def without_older_points(frame: FrameBatch, oldest_s: float) -> FrameBatch:
    """One frame without the points that were measured before a time."""
    changes = {}
    for sensor in ("radar", "lidar"):
        points = getattr(frame, f"{sensor}_points")
        if points is not None:
            keep = float(frame.timestamps_s) - points[:, -1].double() >= oldest_s  # `dt` is the last of both
            names = (f"{sensor}_{name}" for name in ("points", "batch", "origins", "speeds"))
            values = {name: getattr(frame, name, None) for name in names}
            changes |= {name: value[keep] for name, value in values.items() if value is not None}
    return replace(frame, **changes)


def without_sensors(frame: FrameBatch) -> FrameBatch:
    """The frame without points and images."""
    names = ("radar_points", "radar_batch", "lidar_points", "lidar_batch", "lidar_origins", "lidar_speeds")
    changes = {name: getattr(frame, name)[:0] for name in names if getattr(frame, name) is not None}
    if frame.images is not None:
        changes |= {"images": torch.zeros_like(frame.images), "image_valid": torch.zeros_like(frame.image_valid)}
    return replace(frame, **changes)


class DetectionDataModule(L.LightningDataModule):
    """Key frames of the training and the validation split as `FrameBatch`.

    Of `taxonomy.SENSORS` those in `sensors` are read. `temporal` streams clips, with `streams` and `starts` in every
    batch; without it training reads shuffled frames and validation reads frames in table order.
    Raises ConfigError for streams with rays, DataError when tables, split or files are not right.
    """

    def __init__(
        self,
        config: DataConfig,
        root: Path,
        sensors: Collection[str],
        image_size_px: tuple[int, int] | None,  # (height, width); None for a model without images
        seed: int,
        cache: Path,
        *,
        temporal: bool,
        name: str | None = None,  # of the data set in results; None: its folder's
        labels: bool = True,  # False: annotations are not touched, and batches have no boxes
        read_by: str = "the model",  # in messages
    ) -> None:
        super().__init__()
        if temporal and config.num_future_frames and not config.past_frames:
            raise ConfigError(
                f"data.past_frames=0: must be at least 1 with data.num_future_frames={config.num_future_frames}, found "
                "streams, of whose key frames validation would read few, too far apart for a memory; give data."
                "past_frames=1 or more"
            )
        self.config, self.root, self.seed, self.temporal = config, root, seed, temporal
        self.name = name or root.name
        self.settings = config.reader_settings(sensors, image_size_px)
        self.index: DatasetIndex = load_index(root, config.version, cache, labels)
        self.labels = labels
        lidars = [CHANNELS.index(name) for name in LIDARS]
        files, keys = np.isin(self.index.data_channels, lidars).sum(), (self.index.key_data[:, lidars] >= 0).sum()
        if "lidar" in sensors and not files:
            raise DataError(
                f"{root / config.version}: holds no LiDAR files, but {read_by} reads {' and '.join(sensors)}; choose a "
                "data set with LiDAR or another model"
            )
        if config.timeline is not None and files <= keys:
            raise DataError(
                f"{root / config.version}/sample_data.json: has {keys} LiDAR files at key frames and none between, "
                f"which {read_by} reads by data.timeline; a synthetic world has them with data.world.lidar=true "
                "data.world.lidar_sweeps_per_key_frame=5"
            )
        self.reader = FrameReader(self.index, self.settings)

    def evaluation_set(self) -> EvaluationSet:
        """Annotations of the validation split."""
        return evaluation_set(self.index, self.config.split)

    def identity(self) -> dict[str, Any]:
        """Name, version and splits of the data, without machine paths."""
        return {
            "name": self.name,
            "version": self.config.version,
            "train_split": self.config.train_split,
            "split": self.config.split,
            "root": self.root.name,
        }

    @cached_property
    def samples_digest(self) -> str:
        """16 hex digits of the tokens of what training and validation read, in order: other data have others."""
        config, index = self.config, self.index
        training = first_scenes(index, split_samples(index, config.train_split), config.train_scenes)
        tokens = [index.sample_tokens[rows].tolist() for rows in (training, split_samples(index, config.split))]
        return hashlib.sha256(json.dumps(tokens).encode()).hexdigest()[:16]

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint and run.json say of the data."""
        return {"data": self.identity(), "samples_digest": self.samples_digest}

    def validation_clips(self, count: int, length: int) -> list[list[FrameBatch]]:
        """Up to `count` clips that end at different frames spread evenly over what validation reads, in stream 0.

        A clip has `length` consecutive frames in batches of one, fewer where its scene begins later than that; where
        frames of the timeline bring their past along, that past and the frame.
        """
        samples = self._validated()
        if self.brings_past:
            return [[*frame.past, frame] for frame in self._in_order(_evenly_spread(samples, count))]
        scenes = self._scenes_of(samples)
        clips = []
        for sample in _evenly_spread(samples, count):
            (scene,) = (scene for scene in scenes if sample in scene)
            end = int(np.flatnonzero(scene == sample)[0]) + 1
            clips.append(list(self._in_order(scene[max(0, end - length) : end])))
        return clips

    def stream(self, scenes: list[str] | None = None) -> Iterator[FrameBatch]:
        """The frames of some or all scenes of the validation split one by one, in stream 0; each scene is a clip.

        Raises ConfigError for a scene that the split does not have, and where frames bring their past along.
        """
        if self.brings_past and self.config.timeline is not None:
            raise ConfigError(
                f"data.past_frames={self.config.past_frames}: must be 0 to follow scenes frame by frame, found frames "
                "that each bring a past of data.timeline along; give data.past_frames=0 for streams of key frames, or "
                "score such a run by python -m src.evaluate"
            )
        known = self._scenes()
        for name in scenes or ():
            if name not in known:
                near = difflib.get_close_matches(name, known, n=5, cutoff=0.0)
                raise ConfigError(
                    f"scene {name!r}: the split {self.config.split!r} has no such scene; the nearest of its "
                    f"{len(known)} names are {near}"
                )
        wanted = known if scenes is None else scenes
        return (frame for name in wanted for frame in self._in_order(known[name]))

    def _scenes_of(self, samples: np.ndarray) -> list[np.ndarray]:
        return scenes_of(self.index, samples, self.config.on_bad_file is OnBadFile.skip)

    def _scenes(self) -> dict[str, np.ndarray]:
        """Frames of the validation split's scenes by name."""
        scenes = self._scenes_of(split_samples(self.index, self.config.split))
        return {str(self.index.scene_names[self.index.sample_scenes[scene[0]]]): scene for scene in scenes}

    def _in_order(self, samples: np.ndarray) -> Iterator[FrameBatch]:
        """One clip in stream 0, without augmentation."""
        frames = self._frames(None)
        for sample in samples:
            order = () if self.brings_past and self.config.timeline is not None else (0, int(samples[0]))
            frame = frames[FrameKey(0, int(sample), *order)]
            if isinstance(frame, HorizonError):
                raise frame
            yield frame

    def train_dataloader(self) -> DataLoader:
        """Augmented batches of the training split, shuffled frames or clips.

        It starts at the trainer's `global_step`, inside an epoch if need be. One
        optimiser step per batch is assumed. Raises DataError when there are too few frames for one batch.
        """
        config, seed, index = self.config, self.seed, self.index
        samples = first_scenes(index, split_samples(index, config.train_split), config.train_scenes)
        if len(samples) < config.batch_size:
            raise DataError(
                f"data.batch_size={config.batch_size}: the split {config.train_split!r} has only {len(samples)} "
                "frames; lower it"
            )
        if self.labels and not index.annotated:
            raise DataError(f"{index.root / index.version}: has no annotations to train on")
        schedule: Callable[[int], Schedule]
        if self.temporal and not config.past_frames:
            scenes = self._scenes_of(samples)
            cut = (config.groups_per_scene, config.batch_size, config.stream_sets)
            schedule = partial(streamed_groups, scenes, *cut, seed)
        else:
            schedule = partial(shuffled_frames, samples, config.batch_size, seed)
        sampler = ScheduleSampler(schedule, *self._rank(), self._position)
        return self._loader(sampler, config.augmentation, training=True)

    def val_dataloader(self) -> DataLoader:
        """Batches of the validation split, each frame once over all ranks: in table order, or scene by scene."""
        samples = self._validated()
        rank, world_size = self._rank()
        if self.temporal and not self.brings_past:
            schedule = whole_scenes(self._scenes_of(samples), self.config.batch_size, world_size)
        else:
            schedule = frames_in_order(samples, self.config.batch_size)
        return self._loader(ScheduleSampler(lambda epoch: schedule, rank, world_size), None)

    def _validated(self) -> np.ndarray:
        """The validation split; with rays, of each scene some key frames that have the timeline's whole horizon ahead.

        Raises DataError where none has.
        """
        samples = split_samples(self.index, self.config.split)
        if self.reader.timeline is None or not self.config.num_future_frames:
            return samples
        timeline, scenes = self.reader.timeline, self.index.sample_scenes[samples]
        whole = np.array([timeline.is_whole(sample) for sample in samples])
        if not whole.any():
            raise DataError(
                f"{self.index.root / self.config.version}: no scene of the split {self.config.split!r} goes on for "
                f"data.timeline.horizon_s={timeline.config.horizon_s} s after a key frame; lower it"
            )
        own = [samples[whole & (scenes == scene)] for scene in np.unique(scenes[whole])]
        return np.concatenate([_evenly_spread(frames, timeline.config.scored_frames) for frames in own])

    @property
    def brings_past(self) -> bool:
        """Whether frames that are looked at in order have their past with them, not in a stream."""
        of_timeline = self.config.timeline is not None and self.config.past_frames > 0
        return self.temporal and (of_timeline or self.config.past_window_s is not None)

    def _window_depth(self) -> int:
        """How many key frames before a frame of the validation split `data.past_window_s` holds at most.

        Raises ConfigError for none.
        """
        depth, window_s = 0, self.config.past_window_s
        for scene in self._scenes_of(split_samples(self.index, self.config.split)):
            times_s = 1e-6 * self.index.frame_times_us[scene]
            depth = max(depth, *np.arange(len(scene)) - np.searchsorted(times_s, times_s - window_s))
        if not depth:
            raise ConfigError(
                f"data.past_window_s={window_s}: no frame of the split {self.config.split!r} has another one that "
                "shortly before it, so nothing would be remembered; raise it, or give a checkpoint of single frames"
            )
        return int(depth)

    def _rank(self) -> tuple[int, int]:
        """This process's rank and the number of processes, which must divide the batch."""
        rank, world_size = (self.trainer.global_rank, self.trainer.world_size) if self.trainer is not None else (0, 1)
        if self.config.batch_size % world_size:
            raise ConfigError(
                f"data.batch_size={self.config.batch_size} is the total over all devices and must be divisible by "
                f"their number, {world_size}"
            )
        return rank, world_size

    def _position(self, steps: int) -> tuple[int, int]:
        """(epoch, steps done in it), from the optimiser steps that the trainer has counted or restored."""
        if self.trainer is None:
            return 0, 0
        return divmod(self.trainer.global_step, min(steps, self.trainer.num_training_batches))

    def _frames(self, augmentation: AugmentationConfig | None, training: bool = False) -> FrameDataset:
        """Frames by key. Those of the timeline's past always come along, the key frames before it in training.

        With `data.past_window_s` key frames do in validation too.
        """
        config, past = self.config, 0
        if self.temporal and (training or config.timeline is not None):
            past = config.past_frames
        elif self.brings_past:
            past = self._window_depth()
        window_s = config.past_window_s
        return FrameDataset(self.reader, augmentation, self.seed, config.sensor_dropout, past, window_s, training)

    def _loader(
        self, sampler: ScheduleSampler, augmentation: AugmentationConfig | None, training: bool = False
    ) -> DataLoader:
        workers = self.config.num_workers
        return FrameLoader(
            self._frames(augmentation, training),
            batch_sampler=sampler,
            num_workers=workers,
            collate_fn=collate_in_worker if workers else collate,
            pin_memory=torch.cuda.is_available(),
            persistent_workers=workers > 0,
            prefetch_factor=4 if workers else None,
            worker_init_fn=init_worker,
        )

    def transfer_batch_to_device(self, batch: FrameBatch, device: torch.device, dataloader_idx: int) -> FrameBatch:
        """Move a batch, from page-locked memory while the device computes."""
        return batch.to(device, non_blocking=True)


def _evenly_spread(samples: np.ndarray, count: int) -> np.ndarray:
    """Up to `count` different ones, each in the middle of an equal share."""
    picks = np.linspace(0, len(samples) - 1, 2 * count + 1)[1::2].round().astype(int)
    return samples[np.unique(picks)]
