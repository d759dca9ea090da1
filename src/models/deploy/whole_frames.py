"""Frames of one stream in fixed shapes, on a GPU as one CUDA graph: a copy there, the graph, a copy back."""

from __future__ import annotations

import itertools
import logging
import math
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from src.models.deploy.static_parts import capture_graph
from src.models.detector import FixedForm
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D

ALIGNMENT = 16
"""Bytes; every tensor of a frame begins at a multiple of it."""
logger = logging.getLogger(__name__)


class WholeFrames:
    """What a detector in fixed shapes makes of consecutive frames, and what it remembers of them.

    `captured` replays the frame as a CUDA graph, from the second on. `frames` and `refused` count what was given and
    what did not fit. One thread at a time may call it.
    """

    def __init__(self, form: FixedForm, device: torch.device, captured: bool) -> None:
        self.form, self.device, self.captured = form, device, captured
        self.frames = self.refused = 0
        self._memory = form.pack_memory(None, device)
        self._input: PackedFrame | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._result: Tensor | None = None

    @property
    def memory(self) -> Any:
        """What is remembered, as the detector's `forward` takes it. Waits for a GPU."""
        return self.form.unpack_memory(self._memory)

    @memory.setter
    @torch.inference_mode()
    def memory(self, memory: Any) -> None:
        for kept, new in zip(self._memory, self.form.pack_memory(memory, self.device), strict=True):
            kept.copy_(new)

    def step(self, frame: FrameBatch) -> Boxes3D | None:
        """Boxes of the next frame, best first, on the CPU; None where it does not fit, which is not remembered."""
        self.frames += 1
        fitted, boxes = self.form.fitted(frame), None
        if fitted is not None:
            boxes = self.form.boxes(self._run(fitted).cpu())
        if boxes is None:
            self.refused += 1
            logger.info(
                "frame %s exceeds a capacity (points, voxels, cells or pairs) and goes without fixed shapes, as %d of "
                "%d frames did; StreamingDetector(capacities=...) states larger ones",
                *(frame.tokens[0], self.refused, self.frames),
            )
        return boxes

    def _run(self, frame: FrameBatch) -> Tensor:
        if self._input is None:
            self._input = PackedFrame(frame, self.device)
        self._input.load(frame)
        if self._graph is not None:
            self._graph.replay()
            return self._result
        result = self._step()
        if self.captured:
            self._capture()
        return result

    def _step(self) -> Tensor:
        result, memory = self.form(self._input.frame, self._memory)
        for kept, new in zip(self._memory, memory, strict=True):
            kept.copy_(new)
        return result

    def _capture(self) -> None:
        """Record `_step`; the memory is afterwards as it was before."""
        before = [tensor.clone() for tensor in self._memory]

        def restore() -> None:
            for kept, old in zip(self._memory, before, strict=True):
                kept.copy_(old)

        self._graph, self._result = capture_graph(self._step, self.device, restore)


class PackedFrame:
    """Frames whose tensors always have the same shapes: side by side in one buffer, so that one copy moves them."""

    def __init__(self, frame: FrameBatch, device: torch.device) -> None:
        tensors = {x.name: getattr(frame, x.name) for x in fields(frame) if isinstance(getattr(frame, x.name), Tensor)}
        sizes = [ALIGNMENT * math.ceil(tensor.nbytes / ALIGNMENT) for tensor in tensors.values()]
        starts = [0, *itertools.accumulate(sizes)]
        self._host = torch.zeros(starts[-1], dtype=torch.uint8)
        if device.type != "cpu":
            self._host = self._host.pin_memory()
        self._buffer = self._host.to(device)

        def views(buffer: Tensor) -> dict[str, Tensor]:
            return {
                name: buffer[start : start + tensor.nbytes].view(tensor.dtype).view(tensor.shape)
                for start, (name, tensor) in zip(starts, tensors.items(), strict=False)
            }

        self._parts = views(self._host)
        self.frame = replace(frame, **views(self._buffer))
        """On the device, as last loaded."""

    def load(self, frame: FrameBatch) -> None:
        """Put another frame in place. Whatever reads the last one has been waited for."""
        for name, part in self._parts.items():
            part.copy_(getattr(frame, name))
        if self._buffer is not self._host:
            self._buffer.copy_(self._host, non_blocking=True)
