"""The memory of V2: moved to the present, met by attention, selected, stored and refused."""

import math

import pytest
import torch

from src.errors import ConfigError
from src.geometry.voxel_grid import VoxelGrid
from src.models.lrs4fusion.measured_motion import directions
from src.models.lrs4fusion.volume_memory import VolumeMemory
from src.models.lrs4fusion.windowed_fusion import VolumeMemoryConfig, WindowedFusion
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseMap
from tests.models.moving import UTM, bare_frame, bda, pose, tensors_of

GRID = VoxelGrid((-16.0, -16.0, -2.0), (32.0, 16.0, 2.0), (0.5, 0.5, 0.5), num_levels=2)
CHANNELS, STORED = 6, 8


def settings(**changes):
    values = {"max_age_s": 1.0, "channels": 8, "num_heads": 2, "window": 3, "velocity_compensation": True}
    return VolumeMemoryConfig(**(values | changes))


def fusion(**changes):
    torch.manual_seed(0)
    return WindowedFusion(settings(**changes), CHANNELS, STORED, GRID)


def volume_at(xyz, channels=STORED, batch=None, batch_size=1):
    """Voxels of these points, features that tell them apart."""
    batch = torch.zeros(len(xyz), dtype=torch.int64) if batch is None else batch
    sites, _ = Sites.unique(torch.cat([batch[:, None], GRID.cell_of(xyz)], 1), (batch_size, *GRID.cells))
    rows = torch.arange(len(sites))[:, None] + torch.linspace(0, 0.5, channels)
    return SparseMap(sites, rows)


def scattered(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    corner, size = torch.tensor([-8.0, -10.0, -1.5]), torch.tensor([20.0, 20.0, 3.0])
    return torch.rand(count, 3, generator=generator) * size + corner


def remembered(part, volume, frame, speeds=None):
    """What moves goes along its ray."""
    centres = GRID.centre_of(volume.indices[:, 1:])
    velocities = None if speeds is None else speeds[:, None] * directions(centres, None)
    return part.remember(volume, velocities, frame).detached()


def test_a_static_world_coincides_with_the_present():
    """Ego drives whole voxels ahead, 0.5 s apart: every remembered voxel lies where the same matter is seen now."""
    part, world = fusion(), scattered(200)
    before, after = bare_frame(0.0, [pose(origin=UTM)]), bare_frame(0.5, [pose(3.0, 1.5, origin=UTM)])
    seen_now = volume_at(world - torch.tensor([3.0, 1.5, 0.0]))
    memory = remembered(part, volume_at(world), before, torch.zeros(len(volume_at(world))))
    warped = part.recall(memory, after)
    assert torch.equal(warped.volume.sites.keys, seen_now.sites.keys) and warped.elapsed_s.tolist() == [0.5]
    torch.testing.assert_close(warped.volume.features, seen_now.features)
    torch.testing.assert_close(warped.ego_mps, torch.tensor([[6.0, 3.0, 0.0]]))
    assert part.recall(memory, before).ego_mps.isnan().all()  # a memory that is not in the past
    late = bare_frame(2.0, [pose(3.0, 1.5, origin=UTM)])
    assert part.recall(memory, late).ego_mps.isnan().all() and part.recall(None, after).ego_mps.isnan().all()


def test_a_turn_keeps_matter_within_half_a_voxel():
    part, world = fusion(), scattered(80, seed=3)
    before, after = bare_frame(0.0, [pose()]), bare_frame(0.2, [pose(4.0, 0.0, 0.3)])
    volume = volume_at(world)
    warped = part.recall(remembered(part, volume, before), after).volume
    turn = torch.tensor([[math.cos(0.3), math.sin(0.3), 0], [-math.sin(0.3), math.cos(0.3), 0], [0, 0, 1.0]])
    expected = (GRID.centre_of(volume.indices[:, 1:]) - torch.tensor([4.0, 0, 0])) @ turn.T
    found = GRID.centre_of(warped.indices[:, 1:])
    assert torch.cdist(expected, found).amin(1).max() <= 0.25 * math.sqrt(3) + 1e-5


@pytest.mark.parametrize("compensated", [True, False])
def test_a_moving_box_is_aligned_by_its_velocity(compensated):
    """A box ahead drives away at 10 m/s, the ego stands: after half a second it is 5 m, ten voxels, further."""
    part = fusion(velocity_compensation=compensated)
    box = torch.cartesian_prod(torch.arange(10.25, 14, 0.5), torch.tensor([0.25]), torch.tensor([0.25]))
    volume = volume_at(box)
    memory = remembered(part, volume, bare_frame(0.0, [pose()]), torch.full((len(volume),), 10.0))
    warped = part.recall(memory, bare_frame(0.5, [pose()])).volume
    there = GRID.centre_of(warped.indices[:, 1:])
    expected = GRID.centre_of(volume.indices[:, 1:]) + torch.tensor([5.0 * compensated, 0, 0])
    assert (there - expected).abs().max() <= 0.5  # the ray of an off-axis voxel is a little oblique
    assert memory.frames[0].voxels.velocities[0].norm() == pytest.approx(10.0)


def test_speeds_are_along_the_ray_and_turned_back_to_the_ego_frame():
    part = fusion()
    augment = bda(rotation=0.4, flip_y=True)
    volume = volume_at(scattered(30, seed=5))
    speeds = torch.linspace(-5, 5, len(volume))
    memory = remembered(part, volume, bare_frame(0.0, [pose()], [augment]), speeds)
    voxels = memory.frames[0].voxels
    inverse = torch.linalg.inv(augment)[:3, :3]
    centres = GRID.centre_of(volume.indices[:, 1:]) @ inverse.T
    torch.testing.assert_close(voxels.xyz, centres)
    torch.testing.assert_close(voxels.velocities, speeds[:, None] * torch.nn.functional.normalize(centres, dim=1))
    unmoved = bare_frame(0.0, [pose()], [augment])
    again = part.recall(memory, bare_frame(1e-6, [pose()], [unmoved.aug_from_ego[0]])).volume
    assert torch.equal(again.sites.keys, volume.sites.keys)


def test_voxels_that_meet_are_averaged_and_those_outside_dropped():
    part = fusion()
    volume = volume_at(torch.tensor([[10.2, 0.1, 0.1], [10.6, 0.1, 0.1], [31.9, 0.1, 0.1]]))
    volume = volume.with_features(torch.tensor([[2.0], [4.0], [100.0]]).expand(-1, STORED).contiguous())
    speeds = torch.tensor([1.0, 0.0, 5.0])  # the first catches up with the second
    warped = part.recall(remembered(part, volume, bare_frame(0.0, [pose()]), speeds), bare_frame(0.5, [pose()])).volume
    assert GRID.centre_of(warped.indices[:, 1:]).tolist() == [[10.75, 0.25, 0.25]]
    assert warped.features.tolist() == [[3.0] * STORED]


@pytest.mark.parametrize(
    ("time_s", "there"),
    [(1.2, pose(1.0)), (0.0, pose()), (-0.5, pose()), (0.5, pose(80.0))],
    ids=["too old", "not in the past", "of the future", "the pose jumped"],
)
def test_a_memory_that_is_of_no_use(time_s, there):
    part, volume = fusion(), volume_at(scattered(20))
    memory = remembered(part, volume, bare_frame(0.0, [pose()]))
    warped = part.recall(memory, bare_frame(time_s, [there]))
    assert len(warped.volume) == 0 and warped.elapsed_s.tolist() == [0.0]
    current = volume_at(scattered(20), CHANNELS)
    torch.testing.assert_close(part(current, warped).features, current.features)


def test_fusion_changes_what_meets_the_past_and_no_site():
    part, past = fusion(), scattered(30)
    warped = part.recall(remembered(part, volume_at(past), bare_frame(0.0, [pose()])), bare_frame(0.5, [pose()]))
    current = volume_at(torch.cat([past[:15], torch.tensor([[28.0, 12.0, 1.0], [-14.0, -14.0, -1.0]])]), CHANNELS)
    fused = part(current, warped)
    assert fused.sites is current.sites
    apart = (current.indices[:, None] - warped.volume.indices[None]).abs().amax(2)
    meets = (apart <= 1).any(1)
    changed = (fused.features != current.features).any(1)
    assert torch.equal(changed, meets) and 0 < meets.sum() < len(current)


def test_every_parameter_has_a_gradient_with_and_without_memory():
    part, volume = fusion(), volume_at(scattered(40))
    current = volume_at(scattered(40), CHANNELS)
    memory = part.remember(volume.with_features(volume.features.requires_grad_()), None, bare_frame(0.0, [pose()]))
    for past in (None, memory):
        part.zero_grad()
        part(current, part.recall(past, bare_frame(0.5, [pose()]))).features.square().sum().backward()
        assert all(p.grad is not None for p in part.parameters())
        assert any(p.grad.any() for p in part.parameters()) is (past is not None)
    assert volume.features.grad.any()  # through the last transition
    assert not memory.detached().frames[0].voxels.features.requires_grad


def test_streams_are_selected_and_do_not_mix():
    part = fusion()
    points = scattered(60)
    volume = volume_at(points, batch=torch.arange(60) % 3, batch_size=3)
    frame = bare_frame(0.0, [pose(), pose(1.0), pose(2.0)])
    memory = remembered(part, volume, frame).select(torch.tensor([2, 0, 1]), torch.tensor([True, True, False]))
    warped = part.recall(memory, bare_frame(0.5, [pose(2.0), pose(), pose(1.0)])).volume
    for row, stream in ((0, 2), (1, 0)):
        own = volume.features[volume.indices[:, 0] == stream]
        torch.testing.assert_close(warped.features[warped.indices[:, 0] == row], own)
    assert not (warped.indices[:, 0] == 2).any()
    again = VolumeMemory.from_state(memory.state())
    assert all(torch.equal(a, b) for a, b in zip(tensors_of(memory), tensors_of(again), strict=True))
    assert again.frames[0].voxel_m == GRID.voxel_m


def test_an_oracle_replaces_velocities_over_the_ground():
    part, volume = fusion(), volume_at(scattered(10, seed=8))
    memory = remembered(part, volume, bare_frame(0.0, [pose()]), torch.ones(len(volume)))
    frame = memory.frames[0].with_velocities(lambda row, xy, own: xy + row)
    assert torch.equal(frame.voxels.velocities[:, :2], frame.voxels.xyz[:, :2])
    assert not frame.voxels.velocities[:, 2].any()


def test_a_memory_of_another_model_is_refused():
    part, volume = fusion(), volume_at(scattered(10))
    memory = remembered(part, volume, bare_frame(0.0, [pose()]))
    coarse = WindowedFusion(settings(), CHANNELS, STORED, GRID.at(1))
    with pytest.raises(ValueError, match=r"voxels of \(0.5, 0.5, 0.5\) m, but this model .*\(1.0, 1.0, 1.0\) m; start"):
        coarse.recall(memory, bare_frame(0.5, [pose()]))
    wide = WindowedFusion(settings(), CHANNELS, STORED + 1, GRID)
    with pytest.raises(ValueError, match="holds 8 channels .* remembers 9"):
        wide.recall(memory, bare_frame(0.5, [pose()]))
    with pytest.raises(ValueError, match="holds 1 streams, but the batch 2 frames"):
        part.recall(memory, bare_frame(0.5, [pose(), pose()]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"num_heads": 3}, "multiple of num_heads=3"), ({"window": 2}, "1, 3 or 5"), ({"max_age_s": 0.0}, "positive")],
)
def test_settings_that_cannot_work(changes, message):
    with pytest.raises(ConfigError, match=message):
        settings(**changes)
