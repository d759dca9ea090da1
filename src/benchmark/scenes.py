"""Synthetic frames to measure on: a straight highway in radar points and cameras, or in LiDAR, always the same.

Nothing here resembles a recording in detail; what matters is how many cells are occupied and how they cluster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from src.data.frame_loader import collate
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.ray_bundle import RayBundle
from src.structures.taxonomy import CAMERAS, CLASSES

RINGS_M = ((0.0, 75.0), (75.0, 150.0), (150.0, 300.0), (300.0, 600.0))
"""The road ahead and behind by distance; each ring is drawn by itself, so a longer road begins as a shorter one."""
LANES_M = (-9.25, -5.5, -1.75, 1.75, 5.5, 9.25)
RAILS_M = (-13.0, 0.0, 13.0)
VEGETATION_M = (16.0, 60.0)  # |y|
WALLS_M = (-30.0, 30.0)  # where the vegetation lets no ray through
TRUCK_M, CAR_M = (14.0, 2.6), (4.5, 1.9)  # length, width
CLUMP_M = 6.0  # size of a bush or wall in the returns of half a second
NOISE_M, AZIMUTH_NOISE_RAD = 0.2, math.radians(0.5)
HALF_DENSITY_M = 90.0  # where a metre of road gives half the returns that it gives at the truck
SHARES = {"rails": 0.45, "vegetation": 0.4, "clutter": 0.15}  # of the background
CAMERA_YAWS_RAD = tuple(math.radians(yaw) for yaw in (45.0, -45.0, 135.0, -135.0))
LIDAR_HEIGHT_M = 3.0
ELEVATION_RAD = (math.radians(-25.0), math.radians(3.0))
RAIL_HEIGHT_M, WALL_HEIGHT_M, CAR_HEIGHT_M, TRUCK_HEIGHT_M = 1.0, 8.0, 1.6, 3.5
LIDAR_NOISE_M = 0.02
TARGETS_S = (-0.2, 0.0, 1.0, 2.0)  # what a training frame has: past, present and two future moments
CAMERA_FOV_RAD, CAMERA_HEIGHT_M = math.radians(110.0), 2.2
NUM_BOXES = 24  # of a training frame


@dataclass(frozen=True)
class Highway:
    """How much there is on the road. Counts are for the road of 150 m ahead and behind."""

    background: int  # radar points of all sweeps on rails, vegetation and nothing
    num_vehicles: int
    points_per_vehicle: int  # in the mean
    reach_m: float  # the road ends here, ahead and behind
    lidar_returns: int = 0


ROADS = {
    "paper": Highway(12_700, 60, 113, 150.0, 150_000),  # the LiDARs' of MAN TruckScenes in a key frame
    "mini": Highway(2600, 60, 23, 150.0, 20_000),
    "debug": Highway(200, 20, 5, 150.0, 1500),
}
"""The road of 150 m at a scale."""


def highway_points(road: Highway, seed: int = 0) -> Tensor:  # [P, 7] x, y, z (m), rcs (dB), vx, vy (m/s), dt (s)
    """Radar points of the road, nearer stretches denser; twice the vehicles give twice their returns."""
    rings = [(low, min(high, road.reach_m)) for low, high in RINGS_M if low < road.reach_m]
    return torch.cat([_ring_points(road, ring, seed) for ring in rings])


def _ring_points(road: Highway, ring: tuple[float, float], seed: int) -> Tensor:
    draw = torch.Generator().manual_seed(1000 * seed + int(ring[0]))
    share = _returns(*ring) / _returns(0.0, 150.0)
    numbers = {kind: round(road.background * share * part) for kind, part in SHARES.items()}
    rails, across = numbers["rails"], VEGETATION_M[1] * (2 * torch.rand(numbers["clutter"], generator=draw) - 1)
    parts = [
        _vehicle_points(road, ring, share, draw),
        _placed(_spread(rails, ring, draw), torch.tensor(RAILS_M)[_pick(rails, len(RAILS_M), draw)], 0.0),
        _vegetation_points(numbers["vegetation"], ring, draw),
        _placed(_spread(len(across), ring, draw), across, 10.0 * torch.randn(len(across), generator=draw)),
    ]
    return _measured(torch.cat(parts), draw)


def _vehicle_points(road: Highway, ring: tuple[float, float], share: float, draw: torch.Generator) -> Tensor:
    """Points on the hulls of vehicles that stand as densely far away as near, with ever fewer returns."""
    vehicles = round(road.num_vehicles * (ring[1] - ring[0]) / 150.0)
    if not vehicles:
        return torch.zeros(0, 3)
    x, y, long = _vehicles(vehicles, ring, draw)
    sizes = torch.where(long, torch.tensor(TRUCK_M), torch.tensor(CAR_M))
    number = round(road.points_per_vehicle * road.num_vehicles * share)
    owner = torch.multinomial(1 / (1 + (x / HALF_DENSITY_M).square()), number, replacement=True, generator=draw)
    hull = torch.rand(number, 2, generator=draw) - 0.5
    side = torch.rand(number, generator=draw) < 0.5
    hull[:, 1] = torch.where(side, 0.5 * hull[:, 1].sign(), hull[:, 1])
    hull[:, 0] = torch.where(side, hull[:, 0], 0.5 * hull[:, 0].sign())
    xy = torch.stack([x, y], 1)[owner] + hull * sizes[owner]
    return _placed(xy[:, 0], xy[:, 1], -20.0 * y[owner].sign())


def _vehicles(count: int, ring: tuple[float, float], draw: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Places [n] along and across the road, m, and which are trucks [n, 1]."""
    ahead = ring[0] + (ring[1] - ring[0]) * torch.rand(count, generator=draw)
    x = ahead * (2.0 * _pick(count, 2, draw) - 1.0)
    y = torch.tensor(LANES_M)[_pick(count, len(LANES_M), draw)]
    return x, y, torch.rand(count, 1, generator=draw) < 0.3


def _vegetation_points(number: int, ring: tuple[float, float], draw: torch.Generator) -> Tensor:
    """Points of vegetation in clumps beside the road."""
    clumps = max(1, round((ring[1] - ring[0]) / 2.5))
    low, high = VEGETATION_M
    away = low + (high - low) * torch.rand(clumps, generator=draw)
    centres = torch.stack([_spread(clumps, ring, draw), away * (2.0 * _pick(clumps, 2, draw) - 1.0)], 1)
    xy = centres[_pick(number, clumps, draw)] + CLUMP_M / 2 * torch.randn(number, 2, generator=draw)
    return _placed(xy[:, 0], xy[:, 1], 0.0)


def _placed(x: Tensor, y: Tensor, speed: Tensor | float) -> Tensor:  # [n, 3] x, y, vx
    return torch.stack([x, y, torch.as_tensor(speed).expand(len(x))], 1)


def _measured(points: Tensor, draw: torch.Generator) -> Tensor:  # [n, 3] x, y, vx -> [n, 7]
    """Radar points with the sensor's noise; the error across the line of sight grows with the distance."""
    number = len(points)
    distance = points[:, :2].norm(dim=1, keepdim=True)
    across = torch.stack([-points[:, 1], points[:, 0]], 1) / distance.clamp(min=1.0)
    noise = NOISE_M * torch.randn(number, 2, generator=draw)
    turn = AZIMUTH_NOISE_RAD * distance * torch.randn(number, 1, generator=draw)
    height = 0.2 + torch.rand(number, 1, generator=draw) ** 2 * 3.0
    rcs = 10.0 * torch.randn(number, 1, generator=draw)
    age = 0.05 * torch.randint(0, 10, (number, 1), generator=draw)
    return torch.cat([points[:, :2] + noise + turn * across, height, rcs, points[:, 2:], 0 * age, age], 1)


def _returns(low: float, high: float) -> float:
    """Share of returns between two distances, for a density that falls as 1 / (1 + (x / half)^2)."""
    return math.atan(high / HALF_DENSITY_M) - math.atan(low / HALF_DENSITY_M)


def _spread(number: int, ring: tuple[float, float], draw: torch.Generator) -> Tensor:  # [number] m
    """Places along the road, ahead or behind, by that density."""
    low, high = (math.atan(edge / HALF_DENSITY_M) for edge in ring)
    ahead = torch.randint(0, 2, (number,), generator=draw) * 2.0 - 1.0
    return ahead * HALF_DENSITY_M * torch.tan(low + (high - low) * torch.rand(number, generator=draw))


def _pick(number: int, choices: int, draw: torch.Generator) -> Tensor:  # [number] int64
    return torch.randint(0, choices, (number,), generator=draw)


def highway_frame(
    points: Tensor,  # [P, 7]
    image_size_px: tuple[int, int],  # (height, width)
) -> FrameBatch:
    """One frame of these points with four black images; the truck stands at the origin."""
    height, width = image_size_px
    return FrameBatch(
        tokens=["synthetic"],
        timestamps_s=torch.zeros(1, dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64)[None],
        aug_from_ego=torch.eye(4)[None],
        radar_points=points,
        radar_batch=torch.zeros(len(points), dtype=torch.int64),
        images=torch.zeros(1, len(CAMERAS), 3, height, width, dtype=torch.uint8),
        image_valid=torch.ones(1, len(CAMERAS), dtype=torch.bool),
        pix_from_aug=torch.stack([_camera(yaw, height, width) for yaw in CAMERA_YAWS_RAD])[None],
    )


def made_batch(batch_size: int, road: Highway, image_size_px: tuple[int, int], seed: int = 0) -> FrameBatch:
    """Frames of a made highway with boxes, each sample another draw."""
    draws = range(seed, seed + batch_size)
    frames = [highway_frame(highway_points(road, draw), image_size_px) for draw in draws]
    return collate([replace(frame, boxes=[made_boxes(draw)]) for frame, draw in zip(frames, draws, strict=True)])


def made_boxes(seed: int) -> Boxes3D:
    """Boxes of every class along the road, one without a known velocity."""
    draw = torch.Generator().manual_seed(seed)
    number = torch.arange(NUM_BOXES)
    centers = torch.stack([-100.0 + 8.0 * number, 4.0 * (number % 3) - 4.0, torch.ones(NUM_BOXES)], 1)
    velocities = 10.0 * torch.rand(NUM_BOXES, 2, generator=draw)
    velocities[0] = torch.nan
    return Boxes3D(
        centers=centers,
        sizes=torch.tensor([4.5, 1.9, 1.6]).repeat(NUM_BOXES, 1),
        yaws=torch.rand(NUM_BOXES, generator=draw),
        velocities=velocities,
        labels=number % len(CLASSES),
        attributes=torch.full((NUM_BOXES,), -1),
        num_points=torch.full((NUM_BOXES,), 5),
    )


def _camera(yaw: float, height: int, width: int) -> Tensor:  # [4, 4]
    """Pixels from ego for a level camera that looks along a yaw."""
    focal = 0.5 * width / math.tan(0.5 * CAMERA_FOV_RAD)
    cos, sin = math.cos(yaw), math.sin(yaw)
    cam_from_ego = torch.tensor(
        [[sin, -cos, 0, 0], [0, 0, -1, CAMERA_HEIGHT_M], [cos, sin, 0, 0], [0, 0, 0, 1.0]]
    )  # right, down, ahead
    pix_from_cam = torch.tensor([[focal, 0, width / 2, 0], [0, focal, height / 2, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return pix_from_cam @ cam_from_ego


def lidar_frame(road: Highway) -> FrameBatch:
    """One frame of a LiDAR on the truck's roof: what its rays met as points, and as rays to learn from at TARGETS_S,
    at all of which the world is the same. The truck stands at the origin.
    """
    rays = _lidar_rays(road, torch.Generator().manual_seed(0))
    rest = torch.tensor([[20.0, 0.0]]).expand(len(rays), -1)  # intensity, age
    return FrameBatch(
        tokens=["synthetic"],
        timestamps_s=torch.zeros(1, dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64)[None],
        aug_from_ego=torch.eye(4)[None],
        lidar_points=torch.cat([rays.points, rest], 1),
        lidar_batch=torch.zeros(len(rays), dtype=torch.int64),
        lidar_origins=rays.origins,
        rays=rays,
    )


def _lidar_rays(road: Highway, draw: torch.Generator) -> RayBundle:
    """`road.lidar_returns` rays of evenly drawn directions, ending on ground, rails, walls behind them or vehicles."""
    x, y, long = _vehicles(road.num_vehicles, (0.0, road.reach_m), draw)
    sizes = torch.where(long, torch.tensor((*TRUCK_M, TRUCK_HEIGHT_M)), torch.tensor((*CAR_M, CAR_HEIGHT_M)))
    centres = torch.stack([x, y, 0.5 * sizes[:, 2]], 1)
    apart = (centres[:, :2].abs() > 0.5 * sizes[:, :2] + 1.0).any(1)  # none stands where the sensor is
    centres, sizes = centres[apart], sizes[apart]
    origin = torch.tensor([0.0, 0.0, LIDAR_HEIGHT_M])
    kept: list[Tensor] = []
    while sum(map(len, kept)) < road.lidar_returns:
        turn = 2 * math.pi * torch.rand(road.lidar_returns, generator=draw)
        low, high = ELEVATION_RAD
        rise = low + (high - low) * torch.rand(road.lidar_returns, generator=draw)
        direction = torch.stack([rise.cos() * turn.cos(), rise.cos() * turn.sin(), rise.sin()], 1)
        reach = torch.where(direction[:, 2] < 0, -LIDAR_HEIGHT_M / direction[:, 2], torch.inf)  # the ground
        sides = [(rail, RAIL_HEIGHT_M) for rail in RAILS_M if rail] + [(wall, WALL_HEIGHT_M) for wall in WALLS_M]
        for away, height in sides:
            met = away / direction[:, 1]
            met[(met <= 0) | (origin[2] + met * direction[:, 2] > height)] = torch.inf
            reach = torch.minimum(reach, met)
        for centre, size in zip(centres, sizes, strict=True):
            ends = torch.stack([(centre + side * 0.5 * size - origin) / direction for side in (-1, 1)])
            enter, leave = ends.amin(0).amax(1), ends.amax(0).amin(1)
            reach = torch.where((enter > 0) & (enter < leave), torch.minimum(reach, enter), reach)
        inside = (reach[:, None] * direction[:, :2]).abs().amax(1) < road.reach_m
        kept.append(torch.cat([direction, reach[:, None]], 1)[inside])
    direction, reach = torch.cat(kept)[: road.lidar_returns].split([3, 1], 1)
    count = len(reach)
    at = torch.arange(count) % len(TARGETS_S)
    return RayBundle(
        origins=origin.expand(count, -1).clone(),
        directions=direction.contiguous(),
        ranges=reach[:, 0] + LIDAR_NOISE_M * torch.randn(count, generator=draw),
        times_s=torch.tensor(TARGETS_S)[at],
        speeds=torch.full((count,), torch.nan),
        steps=at,
        batch=torch.zeros(count, dtype=torch.int64),
    )
