"""What every training has: the step, loss terms by name, clipping, schedule, validation, what a checkpoint keeps."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Self

import lightning as L
import torch
from torch import Tensor, nn

from src.errors import DataError
from src.models.detector import Detector, Objective
from src.reliability.nonfinite import StepGuard, finite_everywhere, gradient_norm, step_seed
from src.reliability.processes import gather_by_rank, running_statistics, several_processes
from src.structures.batch import FrameBatch
from src.structures.skipped import SkippedFiles
from src.training.epoch_means import EpochMeans
from src.training.evaluator import Evaluator
from src.training.optim import OptimConfig, build_optimizer


class TrainingModule(L.LightningModule):
    """Trains and validates a model one key frame at a time.

    `config` is the run's resolved configuration as plain values; it travels in the checkpoint, so that a checkpoint
    alone tells how to rebuild its model.

    A step whose loss or gradients are not finite leaves a dump in the run's folder and ends the training with
    DivergedError on all ranks; with `skip_nonfinite` it is skipped instead, as if it had not been made.
    """

    temporal = False
    """Whether batches are the next frames of streams (`FrameBatch.streams`)."""

    def __init__(
        self,
        model: Detector,
        optim: OptimConfig,
        backbone_lr_multiplier: float,
        evaluator: Evaluator | None,  # None: nothing will be validated
        seed: int,
        config: dict[str, Any],
        skip_nonfinite: bool = False,
        frozen_norms: Sequence[nn.Module] = (),  # of the model: in training, too, they use their running statistics
    ) -> None:
        super().__init__()
        self.automatic_optimization = False  # a step reads from top to bottom in `training_step`
        self.model = model
        self.optim = optim
        self.backbone_lr_multiplier = backbone_lr_multiplier
        self.evaluator = evaluator
        self.seed = seed
        self.config = config
        self.means = EpochMeans()
        self.evaluated_step = -1
        self.skipped = SkippedFiles()
        self.guard = StepGuard(skip_nonfinite)
        self.frozen_norms = frozen_norms
        self.created_at = time.monotonic()
        self.earlier_s: float | None = 0.0  # the training before it was resumed; None: an older checkpoint did not say
        self.initial_weights: str | None = None  # digest of the checkpoint that the run began from
        self.own_statistics: dict[str, Tensor] = {}  # of this rank, from the checkpoint of an unfinished epoch

    def train(self, mode: bool = True) -> Self:
        """Set the mode of all modules but the frozen norms, which stay in evaluation mode."""
        super().train(mode)
        for norm in self.frozen_norms:
            norm.eval()
        return self

    def run(self, batch: FrameBatch) -> Any:
        """The model's own output for a batch, in training and validation."""
        output, _ = self.model(batch)
        return output

    # ---------------------------------------------------------------- training

    def on_fit_start(self) -> None:
        """Give each rank its own running statistics back: DDP, just set up, has rank 0's on all."""
        for name, value in running_statistics(self).items():
            if name in self.own_statistics:
                value.copy_(self.own_statistics[name])

    def on_train_start(self) -> None:
        """Look up what a step changes of the model; it lies on its device by now.

        Lightning trains in the modes that it finds, which are those of a new module: nobody has called `train`.
        """
        self.train()
        self.guard.watch(self.model)

    def on_train_batch_start(self, batch: FrameBatch, batch_idx: int) -> None:
        """Seed the step by its number, so that a resumed run draws what the uninterrupted one would have drawn."""
        torch.manual_seed(step_seed(self.seed, self.trainer.global_step, self.trainer.global_rank))
        self.guard.begin()

    def training_step(self, batch: FrameBatch, batch_idx: int) -> None:
        """Forward, loss, backward, and a step of optimiser and schedule."""
        objective = self.objective(batch)
        optimizer = self.optimizers()
        optimizer.zero_grad()
        with torch.autocast(self.device.type, enabled=False):  # gradients are not rounded a second time
            self.manual_backward(objective.terms["total"])
        self.clip_gradients_or_skip(batch, objective)
        optimizer.step()
        self.lr_schedulers().step()

    def objective(self, batch: FrameBatch) -> Objective:
        """Loss terms of a batch, logged by name, and diagnostics."""
        objective = self.model.loss(self.run(batch), batch)
        self.skipped.add(batch)
        for name, value in objective.terms.items():  # also where not finite: readers of the log leave such cells out
            self.log(f"step/{name}", value.detach(), batch_size=len(batch), prog_bar=True)
        return objective

    def clip_gradients_or_skip(self, batch: FrameBatch, objective: Objective) -> None:
        """Clip the global norm (Table 10) and take the step into the means of its epoch, or drop its gradients.

        All ranks decide alike. Raises DivergedError as `StepGuard.refuse` does.
        """
        total, norm = objective.terms["total"].detach(), gradient_norm(self.model)
        if not finite_everywhere(total, norm):
            self.guard.refuse(self, batch, objective.terms)
            return
        self.guard.accept()
        nn.utils.clip_grads_with_norm_(self.model.parameters(), self.optim.clip_norm, norm)
        for name, value in objective.terms.items():
            self.means.update(f"loss/{name}", value.detach(), len(batch))
        for name, value in objective.diagnostics.items():
            self.means.update(f"state/{name}", value, len(batch))
        self.means.update("state/gradient_norm", norm, len(batch))

    def memories_before_step(self) -> list[dict[str, Any]]:
        """What the model remembered before the step, as in `rank_state`; nothing for single frames."""
        return []

    def forget_step(self, batch: FrameBatch) -> None:
        """Drop what a skipped step has left to be remembered."""

    def on_train_epoch_end(self) -> None:
        """Log the epoch's means over all ranks and frames. Raises DataError for an epoch that taught nothing."""
        means = self.means.compute(self.device)
        if means.get("loss/total") == 0:
            sensors = " and ".join(sorted(self.model.config.sensors))
            raise DataError(
                f"the loss of the whole epoch is 0: no frame held anything to learn from. The model reads {sensors}; "
                "are there points in the files of data.root?"
            )
        for name, value in means.items():
            self.log(name, value)
        self.log("lr", self.trainer.optimizers[0].param_groups[0]["lr"])

    def configure_optimizers(self) -> dict[str, Any]:
        """AdamW with the cyclic schedule, stepped every batch."""
        steps = int(self.trainer.estimated_stepping_batches)
        backbone = self.model.image_backbone
        optimizer, schedule = build_optimizer(self.model, self.optim, steps, backbone, self.backbone_lr_multiplier)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    # ---------------------------------------------------------------- validation

    def on_validation_epoch_start(self) -> None:
        """Forget what an earlier pass collected."""
        self.evaluator.reset()

    def validation_step(self, batch: FrameBatch, batch_idx: int) -> None:
        """Hand the model's output to the evaluator."""
        self.skipped.add(batch)
        self.evaluator.update(self.model, self.run(batch), batch)

    def on_validation_epoch_end(self) -> None:
        """Score what all ranks collected and log the headline numbers."""
        values = self.evaluator.compute()
        self.evaluated_step = self.trainer.global_step
        for name, value in values.items():
            self.log(f"val/{name}", value)

    # ---------------------------------------------------------------- checkpoint

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the configuration and what each rank has gathered since its epoch began beside the weights.

        Plain values and tensors, so that the file loads without executing code. All ranks take part.
        """
        checkpoint["horizon3d"] = {
            "config": self.config,
            "initial_weights": self.initial_weights,
            "seconds": None if self.earlier_s is None else self.earlier_s + time.monotonic() - self.created_at,
            "ranks": gather_by_rank(self.rank_state()),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Resume the own rank's part of an unfinished epoch; with another number of ranks, what can be moved.

        A checkpoint from the end of an epoch has nothing to resume.
        """
        self.initial_weights = checkpoint["horizon3d"].get("initial_weights")
        self.earlier_s = checkpoint["horizon3d"].get("seconds")
        states = checkpoint["horizon3d"].get("ranks", [])
        same = len(states) == self.trainer.world_size
        mine = states[self.trainer.global_rank :][:1] if same else states if self.trainer.global_rank == 0 else []
        self.skipped.restore(state["skipped"] for state in mine if "skipped" in state)
        if states and "nonfinite" in states[0]:
            self.guard.restore_counts(states[0]["nonfinite"])
        if same:
            own = states[self.trainer.global_rank]
            self.own_statistics = own.get("statistics", {})
            self.restore_rank(own)
        elif self.trainer.global_rank == 0:
            self.adopt_ranks(states)

    def rank_state(self) -> dict[str, Any]:
        """This rank's part of an unfinished epoch, as plain values and tensors on the CPU."""
        state: dict[str, Any] = {"means": self.means.state()}
        if self.guard.skipped_steps:
            state["nonfinite"] = self.guard.state()
        if self.skipped:
            state["skipped"] = self.skipped.state()
        if several_processes():
            state["statistics"] = {name: value.to("cpu", copy=True) for name, value in running_statistics(self).items()}
        return state

    def restore_rank(self, state: dict[str, Any]) -> None:
        """Resume from what `rank_state` gave."""
        self.means.restore(state["means"])

    def adopt_ranks(self, states: list[dict[str, Any]]) -> None:
        """On rank 0, resume from the states of another number of ranks: the epoch's means stay right in total."""
        self.means.adopt(state["means"] for state in states)
