"""Frames into batches: data sets, order, workers. It knows no model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from src.data.augment import AugmentationConfig
from src.data.cache import load_index
from src.data.evaluation import evaluation_set
from src.data.reader import FrameReader, OnBadFile, ReaderSettings
from src.data.schema import DatasetIndex
from src.data.splits import split_samples
from src.data.world.config import WorldConfig
from src.errors import ConfigError, DataError, HorizonError
from src.structures.batch import FrameBatch
from src.structures.detections import EvaluationSet


@dataclass(kw_only=True)
class DataConfig:
    """What is read and how (`data`). Raises ConfigError for values that cannot work."""

    root: str | None  # folder of the data set; null with a world: a folder under paths.outputs
    version: str  # table folder, e.g. v1.2-trainval
    train_split: str
    split: str  # what validation and evaluation read
    batch_size: int  # total over all devices
    num_workers: int  # loader processes per device
    num_sweeps: int  # past sweeps of each radar
    min_distance_m: float  # nearer points are the truck itself
    propagate_points: bool  # move points by their own radial velocity
    on_bad_file: OnBadFile
    test_resize_offset: float  # added to the image scale without augmentation
    augmentation: AugmentationConfig | None
    world: WorldConfig | None  # the synthetic highway to write on first use; null = recorded data

    def __post_init__(self) -> None:
        for name, least in {"batch_size": 1, "num_workers": 0, "num_sweeps": 1, "min_distance_m": 0}.items():
            if not getattr(self, name) >= least:
                raise ConfigError(f"data.{name}={getattr(self, name)}: must be at least {least}")
        if not -0.5 < self.test_resize_offset < 1:
            raise ConfigError(f"data.test_resize_offset={self.test_resize_offset}: must lie between -0.5 and 1")


class FrameDataset(Dataset[FrameBatch]):
    """Frames by (epoch, row of the sample table): the epoch seeds the augmentation, also in worker processes.

    A fault comes back as a value rather than an exception: a loader would wrap an exception of a worker into a
    traceback and lose its message. `collate` passes it on and `FrameLoader` raises it.
    """

    def __init__(self, reader: FrameReader, augmentation: AugmentationConfig | None, seed: int) -> None:
        self.reader, self.augmentation, self.seed = reader, augmentation, seed

    def __getitem__(self, key: tuple[int, int]) -> FrameBatch | HorizonError:
        epoch, sample = key
        try:
            return self.reader.read(sample, self.augmentation, self.seed, epoch)
        except HorizonError as error:
            return error


class FrameSampler(Sampler[tuple[int, int]]):
    """(epoch, sample) pairs of one rank: shuffled by (seed, epoch) for training, in order without padding otherwise.

    In training every rank gets the same number of whole batches; the last incomplete ones are left out.
    """

    def __init__(
        self,
        samples: np.ndarray,  # [n] int64
        rank: int,
        world_size: int,
        batch_size: int,  # of one rank
        shuffle_seed: int | None,
        epoch: Callable[[], int],
    ) -> None:
        self.samples, self.rank, self.world_size = samples, rank, world_size
        self.batch_size, self.shuffle_seed, self.epoch = batch_size, shuffle_seed, epoch

    def __len__(self) -> int:
        if self.shuffle_seed is None:
            return len(range(self.rank, len(self.samples), self.world_size))
        return len(self.samples) // (self.world_size * self.batch_size) * self.batch_size

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, samples = self.epoch(), self.samples
        if self.shuffle_seed is not None:
            samples = np.random.default_rng((self.shuffle_seed, epoch)).permutation(samples)
        for sample in samples[self.rank :: self.world_size][: len(self)]:
            yield epoch, int(sample)


class FrameLoader(DataLoader):
    """A loader whose workers' faults arrive as the errors they are."""

    def __iter__(self) -> Iterator[FrameBatch]:
        """Batches of the epoch; raises the first DataError met, or one for a worker that died."""
        with dead_workers_named():
            for batch in super().__iter__():
                if isinstance(batch, HorizonError):
                    raise batch
                yield batch


@contextmanager
def dead_workers_named() -> Iterator[None]:
    """Turn torch's RuntimeError for a killed worker into a DataError.

    Torch raises it from a signal handler, so it can strike anywhere in a training step: wrap the whole fit as well.
    """
    try:
        yield
    except RuntimeError as error:
        if "DataLoader worker" not in str(error):
            raise
        remedy = "the usual cause is too little memory: lower data.num_workers, then give the same command to go on"
        raise DataError(f"{str(error).splitlines()[0]}; {remedy}") from error


class DetectionDataModule(L.LightningDataModule):
    """Key frames of the training and the validation split as `FrameBatch`.

    `image_size_px` None leaves images unread. Raises DataError when tables, split or files are not right.
    """

    def __init__(
        self,
        config: DataConfig,
        root: Path,
        image_size_px: tuple[int, int] | None,  # (height, width)
        seed: int,
        cache: Path,
    ) -> None:
        super().__init__()
        self.config, self.root, self.seed = config, root, seed
        self.settings = ReaderSettings(
            num_sweeps=config.num_sweeps,
            min_distance_m=config.min_distance_m,
            propagate_points=config.propagate_points,
            on_bad_file=config.on_bad_file,
            image_size_px=image_size_px,
            test_resize_offset=config.test_resize_offset,
        )
        self.index: DatasetIndex = load_index(root, config.version, cache)
        self.reader = FrameReader(self.index, self.settings)

    def evaluation_set(self) -> EvaluationSet:
        """Annotations of the validation split."""
        return evaluation_set(self.index, self.config.split)

    def identity(self) -> dict[str, Any]:
        """What data these are, without machine paths."""
        return {
            "name": "synthetic highway" if self.config.world is not None else self.root.name,
            "version": self.config.version,
            "train_split": self.config.train_split,
            "split": self.config.split,
            "root": self.root.name,
        }

    def validation_frames(self, count: int) -> list[FrameBatch]:
        """Up to `count` different frames spread evenly over the validation split, batches of one."""
        samples = split_samples(self.index, self.config.split)
        picks = np.unique(np.linspace(0, len(samples) - 1, 2 * count + 1)[1::2].round().astype(int))
        return [self.reader.read(int(samples[pick]), None) for pick in picks]

    def train_dataloader(self) -> DataLoader:
        """Shuffled, augmented batches; raises DataError when there are too few frames for one."""
        config = self.config
        samples = split_samples(self.index, config.train_split)
        if len(samples) < config.batch_size:
            raise DataError(
                f"data.batch_size={config.batch_size}: the split {config.train_split!r} has only {len(samples)} frames"
            )
        if not self.index.annotated:
            raise DataError(f"{self.index.root / self.index.version}: has no annotations to train on")
        return self._loader(samples, config.augmentation, self.seed)

    def val_dataloader(self) -> DataLoader:
        """Batches of the validation split in table order, each frame once over all ranks."""
        return self._loader(split_samples(self.index, self.config.split), None, None)

    def _loader(
        self, samples: np.ndarray, augmentation: AugmentationConfig | None, shuffle_seed: int | None
    ) -> DataLoader:
        config, trainer = self.config, self.trainer
        world_size = trainer.world_size if trainer is not None else 1
        if config.batch_size % world_size:
            raise ConfigError(
                f"data.batch_size={config.batch_size} is the total over all devices and must be divisible by their "
                f"number, {world_size}"
            )
        sampler = FrameSampler(
            samples,
            rank=trainer.global_rank if trainer is not None else 0,
            world_size=world_size,
            batch_size=config.batch_size // world_size,
            shuffle_seed=shuffle_seed,
            epoch=lambda: trainer.current_epoch if trainer is not None else 0,
        )
        return FrameLoader(
            FrameDataset(self.reader, augmentation, self.seed),
            batch_size=config.batch_size // world_size,
            sampler=sampler,
            num_workers=config.num_workers,
            collate_fn=collate,
            pin_memory=torch.cuda.is_available(),
            persistent_workers=config.num_workers > 0,
            prefetch_factor=4 if config.num_workers else None,
            worker_init_fn=_one_thread,
        )

    def transfer_batch_to_device(self, batch: FrameBatch, device: torch.device, dataloader_idx: int) -> FrameBatch:
        """Move a batch, from page-locked memory while the device computes."""
        return batch.to(device, non_blocking=True)


def collate(frames: list[FrameBatch | HorizonError]) -> FrameBatch | HorizonError:
    """Batches of one into one batch; the first fault instead, if there is one."""
    for frame in frames:
        if isinstance(frame, HorizonError):
            return frame
    values: dict[str, Any] = {}
    for field in fields(FrameBatch):
        parts = [getattr(frame, field.name) for frame in frames]
        if isinstance(parts[0], torch.Tensor):
            values[field.name] = torch.cat(parts)
        elif isinstance(parts[0], list):
            values[field.name] = [item for part in parts for item in part]
    values["radar_batch"] = torch.repeat_interleave(
        torch.arange(len(frames)), torch.tensor([len(frame.radar_points) for frame in frames])
    )
    values["skipped"] = {
        name: sum(frame.skipped.get(name, 0) for frame in frames) for frame in frames for name in frame.skipped
    }
    return FrameBatch(**values)


def _one_thread(worker: int) -> None:
    """Loader processes share the cores with the training process."""
    torch.set_num_threads(1)
