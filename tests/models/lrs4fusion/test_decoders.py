import pytest
import torch

from src.errors import ConfigError
from src.geometry.voxel_grid import VoxelGrid
from src.models.lrs4fusion.decoders import DecoderConfig, Decoders
from src.models.lrs4fusion.late_encoder import Volumes
from src.ops.ball_query import ball_query
from src.structures.sparse_bev import SparseMap
from tests.ops.maps import random_sites

GRID = VoxelGrid((-4.0, -8.0, -2.0), (12.0, 8.0, 2.0), (0.5, 0.5, 0.25), num_levels=4)
WIDTHS = (3, 4, 5, 6)


def settings(**changes):
    values = {"hidden_channels": 8, "num_blocks": 2, "neighbours": [7, 7, 1, 1], "velocity": True}
    values |= {"velocity_unit_mps": 10.0}
    return DecoderConfig(**(values | changes))


def decoders(**changes):
    torch.manual_seed(0)
    return Decoders(settings(**changes), WIDTHS, GRID)


def volumes(counts=(2000, 600, 150, 30)):
    generator = torch.Generator().manual_seed(2)
    scales = []
    for level, (count, width) in enumerate(zip(counts, WIDTHS, strict=True)):
        sites = random_sites((2, *GRID.at(level).cells), count)
        scales.append(SparseMap(sites, torch.randn(count, width, generator=generator, requires_grad=True)))
    return Volumes(tuple(scales), (0, 0, 0, 0))


def queries(count):
    generator = torch.Generator().manual_seed(3)
    unit = torch.rand(count, 4, generator=generator)
    return unit * torch.tensor([16.0, 16.0, 4.0, 3.0]) + torch.tensor([-4.0, -8.0, -2.0, 0.0]), torch.arange(count) % 2


def test_the_sampler_looks_at_the_place_and_where_the_offset_leads():
    """z = [V2(p), V1(p'), V2(p'), V3(p'), V4(p')], p' = p + dp; at first p' = p."""
    sampler, world, (q, batch) = decoders().sampler, volumes(), queries(50)
    place, z, measured = sampler(world, q, batch)
    assert z.shape == (50, 4 + sum(WIDTHS)) and not measured.any()
    torch.testing.assert_close(place, torch.cat([GRID.normalised(q[:, :3]), q[:, 3:] / 3], 1))
    shift = torch.tensor([0.6, -0.4, 0.1])
    for moved in (torch.zeros(3), shift):
        with torch.no_grad():
            sampler.offset.bias.copy_(moved)
        z = sampler(world, q, batch)[1]
        at = [(1, 7, 0 * moved), (0, 7, moved), (1, 7, moved), (2, 1, moved), (3, 1, moved)]
        expected = [
            ball_query(volume.features, volume.sites, GRID.at(level), q[:, :3] + by, batch, neighbours)
            for level, neighbours, by in at
            for volume in [world.scales[level]]
        ]
        torch.testing.assert_close(z, torch.cat(expected, 1))


def test_the_offset_branch_learns_from_the_place_of_matter():
    """Its last layer begins at zero, so what lies before it has a gradient from the second step on."""
    model, world, (q, batch) = decoders(), volumes(), queries(200)
    occupancy, velocity = model(world, q, batch)
    assert occupancy.shape == velocity.shape == (200,) and not velocity.any()  # untrained, everything rests
    (occupancy.square().sum() + (velocity - 1).square().sum()).backward()
    assert model.sampler.offset.weight.grad.any() and model.sampler.offset.bias.grad.any()
    assert all(volume.features.grad.any() for volume in world.scales)
    torch.optim.SGD(model.parameters(), lr=1e-2).step()
    model.zero_grad()
    occupancy, velocity = model(world, q, batch)
    (occupancy.square().sum() + (velocity - 1).square().sum()).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_queries_are_answered_one_by_one():
    """Order, company and samples change no answer."""
    model, world, (q, batch) = decoders().eval(), volumes(), queries(60)
    together = model(world, q, batch)[0]
    order = torch.randperm(60, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(model(world, q[order], batch[order])[0], together[order])
    other = model(world, q, 1 - batch)[0]
    assert (other - together).abs().max() > 1e-3


def test_outside_the_region_there_is_no_volume():
    """What is said there depends on place and time alone, and an empty volume answers everywhere."""
    model, (q, batch) = decoders(), queries(20)
    empty = volumes((0, 0, 0, 0))
    outside = q + torch.tensor([100.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(model(volumes(), outside, batch)[0], model(empty, outside, batch)[0])
    assert model(empty, q, batch)[0].isfinite().all()
    assert model(volumes(), q[:0], batch[:0])[0].shape == (0,)


def test_autocast_changes_nothing():
    model, world, (q, batch) = decoders(), volumes(), queries(20)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = model(world, q, batch)[0]
    assert rounded.dtype == torch.float32 and torch.equal(rounded, model(world, q, batch)[0])


def test_without_velocity_there_is_one_head():
    model, (q, batch) = decoders(velocity=False), queries(5)
    assert model.velocity is None and model(volumes(), q, batch)[1] is None


def test_velocities_are_stated_in_a_unit():
    """Together with the occupancy and alone; of the same weights."""
    tens, ones, (q, batch) = decoders(), decoders(velocity_unit_mps=1.0), queries(20)
    for model in (tens, ones):
        torch.nn.init.constant_(model.velocity.output.bias, 0.5)
    torch.testing.assert_close(tens(volumes(), q, batch)[1], 10 * ones(volumes(), q, batch)[1])
    torch.testing.assert_close(tens.velocities(volumes(), q, batch), tens(volumes(), q, batch)[1])
    with pytest.raises(ConfigError, match="velocity_unit_mps=0.0: must be above 0"):
        settings(velocity_unit_mps=0.0)


@pytest.mark.parametrize("neighbours", [[7, 7, 1], [7, 7, 1, 3]])
def test_neighbours_that_cannot_be(neighbours):
    with pytest.raises(ConfigError, match="must list 1 or 7 for each of the 4 scales"):
        settings(neighbours=neighbours)
