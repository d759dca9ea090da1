"""Phase 2: a detector with memory, trained and validated on lanes of consecutive key frames (specification 6)."""

from __future__ import annotations

import logging
from typing import Any

from torch import Tensor

from src.models.detector import TemporalMemory
from src.structures.batch import FrameBatch
from src.training.detection import DetectionModule

logger = logging.getLogger(__name__)


class TemporalModule(DetectionModule):
    """Keeps the memory of its lanes between steps; the model itself stays without state.

    A lane's memory ends where a clip starts, where the lane is missing from a batch, and between passes: each epoch of
    training and each validation begins without memory. A checkpoint inside an epoch carries it.
    """

    memory: TemporalMemory | None = None  # detached, one row per entry of `lanes`
    lanes: Tensor | None = None  # [B] int64, lanes of the last batch

    def run(self, batch: FrameBatch) -> Any:
        """The model's output for the next frames of the batch's lanes; they are remembered.

        Raises ValueError for a batch without lanes.
        """
        output, self.memory = self.model(batch, self.recall(batch))
        self.lanes = batch.lanes
        return output

    def recall(self, batch: FrameBatch) -> TemporalMemory | None:
        """Memory of the batch's lanes, row by row, or None where none of them has any."""
        if batch.lanes is None:
            raise ValueError(
                f"samples {batch.tokens} come without lanes, but a temporal model needs FrameBatch.lanes and "
                "FrameBatch.starts; read them with a clip sampler"
            )
        if self.memory is None:
            return None
        same = batch.lanes[:, None] == self.lanes  # [B of now, B of before]
        keep = same.any(dim=1) & ~batch.starts
        return self.memory.select(same.int().argmax(dim=1), keep) if keep.any() else None

    def forget(self) -> None:
        """Drop the memory of all lanes."""
        self.memory = self.lanes = None

    def on_train_epoch_start(self) -> None:
        """Begin without memory; not called when a run goes on inside an epoch."""
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
        """As the base, with `memory`: None or {lanes: list[int], frames: `TemporalMemory.state`}."""
        memory = None
        if self.memory is not None:
            memory = {"lanes": self.lanes.tolist(), "frames": self.memory.to("cpu").state()}
        return super().rank_state() | {"memory": memory}

    def restore_rank(self, state: dict[str, Any]) -> None:
        """As the base, with the memory of this rank's lanes."""
        super().restore_rank(state)
        memory = state.get("memory")
        if memory is not None:
            self.memory = self.model.restore_memory(memory["frames"]).to(self.device)
            self.lanes = Tensor(memory["lanes"]).long().to(self.device)

    def adopt_ranks(self, states: list[dict[str, Any]]) -> None:
        """As the base; lanes are dealt out anew, so they begin without memory, and the log says so."""
        super().adopt_ranks(states)
        if any(state.get("memory") is not None for state in states):
            logger.warning(
                "the checkpoint inside an epoch is of %d processes, this run has %d: the lanes begin without memory, "
                "so the rest of this epoch differs from the uninterrupted run",
                len(states),
                self.trainer.world_size,
            )
