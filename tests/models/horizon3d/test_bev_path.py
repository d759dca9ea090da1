"""BEV path: what is stored, and the warp of Eq. 8 against exact geometry and real tracks."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.geometry.box_cells import cells_in_boxes
from src.models.horizon3d.bev_path import CellPrediction
from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory, StoredCells
from src.models.layers.doppler import Doppler
from tests.models.horizon3d.cells import FULL, GRID, TINY, C, bev_of, make_path, random_cells
from tests.models.moving import UTM, bare_frame, bda, pose
from tests.models.radial import MEASURED

PAGE = Path(__file__).resolve().parents[4] / "shared/real/horizon3d_page/dptf_demo.json"
SQUARE = BEVGrid(cells=(64, 64), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
BDAS = {
    "none": (bda(), bda()),
    "constant": (bda(0.3, 1.05, flip_x=True), bda(0.3, 1.05, flip_x=True)),
    "another each frame": (bda(-0.39, 0.95, flip_y=True), bda(0.25, 1.05, flip_x=True)),
}


def remember(path, batch, cells, velocities, scores=0.9):
    """DPTFMemory frame of occupied cells [n, 3] whose features tell their row in `cells`."""
    fused, order = bev_of(cells, path.grid, batch_size=len(batch))
    logits = torch.logit(torch.as_tensor(scores).expand(len(cells)))
    stored = path.store(fused, CellPrediction(logits[order], velocities[order], velocities[order]), batch)
    return DPTFFrame(batch.timestamps_s, batch.global_from_ego, torch.ones(len(batch)).bool(), stored, None)


def with_batch(cells):
    return F.pad(cells, (1, 0))


def world_to_aug(batch, points):
    """Exact place [n, 2] of world points (float64, in the plane of the ego) in the augmented frame."""
    ego = torch.linalg.inv(batch.global_from_ego[0])
    aug = batch.aug_from_ego[0].double()
    flat = torch.cat([points, torch.zeros(len(points), 1).double(), torch.ones(len(points), 1).double()], 1)
    return (flat @ (aug @ ego).T)[:, :2]


def distinct_world_points(batch, grid):
    """World points near the vehicle, in distinct cells of the batch's augmented frame; and those cells [n, 2]."""
    generator = torch.Generator().manual_seed(3)
    around = (torch.rand(60, 2, generator=generator).double() * 2 - 1) * 20.0
    points = around + batch.global_from_ego[0, :2, 3]
    cells = grid.cell_of(world_to_aug(batch, points))
    _, owners = torch.unique(cells, dim=0, return_inverse=True)
    first = torch.zeros(int(owners.max()) + 1, dtype=torch.int64).scatter_(0, owners, torch.arange(len(points)))
    return points[first], cells[first]


# -- the warp, method 15.4 --------------------------------------------------------------------


@pytest.mark.parametrize("augs", BDAS.values(), ids=BDAS)
@pytest.mark.parametrize("origin", [(0.0, 0.0), UTM])
@pytest.mark.parametrize("drive", [(0.0, 0.0, 0.0), (11.5, 0.4, 0.05), (-3.0, 8.0, -2.0), (14.0, 2.0, 1.2)])
def test_a_static_world_stays_where_it_is(drive, origin, augs):
    """Cells of standing points come back on the cells of the same points, within one cell of quantisation."""
    path = make_path()
    before = bare_frame(100.0, [pose(5.0, 6.0, 0.8, origin)], [augs[0]])
    x, y, turn = drive
    now = bare_frame(100.5, [pose(5.0 + x, 6.0 + y, 0.8 + turn, origin)], [augs[1]])
    points, cells = distinct_world_points(before, GRID)
    frame = remember(path, before, with_batch(cells), torch.zeros(len(cells), 2))
    warped = path.recall(DPTFMemory((frame,)), now, 6.0)

    which = warped.features[:, 0].long()
    expected = GRID.cell_of(world_to_aug(now, points[which]))
    assert len(which) > 40
    assert (warped.indices[:, 2:] - expected).abs().max() <= 1
    # The centres themselves have moved exactly.
    centres = GRID.centre_of(cells, torch.float64)
    flat = torch.cat([centres, torch.zeros(len(cells), 1).double(), torch.ones(len(cells), 1).double()], 1)
    aug_now, aug_before = now.aug_from_ego[0].double(), before.aug_from_ego[0].double()
    chain = (
        aug_now @ torch.linalg.inv(now.global_from_ego[0]) @ before.global_from_ego[0] @ torch.linalg.inv(aug_before)
    )
    exact = (flat @ chain.T)[:, :2]
    torch.testing.assert_close(warped.xy.double(), exact[which], rtol=0, atol=1e-3)
    # What is missing has left the grid.
    gone = torch.ones(len(cells), dtype=torch.bool).index_fill(0, which, False)
    assert not GRID.contains(exact[gone]).any()


@pytest.mark.parametrize("augs", BDAS.values(), ids=BDAS)
@pytest.mark.parametrize("steps", [1, 3, 8])
def test_a_moving_box_coincides_with_its_cells_at_the_new_time(augs, steps):
    """Both directions: every warped cell is within one cell of the box's raster now, and every one of those of it."""
    path, dt = make_path(), 0.5 * steps
    before = bare_frame(7.0, [pose(0.0, 0.0, 0.2, UTM)], [augs[0]])
    now = bare_frame(7.0 + dt, [pose(9.0, 1.0, 0.3, UTM)], [augs[1]])
    heading, speed = 0.35, 4.5  # in the world; long boxes are wider than a cell in any frame
    velocity = speed * torch.tensor([math.cos(heading), math.sin(heading)], dtype=torch.float64)
    start = before.global_from_ego[0, :2, 3] + torch.tensor([-9.0, 4.0])

    def raster(batch, centre):
        place = world_to_aug(batch, centre[None])[0]
        tip = world_to_aug(batch, (centre + velocity)[None])[0]  # the velocity as seen in this frame
        seen = tip - place
        scale = seen.norm() / speed
        box = torch.tensor([[*place, 12.0 * scale, 3.0 * scale, torch.atan2(seen[1], seen[0])]])
        cell = cells_in_boxes(box, GRID)[1]
        return torch.stack([cell // GRID.cols, cell % GRID.cols], 1), seen.float()

    cells, seen = raster(before, start)
    wanted, seen_now = raster(now, start + velocity * dt)
    frame = remember(path, before, with_batch(cells), seen.expand(len(cells), 2))
    warped = path.recall(DPTFMemory((frame,)), now, 6.0)
    gaps = (warped.indices[:, None, 2:] - wanted[None]).abs().amax(2)  # [warped, wanted]
    assert len(warped.indices) == len(cells) and len(wanted) > 40
    assert gaps.amin(1).max() <= 1 and gaps.amin(0).max() <= 1
    assert (gaps.amin(1) == 0).float().mean() > 0.8
    torch.testing.assert_close(warped.velocities, seen_now.expand(len(cells), 2), rtol=0, atol=1e-3)

    behind = replace(path.config, velocity_compensation=False)
    path.config = behind
    late = path.recall(DPTFMemory((frame,)), now, 6.0)
    moved = warped.xy - late.xy  # all the difference is what the box has driven
    torch.testing.assert_close(moved, (seen_now * dt).expand(len(cells), 2), rtol=0, atol=1e-3)


def test_moves_by_whole_cells_give_the_very_set_of_cells():
    """Ego 4 cells ahead, object 10 cells to the left: no rounding to hide behind."""
    path = make_path()
    cells = torch.tensor([[50, 60], [50, 61], [51, 60], [10, 3]])
    velocities = torch.tensor([[0.0, 16.0]] * 3 + [[0.0, 0.0]])
    frame = remember(path, bare_frame(0.0, [pose(2.0, 3.0)]), with_batch(cells), velocities)
    now = bare_frame(0.5, [pose(2.0 + 3.2, 3.0)])
    shift = torch.tensor([[10, -4]] * 3 + [[0, -4]])
    expected = {tuple(cell) for cell in (cells + shift).tolist() if min(cell) >= 0}
    assert {tuple(cell) for cell in path.recall(DPTFMemory((frame,)), now, 6.0).indices[:, 2:].tolist()} == expected
    assert len(expected) == 3  # the standing cell has left the grid
    path.config = replace(path.config, velocity_compensation=False)
    left = path.recall(DPTFMemory((frame,)), now, 6.0)
    assert {tuple(cell) for cell in left.indices[:, 2:].tolist()} == {
        tuple(cell) for cell in (cells + torch.tensor([0, -4])).tolist() if min(cell) >= 0
    }


@pytest.mark.parametrize("before", [bda(), bda(flip_x=True), bda(flip_y=True), bda(math.pi / 2)])
@pytest.mark.parametrize("now", [bda(), bda(flip_x=True, flip_y=True), bda(math.pi / 2, flip_y=True)])
def test_augmentation_on_and_off_give_the_same_set_where_cells_map_to_cells(before, now):
    """Flips and quarter turns of a square grid: the sets after A^-1 are equal, cell by cell, features included."""
    path = make_path(SQUARE)
    generator = torch.Generator().manual_seed(5)
    numbers = torch.randperm(40 * 40, generator=generator)[:80]
    cells = torch.stack([numbers // 40 + 12, numbers % 40 + 12], 1)
    velocities = 1.6 * torch.randint(-3, 4, (80, 2), generator=generator)
    poses = pose(3.0, 1.0, 0.0, UTM), pose(3.0 + 4.0, 1.0 - 1.6, 0.0, UTM)

    def run(first, second):
        xy = SQUARE.centre_of(cells) @ first[:2, :2].T
        frame = remember(
            path,
            bare_frame(2.0, [poses[0]], [first]),
            with_batch(SQUARE.cell_of(xy)),
            velocities @ first[:2, :2].T,
        )
        warped = path.recall(DPTFMemory((frame,)), bare_frame(3.0, [poses[1]], [second]), 6.0)
        back = torch.linalg.inv(second[:2, :2])
        places = SQUARE.centre_of(warped.indices[:, 2:]) @ back.T
        table = torch.cat([warped.features[:, :1], places, warped.velocities @ back.T], 1)
        return table[table[:, 0].argsort()]

    torch.testing.assert_close(run(before, now), run(bda(), bda()), rtol=0, atol=1e-3)


@pytest.mark.parametrize("augs", list(BDAS.values())[1:], ids=list(BDAS)[1:])
def test_augmentation_on_and_off_agree_within_quantisation(augs):
    path = make_path()
    poses = pose(1.0, 2.0, 0.4), pose(10.0, 4.0, 0.5)
    generator = torch.Generator().manual_seed(8)
    points = (torch.rand(50, 2, generator=generator).double() - 0.5) * 40
    speeds = 8 * torch.randn(50, 2, generator=generator)

    def run(first, second):
        before, now = bare_frame(0.0, [poses[0]], [first]), bare_frame(1.0, [poses[1]], [second])
        cells = GRID.cell_of(points.float() @ first[:2, :2].T)
        kept, back = torch.linalg.inv(second[:2, :2]), []
        for point in range(50):  # one at a time, since two may share a cell
            frame = remember(
                path, before, with_batch(cells[point : point + 1]), speeds[point : point + 1] @ first[:2, :2].T
            )
            warped = path.recall(DPTFMemory((frame,)), now, 6.0)
            back += [(warped.xy @ kept.T, warped.velocities @ kept.T)]
        return back

    both = list(zip(run(*augs), run(bda(), bda()), strict=True))
    compared = 0
    for (xy, velocity), (plain_xy, plain_velocity) in both:
        if len(xy) and len(plain_xy):
            compared += 1
            assert (xy - plain_xy).norm() < 2 * 0.4 * math.sqrt(2) / 0.95  # half a cell's diagonal each
            torch.testing.assert_close(velocity, plain_velocity, rtol=0, atol=1e-3)
    assert compared > 35


# -- slots, ages, streams --------------------------------------------------------------------------------------------


def test_slots_run_from_the_oldest_to_the_newest_and_ages_come_from_time_stamps():
    path, memory = make_path(num_frames=4), DPTFMemory(())
    stamps = [0.0, 0.5, 1.0, 2.5, 3.0]  # two frames were dropped before 2.5
    for number, stamp in enumerate(stamps):
        cell = torch.tensor([[0, 40 + number, 50]])
        memory = memory.push(remember(path, bare_frame(stamp, [pose()]), cell, torch.zeros(1, 2)), 4, 0)
    warped = path.recall(memory, bare_frame(3.5, [pose()]), 6.0)
    order = warped.indices[:, 1].argsort()
    assert warped.indices[order, 1].tolist() == [0, 1, 2, 3]
    assert warped.indices[order, 2].tolist() == [41, 42, 43, 44]  # the very first is forgotten
    assert warped.elapsed_s[order].tolist() == [3.0, 2.5, 1.0, 0.5]
    young = path.recall(memory, bare_frame(3.5, [pose()]), 1.0)
    assert sorted(young.indices[:, 1].tolist()) == [2, 3]  # the age limit empties slots, it does not shift them


def test_a_short_memory_fills_the_newest_slots():
    path = make_path()
    frame = remember(path, bare_frame(0.0, [pose()]), torch.tensor([[0, 40, 50]]), torch.zeros(1, 2))
    assert path.recall(DPTFMemory((frame,)), bare_frame(0.5, [pose()]), 6.0).indices.tolist() == [[0, 7, 40, 50]]
    assert path.num_slots == 9


@pytest.mark.parametrize(("elapsed_s", "x"), [(0.0, 0.0), (-1.0, 0.0), (6.5, 0.0), (0.5, 60.0), (0.5, float("nan"))])
def test_nothing_comes_back_from_an_unusable_frame(elapsed_s, x):
    path = make_path()
    cells, velocities = torch.tensor([[0, 40, 50], [1, 41, 50]]), torch.zeros(2, 2)
    frame = remember(path, bare_frame(0.0, [pose(), pose()]), cells, velocities)
    warped = path.recall(DPTFMemory((frame,)), bare_frame([elapsed_s, 0.5], [pose(x), pose()]), 6.0)
    assert warped.indices.tolist() == [[1, 7, 41, 50]]
    assert warped.xy.isfinite().all()


def test_what_is_slower_than_the_least_speed_stays():
    path, cells = make_path(), torch.tensor([[0, 40, 40], [0, 40, 60], [0, 60, 40]])
    velocities = torch.tensor([[0.6, 0.7], [0.8, 0.7], [0.0, -20.0]])
    memory = DPTFMemory((remember(path, bare_frame(5.0, [pose()]), cells, velocities),))
    found = path.recall(memory, bare_frame(7.0, [pose()]), 6.0, min_speed_mps=1.0)
    moved = found.xy - path.grid.centre_of(cells[:, 1:])
    torch.testing.assert_close(moved, torch.tensor([[0.0, 0.0], [1.6, 1.4], [0.0, -40.0]]), atol=1e-4, rtol=0)


def test_cells_that_leave_the_grid_vanish():
    path = make_path()
    edge = torch.tensor([[0, 0, 0], [0, 95, 127], [0, 0, 127], [0, 95, 0]])
    frame = remember(path, bare_frame(0.0, [pose()]), edge, torch.zeros(4, 2))
    for x, y, kept in ((0.8, 0.0, [1, 2]), (0.0, 0.8, [1, 3]), (-0.8, 0.8, [3]), (0.0, 0.0, [0, 1, 2, 3])):
        warped = path.recall(DPTFMemory((frame,)), bare_frame(0.5, [pose(x, y)]), 6.0)
        assert sorted(warped.features[:, 0].long().tolist()) == kept
    broken = remember(path, bare_frame(0.0, [pose()]), edge, torch.full((4, 2), torch.nan))
    assert len(path.recall(DPTFMemory((broken,)), bare_frame(0.5, [pose()]), 6.0).indices) == 0


def test_nothing_remembered_is_none_and_a_frame_without_cells_is_empty():
    path, now = make_path(), bare_frame(0.5, [pose()])
    assert path.recall(DPTFMemory(()), now, 6.0) is None
    frame = remember(path, bare_frame(0.0, [pose()]), torch.zeros(0, 3, dtype=torch.int64), torch.zeros(0, 2))
    assert path.recall(DPTFMemory((replace(frame, cells=None),)), now, 6.0) is None
    assert len(path.recall(DPTFMemory((frame,)), now, 6.0).indices) == 0


def test_streams_with_different_motions_equal_single_streams():
    path = make_path(TINY).eval()
    with torch.no_grad():
        path.norms[-1].weight.fill_(1.0)
    poses = [[pose(), pose(5.0, 0.0, 1.0)], [pose(1.0), pose(6.0, 1.0, 1.2)], [pose(1.5), pose(6.5, 1.0, 1.1)]]
    stamps, augs = [[0.0, 100.0], [0.5, 101.0], [1.0, 101.5]], [bda(0.2), bda(flip_x=True)]

    def run(streams):
        memory = DPTFMemory(())
        for step in range(3):
            batch = bare_frame(
                torch.tensor(stamps[step])[streams], [poses[step][i] for i in streams], [augs[i] for i in streams]
            )
            cells, velocities, features = random_cells(40, 2, TINY, step)
            mine = torch.isin(cells[:, 0], torch.tensor(streams))
            cells, velocities, features = cells[mine], velocities[mine], features[mine]
            cells[:, 0] = cells[:, 0] - min(streams)
            fused, _ = bev_of(cells, TINY, features, len(streams))
            warped = path.recall(memory, batch, 6.0)
            output = path.aggregate(fused, warped)
            stored = path.store(fused, CellPrediction(torch.ones(len(cells)), velocities, velocities), batch)
            present = torch.ones(len(streams)).bool()
            memory = memory.push(DPTFFrame(batch.timestamps_s, batch.global_from_ego, present, stored, None), 8, 0)
        return warped, output

    both_warped, both = run([0, 1])
    for stream in (0, 1):
        warped, alone = run([stream])
        mine = both_warped.indices[:, 0] == stream
        assert len(warped.indices) and torch.equal(both_warped.indices[mine, 1:], warped.indices[:, 1:])
        for name in ("xy", "velocities", "elapsed_s", "features"):
            assert torch.equal(getattr(both_warped, name)[mine], getattr(warped, name)), name
        mine = both.indices[:, 0] == stream
        assert torch.equal(both.indices[mine, 1:], alone.indices[:, 1:])
        torch.testing.assert_close(both.features[mine], alone.features, rtol=1e-5, atol=1e-5)


# -- what is stored ------------------------------------------------------------------------------------------------


def test_cells_above_the_threshold_are_stored_and_the_cap_keeps_the_best_of_each_stream():
    path = make_path(memory_threshold=0.3, max_cells_per_frame=2)
    cells = torch.tensor([[0, 1, 1], [0, 2, 2], [0, 3, 3], [1, 1, 1], [1, 2, 2]])
    scores = torch.tensor([0.4, 0.9, 0.5, 0.29, 0.31])
    frame = remember(path, bare_frame(0.0, [pose(), pose()]), cells, torch.zeros(5, 2), scores)
    assert frame.cells.features[:, 0].tolist() == [1.0, 2.0, 4.0]
    assert frame.cells.rows.tolist() == [0, 0, 1]
    nothing = remember(path, bare_frame(0.0, [pose(), pose()]), cells, torch.zeros(5, 2), 0.2)
    assert len(nothing.cells.rows) == 0


def test_an_untrained_path_remembers_nothing():
    path = make_path().eval()
    fused, _ = bev_of(random_cells(200, 1, GRID, 0)[0], features=torch.randn(200, C).relu())
    cells = path.predict(fused)
    assert (cells.occupancy_logits.sigmoid() < 0.1).all()
    assert len(path.store(fused, cells, bare_frame(0.0, [pose()])).rows) == 0


def test_geometry_is_stored_without_augmentation():
    path, augs = make_path(), [bda(0.3, 1.05, flip_y=True), bda(-0.2, 0.95)]
    cells, velocities = torch.tensor([[0, 20, 30], [1, 60, 90]]), torch.tensor([[3.0, -4.0], [10.0, 1.0]])
    stored = remember(path, bare_frame(0.0, [pose(), pose()], augs), cells, velocities).cells
    for stream, aug in enumerate(augs):
        linear = aug[:2, :2]
        torch.testing.assert_close(linear @ stored.xy[stream], GRID.centre_of(cells[stream, 1:]), rtol=0, atol=1e-4)
        torch.testing.assert_close(linear @ stored.velocities[stream], velocities[stream], rtol=0, atol=1e-4)


def test_autocast_halves_stored_features_and_leaves_positions_alone():
    path, aug = make_path(), [bda(0.31, 1.03)]
    cells = torch.tensor([[0, 20, 30], [0, 61, 93], [0, 90, 7]])
    velocities = torch.tensor([[33.333, -4.567], [10.123, 1.0], [0.777, 0.0]])
    batch, now = bare_frame(0.0, [pose(1.0, 2.0, 0.3, UTM)], aug), bare_frame(0.5, [pose(9.0, 2.0, 0.4, UTM)], aug)
    fused, _ = bev_of(cells)
    prediction = CellPrediction(torch.ones(3), velocities, velocities)
    plain = path.store(fused, prediction, batch)
    frame = DPTFFrame(batch.timestamps_s, batch.global_from_ego, torch.ones(1).bool(), plain, None)
    warped = path.recall(DPTFMemory((frame,)), now, 6.0)
    with torch.autocast("cpu", torch.bfloat16):
        halved = path.store(fused, prediction, batch)
        again = path.recall(DPTFMemory((replace(frame, cells=halved),)), now, 6.0)
    assert plain.features.dtype == torch.float32 and halved.features.dtype == torch.bfloat16
    assert torch.equal(halved.xy, plain.xy) and torch.equal(halved.velocities, plain.velocities)
    for name in ("indices", "xy", "velocities", "elapsed_s"):
        assert torch.equal(getattr(again, name), getattr(warped, name)), name


def test_heads_predict_metres_per_second_in_float32_and_take_gradients():
    path = make_path()
    fused, _ = bev_of(random_cells(60, 2, GRID, 1)[0], features=torch.randn(60, C), batch_size=2)
    with torch.no_grad():
        path.velocity[1].weight.zero_()
        path.velocity[1].bias.copy_(torch.tensor([2.5, -1.0]))  # tens of m/s
    with torch.autocast("cpu", torch.bfloat16):
        cells = path.predict(fused)
    assert cells.occupancy_logits.shape == (60,) and cells.occupancy_logits.dtype == torch.float32
    torch.testing.assert_close(cells.velocities, torch.tensor([25.0, -10.0]).expand(60, 2))
    assert cells.occupancy_logits.requires_grad and cells.velocities.requires_grad


def test_a_cells_velocity_takes_its_radial_part_from_the_radar():
    """A point of 5 m/s along x near the first cell; what the head says across it stays."""
    fused, _ = bev_of(torch.tensor([[0, 2, 2], [0, 90, 4]]), GRID)
    point = torch.cat([GRID.centre_of(torch.tensor([[2, 2]])), torch.tensor([[1.0, 0.0, 5.0, 0.0, 0.1]])], dim=1)
    doppler, path = Doppler.measure(point, torch.tensor([0]), GRID, MEASURED), make_path().eval()
    plain, found = path.predict(fused).velocities, path.predict(fused, doppler).velocities
    torch.testing.assert_close(found[0], torch.tensor([5.0, float(plain[0, 1].detach())]))
    assert torch.equal(found[1], plain[1])
    for in_losses, wanted in ((True, found), (False, plain)):
        measured = replace(doppler, config=replace(MEASURED, in_losses=in_losses))
        assert torch.equal(path.predict(fused, measured).loss_velocities, wanted)


def test_a_path_without_frames_or_with_an_impossible_threshold_is_refused():
    for changes, words in (
        ({"num_frames": 0}, "bev_path=null"),
        ({"max_cells_per_frame": 0}, "max_cells_per_frame=0"),
        ({"memory_threshold": 1.0}, "memory_threshold=1.0"),
        ({"memory_threshold": -0.1}, "memory_threshold"),
    ):
        with pytest.raises(ConfigError, match=words):
            make_path(**changes)


# -- real tracks ---------------------------------------------------------------------------------------------------


def test_real_tracked_boxes_land_on_their_next_place():
    """20 key frames of a truck at 83 km/h, which drives towards -x there; a quarter are identity switches of the file.

    Its tracked boxes are annotated ones, which carry the velocities.
    """
    if not PAGE.is_file():
        pytest.skip(f"{PAGE} is absent: the authors' page data lie outside the repository")
    path, errors, behind = make_path(FULL), [], []
    frames = json.loads(PAGE.read_text())["frames"]
    for first, second in zip(frames[1:], frames[2:], strict=False):  # it stands still in the first
        later = {track["tid"]: track["box"][:2] for track in second["tracked"]}
        tracks = [track for track in first["tracked"] if track["tid"] in later]
        if not tracks:
            continue
        xy = torch.tensor([track["box"][:2] for track in tracks])
        distance, nearest = (xy[:, None] - torch.tensor(first["gt_boxes"])[None, :, :2]).norm(dim=2).min(dim=1)
        assert distance.max() < 0.02
        stored = StoredCells(
            xy=xy,
            velocities=torch.tensor(first["gt_velocities"])[nearest],
            features=torch.arange(len(xy))[:, None].float(),
            rows=torch.zeros(len(xy), dtype=torch.int64),
        )
        before = bare_frame(0.0, [pose(origin=UTM)])
        now = bare_frame(0.5, [pose(-0.5 * first["ego_speed_kmh"] / 3.6, origin=UTM)])
        frame = DPTFFrame(before.timestamps_s, before.global_from_ego, torch.ones(1).bool(), stored, None)
        wanted = torch.tensor([later[track["tid"]] for track in tracks])
        for compensated, found in ((True, errors), (False, behind)):
            path.config = replace(path.config, velocity_compensation=compensated)
            warped = path.recall(DPTFMemory((frame,)), now, 6.0)
            assert len(warped.xy) == len(xy)
            found += (warped.xy - wanted[warped.features[:, 0].long()]).norm(dim=1).tolist()
    errors, behind = torch.tensor(errors), torch.tensor(behind)
    assert len(errors) >= 30
    assert (errors < 1.0).float().mean() >= 0.75
    assert errors.median() < 0.3
    assert behind.median() > 10.0  # without their velocities they stay far behind
