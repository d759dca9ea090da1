"""A frame of Horizon3D in fixed shapes: nothing waits between the frame and its boxes, the memory included."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.models.heads.fixed_decode import FixedDecode
from src.models.horizon3d.dptf_memory import DPTFMemory
from src.models.horizon3d.fixed_memory import FixedMemory
from src.models.horizon3d.gaussian_path import Sampling
from src.models.horizon3d.splatting import FAR_M
from src.ops.box_codes import WIDTHS
from src.ops.fixed_shapes import Capacities, FixedShapes, in_fixed_shapes
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.targets.heatmap import HEAD_GROUPS

if TYPE_CHECKING:
    from src.models.horizon3d.model import Horizon3D

PAIRS_PER_GAUSSIAN = 256
"""A window of 16 x 16 cells, of a Gaussian whose scales are 2.1 m; an untrained one has 13 x 13."""


class FixedHorizon3D(nn.Module):
    """One frame of one stream, not augmented, by a model that is prepared for inference; see `FixedForm`."""

    def __init__(self, model: Horizon3D, capacities: Capacities | None) -> None:
        super().__init__()
        self.model, self.capacities = model, capacities or default_capacities(model)
        self.head = FixedDecode(model.head)

    @staticmethod
    def serves(model: Horizon3D) -> bool:
        """Whether the model is prepared, neither its images nor its memory make the host look at values, and older
        frames stay as they were remembered."""
        path = model.dptf.gaussian_path if model.dptf is not None else None
        looks = model.image_encoder is not None and model.image_encoder.trim_padding
        draws = path is not None and path.config.sampling is Sampling.random
        changes = path is not None and path.config.forget_refuted
        return model.prepared_for is not None and not (looks or draws or changes)

    def fitted(self, frame: FrameBatch) -> FrameBatch | None:
        """The frame with as many points as there is room for; None where it has more."""
        missing = self.capacities.points + 1 - len(frame.radar_points)  # at least one is padding
        if missing < 1:
            return None
        read = ("timestamps_s", "global_from_ego", "aug_from_ego")
        views = ("images", "image_valid", "pix_from_aug") if self.model.image_encoder is not None else ()
        return FrameBatch(
            frame.tokens,
            radar_points=F.pad(frame.radar_points, (0, 0, 0, missing), value=FAR_M),
            radar_batch=F.pad(frame.radar_batch, (0, missing)),
            **{name: getattr(frame, name) for name in (*read, *views)},
        )

    def forward(self, frame: FrameBatch, memory: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
        """What `boxes` reads, and the memory with the frame added; as it was where the frame has overflowed."""
        model, past, warped, kept = self.model, None, None, None
        shapes = FixedShapes(self.capacities, model.grid.cells)
        with torch.no_grad(), in_fixed_shapes(shapes):
            if model.dptf is not None:
                past = FixedMemory(*memory)
                warped, kept = past.recall(model.dptf, frame)
            output = model.detect(frame, warped)
            candidates = self.head(output.head)
            overflow = shapes.overflow()
            if past is not None:
                memory = past.pushed(kept, frame, output, model.dptf, overflow).tensors
            return torch.cat([candidates.flatten(), overflow[None].float()]), memory

    def boxes(
        self,
        result: Tensor,  # of `forward`, on the CPU
    ) -> Boxes3D | None:
        """Boxes of the frame, best first; None where it has overflowed."""
        if result[-1] > 0:
            return None
        return self.head.boxes(result[:-1].view(len(HEAD_GROUPS), -1, sum(WIDTHS)))

    def pack_memory(self, memory: DPTFMemory | None, device: torch.device) -> tuple[Tensor, ...]:
        """The memory of one stream as `forward` takes it. Raises ValueError for one of several."""
        if self.model.dptf is None:
            return ()
        found = DPTFMemory(()) if memory is None else memory
        if found.batch_size > 1:
            raise ValueError(f"the memory holds {found.batch_size} streams, but fixed shapes are for one")
        return FixedMemory.of(found, self.model.dptf, self.model.config.channels, device).tensors

    def unpack_memory(self, memory: tuple[Tensor, ...]) -> DPTFMemory | None:
        """The inverse of `pack_memory`, in float32; what is never read again is lost. Waits for a GPU."""
        return FixedMemory(*(tensor.clone() for tensor in memory)).to_memory() if memory else None


def default_capacities(model: Horizon3D) -> Capacities:
    """Room for as many points as voxels are allowed, twice as many sites, twice the cells that Gaussians may occupy."""
    config, cells = model.config, model.grid.rows * model.grid.cols
    most = config.radar_encoder.max_voxels
    if config.ocsf is None:
        return Capacities(points=most, voxels=2 * most, cells=cells, pairs=1)
    gaussians = sum(config.kggi.counts.values())
    if config.dptf is not None and config.dptf.gaussian_path is not None:
        gaussians += config.dptf.gaussian_path.num_history_gaussians
    occupied = min(2 * config.ocsf.max_occupied_cells, cells)
    return Capacities(points=most, voxels=2 * most, cells=occupied, pairs=PAIRS_PER_GAUSSIAN * gaussians)
