"""`python -m src.replay checkpoint=outputs/RUN/nonfinite-step000123-rank0.pt`: a step of a training, run again.

Training leaves such a file where a loss or a gradient is not finite. This command rebuilds the model with the weights,
the batch, the memory and the seed of that step, runs it forward and backward, and prints what is not finite: inputs,
loss terms, modules, gradients. Then it runs the step once more up to the first such number and, in a terminal, opens
Python's debugger there (`up` leads to the model's code; `q` ends). The exit code is 5, or 0 where all numbers are
finite this time.

The configuration is the dump's, and its keys may be changed: trainer.accelerator=cpu, precision=32-true,
model.loss.box_weight=0.1. On another kind of device dropout draws other numbers. A step of several processes is run
again as the one that wrote the dump saw it: with its own batch, and losses divided by its own number of objects.
"""

from __future__ import annotations

import pdb
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from src.assembly import build_module, restored_model
from src.config import Config, compose_config, refuse_options_of_others, restore_config
from src.errors import ConfigError, DivergedError
from src.ops.precision import computing
from src.reliability.command import run_command
from src.reliability.cpu import tune_cpu
from src.reliability.nonfinite import describe_gradients, gradient_norm, read_dump
from src.structures.batch import LIDAR_POINT_FIELDS, RADAR_POINT_FIELDS, FrameBatch
from src.training.module import TrainingModule

MAX_SHOWN = 8


def main(overrides: list[str]) -> None:
    """Run a dumped step again. Raises DivergedError at the first number that is not finite."""
    command, _ = compose_config(overrides)
    refuse_options_of_others(command, "replay")
    tune_cpu()  # as the step that it repeats
    if command.checkpoint is None:
        raise ConfigError("give checkpoint=PATH of a dump, nonfinite-step*.pt in the folder of a run")
    path = Path(command.checkpoint)
    content, batch = read_dump(path)
    config = restore_config(content["horizon3d"]["config"], overrides)
    step = Step(path, config, content, batch, config.trainer.device())
    print(f"{content['horizon3d']['step']['found']}\n")
    for line in describe_inputs(batch):
        print(line)
    watch = Watch()
    if report(step, watch):
        print("\nAll numbers are finite this time.")
        return
    try:
        step.stop_at_first(watch)
    except DivergedError as error:
        if sys.stdin.isatty():
            print(f"\n{error}\n")
            pdb.post_mortem(error.__traceback__)
        raise


@dataclass
class Step:
    """A step of a training, that can be run any number of times."""

    path: Path
    config: Config
    content: dict[str, Any]  # of the dump
    batch: FrameBatch
    device: torch.device

    def build(self) -> TrainingModule:
        """The module as it was when the step began. Raises CheckpointError when the weights do not fit."""
        config, step = self.config, self.content["horizon3d"]["step"]
        module = build_module(config, {}, None, restored_model(config, self.content, self.path))
        module.restore_rank({"means": {}, "memories": step["memories"]})
        module.to(self.device)
        module.on_fit_start()
        return module.train()

    def forward(self, module: TrainingModule) -> dict[str, Tensor]:
        """The loss terms, drawn from the step's own seed."""
        torch.manual_seed(self.content["horizon3d"]["step"]["seed"])
        batch = self.batch.to(self.device)
        with computing(self.config.precision, self.device):
            return module.model.loss(module.run(batch), batch).terms

    def stop_at_first(self, seen: Watch) -> None:
        """Run up to the first number that is not finite, and raise DivergedError there.

        `seen` holds the findings of a complete run, which alone stop this one: modules may rightly give infinities.
        """
        module = self.build()
        with warnings.catch_warnings(record=True) as caught, torch.autograd.set_detect_anomaly(True):
            warnings.simplefilter("always")  # autograd names the line of the forward pass in a warning
            try:
                with Watch(stop_at=seen.first).over(module.model):
                    self.forward(module)["total"].backward()
            except RuntimeError as error:  # anomaly detection knows NaN only
                trace = next((str(w.message) for w in caught if "forward call" in str(w.message)), "")
                raise DivergedError(f"{error} {_own_line(trace)}") from error
        raise DivergedError("the loss terms themselves, or their weights, are not finite")


class Watch:
    """Records modules whose output is not finite, and those where the gradient at the output is not."""

    def __init__(self, stop_at: str | None = None) -> None:
        self.stop_at = stop_at  # raise DivergedError at this finding
        self.outputs: list[str] = []
        self.gradients: list[str] = []
        self.loss_is_finite = True

    @property
    def first(self) -> str | None:
        """What to stop at: infinities in a forward pass that ends well are meant to be there."""
        found = self.gradients if self.loss_is_finite else self.outputs
        return found[0] if found else None

    def _note(self, found: list[str], what: str) -> None:
        found.append(what)
        if what == self.stop_at:
            raise DivergedError(f"the first that is not finite: {what}")

    @contextmanager
    def over(self, model: nn.Module) -> Iterator[None]:
        """Hook every module's outputs and their gradients for the time within."""

        def check(name: str, module: nn.Module, output: Any) -> None:
            what = f"{name} ({type(module).__name__})"
            values = [value for value in _tensors(output) if value.is_floating_point()]
            if not all(bool(torch.isfinite(value).all()) for value in values):
                self._note(self.outputs, f"the output of {what}")

            def check_gradient(gradient: Tensor) -> None:
                if not torch.isfinite(gradient).all():
                    self._note(self.gradients, f"the gradient at the output of {what}")

            for value in values:
                if value.requires_grad:
                    value.register_hook(check_gradient)

        handles = [
            module.register_forward_hook(lambda module, _, output, name=name: check(name, module, output))
            for name, module in model.named_modules()
            if name
        ]
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()


def report(step: Step, watch: Watch) -> bool:
    """Run the step to its end and print what it gives; whether loss and gradients are finite."""
    module = step.build()
    with watch.over(module.model):
        terms = step.forward(module)
        watch.loss_is_finite = bool(torch.isfinite(terms["total"]))
        print("\nloss terms:")
        for name, value in terms.items():
            print(f"  {name:20s} {float(value.detach()):.6g}{'' if torch.isfinite(value) else '   <- not finite'}")
        terms["total"].backward()
    norm = gradient_norm(module.model)
    print(f"norm of all gradients: {float(norm):.6g}")
    if watch.loss_is_finite and torch.isfinite(norm):
        return True
    print(describe_gradients(module.model))
    direction, names = ("backward", watch.gradients) if watch.loss_is_finite else ("forward", watch.outputs)
    names = list(dict.fromkeys(names))
    if names:
        print(f"\nnot finite, in the order of the {direction} pass:")
        for name in names[:MAX_SHOWN]:
            print(f"  {name}")
        if len(names) > MAX_SHOWN:
            print(f"  and {len(names) - MAX_SHOWN} more")
    return False


def describe_inputs(batch: FrameBatch) -> Iterator[str]:
    """A line for each kind of input that is not finite, of past frames too; unknown velocities and speeds are NaN."""
    for past in batch.past:
        yield from describe_inputs(past)
    for sensor, names in (("radar", RADAR_POINT_FIELDS), ("lidar", LIDAR_POINT_FIELDS)):
        points, owners = getattr(batch, f"{sensor}_points"), getattr(batch, f"{sensor}_batch")
        rows = [] if points is None else (~torch.isfinite(points).all(dim=1)).nonzero().flatten()[:MAX_SHOWN].tolist()
        for row in rows:
            point = ", ".join(f"{n} {v:.4g}" for n, v in zip(names, points[row], strict=True))
            yield f"input: {sensor} point {row} of {batch.tokens[int(owners[row])]} is not finite: {point}"
    for name in ("timestamps_s", "global_from_ego", "aug_from_ego", "pix_from_aug", "lidar_origins"):
        value = getattr(batch, name)
        if value is not None and not torch.isfinite(value).all():
            yield f"input: {name} of {', '.join(batch.tokens)} is not finite"
    for name in ("origins", "directions", "ranges", "times_s") if batch.rays is not None else ():
        if not torch.isfinite(getattr(batch.rays, name)).all():
            yield f"input: {name} of the rays of {', '.join(batch.tokens)} are not finite"
    for token, boxes in zip(batch.tokens, batch.boxes or [], strict=False):
        for name in ("centers", "sizes", "yaws"):
            if not torch.isfinite(getattr(boxes, name)).all():
                yield f"input: {name} of the boxes of {token} are not finite"


def _tensors(value: Any) -> Iterator[Tensor]:
    """All tensors in nested containers and dataclasses."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from _tensors(item)
    elif is_dataclass(value):
        for field in fields(value):
            yield from _tensors(getattr(value, field.name))


def _own_line(trace: str) -> str:
    """The innermost line of this project in a traceback of the forward pass."""
    lines = trace.splitlines()
    folder = str(Path(__file__).resolve().parent)
    own = [f"{line.strip()}: {code.strip()}" for line, code in zip(lines, lines[1:], strict=False) if folder in line]
    return f"It derives {own[-1]}" if own else ""


if __name__ == "__main__":
    run_command(main)
