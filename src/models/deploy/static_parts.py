"""The parts of a prepared detector whose shapes never change: compiled, or replayed as a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor, nn

from src.models.backbones.image import ImageEncoder
from src.models.deploy.inference import declared_parts

T = TypeVar("T")
WARM_UP_RUNS = 3
"""Before a capture, so that libraries have chosen their kernels and taken their memory."""


def capture_graph(
    step: Callable[[], T], device: torch.device, restore: Callable[[], None] = lambda: None
) -> tuple[torch.cuda.CUDAGraph, T]:
    """What `step` launches on a device as a CUDA graph, and its result, which every replay fills anew.

    `step` runs a few times before; `restore` undoes what these runs have changed, also where one of them fails.
    """
    with torch.cuda.device(device):  # a stream, and a graph without one of its own, are of the current device
        stream, graph = torch.cuda.Stream(device), torch.cuda.CUDAGraph()
        stream.wait_stream(torch.cuda.current_stream(device))
        try:
            with torch.cuda.stream(stream):
                for _ in range(WARM_UP_RUNS):
                    step()
        finally:
            torch.cuda.current_stream(device).wait_stream(stream)
            restore()
        with torch.cuda.graph(graph, stream=stream):
            result = step()
    return graph, result


class ImageNetwork(nn.Module):
    """Backbone and neck of an image encoder as one function of the normalised views."""

    static_parts = ("",)

    def __init__(self, backbone: nn.Module, neck: nn.Module) -> None:
        super().__init__()
        self.backbone, self.neck = backbone, neck

    def forward(
        self,
        x: Tensor,  # [M, 3, H, W] normalised
    ) -> list[Tensor]:  # per level [M, C_I, H_l, W_l]
        return self.neck(self.backbone(x))


@dataclass
class _Capture:
    graph: torch.cuda.CUDAGraph
    input: Tensor
    outputs: list[Tensor]


class GraphReplay(nn.Module):
    """Runs a network as one CUDA graph for each shape of its input, without its launches; on a CPU as it is.

    What it returns is a copy, so results of earlier calls stay what they are. One thread at a time may call it: all
    calls share the graph's input.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self._captures: dict[tuple[torch.Size, bool], _Capture] = {}

    @torch.inference_mode()
    def forward(
        self,
        x: Tensor,
    ) -> list[Tensor]:
        """Results of the network."""
        if x.device.type != "cuda":
            return self.network(x)
        key = (x.shape, torch.is_autocast_enabled("cuda"))
        if key not in self._captures:
            self._captures[key] = self._capture(x)
        capture = self._captures[key]
        capture.input.copy_(x)
        capture.graph.replay()
        return [output.clone() for output in capture.outputs]

    def _capture(self, x: Tensor) -> _Capture:
        static = x.clone()
        graph, outputs = capture_graph(lambda: self.network(static), x.device)
        return _Capture(graph, static, outputs)


def replay_image_encoder(model: nn.Module) -> None:
    """Let the model's image encoder run as a CUDA graph, in place; the model must be prepared for inference."""
    for encoder in _image_encoders(model):
        _join(encoder)
        encoder.backbone = GraphReplay(encoder.backbone)


def compile_static_parts(model: nn.Module) -> None:
    """Compile them in place with `torch.compile`; the first frames take a minute or two then.

    They are the image network and what modules declare as `static_parts`. The model must be prepared for inference,
    which gives the Gaussians a fixed number of places.
    """
    for encoder in _image_encoders(model):
        _join(encoder)
    for part in list(declared_parts(model, "static_parts")):
        part.compile(dynamic=False)


def _image_encoders(model: nn.Module) -> list[ImageEncoder]:
    return [module for module in model.modules() if isinstance(module, ImageEncoder)]


def _join(encoder: ImageEncoder) -> None:
    if not isinstance(encoder.backbone, ImageNetwork | GraphReplay):
        encoder.backbone, encoder.neck = ImageNetwork(encoder.backbone, encoder.neck), nn.Identity()
