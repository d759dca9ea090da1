"""What every detector's training has in common: the step, named losses, gradient clipping, the official metric."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import lightning as L
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torchmetrics import MeanMetric

from src.errors import DivergedError
from src.metrics.detection import DetectionMetric, score_detections
from src.metrics.scores import DetectionScores
from src.metrics.submission import to_global
from src.models.detector import Detector
from src.reliability.nonfinite import (
    MAX_IN_A_ROW,
    StepGuard,
    describe_gradients,
    finite_everywhere,
    gradient_norm,
    step_seed,
    write_dump,
)
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable, EvaluationSet
from src.structures.skipped import SkippedFiles
from src.training.optim import OptimConfig, build_optimizer

logger = logging.getLogger(__name__)


class DetectionModule(L.LightningModule):
    """Trains and validates a detector one key frame at a time.

    `config` is the run's resolved configuration as plain values; it travels in the checkpoint, so that a checkpoint
    alone tells how to rebuild its model. After a validation `scores` and `detections` are the same on every process.

    A step whose loss or gradients are not finite leaves a dump in the run's folder and ends the training with
    DivergedError on all ranks; with `skip_nonfinite` it is passed over instead, as if it had not been made.
    """

    def __init__(
        self,
        model: Detector,
        optim: OptimConfig,
        backbone_lr_multiplier: float,
        evaluation_set: EvaluationSet,
        seed: int,
        config: dict[str, Any],
        skip_nonfinite: bool = False,
    ) -> None:
        super().__init__()
        self.model = model
        self.optim = optim
        self.backbone_lr_multiplier = backbone_lr_multiplier
        self.seed = seed
        self.config = config
        self.metric = DetectionMetric(evaluation_set)
        self.loss_means = nn.ModuleDict()
        self.scores: DetectionScores | None = None
        self.detections: DetectionTable | None = None
        self.scored_step = -1
        self.skipped = SkippedFiles()
        self.guard = StepGuard(skip_nonfinite)
        self._step: tuple[FrameBatch, dict[str, Tensor], dict[str, Tensor]] | None = None  # batch, terms, diagnostics

    def run(self, batch: FrameBatch) -> Any:
        """The model's own output for a batch, in training and validation."""
        output, _ = self.model(batch)
        return output

    # ---------------------------------------------------------------- training

    def on_train_start(self) -> None:
        """Look up what a step changes of the model; it lies on its device by now."""
        self.guard.watch(self.model)

    def on_train_batch_start(self, batch: FrameBatch, batch_idx: int) -> None:
        """Seed the step by its number, so that a resumed run draws what the uninterrupted one would have drawn."""
        torch.manual_seed(step_seed(self.seed, self.trainer.global_step, self.trainer.global_rank))
        self.guard.begin()

    def training_step(self, batch: FrameBatch, batch_idx: int) -> Tensor:
        """Forward and loss of one batch; `configure_gradient_clipping` looks at the terms and gradients together."""
        output = self.run(batch)
        terms = self.model.loss(output, batch)
        self.skipped.add(batch)
        values = {name: value.detach() for name, value in terms.items()}
        for name, value in values.items():  # also where not finite: each reader of the log leaves such cells out
            self.log(f"step/{name}", value, batch_size=len(batch), prog_bar=True)
        self._step = (batch, values, self.model.diagnostics(output))
        return terms["total"]

    def _mean(self, name: str) -> MeanMetric:
        key = name.replace(".", "_")
        if key not in self.loss_means:
            self.loss_means[key] = MeanMetric().to(self.device)
        return self.loss_means[key]

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the global norm (Table 10) and take the step into the means of its epoch, or refuse it.

        Raises DivergedError as `_refuse` does.
        """
        (batch, terms, diagnostics), self._step = self._step, None
        norm = gradient_norm(self.model)
        if not finite_everywhere(terms["total"], norm):
            self._refuse(batch, terms)
            return
        self.guard.in_a_row = 0
        nn.utils.clip_grads_with_norm_(self.model.parameters(), self.optim.clip_norm, norm)
        for name, value in terms.items():
            self._mean(f"loss/{name}").update(value, len(batch))
        for name, value in diagnostics.items():
            self._mean(f"state/{name}").update(value, len(batch))
        self._mean("state/gradient_norm").update(norm, len(batch))

    def _refuse(self, batch: FrameBatch, terms: dict[str, Tensor]) -> None:
        """Take back what the step did, keep it for a replay, and go on without it where that is wanted.

        The weights have not changed yet; gradients are dropped, so that the optimiser does nothing. All ranks come here
        together. Raises DivergedError on all of them, with the same words, or when too many steps were passed over.
        """
        bad = {name: float(value) for name, value in terms.items() if not torch.isfinite(value)}
        ranks = gather_by_rank({"bad": bad, "total": float(terms["total"]), "tokens": batch.tokens})
        guilty = [rank for rank, own in enumerate(ranks) if own["bad"]]
        # Gradients are means over the ranks by now: where every loss is finite, none can be told from the others.
        told = guilty or range(len(ranks))
        if guilty:
            found = "; ".join(f"loss terms {ranks[rank]['bad']} of rank {rank} are not finite" for rank in guilty)
        else:
            totals = ", ".join(f"{own['total']:.4g}" for own in ranks)
            found = f"the loss ({totals}) is finite, but {describe_gradients(self.model)}"
        samples = "; ".join(f"rank {rank}: {', '.join(ranks[rank]['tokens'])}" for rank in told)
        trainer = self.trainer
        text = f"step {trainer.global_step}, epoch {trainer.current_epoch}: {found}; samples of {samples}"

        self.guard.restore()
        if self.guard.in_a_row == 0:  # the next ones in a row have the same weights
            path = self._dump(batch, text) if trainer.global_rank in told else None
            kept = [path for path in gather_by_rank(path and str(path)) if path]
            text += f"; run it again with: python -m src.replay checkpoint={kept[0]}" if kept else ""
        self.forget_step(batch)
        self.guard.in_a_row += 1
        if not self.guard.skip:
            raise DivergedError(
                f"{text}\nThe last checkpoint, if there is one yet, holds earlier weights. Look for broken data, try a "
                "smaller optim.lr or optim.peak_lr_ratio, or pass over such steps with trainer.on_nonfinite=skip"
            )
        if self.guard.in_a_row > MAX_IN_A_ROW:
            raise DivergedError(
                f"{text}\nMore than {MAX_IN_A_ROW} steps in a row were like this, so it is not one bad batch: the dump "
                "of the first of them tells more"
            )
        self.guard.skipped_steps += 1
        if trainer.is_global_zero:
            logger.warning("passed over (%d so far): %s", self.guard.skipped_steps, text)
        for parameter in self.model.parameters():
            parameter.grad = None

    def _dump(self, batch: FrameBatch, found: str) -> Path | None:
        """Write what `src.replay` needs; see `write_dump`."""
        step, rank = self.trainer.global_step, self.trainer.global_rank
        return write_dump(
            Path(self.trainer.default_root_dir),
            self.model,
            self.config,
            batch,
            global_step=step,
            epoch=self.trainer.current_epoch,
            rank=rank,
            world_size=self.trainer.world_size,
            seed=step_seed(self.seed, step, rank),
            memories=self.memories_before_step(),
            found=found,
        )

    def memories_before_step(self) -> list[dict[str, Any]]:
        """What the model remembered before the step, as in `rank_state`; nothing for single frames."""
        return []

    def forget_step(self, batch: FrameBatch) -> None:
        """Drop what a step that counts for nothing has left to be remembered."""

    def on_train_epoch_end(self) -> None:
        """Log the epoch's means over all ranks and frames."""
        # A term may be missing on a rank that never saw its objects; each compute is a meeting of all ranks.
        for name in sorted(set().union(*gather_by_rank(list(self.loss_means)))):
            mean = self._mean(name)
            self.log(name, mean.compute())
            mean.reset()
        self.log("lr", self.trainer.optimizers[0].param_groups[0]["lr"])

    def configure_optimizers(self) -> dict[str, Any]:
        """AdamW with the cyclic schedule, stepped every batch."""
        optimizer, schedule = build_optimizer(
            self.model,
            self.optim,
            int(self.trainer.estimated_stepping_batches),
            self.model.image_backbone,
            self.backbone_lr_multiplier,
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    # ---------------------------------------------------------------- validation

    def on_validation_epoch_start(self) -> None:
        """Forget what an earlier pass collected."""
        self.metric.reset()

    def validation_step(self, batch: FrameBatch, batch_idx: int) -> None:
        """Detect, bring the boxes to the global frame, hand them to the metric."""
        self.skipped.add(batch)
        for token, boxes, global_from_ego in zip(
            batch.tokens, self.detect(batch), batch.global_from_ego.cpu().numpy(), strict=True
        ):
            table = to_global(boxes.to("cpu"), global_from_ego, self.metric.evaluation_set.index_of[token])
            self.metric.update([token], table)

    def detect(self, batch: FrameBatch) -> list[Boxes3D]:
        """Boxes of each sample in its ego frame."""
        return self.model.decode(self.run(batch))

    def on_validation_epoch_end(self) -> None:
        """Score the boxes of all ranks and log the headline numbers.

        The full table stays in `scores` and the boxes in `detections`, so that one rank alone can write them later.
        """
        with self.metric.sync_context():
            self.detections, _ = self.metric.collected()
        self.scores = score_detections(self.metric.evaluation_set, self.detections)
        self.scored_step = self.trainer.global_step
        for name, value in self.scores.headline().items():
            self.log(f"val/{name}", value)

    # ---------------------------------------------------------------- checkpoint

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the configuration and what each rank has gathered since its epoch began beside the weights.

        Plain values and tensors, so that the file loads without executing code. All ranks take part.
        """
        checkpoint["horizon3d"] = {"config": self.config, "ranks": gather_by_rank(self.rank_state())}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on with the own rank's part of an unfinished epoch; with another number of ranks, with what can be moved.

        A checkpoint from the end of an epoch has nothing to go on with.
        """
        states = checkpoint["horizon3d"].get("ranks", [])
        same = len(states) == self.trainer.world_size
        mine = states[self.trainer.global_rank :][:1] if same else states if self.trainer.global_rank == 0 else []
        self.skipped.restore(state["skipped"] for state in mine if "skipped" in state)
        if states and "nonfinite" in states[0]:
            self.guard.restore_counts(states[0]["nonfinite"])
        if len(states) == self.trainer.world_size:
            self.restore_rank(states[self.trainer.global_rank])
        elif self.trainer.global_rank == 0:
            self.adopt_ranks(states)

    def rank_state(self) -> dict[str, Any]:
        """This rank's part of an unfinished epoch, as plain values and tensors on the CPU."""
        sums = {name: [float(mean.mean_value), float(mean.weight)] for name, mean in self.loss_means.items()}
        state: dict[str, Any] = {"means": {name: values for name, values in sums.items() if values[1] > 0}}
        if self.guard.skipped_steps:
            state["nonfinite"] = self.guard.state()
        if self.skipped:
            state["skipped"] = self.skipped.state()
        return state

    def restore_rank(self, state: dict[str, Any]) -> None:
        """Go on from what `rank_state` gave."""
        for name, (total, weight) in state["means"].items():
            mean = self._mean(name)
            mean.update(0.0, 0.0)  # so that it knows it has values
            mean.mean_value.fill_(total)
            mean.weight.fill_(weight)

    def adopt_ranks(self, states: list[dict[str, Any]]) -> None:
        """On rank 0, go on from the states of another number of ranks: the epoch's means stay right in total."""
        totals: dict[str, list[float]] = {}
        for state in states:
            for name, values in state["means"].items():
                totals[name] = [a + b for a, b in zip(totals.get(name, [0.0, 0.0]), values, strict=True)]
        DetectionModule.restore_rank(self, {"means": totals})


def gather_by_rank(value: Any) -> list[Any]:
    """The `value`s of all ranks in their order; every rank must call it. One value without a process group."""
    if not (dist.is_available() and dist.is_initialized()):
        return [value]
    values: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(values, value)
    return values
