"""Motion-guided fusion: warps by velocity, ego motion and augmentation, recurrence, what is usable."""

import io

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.crt_fusion.motion_estimator import CellMotion
from src.models.crt_fusion.motion_fusion import MotionFusionConfig, MotionGuidedFusion, StackMemory
from tests.models.frames import pose
from tests.models.moving import bare_frame, bda

WIDE = BEVGrid(cells=(40, 60), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


def make_fusion(num_frames=3, min_speed_mps=1.0, threshold=0.5, max_cells=1000, max_age_s=6.0):
    torch.manual_seed(0)
    config = MotionFusionConfig(
        num_frames=num_frames, max_age_s=max_age_s, min_speed_mps=min_speed_mps,
        occupancy_threshold=threshold, max_cells=max_cells,
    )  # fmt: skip
    return MotionGuidedFusion(config, 2, WIDE)


def world(*cells):
    """Map [1, 2, rows, cols] and motion of one stream: (row, col, vx, vy, value) are occupied."""
    fused, logits = torch.zeros(1, 2, *WIDE.cells), torch.full(WIDE.cells, -9.0)
    velocities = torch.zeros(*WIDE.cells, 2)
    for row, col, vx, vy, value in cells:
        fused[0, :, row, col] = torch.tensor([value, -value])
        logits[row, col] = 9.0
        velocities[row, col] = torch.tensor([vx, vy])
    return fused, CellMotion(logits.flatten(), velocities.view(-1, 2))


def remember(fusion, memory, batch, *cells):
    fused, motion = world(*cells)
    return fusion.remember(batch, fused, motion, fusion.recall(memory, batch))


def seen(maps, slot=0):
    """(row, col, value) of what a remembered map holds."""
    first = maps.maps[0, 2 * slot]
    assert torch.equal(maps.maps[0, 2 * slot + 1], -first)
    return [(r, c, round(float(first[r, c]), 4)) for r, c in (first.abs() > 1e-4).nonzero().tolist()]


def test_a_cell_moves_by_its_velocity_exactly():
    """16 m/s for 0.5 s are ten columns, -4.8 m/s three rows; what is slower than 1 m/s stays, empty cells are gone."""
    fusion = make_fusion()
    memory = remember(
        fusion,
        None,
        bare_frame(0.0, [pose()]),
        (20, 10, 16.0, -4.8, 3.0),
        (5, 5, 0.9, 0.0, 2.0),
        (7, 50, 0.0, 0.0, 4.0),
    )
    now = bare_frame(0.5, [pose()])
    assert seen(fusion.recall(memory, now)) == [(5, 5, 2.0), (7, 50, 4.0), (17, 20, 3.0)]
    fused, motion = world((1, 1, 0.0, 0.0, 7.0))
    fused[0, :, 30, 30] = 5.0  # not occupied
    memory = fusion.remember(bare_frame(0.0, [pose()]), fused, motion, fusion.recall(None, now))
    assert seen(fusion.recall(memory, now)) == [(1, 1, 7.0)]


def test_the_vehicle_drives_and_turns():
    """8 m ahead are ten columns back; velocities are over ground. A quarter turn maps ahead to the right."""
    fusion = make_fusion()
    memory = remember(fusion, None, bare_frame(0.0, [pose()]), (20, 40, 0.0, 0.0, 3.0), (25, 30, 16.0, 0.0, 2.0))
    assert seen(fusion.recall(memory, bare_frame(0.5, [pose(8.0)]))) == [(20, 30, 3.0), (25, 30, 2.0)]
    square = BEVGrid(cells=(40, 40), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    fusion.grid = square
    logits = torch.full((40, 40), -9.0)
    logits[20, 30] = 9.0
    motion = CellMotion(logits.flatten(), torch.tensor([16.0, 0.0]).repeat(1600, 1))
    first = bare_frame(0.0, [pose()])
    memory = fusion.remember(first, torch.ones(1, 2, 40, 40), motion, fusion.recall(None, first))
    turned = fusion.recall(memory, bare_frame(0.25, [pose(0.0, 0.0, torch.pi / 2)])).maps[0, 0]
    # (x, y) = (8.4 + 4, 0.4) m was ahead; now x' = y, y' = -x
    wanted = square.cell_of(torch.tensor([0.4, -12.4])).tolist()
    assert (turned > 0.99).nonzero().tolist() == [wanted] and turned.sum() == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("then", "now"), [(bda(), bda()), (bda(flip_y=True), bda(flip_y=True)), (bda(flip_x=True), bda(flip_y=True))]
)
def test_augmentations_are_taken_back(then, now):
    """Velocities come in the axes of the augmented frame that they were predicted in."""
    fusion = make_fusion()
    past, batch = bare_frame(0.0, [pose()], [then]), bare_frame(0.5, [pose()], [now])

    def cell(aug, x, y):
        row, col = WIDE.cell_of(torch.stack([aug[0, 0] * x, aug[1, 1] * y])).tolist()
        return row, col

    velocity = (float(then[0, 0]) * 16.0, float(then[1, 1]) * 8.0)  # 16 m/s ahead, 8 to the left
    memory = remember(fusion, None, past, (*cell(then, -4.4, 2.0), *velocity, 3.0))
    assert seen(fusion.recall(memory, batch)) == [(*cell(now, 3.6, 6.0), 3.0)]


def test_older_maps_move_on_by_the_motion_that_newer_frames_predict():
    """At 0 s a cell drives ahead, at 0.5 s the frame that it has come to says that it now drives to the left."""
    fusion = make_fusion(num_frames=2)
    memory = remember(fusion, None, bare_frame(0.0, [pose()]), (20, 10, 16.0, 0.0, 3.0))
    memory = remember(fusion, memory, bare_frame(0.5, [pose()]), (20, 20, 0.0, 8.0, 4.0))
    maps = fusion.recall(memory, bare_frame(1.0, [pose()]))
    assert seen(maps, 0) == [(25, 20, 4.0)] and seen(maps, 1) == [(25, 20, 3.0)]
    assert maps.ages_s.tolist() == [[0.5, 1.0]] and maps.usable.all()
    memory = remember(fusion, memory, bare_frame(1.0, [pose()]), (3, 3, 0.0, 0.0, 5.0))  # both are no longer occupied
    maps = fusion.recall(memory, bare_frame(1.5, [pose()]))
    assert seen(maps, 0) == [(3, 3, 5.0)] and seen(maps, 1) == [] and maps.ages_s.tolist() == [[0.5, 1.0]]


def test_the_most_occupied_cells_stay():
    fusion = make_fusion(max_cells=2)
    fused, motion = world(*((row, 5, 0.0, 0.0, row) for row in (4.0, 9.0, 2.0) for row in [int(row)]))
    motion.occupancy_logits[4 * 60 + 5] = 1.0
    frame = bare_frame(0.0, [pose()])
    memory = fusion.remember(frame, fused, motion, fusion.recall(None, frame))
    assert seen(fusion.recall(memory, bare_frame(0.5, [pose()]))) == [(2, 5, 2.0), (9, 5, 9.0)]


@pytest.mark.parametrize(("elapsed_s", "metres"), [(0.0, 0.0), (-0.5, 5.0), (6.5, 5.0), (0.5, 80.0)])
def test_what_is_not_a_usable_past_is_zero_and_only_in_its_stream(elapsed_s, metres):
    fusion = make_fusion()
    fused, motion = world((20, 20, 0.0, 0.0, 3.0))
    fused, motion = (
        fused.repeat(2, 1, 1, 1),
        CellMotion(*(x.repeat(2, *(1,) * (x.dim() - 1)) for x in vars(motion).values())),
    )
    past = bare_frame(10.0, [pose(), pose()])
    memory = fusion.remember(past, fused, motion, fusion.recall(None, past))
    maps = fusion.recall(memory, bare_frame([10.0 + elapsed_s, 10.5], [pose(metres), pose()]))
    assert maps.usable[:, 0].tolist() == [False, True]
    assert not maps.maps[0].any() and maps.maps[1].any()


def test_one_map_grows_too_old_for_itself():
    fusion = make_fusion(num_frames=2, max_age_s=0.8)
    memory = None
    for step in range(2):
        memory = remember(fusion, memory, bare_frame(0.5 * step, [pose()]), (20, 20, 0.0, 0.0, step + 1.0))
    maps = fusion.recall(memory, bare_frame(1.0, [pose()]))
    assert maps.usable.tolist() == [[True, False]] and seen(maps) == [(20, 20, 2.0)] and not maps.maps[:, 2:].any()


def test_streams_come_and_go_and_a_checkpoint_keeps_them():
    fusion = make_fusion()
    fused, motion = world((20, 20, 8.0, 0.0, 1.0))
    fused = torch.cat([fused, 10 * fused])
    motion = CellMotion(motion.occupancy_logits.repeat(2), motion.velocities.repeat(2, 1))
    past = bare_frame(0.0, [pose(), pose()])
    memory = fusion.remember(past, fused.requires_grad_(), motion, fusion.recall(None, past))
    assert not memory.frames[0].cells.features.requires_grad and memory.frames[0].cells.features.dtype == torch.bfloat16
    buffer = io.BytesIO()
    torch.save(memory.to("cpu").state(), buffer)
    buffer.seek(0)
    memory = StackMemory.from_state(torch.load(buffer, weights_only=True))
    now = bare_frame(0.5, [pose(), pose()])
    maps = fusion.recall(memory.select(torch.tensor([1, 0]), torch.tensor([True, False])), now)
    assert seen(maps) == [(20, 25, 10.0)] and not maps.maps[1].any()
    assert memory.select(torch.tensor([0, 1]), torch.tensor([False, False])).frames == ()


def test_aggregation_is_gates_and_convolutions_of_all_maps_and_ages_side_by_side():
    fusion = make_fusion(num_frames=2).train()
    nn.init.ones_(fusion.norm.weight)
    memory = remember(fusion, None, bare_frame(0.0, [pose()]), (20, 10, 16.0, 0.0, 3.0))
    moved, fused = fusion.recall(memory, bare_frame(0.5, [pose()])), torch.randn(1, 2, *WIDE.cells)
    x = torch.cat([fused, moved.maps], 1)
    ages = torch.tensor([0.0, 0.5, 0.0]).view(1, 3, 1, 1).expand(1, 3, *WIDE.cells)
    wanted = torch.cat([x * fusion.gates(x).sigmoid(), ages], 1)
    wanted = fused + fusion.norm(fusion.refine(fusion.reduce(wanted)))
    torch.testing.assert_close(fusion.aggregate(fused, moved), wanted, rtol=1e-5, atol=1e-5)


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="num_frames=0.*model.temporal=null"):
        make_fusion(num_frames=0)
    with pytest.raises(ConfigError, match="occupancy_threshold=1.0"):
        make_fusion(threshold=1.0)
    with pytest.raises(ConfigError, match="min_speed_mps=-1"):
        make_fusion(min_speed_mps=-1.0)
