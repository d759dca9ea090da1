"""The past of a detector's streams: time and pose of remembered frames, and their motion to the present (method 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Generic, Self, TypeVar, get_args, get_type_hints

import torch
from torch import Tensor

from src.errors import CheckpointError, ConfigError, require_least
from src.ops.frame_motion import relative_motion, relative_pose
from src.ops.segment_reduce import topk_per_sample
from src.structures.batch import MAX_EGO_SPEED_MPS, FrameBatch
from src.structures.tensor_fields import TensorFields


@dataclass(kw_only=True)
class TemporalConfig:
    """Settings of the temporal part (`model.temporal`). Raises ConfigError when there is nothing to remember."""

    num_frames: int  # remembered key frames
    max_age_s: float  # older ones are not used

    def __post_init__(self) -> None:
        require_least(self, "model.temporal", {"num_frames": 1}, "; model.temporal=null means no memory")
        if not self.max_age_s > 0:
            raise ConfigError(f"model.temporal.max_age_s={self.max_age_s}: must be positive")


@dataclass
class Motion:
    """How each stream got from a stored frame to the current one."""

    aug_from_past: Tensor  # [B, 4, 4] float32, A_t T_{t-k -> t}
    elapsed_s: Tensor  # [B] float32, dt_k; 0 where not usable
    usable: Tensor  # [B] bool


@dataclass
class RememberedFrame(TensorFields):
    """Time and pose of one remembered key frame of each of B streams; models add what they remember of it.

    That is tensors with a leading axis [B], `TensorFields` of them, `StoredRows`, and values that all streams share.
    """

    timestamps_s: Tensor  # [B] float64
    global_from_ego: Tensor  # [B, 4, 4] float64
    present: Tensor  # [B] bool, False for a stream whose clip began later

    def motion(self, batch: FrameBatch, max_age_s: float) -> Motion:
        """From this frame to the batch's, composed in float64.

        Not usable: an absent stream, a frame that is not in the past or older than `max_age_s`, a pose that jumped.
        """
        return self._motion(batch, max_age_s, newest=False)[1]

    def stacked_motion(self, batch: FrameBatch, max_age_s: float) -> tuple[Tensor, Motion]:
        """`motion` of T frames stacked in one, newest first, each tensor with a leading axis [T].

        Returns which of them `FrameMemory.before` keeps for a stream [T, B] bool, and the motion of those.
        """
        return self._motion(batch, max_age_s, newest=True)

    def _motion(self, batch: FrameBatch, max_age_s: float, newest: bool) -> tuple[Tensor, Motion]:
        now, past = (batch.global_from_ego, batch.timestamps_s), (self.global_from_ego, self.timestamps_s)
        limits = (max_age_s, MAX_EGO_SPEED_MPS, newest)
        kept, *motion = relative_motion(now, batch.aug_from_ego, past, self.present, *limits)
        return kept, Motion(*motion)

    def jumped(self, batch: FrameBatch) -> Tensor:  # [B] bool
        """Streams whose pose jumped between this frame and the batch's, which is later."""
        now, past = (batch.global_from_ego, batch.timestamps_s), (self.global_from_ego, self.timestamps_s)
        _, elapsed, driven = relative_pose(now, past, MAX_EGO_SPEED_MPS)
        return self.present & (elapsed > 0) & ~driven

    def select(
        self,
        rows: Tensor,  # [B'] int64, distinct where kept
        keep: Tensor,  # [B'] bool
    ) -> Self:
        """The streams at `rows`, those without `keep` forgotten."""

        def selected(value: Any) -> Any:
            if isinstance(value, StoredRows):
                return value.of_streams(rows, keep, len(self.present))
            if isinstance(value, Tensor):
                return value.index_select(0, rows)
            return value.map(selected) if isinstance(value, TensorFields) else value

        frame = replace(self, **{field.name: selected(getattr(self, field.name)) for field in fields(self)})
        return replace(frame, present=frame.present & keep)

    def with_velocities(
        self,
        velocities: Callable[[int, Tensor, Tensor], Tensor],  # of a stream's row, [n, 2] m and [n, 2] m/s as remembered
    ) -> Self:
        """The frame with other velocities, in the ego frame of its own time; for a model that remembers some.

        Raises ConfigError for one that does not.
        """
        raise ConfigError(f"{type(self).__name__} holds no velocities that an oracle could replace; leave oracle= out")


def rows_to_remember(
    scores: Tensor,  # [n]
    streams: Tensor,  # [n] int64, of each row, ascending
    threshold: float,
    batch_size: int,
    limit: int,  # rows of a stream
) -> Tensor:  # [m] int64, their streams ascend
    """The best rows of each stream among those above the threshold."""
    kept = (scores > threshold).nonzero().squeeze(1)
    best = topk_per_sample(scores[kept], streams[kept], batch_size, limit).flatten()
    return kept[best[best >= 0]]


class StoredRows(TensorFields):
    """Base of what a frame remembers as rows of all its streams, one after the other."""

    rows: Tensor  # [n] int64, stream of each, ascending; a field of every subclass

    def of_streams(
        self,
        rows: Tensor,  # [B'] int64, distinct where kept
        keep: Tensor,  # [B'] bool
        batch_size: int,  # B, of the streams so far
    ) -> Self:
        """What belongs to the streams at `rows`, those without `keep` forgotten."""
        target = rows.new_full((batch_size,), -1)  # new row of every old one
        kept = keep.nonzero().squeeze(1)
        target[rows[kept]] = kept
        moved = target[self.rows]
        order = moved.argsort(stable=True)
        order = order[moved[order] >= 0]
        return replace(self.map(lambda value: value[order]), rows=moved[order])

    def by_stream(
        self,
        velocities: Callable[[int, Tensor, Tensor], Tensor],  # see `RememberedFrame.with_velocities`
        batch_size: int,  # B
        xy: Tensor,  # [n, 2] m, places of the rows
        own: Tensor,  # [n, 2] m/s, their velocities as remembered
    ) -> Tensor:  # [n, 2] m/s
        """What `velocities` gives for all rows, asked stream by stream."""
        streams = [self.rows == stream for stream in range(batch_size)]
        return torch.cat([velocities(stream, xy[at], own[at]) for stream, at in enumerate(streams)])  # the rows ascend


Frame = TypeVar("Frame", bound=RememberedFrame)


def motions(frames: Sequence[RememberedFrame], batch: FrameBatch, max_age_s: float) -> Motion:
    """`RememberedFrame.motion` of T frames at once, each tensor with a leading axis [T]."""
    names = ("timestamps_s", "global_from_ego", "present")
    stacked = RememberedFrame(*(torch.stack([getattr(frame, name) for frame in frames]) for name in names))
    return stacked.motion(batch, max_age_s)


@dataclass(frozen=True)
class FrameMemory(TensorFields, Generic[Frame]):
    """The last key frames of each of B streams, newest first. A value: what changes it makes a new one."""

    frame_type: ClassVar[type[RememberedFrame]]

    frames: tuple[Frame, ...]

    @property
    def batch_size(self) -> int:
        """B, 0 for an empty memory."""
        return len(self.frames[0].present) if self.frames else 0

    @property
    def present(self) -> Tensor:  # [T, B] bool
        """Which streams remember their last, last but one, ... frame; not of an empty memory."""
        return torch.stack([frame.present for frame in self.frames])

    def before(self, batch: FrameBatch) -> Self:
        """What of the memory is in the past of the batch, stream by stream; the rest is forgotten for good.

        Dropped are frames that are not older than the batch's, and, where the pose jumped since a stream's last frame,
        all before the jump. Only consecutive frames are compared: over several seconds the same jump could pass for a
        drive. Raises ValueError for a batch of another number of streams.
        """
        self.check_streams(batch)
        if not self.frames:
            return self
        steady = ~self.frames[0].jumped(batch)
        stamps = torch.stack([frame.timestamps_s for frame in self.frames])  # [T, B]
        present = self.present & steady & (stamps < batch.timestamps_s)
        frames = zip(self.frames, present.unbind(0), strict=True)
        return self._shared(replace(frame, present=row) for frame, row in frames)

    def check_streams(self, batch: FrameBatch) -> None:
        """Raises ValueError for a batch of another number of streams."""
        if self.frames and self.batch_size != len(batch):
            raise ValueError(f"the memory holds {self.batch_size} streams, but the batch {len(batch)} frames")

    def select(
        self,
        rows: Tensor,  # [B'] int64, row of each new stream in this memory, distinct where kept
        keep: Tensor,  # [B'] bool, False: the stream starts anew
    ) -> Self:
        """Memory for a batch whose streams come from these rows; frames that no stream has any more are dropped."""
        return self._shared(frame.select(rows, keep) for frame in self.frames)

    def mapped(self, change: Callable[[Frame], Frame]) -> Self:
        """The memory with every frame changed."""
        return replace(self, frames=tuple(map(change, self.frames)))

    def state(self) -> list[dict[str, Any]]:
        """Tensors and plain containers, for a checkpoint."""
        return [_plain(frame) for frame in self.frames]

    @classmethod
    def from_state(cls, state: list[dict[str, Any]]) -> Self:
        """The memory that `state` described. Raises CheckpointError for one of other fields, as other code writes."""
        return cls(tuple(_restored(cls.frame_type, entry) for entry in state))

    @classmethod
    def _shared(cls, frames: Iterable[Frame]) -> Self:
        """A memory without the frames that no stream has any more, so that they take no other's slot."""
        frames = tuple(frames)
        if not frames:
            return cls(())
        kept = torch.stack([frame.present for frame in frames]).any(1).tolist()  # one transfer, which synchronises
        return cls(tuple(frame for frame, wanted in zip(frames, kept, strict=True) if wanted))


def _plain(value: Any) -> Any:
    if not isinstance(value, TensorFields):
        return value
    return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}


def _restored(kind: type, entry: dict[str, Any]) -> Any:
    """An instance of the dataclass `kind` from its `_plain` form; fields may be other `TensorFields`, or None."""
    hints = get_type_hints(kind)
    if entry.keys() != (names := {field.name for field in fields(kind)}):
        odd = ", ".join(sorted(entry.keys() ^ names))
        raise CheckpointError(
            f"what the checkpoint remembers ({kind.__name__}) differs from this code's in {odd}: it was written by "
            "other code; go on with that, or begin anew with resume=restart"
        )
    values = dict(entry)
    for name, value in entry.items():
        parts = [part for part in (hints[name], *get_args(hints[name])) if isinstance(part, type)]
        part = next((part for part in parts if issubclass(part, TensorFields)), None)
        if part is not None and value is not None:
            values[name] = _restored(part, value)
    return kind(**values)
