"""suite=model: time, arithmetic, memory traffic and memory of a model's parts, each against what the machine can do."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from src.assembly import build_datamodule, build_model, data_root
from src.benchmark.counting import counted_work, distinct_bytes
from src.benchmark.machine import gemm_rate, measure_roofline
from src.benchmark.operation_table import NOTE as OPERATIONS_NOTE
from src.benchmark.operation_table import operation_table
from src.benchmark.parts import Call, derive, is_within, parts_of, record_calls, tensors_in
from src.benchmark.timing import added_bytes, chosen_device, interleaved, median_spread, peak_bytes
from src.config import Config
from src.models.deploy.inference import prepare_for_inference
from src.models.detector import Detector
from src.reliability.checkpoints import load_model_weights, read_checkpoint
from src.structures.batch import FrameBatch

logger = logging.getLogger(__name__)

ROUNDS = 5  # all parts in turns; a round of the full size takes ten seconds on two cores
KEY_FRAME_S = 0.5
CANDIDATES = 300  # cells above the score threshold: what traffic lights up in a trained model, within its 500 boxes
BACKWARD_PASSES = 3  # of inputs, outputs and weights: forward, and once more each for gradients to be read and written


@dataclass
class Case:
    """A model, as trained and as prediction prepares it, with a batch and, in phase 2, a full memory."""

    model: Detector
    prepared: Detector
    batch: FrameBatch
    memory: Any
    device: torch.device
    autocast: bool  # bfloat16

    @contextmanager
    def precision(self) -> Iterator[None]:
        """As training and prediction compute."""
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.autocast):
            yield

    def infer(self) -> tuple[Any, Any]:
        """Forward and decode, without gradients."""
        with torch.no_grad(), self.precision():
            output, _ = self.prepared(self.batch, self.memory)
            return output, self.prepared.decode(output)

    def run(self) -> tuple[Any, Any]:
        """Forward, for gradients."""
        with self.precision():
            return self.model(self.batch, self.memory)

    def step(self) -> Tensor:
        """Forward, losses and backward; the weights' gradients are dropped."""
        with self.precision():
            output, _ = self.model(self.batch, self.memory)
            total = self.model.loss(output, self.batch).terms["total"]
        total.backward()
        self.model.zero_grad(set_to_none=True)
        return total.detach()


def benchmark_model(config: Config, tree: dict[str, Any]) -> dict[str, Any]:
    """The configured model on the first training batch; see `measure_parts` for the columns."""
    torch.manual_seed(config.seed)
    device = chosen_device(config)
    case = make_case(config, device)
    roofline = measure_roofline(device)
    rate = gemm_rate(roofline, config.precision)
    tables = measure_parts(case, rate, roofline["copy_gbps"])
    losses = case.step()
    with torch.no_grad():
        state = case.model.diagnostics(case.run()[0])
    return {
        "notes": [
            f"{config.model.name}, scale {config.scale}, {config.phase.name}, batch {len(case.batch)}, "
            f"{config.precision} on {device}. Medians of {ROUNDS} rounds in which every part has its turn, alone, with "
            "the inputs that it has within the model; ± is the range of the middle half. Forward is the model as "
            "prediction prepares it, f+b forward and backward of the model as it is trained. "
            + ("" if config.checkpoint else f"Fresh weights; {CANDIDATES} cells pass the score threshold."),
            "GFLOP are those of matrix products, convolutions and attention. The floor is the longer of GFLOP over the "
            "measured product rate and bytes over the measured copy rate, bytes being inputs, outputs and weights once "
            f"({BACKWARD_PASSES} times with backward). Traffic is what all operations read and write without fusion "
            "and cache. Added memory is the most that a call takes beyond its inputs and weights.",
            OPERATIONS_NOTE,
        ]
        + ([] if device.type == "cuda" else [gpu_note(config)]),
        **tables,
        "operations of a frame": operation_table(case.infer, device),
        "operations of forward, loss and backward": operation_table(case.step, device),
        "roofline": roofline,
        "device": str(device),
        "batch_size": len(case.batch),
        "peak_memory_mib": int(peak_bytes(device) / 2**20),
        "parameters": {n: sum(p.numel() for p in part.parameters()) for n, part in case.model.named_children()},
        "radar_points": len(case.batch.radar_points),
        "loss": float(losses),
        "state": {name: float(value) for name, value in state.items()},
    }


def gpu_note(config: Config) -> str:
    """The command that measures the same on a GPU."""
    return (
        "Measured without a GPU. There: `python -m src.benchmark suite=model "
        f"model={config.model.name} phase={config.phase.name} scale={config.scale} precision=bf16-mixed "
        "trainer.accelerator=gpu out=DIR`, with the data of the command above."
    )


def make_case(config: Config, device: torch.device) -> Case:
    """The configured model on its first training batch; in phase 2 the truck stands until the memory is full."""
    config.data.num_workers = 0
    datamodule = build_datamodule(config, data_root(config))
    batch = next(iter(datamodule.train_dataloader())).to(device)
    model = build_model(config)
    if config.checkpoint:
        load_model_weights(model, read_checkpoint(Path(config.checkpoint)), Path(config.checkpoint))
    bf16 = config.precision == "bf16-mixed"
    case = Case(model.to(device).train(), prepare_for_inference(model, bf16), batch, None, device, bf16)
    case = fill_memory(case, config.model.memory_frames)
    if not config.checkpoint:
        expect_trained_scores(case)
    return case


def fill_memory(case: Case, frames: int) -> Case:
    """The same case after so many frames of the same place."""
    with torch.no_grad():
        for _ in range(frames):
            _, case.memory = case.run()
            case.batch = replace(case.batch, timestamps_s=case.batch.timestamps_s + KEY_FRAME_S)
    return case


def expect_trained_scores(case: Case) -> Any:
    """Set the score threshold of the prepared model so that decoding has the work that it has in a trained one.

    Fresh weights give every cell about the threshold of the configuration, and boxes would be made of half of them.
    Returns the memory after the frame that told the scores.
    """
    with torch.no_grad(), case.precision():
        output, memory = case.prepared(case.batch, case.memory)
    scores = output.head.logits.float().sigmoid().flatten()
    if len(scores) > CANDIDATES:
        head = case.prepared.head
        head.config = replace(head.config, score_threshold=float(scores.topk(CANDIDATES).values[-1]))
    return memory


def measure_parts(
    case: Case,
    rate: float,  # GFLOP/s
    bandwidth: float,  # GB/s
) -> dict[str, list[dict[str, Any]]]:
    """Two tables with a row for each part, and for all of them: `time by part` and `work by part`."""
    parts = parts_of(case.model)
    inferred = record_calls(case.prepared, parts, case.infer)
    forward = measure_mode(case, inferred, backward=False)
    trained = record_calls(case.model, {name: parts[name] for name in inferred}, case.run)
    both = measure_mode(case, trained, backward=True)
    modes = {"forward": forward, "f+b": both}
    times, works = [], []
    for name in forward:
        time_row, work_row = {"part": name}, {"part": name}
        for mode, found in modes.items():
            if name in found:
                time_row |= time_columns(mode, found[name], rate, bandwidth)
                work_row |= work_columns(mode, found[name])
        times.append(time_row)
        works.append(work_row)
    rest: dict[str, Any] = {"part": "sum without the image encoder"}
    for mode, found in modes.items():
        counted = [values for name, values in found.items() if not is_within(name) and name != "image_encoder"]
        rest[f"{mode} ms"] = 1e3 * sum(median_spread(values["seconds"])[0] for values in counted)
    whole = measure_whole(case)
    label = {"part": "whole: frame to boxes, step to gradients"}
    for mode, found in whole.items():
        label |= {f"{mode} ms": 1e3 * median_spread(found["seconds"])[0]}
        label |= {f"± {mode}": 1e3 * median_spread(found["seconds"])[1]}
    times += [rest, label]
    works.append(
        {"part": label["part"]} | work_columns("forward", whole["forward"]) | work_columns("f+b", whole["f+b"])
    )
    return {"time by part": times, "work by part": works}


def time_columns(mode: str, found: dict[str, Any], rate: float, bandwidth: float) -> dict[str, Any]:
    """How long a part takes, and how much of that the machine would need at least."""
    middle, spread = median_spread(found["seconds"])
    by_rate, by_bandwidth = found["flops"] / rate / 1e9, found["compulsory_bytes"] / bandwidth / 1e9
    floor = max(by_rate, by_bandwidth)
    return {
        f"{mode} % of floor": 100 * floor / middle,
        f"{mode} ms": 1e3 * middle,
        f"± {mode}": 1e3 * spread,
        f"{mode} floor ms": 1e3 * floor,
        f"{mode} bound by": "products" if by_rate >= by_bandwidth else "bytes",
    }


def work_columns(mode: str, found: dict[str, Any]) -> dict[str, Any]:
    """What a part computes, moves and holds."""
    compulsory, added = found.get("compulsory_bytes"), found["added_bytes"]
    return {
        f"{mode} GFLOP": found["flops"] / 1e9,
        f"{mode} MB": None if compulsory is None else compulsory / 1e6,
        f"{mode} traffic MB": found["traffic_bytes"] / 1e6,
        f"{mode} added MiB": None if added is None else added / 2**20,
    }


def measure_mode(case: Case, calls: dict[str, list[Call]], backward: bool) -> dict[str, dict[str, Any]]:
    """Seconds, arithmetic and bytes of every part; a part without anything to derive counts as its forward."""

    def prepared(name: str) -> Callable[[], bool]:
        ready = [call.prepare() for call in calls[name]]

        def run() -> bool:
            with torch.set_grad_enabled(backward), case.precision():
                results = [call() for call in ready]
            return backward and any([derive(result) for result in results])

        return run

    found: dict[str, dict[str, Any]] = {}
    for name in calls:
        with counted_work() as work:
            derived = prepared(name)()
        found[name] = {
            "flops": work.flops,
            "traffic_bytes": work.bytes,
            "compulsory_bytes": (BACKWARD_PASSES if derived else 1) * compulsory_bytes(calls[name]),
            "added_bytes": added_bytes(prepared(name), case.device),
            "seconds": [],
        }
        case.model.zero_grad(set_to_none=True)
    for number in range(1 + ROUNDS):
        logger.info("%s, round %d of %d", "f+b" if backward else "forward", number, ROUNDS)
        for name in calls:
            seconds = interleaved({name: prepared(name)}, case.device, 1, warm_up=0)[name]
            case.model.zero_grad(set_to_none=True)
            found[name]["seconds"] += seconds if number else []
    return found


def compulsory_bytes(calls: list[Call]) -> int:
    """Inputs, results and weights of a part, each once: what no implementation can avoid to read or to write."""
    owners = [getattr(call.function, "__self__", None) for call in calls]
    weights = [p for owner in owners if isinstance(owner, torch.nn.Module) for p in owner.parameters()]
    values = tensors_in([[call.arguments, call.named, call.result] for call in calls])
    return distinct_bytes([*weights, *values])


def measure_whole(case: Case) -> dict[str, dict[str, Any]]:
    """All parts in place: a frame to its boxes, and a training step to its gradients with losses and targets."""
    found = {}
    for mode, function in (("forward", case.infer), ("f+b", case.step)):
        with counted_work() as work:
            function()
        found[mode] = {
            "flops": work.flops,
            "traffic_bytes": work.bytes,
            "added_bytes": added_bytes(function, case.device),
            "seconds": interleaved({mode: function}, case.device, ROUNDS)[mode],
        }
    return found
