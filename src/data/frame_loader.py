"""Frames of loader processes into batches, and what such a process says at its end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any

import torch
from torch.utils.data import DataLoader, default_collate

from src.data.packed_batch import PackedBatch
from src.errors import DataError, HorizonError
from src.structures.batch import FrameBatch
from src.structures.ray_bundle import RayBundle

TERMINATION_GRACE_S = 10


class FrameLoader(DataLoader):
    """A loader whose workers' faults arrive as the errors they are."""

    def __iter__(self) -> Iterator[FrameBatch]:
        """Batches of the epoch; raises the first DataError met, or one for a worker that died."""
        with dead_workers_named():
            for batch in super().__iter__():
                if isinstance(batch, HorizonError):
                    raise batch
                yield batch.unpack() if isinstance(batch, PackedBatch) else batch

    def state_dict(self) -> dict[str, Any]:
        """Nothing: the place in an epoch follows from the trainer's step. Lightning warns of a loader without this."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing to restore."""


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
        remedy = "the usual cause is too little memory: lower data.num_workers; the same command then resumes"
        raise DataError(f"{str(error).splitlines()[0]}; {remedy}") from error


def collate(frames: list[FrameBatch | HorizonError]) -> FrameBatch | HorizonError:
    """Batches of one into one batch; the first fault instead, if there is one."""
    for frame in frames:
        if isinstance(frame, HorizonError):
            return frame
    if len(frames) == 1:
        return frames[0]
    values: dict[str, Any] = {}
    for field in fields(FrameBatch):
        parts = [getattr(frame, field.name) for frame in frames]
        if isinstance(parts[0], torch.Tensor):
            # torch's own collate writes a worker's stack into shared memory at once.
            stack = field.name == "images"
            values[field.name] = default_collate([part[0] for part in parts]) if stack else torch.cat(parts)
        elif isinstance(parts[0], list):
            values[field.name] = [item for part in parts for item in part]
    for sensor in ("radar", "lidar"):
        clouds = [getattr(frame, f"{sensor}_points") for frame in frames]
        if clouds[0] is not None:
            counts = torch.tensor([len(cloud) for cloud in clouds])
            values[f"{sensor}_batch"] = torch.repeat_interleave(torch.arange(len(frames)), counts)
    values["past"] = tuple(collate(list(part)) for part in zip(*(frame.past for frame in frames), strict=True))
    if frames[0].rays is not None:
        values["rays"] = RayBundle.concatenate(
            [replace(frame.rays, batch=torch.full_like(frame.rays.batch, at)) for at, frame in enumerate(frames)], dim=0
        )
    values["skipped"] = {
        name: sum(frame.skipped.get(name, 0) for frame in frames) for frame in frames for name in frame.skipped
    }
    return FrameBatch(**values)


def collate_in_worker(frames: list[FrameBatch | HorizonError]) -> PackedBatch | HorizonError:
    """As `collate`, packed for the way to the training process."""
    batch = collate(frames)
    return batch if isinstance(batch, HorizonError) else PackedBatch.pack(batch)


def init_worker(worker: int) -> None:
    """One thread, since loader processes share the cores; and a delayed end on a signal to the whole process group.

    The training process finishes its step on such a signal and needs their batches; it ends them itself afterwards.
    """
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: signal.alarm(TERMINATION_GRACE_S))  # SIGALRM then ends it
