"""Velocity compensation beats none on fast synthetic traffic in phase 2 (method 15.10)."""

from dataclasses import replace

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.heads.center_head import BoxOptions
from src.models.horizon3d.dptf_memory import DPTFMemory
from src.models.horizon3d.model import Horizon3D
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from tests.models.horizon3d.small_model import dptf_config
from tests.models.moving import UTM, pose

GRID = BEVGrid(cells=(44, 176), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
STEP_S = 0.5
ROADS_M = torch.tensor([-11.0, -7.0, -3.0, 3.0, 7.0, 11.0])  # y of the streams of traffic, along x
NUM_FAST, NUM_PARKED, NUM_POINTS, NUM_CLUTTER = 3, 2, 5, 8
SIZE_M = torch.tensor([4.5, 1.9, 1.6])
NEAR_M = 4.0
"""The widest matching distance of the benchmark; no less than the next road, a third of what the slowest of the fast
drive between the frames."""
STREAMS, STEPS, LEARNING_RATE = 12, 100, 1e-2


def between(low, high, generator, *shape):
    return low + (high - low) * torch.rand(*shape, generator=generator)


def either_side(low, high, generator, *shape):
    return between(low, high, generator, *shape) * (2.0 * torch.randint(0, 2, shape, generator=generator) - 1.0)


def vehicles_of(generator):
    """World places [5, 2] at the start and velocities [5, 2]: three at 25 to 45 m/s in both directions, two parked.

    The radar starts at the origin. Nobody is beside it then, where it would not see how fast they pass.
    """
    count = NUM_FAST + NUM_PARKED
    roads = ROADS_M[torch.randperm(len(ROADS_M), generator=generator)[:count]]
    speeds = either_side(25.0, 45.0, generator, count)
    speeds[NUM_FAST:] = 0.0
    return torch.stack([either_side(15.0, 45.0, generator, count), roads], 1), torch.stack([speeds, 0 * speeds], 1)


def cars(xy, velocities, yaws):
    k = len(xy)
    return Boxes3D(
        centers=torch.cat([xy, torch.full((k, 1), 0.5)], 1),
        sizes=SIZE_M.expand(k, 3),
        yaws=yaws,
        velocities=velocities,
        labels=torch.full((k,), CLASSES.index("car")),
        attributes=torch.full((k,), -1),
        num_points=torch.full((k,), NUM_POINTS),  # annotated although the radar misses them
    )


def returns(boxes, generator):
    """Radar points [n, 7] on vehicles: of their velocity a radar measures the radial part."""
    owners = torch.arange(len(boxes)).repeat_interleave(NUM_POINTS)
    place = boxes.centers[owners, :2] + between(-0.5, 0.5, generator, len(owners), 2) * torch.tensor([3.5, 1.2])
    ray = place / place.norm(dim=1, keepdim=True)
    radial = (boxes.velocities[owners] * ray).sum(1, keepdim=True) * ray
    return torch.cat([place, torch.tensor([0.5, 15.0]).expand(len(owners), 2), radial, 0 * place[:, :1]], 1)


def clutter(generator):
    place = between(-0.95, 0.95, generator, NUM_CLUTTER, 2) * torch.tensor(GRID.half_extent_m)
    return torch.cat([place, torch.tensor([0.5, -5.0, 0.0, 0.0, 0.0]).expand(NUM_CLUTTER, 5)], 1)


def traffic(seed, streams, steps):
    """Batches of a stream of clips of two key frames: the radar sees the vehicles in the first, not in the second.

    The ego drives at 5 to 15 m/s and turns. Every other stream is a frame ahead, so that each batch holds first and
    second frames and the batch statistics are those of both. Streams that are ahead begin with a second frame.
    """
    generator, clips = torch.Generator().manual_seed(seed), {}
    for step in range(steps):
        hidden = (torch.arange(streams) + step) % 2 == 1
        clouds, boxes, poses = [], [], []
        for stream in range(streams):
            if not hidden[stream] or stream not in clips:
                drive = [between(5.0, 15.0, generator, 1).item(), between(-0.1, 0.1, generator, 1).item()]
                clips[stream] = (*vehicles_of(generator), *drive)
            places, velocities, ego_mps, turn = clips[stream]
            elapsed = STEP_S * float(hidden[stream])
            world_from_ego = pose(ego_mps * elapsed, 0.0, turn * elapsed)
            rotation, origin = world_from_ego[:2, :2].float(), world_from_ego[:2, 3].float()
            xy = (places + velocities * elapsed - origin) @ rotation
            yaws = torch.where(velocities[:, 0] < 0, torch.pi, 0.0) - turn * elapsed
            boxes.append(cars(xy, velocities @ rotation, yaws))
            noise = clutter(generator)
            clouds.append(noise if hidden[stream] else torch.cat([returns(boxes[-1], generator), noise]))
            poses.append(pose(ego_mps * elapsed, 0.0, turn * elapsed, UTM))
        yield FrameBatch(
            tokens=[f"{step}-{stream}" for stream in range(streams)],
            timestamps_s=torch.full((streams,), 100.0 + STEP_S * step, dtype=torch.float64),
            global_from_ego=torch.stack(poses),
            aug_from_ego=torch.eye(4).repeat(streams, 1, 1),
            radar_points=torch.cat(clouds),
            radar_batch=torch.arange(streams).repeat_interleave(torch.tensor([len(cloud) for cloud in clouds])),
            boxes=boxes,
            streams=torch.arange(streams),
            starts=~hidden,
        )


def stream(model, seed, streams, steps):
    """Batches and the model's output for them, each clip with its own memory."""
    memory = DPTFMemory(())
    for batch in traffic(seed, streams, steps):
        output, memory = model(batch, memory.select(batch.streams, ~batch.starts))
        yield batch, output


def train(config):
    torch.manual_seed(0)
    model = Horizon3D(config, GRID, None, BoxOptions(velocity_code_weight=0.2)).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=STEPS)
    for batch, output in stream(model, 0, STREAMS, STEPS):
        optimizer.zero_grad()
        model.loss(output, batch).terms["total"].backward()
        optimizer.step()
        schedule.step()
    return model.eval()


@torch.no_grad()
def shares_found(model):
    """Shares of the hidden vehicles, fast and parked, near one of the best boxes, of which as many count as there are.

    In clips that the training has not seen.
    """
    batch, output = list(stream(model, seed=10**6, streams=64, steps=2))[-1]
    predicted, found = model.decode(output), []
    for row in (~batch.starts).nonzero().squeeze(1).tolist():
        truth, best = batch.boxes[row].centers[:, :2], predicted[row].centers[:, :2]
        found.append((torch.cdist(truth, best[: len(truth)]) < NEAR_M).any(1))
    found = torch.stack(found).float()
    return found[:, :NUM_FAST].mean().item(), found[:, NUM_FAST:].mean().item()


@pytest.mark.slow
def test_velocity_compensation_beats_none_on_fast_traffic(make_config):
    """Trained alike, both models find parked vehicles that the radar no longer sees, and only one finds the fast."""
    shares = {}
    for compensated in (True, False):
        dptf = dptf_config(gaussian_path=False, num_frames=1, velocity_compensation=compensated)
        config = make_config(radar_only=True, dptf=dptf, box_weight=0.5, cell_velocity_weight=1.0)
        # A short training: running statistics have to keep up.
        config = replace(config, radar_encoder=replace(config.radar_encoder, norm_momentum=0.1))
        shares[compensated] = shares_found(train(config))
    (fast, parked), (fast_without, parked_without) = shares[True], shares[False]
    assert parked > 0.7 and parked_without > 0.7, shares  # the memory itself works either way
    assert fast > 0.5 and fast_without < 0.15, shares
