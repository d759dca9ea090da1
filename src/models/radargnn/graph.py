"""Graph over radar points: who hears whom, and features that do not depend on where the scene lies (RadarGNN)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor

from src.errors import require_least
from src.geometry.constants import constant
from src.geometry.tensor_transforms import rotate, rotate_back, unit_vectors
from src.models.backbones.sparse_voxel import POINT_SCALES
from src.ops.nearest_neighbours import nearest_neighbours

EDGE_UNIT_M = 5.0
MIN_SPEED_MPS = 1e-6
"""Below it a point has no direction of motion; its angles count as right ones, as in the public code."""
MIN_DISTANCE_M = 1e-3
"""Points nearer to one another have no direction between them."""


class Invariance(Enum):
    """Under what motions of the whole scene the features stay and boxes move along.

    `translation`: edges carry relative positions, nodes velocity vectors. `rigid`: also rotations about the vertical:
    edges carry point-pair features, nodes speeds, and boxes are relative to the direction of the nearest neighbour.
    """

    translation = "translation"
    rigid = "rigid"


@dataclass(kw_only=True)
class GraphConfig:
    """Settings of the graph (`model.graph`). Raises ConfigError for values that cannot work."""

    num_neighbours: int  # k, points that each one hears
    invariance: Invariance

    def __post_init__(self) -> None:
        require_least(self, "model.graph", {"num_neighbours": 1})

    @property
    def widths(self) -> tuple[int, int]:
        """Numbers of a node and of an edge, in `PointGraph.nodes` and `PointGraph.edges`."""
        return (5, 5) if self.invariance is Invariance.rigid else (6, 2)


@dataclass
class PointGraph:
    """n points of B samples; each hears its k nearest of the same sample."""

    points: Tensor  # [n, 7] x, y, z (m, aug frame), rcs (dB), vx, vy (m/s), dt (s), float32
    sample: Tensor  # [n] int64, ascending
    batch_size: int
    neighbours: Tensor  # [n, k] int64 row of each, nearest first; the point's own where it has fewer
    present: Tensor  # [n, k] bool
    axes: Tensor  # [n, 2] unit vector in the aug frame: the x axis that boxes of the point are relative to
    nodes: Tensor  # [n, node features]
    edges: Tensor  # [n, k, edge features], zero where not present

    def to_local(
        self,
        codes: Tensor,  # [m, CODE_SIZE] centre (m), log sizes, cos, sin of the yaw, velocity (m/s); aug frame
        rows: Tensor | slice,  # [m] int64, the point of each
    ) -> Tensor:  # [m, CODE_SIZE]
        """Box codes relative to points: centre and velocity less theirs, all directions turned to their axes."""
        points = self.points[rows]
        codes = torch.cat([codes[:, :2] - points[:, :2], codes[:, 2:8], codes[:, 8:] - points[:, 4:6]], dim=1)
        return self._turn(codes, rows, rotate_back)

    def to_frame(
        self,
        codes: Tensor,  # [m, CODE_SIZE] of `to_local`
        rows: Tensor | slice,
    ) -> Tensor:  # [m, CODE_SIZE]
        """The inverse of `to_local`."""
        codes, points = self._turn(codes, rows, rotate), self.points[rows]
        return torch.cat([codes[:, :2] + points[:, :2], codes[:, 2:8], codes[:, 8:] + points[:, 4:6]], dim=1)

    def _turn(self, codes: Tensor, rows: Tensor | slice, turn: Callable[..., tuple[Tensor, Tensor]]) -> Tensor:
        cosine, sine = self.axes[rows].unbind(1)
        offset, heading, velocity = (
            torch.stack(turn(cosine, sine, *codes[:, first : first + 2].unbind(1)), dim=1) for first in (0, 6, 8)
        )
        return torch.cat([offset, codes[:, 2:6], heading, velocity], dim=1)


@torch.no_grad()
def build_graph(
    config: GraphConfig,
    points: Tensor,  # [n, 7] as `PointGraph.points`
    sample: Tensor,  # [n] int64, ascending
    batch_size: int,
) -> PointGraph:
    """The graph of a packed batch. Synchronises with a GPU once; runs in float32 whatever autocast says."""
    with torch.autocast(points.device.type, enabled=False):
        points = points.float()
        neighbours, present = nearest_neighbours(points[:, :2], sample, batch_size, config.num_neighbours)
        near = F.embedding(neighbours, points)  # [n, k, 7]
        offsets = (near - points[:, None])[..., :2]
        rigid = config.invariance is Invariance.rigid
        edges = pair_features(points[:, None, 4:6], near[..., 4:6], offsets) if rigid else offsets / EDGE_UNIT_M
        ahead = constant((1.0, 0.0), points.dtype, points.device).expand(len(points), 2)
        distance = offsets.norm(dim=2)
        distance, first = distance.masked_fill(~present | (distance < MIN_DISTANCE_M), torch.inf).min(dim=1)
        chosen = offsets.gather(1, first[:, None, None].expand(-1, 1, 2)).squeeze(1)
        known = distance.isfinite()[:, None] & rigid
        axes = torch.where(known, unit_vectors(chosen, MIN_DISTANCE_M), ahead)
        scales = constant(POINT_SCALES, points.dtype, points.device)
        motion = points[:, 4:6] / scales[4:6]
        motion = motion.norm(dim=1, keepdim=True) if rigid else motion
        heard = torch.zeros_like(sample).index_add(0, neighbours.flatten(), present.flatten().long())
        z, rcs, dt = ((points / scales)[:, column, None] for column in (2, 3, 6))
        nodes = torch.cat([z, rcs, motion, dt, heard[:, None] / config.num_neighbours], dim=1)
    return PointGraph(points, sample, batch_size, neighbours, present, axes, nodes, edges * present[..., None])


def pair_features(
    velocities: Tensor,  # [..., 2] m/s of the hearing points
    heard: Tensor,  # [..., 2] m/s of the heard ones
    offsets: Tensor,  # [..., 2] m from the hearing to the heard
) -> Tensor:  # [..., 5]
    """Point-pair features: distance, cosines of the angles (v_i, v_j), (v_i, d), (v_j, d), and |v_j - v_i|.

    The public code has the angles themselves, in degrees, and the last as an option.
    """
    directions = unit_vectors(offsets, MIN_DISTANCE_M)
    ours, theirs = unit_vectors(velocities, MIN_SPEED_MPS), unit_vectors(heard, MIN_SPEED_MPS)
    distance = offsets.norm(dim=-1) / EDGE_UNIT_M
    angles = [(a * b).sum(-1) for a, b in ((ours, theirs), (ours, directions), (theirs, directions))]
    return torch.stack([distance, *angles, (heard - velocities).norm(dim=-1) / POINT_SCALES[4]], dim=-1)
