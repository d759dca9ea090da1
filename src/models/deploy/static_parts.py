"""The parts of a prepared detector whose shapes never change: compiled, or replayed as a CUDA graph."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from src.models.backbones.image import ImageEncoder
from src.models.deploy.inference import declared_parts

WARM_UP_RUNS = 3
"""Before a capture, so that libraries have chosen their kernels and taken their memory."""


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
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP_RUNS):
                self.network(static)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            outputs = self.network(static)
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
