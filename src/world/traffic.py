"""Motion of the vehicles on the main road: car following, lane changes and braking."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.world.road import Road

Array = np.ndarray

STEP_S = 0.05
LANE_CHANGE_S = 3.2


@dataclass
class Vehicle:
    """One road user of the main road before the simulation; row 0 of a fleet is the ego truck."""

    kind: str
    direction: int  # +1 the ego's, -1 oncoming
    lane: int  # 0 beside the median
    along_m: float  # position in its own direction at the start
    wanted_mps: float
    length_m: float = 0.0  # with its trailer
    has_trailer: bool = False
    may_change: bool = True


def simulate_traffic(
    fleet: list[Vehicle], road: Road, steps: int, rng: np.random.Generator
) -> tuple[Array, Array, Array, Array]:
    """Positions along s and d with their rates, each [N, steps] on a grid of STEP_S.

    Following is the intelligent driver model (Treiber et al. 2000); s is integrated from the stored speeds by the
    trapezoid rule, so that positions and speeds agree exactly between grid points.
    """
    n = len(fleet)
    direction = np.array([v.direction for v in fleet])
    lane = np.array([v.lane for v in fleet])
    length = np.array([v.length_m for v in fleet])
    wanted = np.array([v.wanted_mps for v in fleet])
    along, speed = np.array([v.along_m for v in fleet]), wanted.copy()
    centre = np.array([road.lane_centre(v.direction, v.lane) for v in fleet])
    move_from, move_to, move_start = centre.copy(), centre.copy(), np.full(n, -1e9)
    brakes = np.where(rng.random(n) < 0.06, rng.uniform(0, steps * STEP_S, n), 1e9)
    brakes[0] = 1e9
    out_s, out_v = np.zeros((n, steps)), np.zeros((n, steps))
    out_dv = np.zeros((n, steps))

    def change_lanes(now: float, gap: Array, closing: Array) -> None:
        """Let those that are held up pull out to the left, and some free ones return, where that lane has room."""
        for i in range(1, n):
            if not fleet[i].may_change or now - move_start[i] < LANE_CHANGE_S + 1.0:
                continue
            held_up = closing[i] > 1.0 and gap[i] < 12 + 2.2 * speed[i]
            if held_up:
                goal = lane[i] - 1
            elif rng.random() < 0.015:
                goal = lane[i] + 1
            else:
                continue
            heavy = length[i] > 7.0
            if not 0 <= goal < road.lanes or (heavy and goal < road.lanes - 2):
                continue
            others = np.array([v.direction == fleet[i].direction for v in fleet]) & (lane == goal)
            others[i] = False
            ahead = along[others] - along[i]
            room = np.abs(ahead) - 0.5 * (length[others] + length[i])
            need = 6 + np.where(ahead > 0, 1.5 * (speed[i] - speed[others]), 2.5 * (speed[others] - speed[i])).clip(0)
            if np.all(room > need + 0.4 * speed[i]):
                lane[i] = goal
                move_from[i], move_to[i] = move_to[i], road.lane_centre(fleet[i].direction, int(goal))
                move_start[i] = now

    for step in range(steps):
        now = step * STEP_S
        out_s[:, step], out_v[:, step] = along, speed
        phase = np.clip((now - move_start) / LANE_CHANGE_S, 0, 1)
        out_dv[:, step] = (move_to - move_from) * 6 * phase * (1 - phase) / LANE_CHANGE_S
        braking = (now >= brakes) & (now < brakes + 2.5)
        goal = np.where(braking, 0.55 * wanted, wanted)
        gap, closing = _leaders(along, speed, length, direction * 10 + lane)
        target = 2.0 + np.maximum(0.0, 0.7 * speed + speed * closing / (2 * np.sqrt(1.2 * 2.0)))
        accel = 1.2 * (1 - (speed / np.maximum(goal, 1.0)) ** 4 - (target / np.maximum(gap, 0.5)) ** 2)
        accel = np.clip(accel, -6.0, 1.5)
        if step % 10 == 0:
            change_lanes(now, gap, closing)
        new_speed = np.maximum(speed + accel * STEP_S, 0.0)
        along = along + 0.5 * (speed + new_speed) * STEP_S
        speed = new_speed
    d_start = np.array([road.lane_centre(v.direction, v.lane) for v in fleet])
    drift = np.concatenate([np.zeros((n, 1)), np.cumsum(0.5 * (out_dv[:, 1:] + out_dv[:, :-1]) * STEP_S, 1)], 1)
    return out_s * direction[:, None], out_v * direction[:, None], d_start[:, None] + drift, out_dv


def _leaders(along: Array, speed: Array, length: Array, lane_key: Array) -> tuple[Array, Array]:
    """Bumper-to-bumper gap to the next vehicle in the lane (1e3 m if none) and the speed difference to it, each [N]."""
    order = np.lexsort((along, lane_key))
    gap, closing = np.full(len(along), 1e3), np.zeros(len(along))
    rear, front = order[:-1], order[1:]
    same = lane_key[rear] == lane_key[front]
    rear, front = rear[same], front[same]
    gap[rear] = along[front] - along[rear] - 0.5 * (length[front] + length[rear])
    closing[rear] = speed[rear] - speed[front]
    return gap, closing
