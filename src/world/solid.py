"""What is solid in a scene at any time, for those who ask a data set and know nothing of worlds."""

from __future__ import annotations

import numpy as np

from src.data.true_geometry import TrueGeometry
from src.world.motion import LEAD_IN_S
from src.world.simulate import Scene
from src.world.traffic import STEP_S

AROUND_M = 260.0
"""How far from the truck's path the ground is known: the corner of what is asked about."""
GROUND_CELL_M = 4.0


def true_geometry(scene: Scene, duration_s: float, start_us: int) -> TrueGeometry:
    """Boxes of all actors and slats over the simulated time, and the ground around the truck's path."""
    times_s = np.arange(-LEAD_IN_S, duration_s + LEAD_IN_S, STEP_S)
    _, path = scene.ego.poses(times_s)
    along = [float(scene.ego.tracks.road_state(time)[0][0]) for time in (times_s[0], times_s[-1])]
    slats, slat_sizes, slat_yaws = scene.road.slats(along[0] - AROUND_M, along[1] + AROUND_M)
    states = [scene.boxes(time) for time in times_s]
    low, high = path[:, :2].min(0) - AROUND_M, path[:, :2].max(0) + AROUND_M
    x, y = (np.arange(low[axis], high[axis] + GROUND_CELL_M, GROUND_CELL_M) for axis in range(2))
    xy = np.stack(np.meshgrid(x, y), -1)  # [rows, cols, 2]
    beside = np.argmin(np.linalg.norm(xy[:, :, None] - path[::10, :2], axis=-1), -1)
    guess_s = np.linspace(*along, len(times_s))[::10][beside]
    steps = len(times_s)
    still = (np.broadcast_to(slats, (steps, *slats.shape)), np.broadcast_to(slat_yaws, (steps, len(slats))))
    return TrueGeometry(
        origin=scene.utm_offset,
        times_us=start_us + np.round(1e6 * times_s).astype(np.int64),
        middles=np.concatenate([np.stack([middles for middles, _, _ in states]), still[0]], 1).astype(np.float32),
        yaws=np.concatenate([np.stack([yaws for _, _, yaws in states]), still[1]], 1).astype(np.float32),
        sizes=np.concatenate([scene.sizes, slat_sizes]).astype(np.float32),
        ground=scene.road.height_at(scene.road.along(xy, guess_s)).astype(np.float32),
        ground_corner=low,
        ground_cell_m=np.array(GROUND_CELL_M),
    )
