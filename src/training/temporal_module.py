"""Phase 2: a detector with memory, trained and validated on streams of consecutive key frames (method 6).

Or trained on shuffled frames, each of which brings its past along (`data.past_frames`).
"""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch import Tensor

from src.models.detector import Objective
from src.models.memory import FrameMemory
from src.structures.batch import FrameBatch
from src.training.evaluation_mode import evaluation_mode
from src.training.module import TrainingModule
from src.training.true_motion import TrueMotion

logger = logging.getLogger(__name__)


class TemporalModule(TrainingModule):
    """Keeps the memory of its streams between steps; the model itself stays without state.

    A stream's memory ends where a clip starts, where the stream is missing from its set's next batch, and between
    passes: each epoch of training and each validation begins without memory. A checkpoint inside an epoch carries it.
    """

    temporal = True

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        # Sets of streams take turns (`data.stream_sets`): the streams [B] int64 of each last batch, and their memory.
        self.memories: list[tuple[Tensor, FrameMemory]] = []
        self._before_step: list[tuple[Tensor, FrameMemory]] = []
        self._used: FrameMemory | None = None  # by the last batch
        self.oracle: TrueMotion | None = None  # of an evaluation

    def run(self, batch: FrameBatch) -> Any:
        """The model's output for the next frames of the batch's streams, to be remembered, or for frames with a past.

        Raises ValueError for a batch without either.
        """
        past = self._used = self.remember(batch.past) if batch.past else self.select_memory(batch)
        if batch.past:
            return self.model.output_alone(batch, past)
        if self.oracle is not None and past is not None:
            past = self.oracle.correct(past, batch)
        # Before the forward pass: on a GPU the look at the streams would otherwise wait for all of it.
        self.memories = [entry for entry in self.memories if not _common(batch.streams, entry[0]).any()]
        output, memory = self.model(batch, past)
        if memory is not None:
            self.memories.append((batch.streams, memory))
        return output

    def remember(self, frames: tuple[FrameBatch, ...]) -> FrameMemory | None:
        """What the model, as it is used later, remembers of the frames before a batch, without gradient.

        In training a model may learn through the last of them (`Detector.trains_last_transition`).
        """
        learns = self.model.training and self.model.trains_last_transition
        with evaluation_mode(self.model), torch.no_grad():
            memory = self.model.memory_of(frames[: len(frames) - learns])
        return self.model.transition(frames[-1], memory) if learns else memory

    def select_memory(self, batch: FrameBatch) -> FrameMemory | None:
        """Memory of the batch's streams, row by row, or None where none of them has any."""
        if batch.streams is None:
            raise ValueError(
                f"samples {batch.tokens} come without streams, but a temporal model needs FrameBatch.streams and "
                "FrameBatch.starts; read them with a clip sampler"
            )
        for streams, memory in self.memories:
            same = _common(batch.streams, streams)  # [B of now, B of before]
            if same.any():
                keep = same.any(dim=1) & ~batch.starts
                return memory.select(same.int().argmax(dim=1), keep) if keep.any() else None
        return None

    def objective(self, batch: FrameBatch) -> Objective:
        """As the base, with how many frames the memory held and how many steps ago they were written, on average."""
        objective = super().objective(batch)
        present = self._used.present if self._used is not None else batch.timestamps_s.new_zeros(1, len(batch))
        turns = torch.arange(1, len(present) + 1, device=present.device)[:, None]
        steps = 0 if batch.past else len(self.memories)  # between two turns of a stream
        objective.diagnostics["memory_frames"] = present.sum() / len(batch)
        objective.diagnostics["memory_steps"] = steps * (turns * present).sum() / present.sum().clamp(min=1)
        return objective

    def forget(self) -> None:
        """Drop the memory of all streams."""
        self.memories.clear()
        self._before_step.clear()
        self._used = None

    def forget_step(self, batch: FrameBatch) -> None:
        """Let the streams of a step that counts for nothing begin anew: what they remember may not be finite."""
        if batch.streams is None:
            return
        self.memories = [entry for entry in self.memories if not _common(batch.streams, entry[0]).any()]

    def memories_before_step(self) -> list[dict[str, Any]]:
        """The `memories` of `rank_state` as they were before the running step."""
        return _plain(self._before_step)

    def on_train_batch_start(self, batch: FrameBatch, batch_idx: int) -> None:
        """As the base; a step that has to be replayed needs the memory that it began with."""
        super().on_train_batch_start(batch, batch_idx)
        self._before_step = list(self.memories)

    def on_fit_start(self) -> None:
        """As the base; a restored memory goes to the device, where the module has been moved since it was read."""
        super().on_fit_start()
        self.memories = [(streams.to(self.device), memory.to(self.device)) for streams, memory in self.memories]

    def on_train_epoch_start(self) -> None:
        """Begin without memory; not called when a run resumes inside an epoch."""
        self.forget()

    def on_train_epoch_end(self) -> None:
        """Log the epoch; its memory is of no use to a checkpoint."""
        super().on_train_epoch_end()
        self.forget()

    def on_validation_epoch_start(self) -> None:
        """Begin without boxes and without memory."""
        super().on_validation_epoch_start()
        self.forget()

    def on_validation_epoch_end(self) -> None:
        """Score; the last frames of validation are not the past of any training frame."""
        super().on_validation_epoch_end()
        self.forget()

    def rank_state(self) -> dict[str, Any]:
        """As the base, with `memories`: a list of {streams: list[int], frames: `FrameMemory.state`}."""
        return super().rank_state() | {"memories": _plain(self.memories)}

    def restore_rank(self, state: dict[str, Any]) -> None:
        """As the base, with the memory of this rank's streams."""
        super().restore_rank(state)
        for entry in state.get("memories", []):
            self.memories.append((torch.tensor(entry["streams"]), self.model.restore_memory(entry["frames"])))

    def adopt_ranks(self, states: list[dict[str, Any]]) -> None:
        """As the base; streams are dealt out anew, so they begin without memory, and the log says so."""
        super().adopt_ranks(states)
        if any(state.get("memories") for state in states):
            logger.warning(
                "the checkpoint inside an epoch is of %d processes, this run has %d: the streams begin without memory, "
                "so the rest of this epoch differs from the uninterrupted run",
                len(states),
                self.trainer.world_size,
            )


def _plain(memories: list[tuple[Tensor, FrameMemory]]) -> list[dict[str, Any]]:
    return [{"streams": streams.tolist(), "frames": memory.to("cpu").state()} for streams, memory in memories]


def _common(
    streams: Tensor,  # [B] int64
    others: Tensor,  # [B'] int64
) -> Tensor:  # [B, B'] bool
    return streams[:, None] == others
