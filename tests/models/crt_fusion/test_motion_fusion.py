"""Motion-guided fusion: warps by velocity, ego motion and augmentation, recurrence, what is usable, the first step."""

import io
import re
from dataclasses import replace

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.crt_fusion.model import CRTFusionConfig
from src.models.crt_fusion.motion_estimator import CellMotion
from src.models.crt_fusion.motion_fusion import MotionFusionConfig, MotionGuidedFusion, StackMemory
from tests.models.crt_fusion.crt_frames import crt_model
from tests.models.dense_bev.dense_frames import drive, fill, pose
from tests.models.learning import gradients_are_finite
from tests.models.moving import bare_frame, bda

WIDE = BEVGrid(cells=(40, 60), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
ADDED = re.compile(CRTFusionConfig.new_in_temporal_phase)


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


# ---------------------------------------------------------------- in the model


@pytest.fixture
def pair():
    """A phase-1 model and the phase-2 model that took its weights; half of all cells are occupied."""
    first, second = crt_model(seed=1), crt_model(phase="phase2", seed=3)
    with torch.no_grad():
        first.estimator.output.bias[0] = 0.0
    new = second.load_state_dict(first.state_dict(), strict=False)
    assert new.missing_keys and all(ADDED.match(key) for key in new.missing_keys) and not new.unexpected_keys
    return first, second


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_untrained_memory_leaves_phase_1_to_the_last_bit(pair, training, steps):
    first, second = (model.train(training) for model in pair)
    memory, batch = fill(second, steps), drive(steps)
    second.load_state_dict(first.state_dict(), strict=False)  # batch statistics
    one, two = first(batch)[0], second(batch, memory)[0]
    assert torch.equal(one.head.logits, two.head.logits) and first(batch)[1] is None
    assert second.diagnostics(two)["remembered_frames"] == min(steps, 2)


def test_trained_memory_changes_the_output_and_streams_do_not_mix(pair):
    model = pair[1].eval()
    nn.init.normal_(model.temporal.norm.weight)
    memory, batch = fill(model, 3), drive(3)
    with torch.no_grad():
        both, nothing, half = (
            model(batch, past)[0].head.logits.view(2, -1, 12)
            for past in (memory, None, memory.select(torch.tensor([0, 1]), torch.tensor([True, False])))
        )
    assert not torch.allclose(both[0], nothing[0]) and not torch.allclose(both[1], nothing[1])
    torch.testing.assert_close(half[0], both[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(half[1], nothing[1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("steps", [0, 2])
def test_every_parameter_of_the_memory_learns(pair, steps):
    model = pair[1].train()
    memory, batch = fill(model, steps), drive(steps, boxes=(12, 12))
    optimizer, moved = torch.optim.SGD(model.parameters(), lr=1e-2), set()
    for _ in range(2):
        model.zero_grad()
        output, _ = model(batch, memory)
        model.loss(output, batch).terms["total"].backward()
        assert gradients_are_finite(model)
        moved |= {name for name, p in model.temporal.named_parameters() if p.grad.any()}
        optimizer.step()
    assert moved == {name for name, _ in model.temporal.named_parameters()}


@pytest.mark.parametrize("shape", [{"points": (0, 0)}, {"boxes": (0, 0)}])
def test_empty_frames_pass_through_the_memory(pair, shape):
    model = pair[1].train()
    batch = drive(1, **shape)
    batch.image_valid[:] = False
    output, memory = model(batch, fill(model, 1))
    assert model.loss(output, batch).terms["total"].isfinite() and memory.batch_size == 2


def test_a_memory_of_other_streams_is_refused(pair):
    model = pair[1].eval()
    with pytest.raises(ValueError, match="2 streams, but the batch 1 frames"):
        model(drive(1, points=(10,), boxes=(1,)), fill(model, 1))


def test_a_jump_of_the_clock_or_the_pose_empties_the_memory(pair):
    model = pair[1].eval()
    memory, batch = fill(model, 2), drive(2)
    late = replace(batch, timestamps_s=batch.timestamps_s + 100.0)
    far = replace(batch, global_from_ego=torch.stack([pose(1000.0), pose(2000.0)]))
    with torch.no_grad():
        assert not model(late, memory)[0].moved.usable.any() and not model(far, memory)[0].moved.usable.any()
        assert model(batch, memory)[0].moved.usable.all()
