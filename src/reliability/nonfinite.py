"""Steps whose loss or gradients are not finite: detected at once, reported, dumped for a replay, skipped if wanted."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol

import lightning as L
import torch
import torch.distributed as dist
from torch import Tensor, nn

from src.errors import CheckpointError, DivergedError
from src.reliability.checkpoints import AtomicCheckpointIO, read_checkpoint
from src.reliability.processes import gather_by_rank
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.ray_bundle import RayBundle

logger = logging.getLogger(__name__)

MAX_IN_A_ROW = 50
"""Steps skipped in a row before training gives up.

More than the 40 key frames of a scene, which follow one another in phase 2, so that one broken recording is survived;
beyond that it is the weights or the settings, and since a skipped step changes neither, waiting does not help.
"""
MAX_DUMPS = 3
"""Dumps kept per rank: each is as large as a checkpoint, and the newest are about the code and settings of now."""
MAX_NAMES = 5


class GuardedModule(Protocol):
    """What a `StepGuard` asks of the Lightning module whose steps it guards."""

    model: nn.Module
    config: dict[str, Any]  # of the run, plain
    seed: int
    trainer: L.Trainer

    def memories_before_step(self) -> list[dict[str, Any]]:
        """What the model remembered before the step, one entry per stream."""

    def forget_step(self, batch: FrameBatch) -> None:
        """Drop what the step has left to be remembered."""


class StepGuard:
    """What a step must not leave behind when its numbers are not finite, and how many such steps there were.

    Until the optimiser steps, a training step changes nothing of a model but its running statistics, of which `begin`
    keeps a copy. The counts are the same on every rank, since all ranks skip a step together.
    """

    def __init__(self, skip: bool) -> None:
        self.skip = skip  # False: the first such step ends the training
        self.skipped_steps = 0
        self.in_a_row = 0
        self._statistics: list[list[Tensor]] = []  # by type
        self._before: list[list[Tensor]] = []

    def watch(self, model: nn.Module) -> None:
        """Take the running statistics of a model that lies on the device it is trained on."""
        stored = model.state_dict().keys()
        by_type: dict[torch.dtype, list[Tensor]] = {}
        for name, buffer in model.named_buffers():
            if name in stored:  # the others are constants
                by_type.setdefault(buffer.dtype, []).append(buffer)
        self._statistics = list(by_type.values())
        self._before = [[buffer.clone() for buffer in buffers] for buffers in self._statistics]

    @torch.no_grad()
    def begin(self) -> None:
        """Remember the statistics as they are before a step."""
        for before, now in zip(self._before, self._statistics, strict=True):
            torch._foreach_copy_(before, now)

    @torch.no_grad()
    def restore(self) -> None:
        """Bring the statistics back to where they were before the step."""
        for before, now in zip(self._before, self._statistics, strict=True):
            torch._foreach_copy_(now, before)

    def accept(self) -> None:
        """Note that the step's numbers are finite."""
        self.in_a_row = 0

    def refuse(self, module: GuardedModule, batch: FrameBatch, terms: dict[str, Tensor]) -> None:
        """Take back what the step did, keep it for a replay, and skip it where that is wanted.

        The weights have not changed yet; gradients are dropped, so that the optimiser does nothing. All ranks come here
        together. Raises DivergedError on all of them, with the same words, or when too many steps were skipped.
        """
        found, failing = _describe(module.model, batch, terms)
        trainer = module.trainer
        text = f"step {trainer.global_step}, epoch {trainer.current_epoch}: {found}"
        self.restore()
        if self.in_a_row == 0:  # the next ones in a row have the same weights
            path = _dump(module, batch, text) if trainer.global_rank in failing else None
            kept = [path for path in gather_by_rank(path and str(path)) if path]
            text += f"; run it again with: python -m src.replay checkpoint={kept[0]}" if kept else ""
        module.forget_step(batch)
        self.in_a_row += 1
        if not self.skip:
            raise DivergedError(
                f"{text}\nThe last checkpoint, if there is one yet, holds earlier weights. Look for broken data, try a "
                "smaller optim.lr or optim.peak_lr_ratio, or skip such steps with trainer.on_nonfinite=skip"
            )
        if self.in_a_row > MAX_IN_A_ROW:
            raise DivergedError(
                f"{text}\nMore than {MAX_IN_A_ROW} steps in a row were like this, so it is not one bad batch: the dump "
                "of the first of them tells more"
            )
        self.skipped_steps += 1
        if trainer.is_global_zero:
            logger.warning("skipped (%d so far): %s", self.skipped_steps, text)
        for parameter in module.model.parameters():
            parameter.grad = None

    def state(self) -> list[int]:
        """The counts, for a checkpoint."""
        return [self.skipped_steps, self.in_a_row]

    def restore_counts(self, state: list[int]) -> None:
        """Restore what `state` gave."""
        self.skipped_steps, self.in_a_row = state


def _describe(model: nn.Module, batch: FrameBatch, terms: dict[str, Tensor]) -> tuple[str, Sequence[int]]:
    """What is not finite and the samples of it, the same on every rank, and the ranks whose samples those are."""
    terms = {name: value.detach() for name, value in terms.items()}
    bad = {name: float(value) for name, value in terms.items() if not torch.isfinite(value)}
    ranks = gather_by_rank({"bad": bad, "total": float(terms["total"]), "tokens": batch.tokens})
    failing: Sequence[int] = [rank for rank, own in enumerate(ranks) if own["bad"]]
    if failing:
        found = "; ".join(f"loss terms {ranks[rank]['bad']} of rank {rank} are not finite" for rank in failing)
    else:
        failing = range(len(ranks))  # gradients are means over the ranks by now: none can be singled out
        totals = ", ".join(f"{own['total']:.4g}" for own in ranks)
        found = f"the loss ({totals}) is finite, but {describe_gradients(model)}"
    samples = "; ".join(f"rank {rank}: {', '.join(ranks[rank]['tokens'])}" for rank in failing)
    return f"{found}; samples of {samples}", failing


def _dump(module: GuardedModule, batch: FrameBatch, found: str) -> Path | None:
    """Keep the step of this rank as `write_dump` does."""
    trainer = module.trainer
    number, rank = trainer.global_step, trainer.global_rank
    step = {"global_step": number, "epoch": trainer.current_epoch, "rank": rank, "found": found}
    step |= {"world_size": trainer.world_size, "seed": step_seed(module.seed, number, rank)}
    step["memories"] = module.memories_before_step()
    return write_dump(Path(trainer.default_root_dir), module.model, module.config, batch, **step)


def step_seed(seed: int, step: int, rank: int) -> int:
    """What the generators of a rank are seeded with before a step of a run with this `seed`."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{step}/{rank}".encode()).digest()[:8], "little")


def finite_everywhere(*values: Tensor) -> bool:
    """Whether these scalars are finite on every rank; all ranks must call it, and all get the same answer.

    The one place where a step waits for its GPU: the values, and among several ranks one flag, are read together.
    """
    broken = (~torch.stack([value.detach().float() for value in values]).isfinite()).any().float()
    if dist.is_available() and dist.is_initialized():
        dist.all_reduce(broken, op=dist.ReduceOp.MAX)
    return not bool(broken)


def gradient_norm(model: nn.Module) -> Tensor:
    """Global L2 norm of the gradients, a scalar; not finite where a gradient is not, or where the squares overflow."""
    return nn.utils.get_total_norm([p.grad for p in model.parameters() if p.grad is not None])


def describe_gradients(model: nn.Module) -> str:
    """Names of the parameters whose gradients are not finite, or of the largest where only the norm overflows."""
    gradients = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
    bad = [name for name, gradient in gradients.items() if not torch.isfinite(gradient).all()]
    if bad:
        more = f" and {len(bad) - MAX_NAMES} more" if len(bad) > MAX_NAMES else ""
        return f"the gradients of {len(bad)} of {len(gradients)} parameters are not: {', '.join(bad[:MAX_NAMES])}{more}"
    largest = {name: float(gradient.abs().max()) for name, gradient in gradients.items() if gradient.numel()}
    name = max(largest, key=largest.__getitem__)
    return f"the norm of the gradients overflows; the largest is {largest[name]:.3g} in {name}"


# ---------------------------------------------------------------- dumps


def write_dump(
    folder: Path,  # of the run
    model: nn.Module,  # as it was before the step
    config: dict[str, Any],
    batch: FrameBatch,
    **step: Any,  # plain values and tensors: global_step, epoch, rank, world_size, seed, memories, found
) -> Path | None:
    """Write `nonfinite-step000123-rank0.pt`, a checkpoint with all that `src.replay` needs to run the step again.

    The newest `MAX_DUMPS` of the rank are kept. None, with a warning, where the disk refuses: what is not finite is
    reported all the same.
    """
    rank = step["rank"]
    path = folder / f"nonfinite-step{step['global_step']:06d}-rank{rank}.pt"
    content = {
        "state_dict": {f"model.{name}": value.cpu() for name, value in model.state_dict().items()},
        "horizon3d": {"config": config, "step": step | {"batch": _plain(batch)}},
    }
    try:
        AtomicCheckpointIO(fail_fast=lambda: True).save_checkpoint(content, path)  # the other ranks wait
        named = re.compile(rf"nonfinite-step\d+-rank{rank}\.pt")
        others = [old for old in folder.iterdir() if named.fullmatch(old.name) and old != path]  # clocks may be wrong
        for old in sorted(others, key=lambda old: old.stat().st_mtime)[: 1 - MAX_DUMPS]:
            old.unlink()
    except (CheckpointError, OSError) as error:
        logger.warning("the step could not be kept for a replay: %s", error)
        return None
    return path


def read_dump(path: Path) -> tuple[dict[str, Any], FrameBatch]:
    """A dump, with the step under ["horizon3d"]["step"], and its batch; nothing in the file is executed.

    Raises CheckpointError for anything else than a dump.
    """
    content = read_checkpoint(path)
    step = content["horizon3d"].get("step")
    known = {"global_step", "epoch", "rank", "world_size", "seed", "memories", "found", "batch"}
    if not isinstance(step, dict) or not known <= step.keys():
        raise CheckpointError(f"{path} is no dump of a step; training leaves those as nonfinite-step*.pt in its folder")
    try:
        values = dict(step["batch"])
        if values["boxes"] is not None:
            values["boxes"] = [Boxes3D(**boxes) for boxes in values["boxes"]]
        if values["rays"] is not None:
            values["rays"] = RayBundle(**values["rays"])
        values["past"] = tuple(FrameBatch(**(frame | {"past": ()})) for frame in values["past"])
        return content, FrameBatch(**values)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path}: its batch is not as written ({error})") from error


def _plain(value: Any) -> Any:
    """Tensors on the CPU, and batches, boxes and rays as dictionaries."""
    if isinstance(value, Tensor):
        return value.detach().cpu()
    if isinstance(value, (FrameBatch, Boxes3D, RayBundle)):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value
