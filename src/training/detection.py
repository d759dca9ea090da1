"""What every detector's training has in common: the step, named losses, gradient clipping, the official metric."""

from __future__ import annotations

import hashlib
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
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.detections import DetectionTable, EvaluationSet
from src.training.optim import OptimConfig, build_optimizer


class DetectionModule(L.LightningModule):
    """Trains and validates a detector one key frame at a time.

    `config` is the run's resolved configuration as plain values; it travels in the checkpoint, so that a checkpoint
    alone tells how to rebuild its model. After a validation `scores` and `detections` are the same on every process.
    """

    def __init__(
        self,
        model: Detector,
        optim: OptimConfig,
        backbone_lr_multiplier: float,
        evaluation_set: EvaluationSet,
        seed: int,
        config: dict[str, Any],
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
        self.skipped: dict[str, int] = {}

    def run(self, batch: FrameBatch) -> Any:
        """The model's own output for a batch, in training and validation."""
        output, _ = self.model(batch)
        return output

    # ---------------------------------------------------------------- training

    def on_train_batch_start(self, batch: FrameBatch, batch_idx: int) -> None:
        """Seed the step by its number, so that a resumed run draws what the uninterrupted one would have drawn."""
        text = f"{self.seed}/{self.trainer.global_step}/{self.trainer.global_rank}"
        torch.manual_seed(int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little"))

    def training_step(self, batch: FrameBatch, batch_idx: int) -> Tensor:
        """Forward and loss of one batch; every term is logged under its own name."""
        output = self.run(batch)
        terms = self.model.loss(output, batch)
        self._check_finite(terms, batch)
        self._count_skipped(batch)
        for name, value in terms.items():
            self._mean(f"loss/{name}").update(value.detach(), len(batch))
            self.log(f"step/{name}", value.detach(), batch_size=len(batch), prog_bar=True)
        for name, value in self.model.diagnostics(output).items():
            self._mean(f"state/{name}").update(value)
        return terms["total"]

    def _mean(self, name: str) -> MeanMetric:
        key = name.replace(".", "_")
        if key not in self.loss_means:
            self.loss_means[key] = MeanMetric().to(self.device)
        return self.loss_means[key]

    def _check_finite(self, terms: dict[str, Tensor], batch: FrameBatch) -> None:
        if not torch.isfinite(terms["total"]):
            bad = {name: float(value.detach()) for name, value in terms.items() if not torch.isfinite(value)}
            raise DivergedError(
                f"step {self.trainer.global_step}: loss terms {bad} are not finite for samples {batch.tokens}; "
                "the last checkpoint, if there is one yet, holds the weights before; try a smaller optim.lr or "
                "optim.peak_lr_ratio"
            )

    def _count_skipped(self, batch: FrameBatch) -> None:
        for channel, count in batch.skipped.items():
            self.skipped[channel] = self.skipped.get(channel, 0) + count

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the global norm (Table 10) and log what it was."""
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.optim.clip_norm)
        self._mean("state/gradient_norm").update(norm)

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
        self._count_skipped(batch)
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
        if len(states) == self.trainer.world_size:
            self.restore_rank(states[self.trainer.global_rank])
        elif self.trainer.global_rank == 0:
            self.adopt_ranks(states)

    def rank_state(self) -> dict[str, Any]:
        """This rank's part of an unfinished epoch, as plain values and tensors on the CPU."""
        sums = {name: [float(mean.mean_value), float(mean.weight)] for name, mean in self.loss_means.items()}
        return {"means": {name: values for name, values in sums.items() if values[1] > 0}}

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
