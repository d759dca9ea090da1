"""Where everything is at any moment: trajectories on a fixed time grid, and the ego truck's six degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from src.geometry.transforms import rotation_zyx
from src.world.road import Road
from src.world.traffic import STEP_S

Array = np.ndarray

LEAD_IN_S = 0.7
"""Simulated time before the first key frame, for the sweeps that precede it."""
HALF_STEP_S = 0.002
"""Half the step of the central differences that give rates."""


@dataclass
class Tracks:
    """Road coordinates of N objects on a grid of STEP_S that starts LEAD_IN_S before the first key frame."""

    road: Road
    s: Array  # [N, T] m
    s_rate: Array  # [N, T] m/s
    d: Array  # [N, T] m
    d_rate: Array  # [N, T] m/s
    turn: Array  # [N, T] rad, heading relative to the road's

    def road_state(self, time_s: float) -> tuple[Array, Array, Array, Array, Array]:
        """s, ds/dt, d, dd/dt and turn at a time, each [N]; rates change linearly within a step."""
        place = np.clip((time_s + LEAD_IN_S) / STEP_S, 0, self.s.shape[1] - 1.001)
        low = int(place)
        part = place - low
        after = part * STEP_S
        bend = 0.5 * after * part
        s_rate = self.s_rate[:, low] + part * (self.s_rate[:, low + 1] - self.s_rate[:, low])
        d_rate = self.d_rate[:, low] + part * (self.d_rate[:, low + 1] - self.d_rate[:, low])
        s = self.s[:, low] + after * self.s_rate[:, low] + bend * (self.s_rate[:, low + 1] - self.s_rate[:, low])
        d = self.d[:, low] + after * self.d_rate[:, low] + bend * (self.d_rate[:, low + 1] - self.d_rate[:, low])
        return s, s_rate, d, d_rate, self.turn[:, low] + part * (self.turn[:, low + 1] - self.turn[:, low])

    def state(self, time_s: float) -> tuple[Array, Array, Array]:
        """Ground positions [N, 3], velocities [N, 3] and headings [N] in local coordinates."""
        s, s_rate, d, d_rate, turn = self.road_state(time_s)
        heading = self.road.heading_at(s)
        forward = s_rate * (1.0 - self.road.curvature_at(s) * d)
        cos, sin = np.cos(heading), np.sin(heading)
        velocity = np.stack(
            [forward * cos - d_rate * sin, forward * sin + d_rate * cos, s_rate * self.road.slope_at(s)], 1
        )
        return self.road.place(s, d), velocity, heading + turn


@dataclass(kw_only=True)
class EgoMotion:
    """The ego truck: its lane position from the traffic simulation, with small swaying of body and course on top."""

    tracks: Tracks  # one row
    sway: Array  # [4, 3] amplitude, frequency in rad/s, phase of lateral offset (m), yaw, pitch and roll (rad)

    @classmethod
    def draw(cls, tracks: Tracks, rng: np.random.Generator) -> EgoMotion:
        """A driver and a cabin of their own."""
        amplitude = np.array([0.12, 0.002, 0.004, 0.006]) * rng.uniform(0.5, 1.2, 4)
        frequency = np.array([0.8, 2.0, 7.0, 4.5]) * rng.uniform(0.8, 1.2, 4)
        return cls(tracks=tracks, sway=np.stack([amplitude, frequency, rng.uniform(0, 6.28, 4)], 1))

    def poses(self, times_s: Array) -> tuple[Array, Array]:
        """Rotations [T, 3, 3] and translations [T, 3] from ego to local coordinates; the origin is on the ground."""
        tracks, road = self.tracks, self.tracks.road
        place = np.clip((times_s + LEAD_IN_S) / STEP_S, 0, tracks.s.shape[1] - 1.001)
        low = place.astype(np.int64)
        part = place - low
        after, bend = part * STEP_S, 0.5 * part * part * STEP_S
        s_rate, d_rate = tracks.s_rate[0], tracks.d_rate[0]
        s = tracks.s[0, low] + after * s_rate[low] + bend * (s_rate[low + 1] - s_rate[low])
        d = tracks.d[0, low] + after * d_rate[low] + bend * (d_rate[low + 1] - d_rate[low])
        forward = s_rate[low] + part * (s_rate[low + 1] - s_rate[low])
        sideways = d_rate[low] + part * (d_rate[low + 1] - d_rate[low])
        angle = self.sway[:, 1:2] * times_s + self.sway[:, 2:]
        offset, yaw, pitch, roll = self.sway[:, :1] * np.sin(angle)
        sideways = sideways + self.sway[0, 0] * self.sway[0, 1] * np.cos(angle[0])
        course = road.heading_at(s) + np.arctan2(sideways, np.maximum(forward, 1.0)) + yaw
        return rotation_zyx(course, pitch - np.arctan(road.slope_at(s)), roll), road.place(s, d + offset)

    def pose(self, time_s: float) -> tuple[Array, Array]:
        """Rotation [3, 3] and translation [3] at one moment."""
        rotation, translation = self.poses(np.array([time_s]))
        return rotation[0], translation[0]

    def rates(self, times_s: Array) -> tuple[Array, Array]:
        """Velocities [T, 3] and angular rates [T, 3] in the ego frame, by central differences of the pose."""
        now, _ = self.poses(times_s)
        before, t_before = self.poses(times_s - HALF_STEP_S)
        after, t_after = self.poses(times_s + HALF_STEP_S)
        velocity = np.einsum("tji,tj->ti", now, t_after - t_before) / (2 * HALF_STEP_S)
        skew = np.einsum("tji,tjk->tik", now, after - before) / (4 * HALF_STEP_S)
        turning = [skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]]
        return velocity, np.stack(turning, 1)
