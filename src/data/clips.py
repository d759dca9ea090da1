"""Which frames each step reads: shuffled single frames, or streams of consecutive frames (method 6.4).

A stream is one row of the batch over time. A clip is a run of consecutive key frames of one scene in one stream; memory
begins empty where a clip starts. Streams are numbered over all ranks; rank r of W serves the r-th of W equal blocks, so
that the ranks together read exactly the batch that one process would read, in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch.utils.data import Sampler

from src.data.schema import DatasetIndex
from src.errors import DataError
from src.structures.batch import MAX_EGO_SPEED_MPS

Array = np.ndarray


class FrameKey(NamedTuple):
    """Key of one frame in `FrameDataset`."""

    epoch: int
    sample: int  # row of the sample table
    stream: int | None = None  # None: a frame without order
    clip: int | None = None  # row of the clip's first frame

    @property
    def starts(self) -> bool:
        """Whether the frame begins its clip."""
        return self.sample == self.clip


@dataclass(frozen=True)
class Schedule:
    """The frames of T steps in L streams over all ranks, as rows of the sample table; -1 where a stream has run out."""

    samples: Array  # [T, L] int64
    clips: Array | None  # [T, L] int64, first frame of the clip that the frame belongs to; None: frames without order
    stream_sets: int = 1  # sets of L streams that take turns: step t reads those of set t % stream_sets


def scenes_of(index: DatasetIndex, samples: Array, jumps_allowed: bool = False) -> list[Array]:
    """The frames of each scene in the order of time; scenes in the order in which the sample table begins them.

    Raises DataError where the truck would have to jump from one frame to the next, unless that is allowed: a memory
    forgets what lies before a jump.
    """
    owners = index.sample_scenes[samples]
    names, first = np.unique(owners, return_index=True)
    scenes = []
    for name in names[np.argsort(first)]:
        rows = samples[owners == name]
        scenes.append(rows[np.argsort(index.frame_times_us[rows], kind="stable")])
    for scene in () if jumps_allowed else scenes:
        shift = np.diff(index.pose_translations[index.frame_poses[scene]], axis=0)
        speed = np.linalg.norm(shift, axis=1) / (1e-6 * np.diff(index.frame_times_us[scene]))
        if not (speed <= MAX_EGO_SPEED_MPS).all():
            at = int(np.argmax(~(speed <= MAX_EGO_SPEED_MPS)))
            before, after = index.sample_tokens[scene[at : at + 2]]
            raise DataError(
                f"{index.root / index.version}/ego_pose.json: from sample {before!s} to the next, {after!s}, the ego "
                f"moves at {speed[at]:.0f} m/s; a truck stays below {MAX_EGO_SPEED_MPS:.0f}, so the pose table is "
                "damaged there; unpack the release again, or skip and count what is wrong with data.on_bad_file=skip"
            )
    return scenes


def shuffled_frames(
    samples: Array,  # [n] int64
    num_streams: int,
    seed: int,
    epoch: int,
) -> Schedule:
    """Whole batches of unordered frames; the last incomplete one is left out."""
    steps = len(samples) // num_streams
    order = np.random.default_rng((seed, epoch)).permutation(samples)
    return Schedule(order[: steps * num_streams].reshape(steps, num_streams), None)


def frames_in_order(
    samples: Array,  # [n] int64
    num_streams: int,
) -> Schedule:
    """Every frame once, as given; the last batch may be smaller."""
    missing = -len(samples) % num_streams
    return Schedule(np.concatenate([samples, np.full(missing, -1)]).reshape(-1, num_streams), None)


def streamed_groups(
    scenes: list[Array], groups_per_scene: int, num_streams: int, stream_sets: int, seed: int, epoch: int
) -> Schedule:
    """Training: scenes cut into groups, the groups shuffled into one sequence, the sequence cut into equal streams.

    With several sets of streams, neighbouring steps show other scenes; there are at most as many sets as groups to fill
    their streams, since more would cut the groups shorter. Stream l of all sets reads the l-th part of the N
    frames, N // streams long, so every stream and every epoch has that number of frames; a group cut by the end of a
    stream becomes two clips, and the fewer frames than streams that are left are skipped.
    """
    groups = [group for scene in scenes for group in np.array_split(scene, min(groups_per_scene, len(scene)))]
    groups = [groups[at] for at in np.random.default_rng((seed, epoch)).permutation(len(groups))]
    stream_sets = max(1, min(stream_sets, len(groups) // num_streams))
    stream = np.concatenate(groups)
    group_starts = np.repeat(np.cumsum([0, *map(len, groups[:-1])]), [len(group) for group in groups])
    turns = len(stream) // (num_streams * stream_sets)
    position = np.arange(turns * num_streams * stream_sets).reshape(num_streams * stream_sets, turns)
    begins = np.maximum(group_starts[position], position[:, :1])  # a stream's first frame starts a clip too
    # [streams of all sets, turns] -> [turns * sets, streams of a set]
    steps, clips = (stream[rows].T.reshape(turns * stream_sets, num_streams) for rows in (position, begins))
    return Schedule(steps, clips, stream_sets)


def whole_scenes(scenes: list[Array], num_streams: int, world_size: int) -> Schedule:
    """Validation: every scene once and uncut; the longest is placed first, each in the stream with the fewest frames.

    Among equally long streams the rank with the fewest frames comes first. Each reads its scenes in the given order.
    """
    streams: list[list[int]] = [[] for _ in range(num_streams)]
    lengths = np.zeros((world_size, num_streams // world_size), np.int64)
    for scene in sorted(range(len(scenes)), key=lambda at: -len(scenes[at])):
        of_rank = np.broadcast_to(lengths.sum(axis=1, keepdims=True), lengths.shape)
        stream = int(np.lexsort((of_rank.ravel(), lengths.ravel()))[0])
        streams[stream].append(scene)
        lengths.flat[stream] += len(scenes[scene])
    samples = np.full((lengths.max(), num_streams), -1)
    clips = samples.copy()
    for stream, members in enumerate(streams):
        end = 0
        for scene in sorted(members):
            begin, end = end, end + len(scenes[scene])
            samples[begin:end, stream] = scenes[scene]
            clips[begin:end, stream] = scenes[scene][0]
    return Schedule(samples, clips)


class ScheduleSampler(Sampler[list[FrameKey]]):
    """Batches of one rank, for a loader's `batch_sampler`.

    `schedule` gives an epoch's frames, the same number of steps in each epoch. `position` is asked whenever an
    iteration begins; it gets the steps of an epoch and returns (epoch, steps of it already done), where the
    iteration continues. Nothing is counted here, so frames that workers fetched ahead of an interruption are not lost.
    """

    def __init__(
        self,
        schedule: Callable[[int], Schedule],
        rank: int,
        world_size: int,
        position: Callable[[int], tuple[int, int]] = lambda steps: (0, 0),
    ) -> None:
        self.schedule, self.rank, self.world_size, self.position = schedule, rank, world_size, position
        self._steps = int((self._mine(schedule(0).samples) >= 0).any(axis=1).sum())

    def _mine(self, table: Array) -> Array:
        """This rank's streams of [T, L]."""
        return np.split(table, self.world_size, axis=1)[self.rank]

    def __len__(self) -> int:
        """Steps of a whole epoch, however many of them are done; 1 for a rank without any frame.

        Lightning leaves out the validation of a rank that reports none, and the others would wait for it for ever.
        """
        return max(1, self._steps)

    def __iter__(self) -> Iterator[list[FrameKey]]:
        epoch, done = self.position(self._steps)
        schedule = self.schedule(epoch)
        samples = self._mine(schedule.samples)
        num_streams = schedule.samples.shape[1]
        clips = None if schedule.clips is None else self._mine(schedule.clips)
        for step in range(done, self._steps):
            first_stream = step % schedule.stream_sets * num_streams + self.rank * samples.shape[1]
            yield [
                FrameKey(epoch, int(sample))
                if clips is None
                else FrameKey(epoch, int(sample), first_stream + stream, int(clips[step, stream]))
                for stream, sample in enumerate(samples[step])
                if sample >= 0
            ]
