from dataclasses import replace

import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.geometry.voxel_grid import VoxelGrid
from src.models.layers.dense import DenseToSparse
from src.models.lrs4fusion.decoders import DecoderConfig, Decoders
from src.models.lrs4fusion.late_encoder import FUSED_SCALE, Volumes
from src.models.lrs4fusion.measured_motion import MeasuredMotion, at_key_time, return_velocities
from src.ops.ball_query import ball_query
from src.ops.sites import Sites
from src.structures.boxes import Boxes3D
from src.structures.sparse_bev import SparseMap
from src.targets.heatmap import head_targets
from tests.models.moving import bare_frame, pose
from tests.ops.maps import random_sites

FINEST = VoxelGrid((-64.0, -64.0, -4.0), (64.0, 64.0, 4.0), (0.5, 0.5, 0.5), num_levels=4)
GRID = FINEST.at(FUSED_SCALE)  # voxels of 1 m
CAR, WALL = [20.5, 0.5, 0.5], [30.5, 0.5, 0.5]
"""Centres of the only two voxels; the ego's heading is x, and the car is nearly ahead."""


def volume(*centres, samples=None):
    cells = GRID.cell_of(torch.tensor(centres))
    sample = torch.zeros(len(centres)) if samples is None else torch.tensor(samples)
    sites, order = Sites.from_indices(torch.cat([sample.long()[:, None], cells], 1), (2, *GRID.cells))
    features = 1 + torch.arange(len(centres)).float()[:, None].expand(-1, 3)  # 1 1 1, then 2 2 2, ...
    return SparseMap(sites, features[order].clone().requires_grad_())


def motion(
    scale, speeds=(10.0, torch.nan), centres=(CAR, WALL), samples=(0, 0), ego_mps=0.0, augs=None, sensors=(0.0, 0, 0)
):
    """Of points in the voxels' centres; `speeds` are along their rays from one sensor or from one each."""
    frame = replace(
        bare_frame(0.0, [pose()] * 2, augs),
        lidar_points=torch.cat([torch.tensor(centres), torch.zeros(len(centres), 2)], 1),
        lidar_batch=torch.tensor(samples),
        lidar_origins=torch.tensor(sensors).expand(len(centres), 3),
        lidar_speeds=torch.tensor(speeds),
    )
    return MeasuredMotion.of(scale, GRID, frame, return_velocities(frame), torch.tensor([[ego_mps, 0.0, 0.0]] * 2))


def seen(moving, *queries, batch=None):
    q = torch.tensor(queries)
    return moving.seen_at(q[:, :3], q[:, 3], torch.zeros(len(q)).long() if batch is None else torch.tensor(batch), 7)


def test_returns_lie_where_their_matter_is_at_the_key_time():
    """Of an age of 50 ms, 1 m/s or less, unknown, abeam, and measured after the key time."""
    points = torch.tensor([[20.0, 0, 0, 7, 0.05], [20.0, 0, 0, 7, 0.05], [20.0, 0, 0, 7, 0.05], [0.0, 9, 0, 7, 0.1],
                           [-20.0, 0, 0, 7, -0.05]])  # fmt: skip
    frame = replace(
        bare_frame(0.0, [pose()]), lidar_points=points, lidar_batch=torch.zeros(5).long(),
        lidar_origins=torch.zeros(5, 3), lidar_speeds=torch.tensor([30.0, 1.0, torch.nan, -4.0, 30.0]),
    )  # fmt: skip
    moved = at_key_time(points, return_velocities(frame))
    assert torch.equal(moved[:, 2:], points[:, 2:])
    torch.testing.assert_close(moved[:, :2], torch.tensor([[21.5, 0], [20, 0], [20, 0], [0, 8.6], [-18.5, 0]]))


def test_what_is_measured_to_move_is_seen_where_it_will_be():
    """About 10 m/s: 10 m farther in a second, where the wall stands; 5 m nearer half a second ago."""
    moving = motion(volume(CAR, WALL))
    features, source, speeds = seen(moving, [*CAR, 0.0], [30.4, 0.6, 0.5, 1.0], [15.6, 0.4, 0.5, -0.5])
    torch.testing.assert_close(features, torch.ones(3, 3))
    assert (source - torch.tensor(CAR)).abs().max() < 0.2  # where the car is now
    torch.testing.assert_close(speeds, torch.full((3,), 10.0), atol=0.02, rtol=0)


def test_it_goes_along_the_road_with_its_radial_speed():
    """A 4-3-5 triangle to the side: 10 m/s along the ray are 12.5 along the heading, which an augmentation turns."""
    side, abeam, turned = [20.5, 15.5, 0.5], [2.5, 20.5, 0.5], torch.eye(4)
    ray = torch.nn.functional.normalize(torch.tensor(side), dim=0)
    moving = motion(volume(side), (10.0,), (side,), (0,))
    torch.testing.assert_close(moving.velocities, torch.tensor([[10 / float(ray[0]), 0.0, 0.0]]))
    assert float(moving.velocities[0, 0]) == pytest.approx(12.5, abs=0.1)
    turned[:2, :2] = torch.tensor([[0.8, -0.6], [0.6, 0.8]]) * 1.05
    along = torch.tensor([0.8, 0.6, 0.0])
    moving = motion(volume(side), (10.0,), (side,), (0,), augs=[turned] * 2)
    torch.testing.assert_close(moving.velocities[0], 10 / (ray @ along) * along)
    moving = motion(volume(abeam), (10.0,), (abeam,), (0,))  # nearly at a right angle: along the ray
    torch.testing.assert_close(moving.velocities[0], 10 * torch.nn.functional.normalize(torch.tensor(abeam), dim=0))


def test_each_speed_is_along_the_ray_from_its_own_sensor():
    """Beside the cab, behind a sensor ahead of it: what goes away goes backwards. One voxel may be seen by two."""
    beside = [2.5, 3.5, 0.5]
    moving = motion(volume(beside), (10.0,), (beside,), (0,), sensors=((5.5, 0.5, 0.5),))
    torch.testing.assert_close(moving.velocities, torch.tensor([[-10 * 2**0.5, 0.0, 0.0]]))
    speeds = seen(moving, [*beside, 0.0])[2]
    torch.testing.assert_close(speeds, torch.tensor([10.0]))
    sensors = ((0.5, 0.5, 0.5), (40.5, 0.5, 0.5))  # behind and ahead of the car, which both see at 10 m/s
    moving = motion(volume(CAR), (10.0, -10.0), (CAR, CAR), (0, 0), sensors=sensors)
    torch.testing.assert_close(moving.velocities, torch.tensor([[10.0, 0.0, 0.0]]))


def test_a_speed_is_along_the_ray_from_where_the_sensors_will_be():
    """The ego overtakes: 21 m behind a car is its mast, 20 m above it, and 30 m/s fast."""
    moving = motion(volume(CAR), (10.0,), (CAR,), (0,), ego_mps=30.0, sensors=(-0.5, 0.5, 20.5))
    over_ground = 10 * 29 / 21  # a triangle of 20, 21 and 29 m
    behind = 60 - 21 - 2 * over_ground  # of the mast, in two seconds
    _, _, speeds = seen(moving, [*CAR, 0.0], [20.5 + 2 * over_ground, 0.5, 0.5, 2.0])
    expected = torch.tensor([10.0, -over_ground * behind / (behind**2 + 20**2) ** 0.5])
    torch.testing.assert_close(speeds, expected)


def test_where_the_egos_speed_is_unknown_a_speed_is_along_the_present_ray():
    """A car 20 m behind at 25 m/s: 2 s later it is still behind an ego as fast, ahead of one known to stand."""
    behind = [-19.5, 0.5, 0.5]
    moving = motion(volume(behind, behind, samples=[0, 1]), (-25.0, -25.0), (behind, behind), (0, 1), torch.nan,
                    sensors=(0.5, 0.5, 0.5))  # fmt: skip
    moving.ego_mps[1] = 0
    ahead = [30.5, 0.5, 0.5, 2.0]
    speeds = seen(moving, [*behind, 0.0], ahead, [*behind, 0.0], ahead, batch=[0, 0, 1, 1])[2]
    assert speeds.tolist() == [-25.0, -25.0, -25.0, 25.0]


def test_the_place_that_it_leaves_is_empty_and_what_rests_stays():
    moving = motion(volume(CAR, WALL))
    features, source, speeds = seen(moving, [*CAR, 1.0], [*WALL, 2.0], [*WALL, 0.0])
    assert features[:, 0].tolist() == [0, 2, 2]
    assert source.tolist() == [CAR, WALL, WALL] and not speeds.any()


@pytest.mark.parametrize("speed", [torch.nan, 0.9, -0.9])
def test_without_a_measured_speed_above_1_mps_all_rests(speed):
    scale = SparseMap(random_sites((2, *GRID.cells), 4000), torch.randn(4000, 3))
    points = GRID.centre_of(scale.indices[:100, 1:])
    batch = scale.indices[:100, 0]
    moving = motion(scale, [speed] * 100, points.tolist(), batch.tolist())
    queries = points + 0.3
    features, source, speeds = moving.seen_at(queries, torch.linspace(-0.5, 3, 100), batch, 7)
    torch.testing.assert_close(features, ball_query(scale.features, scale.sites, GRID, queries, batch, 7))
    assert torch.equal(source, queries) and not speeds.any()


def test_samples_and_moments_do_not_meet():
    """The second sample has the same car, at rest. Near times share a place, but where it was is exact."""
    moving = motion(volume(CAR, CAR, samples=[0, 1]), (10.0, 0.0), (CAR, CAR), (0, 1))
    there = [30.5, 0.5, 0.5]
    times, samples = [1.0, 1.0, 1.02, 0.5], [0, 1, 0, 0]
    features, source, _ = seen(moving, *([*there, time] for time in times), batch=samples)
    assert features[:, 0].tolist() == [1, 0, 1, 0]
    torch.testing.assert_close(source[:, 0], torch.tensor([20.5, 30.5, 20.3, 30.5]), atol=0.01, rtol=0)
    features = seen(moving, [*CAR, 1.0], [*CAR, 1.0], batch=[0, 1])[0]
    assert features[:, 0].tolist() == [0, 2]


def test_what_leaves_the_region_is_seen_no_more():
    far = [60.5, 0.5, 0.5]
    moving = motion(volume(far), (30.0,), (far,), (0,))
    features, source, speeds = seen(moving, [63.9, 0.5, 0.5, 1.0], [90.5, 0.5, 0.5, 1.0])
    assert (
        not features.any()
        and not speeds.any()
        and source.tolist() == [pytest.approx([63.9, 0.5, 0.5]), [90.5, 0.5, 0.5]]
    )


def test_what_is_measured_to_stand_stands_beside_what_moves():
    """The road under a car has a speed of its own; the voxel on the car's other side has none."""
    road, roof = [20.5, 0.5, -0.5], [20.5, 0.5, 1.5]
    moving = motion(volume(CAR, road, roof), (10.0, 0.0), (CAR, road), (0, 0))
    assert moving.xyz.tolist() == [CAR, roof]
    assert GRID.centre_of(moving.rest.indices[:, 1:]).tolist() == [road]


def test_a_voxel_moves_where_half_of_its_points_do():
    for speeds, found in (((10.0, 10.0, 0.0), 10.0), ((10.0, 0.0), 10.0), ((10.0, 0.0, 0.0), None)):
        points = (CAR,) * len(speeds)
        moving = motion(volume(CAR), speeds, points, (0,) * len(speeds))
        assert [pytest.approx(found, abs=0.01)] * (found is not None) == moving.velocities[:, 0].tolist()


def test_speeds_reach_the_faces_neighbours_and_are_means():
    """Two points of one voxel; the voxel beside them has none of its own and moves with them, the next one rests."""
    beside, beyond = [21.5, 0.5, 0.5], [22.5, 0.5, 0.5]
    moving = motion(volume(CAR, beside, beyond), (8.0, 12.0), (CAR, CAR), (0, 0))
    assert moving.xyz.tolist() == [CAR, beside] and len(moving.rest) == 1
    torch.testing.assert_close(moving.velocities, torch.tensor([[10.0, 0, 0]]).expand(2, 3), atol=0.01, rtol=0)


def test_motion_on_the_ground_is_that_of_the_cell_or_of_those_around_it():
    """Cells of 2 m about their lower corners: two voxels above each other, one beside them, the second sample's own."""
    above, beside = [20.5, 0.5, 2.5], [22.5, 0.5, 0.5]
    centres = (CAR, above, beside, CAR)
    moving = motion(volume(*centres, samples=[0, 0, 0, 1]), (10.0, 20.0, 30.0, -10.0), centres, (0, 0, 0, 1))
    grid = BEVGrid((4, 16), 2.0, (20.0, 0.0), (-4.0, 4.0))
    found = moving.on_ground(grid)
    assert found.shape == (2, 2, 4, 16) and not found[:, 1].any()
    row = found[0, 0, 2]  # about y = 0; the car is nearest to x = 20 m, column 8
    torch.testing.assert_close(row[6:12], torch.tensor([0.0, 15, 15, 30, 30, 0]), atol=0.1, rtol=0)
    torch.testing.assert_close(found[0, 0, 1, 7:11], torch.tensor([15.0, 20, 20, 30]), atol=0.1, rtol=0)
    assert not found[0, 0, 0].any() and float(found[1, 0, 2, 8]) == pytest.approx(-10, abs=0.1)
    far = motion(volume(CAR), (10.0,), (CAR,), (0,)).on_ground(BEVGrid((4, 4), 2.0, (-20.0, 0.0), (-4.0, 4.0)))
    assert far.shape == (2, 2, 4, 4) and not far.any()


@pytest.mark.parametrize("shift", torch.arange(0, 3.2, 0.4).tolist())
def test_motion_on_the_ground_is_asked_where_the_head_learns_the_box(shift):
    """Two lanes, 3.5 m apart, of opposite directions, on cells of 3.2 m."""
    grid = BEVGrid((20, 40), 3.2, (0.0, 0.0), (-4.0, 4.0))
    centres = torch.tensor([[20.0, shift, 0.5], [20.0, shift + 3.5, 0.5]])
    around = torch.tensor([[x, y, 0.0] for x in (-1.5, -0.5, 0.5, 1.5) for y in (-0.5, 0.5)])
    cars = (centres[:, None] + around).flatten(0, 1)
    points = GRID.centre_of(GRID.cell_of(cars)).tolist()
    speeds = [25.0] * 8 + [-25.0] * 8
    found = motion(volume(*points), speeds, points, [0] * 16).on_ground(grid)
    boxes = Boxes3D(
        centers=centres, sizes=torch.tensor([[1.9, 4.5, 1.6]] * 2), yaws=torch.zeros(2), velocities=torch.zeros(2, 2),
        labels=torch.zeros(2).long(), attributes=torch.full((2,), -1), num_points=torch.full((2,), 8),
    )  # fmt: skip
    rows = head_targets([boxes], DenseToSparse().sites(found[:1]), grid).rows
    there, back = found[0, 0].flatten()[rows].tolist()
    assert there > 5 and back < -5


def test_nothing_measured_and_nothing_asked():
    moving = motion(volume(CAR, WALL), (torch.nan, torch.nan))
    features, source, speeds = moving.seen_at(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0).long(), 7)
    assert features.shape == (0, 3) and source.shape == (0, 3) and speeds.shape == (0,)
    assert not moving.on_ground(BEVGrid((4, 4), 2.0, (20.0, 0.0), (-4.0, 4.0))).any()


def test_decoders_begin_with_the_measured_speed_of_what_will_be_there():
    """Untrained, a velocity is the one measured where the matter of (p, t) is now; features there have a gradient."""
    scales = [SparseMap(random_sites((2, *FINEST.at(level).cells), 50), torch.randn(50, 3)) for level in range(4)]
    scales[FUSED_SCALE] = volume(CAR, WALL)
    config = DecoderConfig(
        hidden_channels=8,
        num_blocks=2,
        neighbours=[7, 7, 1, 1],
        velocity=True,
        velocity_unit_mps=10.0,
    )
    model, volumes = Decoders(config, (3, 3, 3, 3), FINEST), Volumes(tuple(scales), (0,) * 4)
    volumes.measured = motion(scales[FUSED_SCALE])
    queries = torch.tensor([[*CAR, 0.0], [30.5, 0.5, 0.5, 1.0], [*CAR, 2.0], [*WALL, 0.0]])
    occupancy, speeds = model(volumes, queries, torch.zeros(4).long())
    torch.testing.assert_close(speeds, torch.tensor([10.0, 10.0, 0.0, 0.0]), atol=0.01, rtol=0)
    torch.testing.assert_close(model.velocities(volumes, queries, torch.zeros(4).long()), speeds)
    occupancy[1].backward()
    car, wall = scales[FUSED_SCALE].features.grad.abs().sum(1)
    assert car > 0 and wall == 0
