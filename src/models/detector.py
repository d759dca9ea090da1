"""What every detector offers to training and inference: forward, loss, decode, and memory as a value."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import torch
from torch import Tensor, nn

from src.geometry.constants import on_device
from src.models.memory import FrameMemory
from src.ops.fixed_shapes import Capacities
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.evidence import Evidence


@dataclass(kw_only=True)
class ModelConfig:
    """What every model's settings (`model`) have in common, and what commands ask of them.

    Each also has `sensors`, a class variable, property or key: which of `taxonomy.SENSORS` are read, all that `forward`
    takes of a batch, and what a submission states.
    """

    temporal_part: ClassVar[str] = ""
    """The key of all that is temporal; a phase of single frames sets it to null. Empty for a model without."""
    temporal_switches: ClassVar[tuple[str, ...]] = ()
    """Keys of switches that only this part reads, though they stand elsewhere; such a phase sets them to false."""
    new_in_temporal_phase: ClassVar[str] = ""
    """Regular expression: names of the parameters that the temporal phase adds, and no checkpoint of the phase before
    holds. Empty for a model without."""
    layer_stack: ClassVar[str] = ""
    """Name of a list of alike layers, each of which refines what the one before it made. Empty for a model without."""
    keys_of_later_phases: ClassVar[tuple[str, ...]] = ()
    """Dotted keys of what the first of several temporal phases neither builds nor reads."""

    name: str
    channels: int  # C, width of the map that the head reads

    @property
    def keys_of_temporal_phase(self) -> tuple[str, ...]:
        """Dotted keys that change nothing of a run of the phase before."""
        return (f"model.{self.temporal_part}",) if self.temporal_part else ()

    @property
    def memory_frames(self) -> int:
        """How many past key frames are remembered at most; 0 for single frames."""
        return 0 if self._temporal is None else self._temporal.num_frames

    @property
    def memory_max_age_s(self) -> float | None:
        """How far back the memory may lie; None for single frames."""
        return None if self._temporal is None else self._temporal.max_age_s

    @property
    def moves_memory(self) -> bool:
        """Whether what is remembered moves by velocities of its own, if it has any, which an oracle can replace."""
        return self._temporal is not None

    @property
    def _temporal(self) -> Any:
        return getattr(self, self.temporal_part) if self.temporal_part else None

    def scaled(
        self, gaussians: float = 1.0, memory_frames: int | None = None, cells_per_frame: int | None = None
    ) -> Self:
        """The settings of a measurement: with so many times the Gaussians; with so many remembered frames (0: none,
        None: as configured); with so many cells remembered of each, whatever fresh weights call occupied. What a model
        does not have stays as it is."""
        past = self._temporal
        if memory_frames is None or past is None or "num_frames" not in {field.name for field in fields(past)}:
            return self
        past = replace(past, num_frames=memory_frames) if memory_frames else None
        return replace(self, **{self.temporal_part: past})

    def at_range(self, range_m: float) -> Self:
        """The settings with a region of their own, not the `grid`, that reaches at least so far to each side."""
        return self


class FixedForm(Protocol):
    """A frame of one stream by a detector in fixed shapes (`ops/fixed_shapes.py`), which always launches the same."""

    def fitted(self, frame: FrameBatch) -> FrameBatch | None:
        """The frame, not augmented, in the form of all others; None where it is too large."""

    def __call__(self, frame: FrameBatch, memory: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """A result of one tensor, and the memory with the frame added; as it was where the frame has overflowed."""

    def boxes(self, result: Tensor) -> Boxes3D | None:
        """Boxes of a result on the CPU, best first; None where the frame has overflowed."""

    def pack_memory(self, memory: Any, device: torch.device) -> tuple[Tensor, ...]:
        """What `forward` of the detector remembers of one stream, None for nothing, in fixed shapes."""

    def unpack_memory(self, memory: tuple[Tensor, ...]) -> Any:
        """The inverse of `pack_memory`, for `forward`. Waits for a GPU."""


class Objective(NamedTuple):
    """What a training step minimises, and what it shows besides."""

    terms: dict[str, Tensor]  # weighted, each a scalar; `Detector.loss` adds `total`, their sum
    diagnostics: dict[str, Tensor]  # scalars worth a curve that are no losses


class Detector(nn.Module, ABC):
    """One frame in, boxes out. State between frames never lives on the module; the output is the model's own type.

    What else others want to know of a model it declares by the optional members below and, where inference is
    concerned, by those of its modules (`deploy/inference.py`).
    """

    phase_options: ClassVar[type]
    """Dataclass of what a phase says to this family, `phase.options`; an instance is the constructor's last."""
    benchmark_parts: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """Parts worth looking into, beside the model's children: by name the methods, `ocsf.encoder.forward`, or functions,
    `package.module:function`, that each is; `part: inner` lies within `part`."""
    latency_parts: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    """The parts of Table 15 by the methods that each is; one within another counts for both."""
    memory_type: ClassVar[type[FrameMemory] | None] = None
    """Class of the memory that `forward` takes and returns; None for a model of single frames."""
    trains_last_transition: bool = False
    """Whether a step learns also through the encoding of the frame before, where frames bring their past along."""
    prepared_for: str | None = None
    """The precision that `prepare_for_inference` made this copy for; None: as trained."""

    @property
    def image_backbone(self) -> nn.Module | None:
        """The part trained at the backbone's own learning rate: the image encoder's; None without one."""
        encoder = getattr(self, "image_encoder", None)
        return None if encoder is None else encoder.backbone

    @abstractmethod
    def forward(
        self, batch: FrameBatch, memory: Any = None
    ) -> tuple[Any, Any]:  # each model returns its own dataclass and memory
        """Everything that `loss` and `decode` need for the B frames of a batch, and the memory with these frames added.

        `memory` is what the call for the previous frames of the same streams returned, row by row (see
        `FrameMemory.select`); None where there is none. A detector of single frames takes and returns None.
        """

    def fixed_form(self, capacities: Capacities | None = None) -> FixedForm | None:
        """How a frame runs in fixed shapes, None without; capacities None are the detector's own."""
        return None

    def output_alone(self, batch: FrameBatch, memory: Any) -> Any:
        """The output of `forward`, of a frame that none follows."""
        return self(batch, memory)[0]

    def transition(self, batch: FrameBatch, memory: Any) -> Any:
        """The memory of `forward` where the frame is only remembered; not detached with `trains_last_transition`."""
        return self(batch, memory)[1]

    def memory_of(self, frames: Iterable[FrameBatch]) -> Any:
        """The memory of consecutive frames, the oldest first, of which the first has none; None for no frame."""
        memory = None
        for frame in frames:
            memory = self.transition(frame, memory)
        return memory

    def restore_memory(self, state: list[dict[str, Any]]) -> Any:
        """The memory that `FrameMemory.state` described. Raises NotImplementedError for single-frame detectors."""
        if self.memory_type is None:
            raise NotImplementedError(f"{type(self).__name__} has no memory")
        return self.memory_type.from_state(state)

    def loss(self, output: Any, batch: FrameBatch) -> Objective:
        """Weighted terms by name with their sum `total`, and scalars worth a curve, all in float32."""
        with torch.autocast(batch.device.type, enabled=False):
            terms, counts = self.loss_terms(output, batch)
        with torch.no_grad():
            values = self.diagnostics(output) | counts
            known = {name: value for name, value in values.items() if not isinstance(value, Tensor)}
            uploaded = dict(zip(known, on_device([*known.values()], torch.float32, batch.device), strict=True))
            shown = {name: uploaded.get(name, value).float() for name, value in values.items()}
        total = sum(terms.values(), torch.zeros((), device=batch.device))
        return Objective(terms | {"total": total}, shown)

    @abstractmethod
    def loss_terms(self, output: Any, batch: FrameBatch) -> Objective:
        """Weighted loss terms by name, and what comparing with the truth shows besides.

        Raises ValueError for a batch that lacks what it compares with.
        """

    def decode(self, output: Any) -> list[Boxes3D]:
        """Predicted boxes with scores, one entry per sample, best first, in the (augmented) ego frame: the head's."""
        return self.head.decode(output.head)

    def diagnostics(self, output: Any) -> dict[str, Tensor | float]:
        """Scalars of the output that are worth a curve."""
        return {}

    def evidence(self, output: Any) -> Evidence:
        """What pictures of a frame can show and measures can compare with the truth, beside its boxes."""
        return Evidence()
