"""Memory of maps: alignment under ego motion and augmentation, what is usable, streams, storage, the first step."""

import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.dense_bev.model import DenseBEVConfig
from src.models.map_memory import MapMemory, TemporalFusion
from src.reliability.checkpoints import load_model_weights
from tests.models.dense_bev.dense_frames import GRID, dense_model, drive, fill, memory_config, pose
from tests.models.moving import bare_frame, bda

ADDED = re.compile(DenseBEVConfig.new_in_temporal_phase)

WIDE = BEVGrid(cells=(96, 96), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


def make_fusion(grid=WIDE, channels=2, **changes):
    torch.manual_seed(0)
    return TemporalFusion(memory_config(**changes), channels, grid)


def world_at(xy):
    """Two smooth functions of global positions, metres from the origin of the drive."""
    x, y = xy.double().unbind(-1)
    return torch.stack([(0.11 * x).sin() + (0.07 * y).cos(), (0.05 * x * 0.6 + 0.09 * y).sin()], 1)


def map_of(batch, grid=WIDE):
    """What a network that sees the standing world puts into the cells of each augmented frame: [B, 2, rows, cols]."""
    row, col = torch.meshgrid(torch.arange(grid.rows), torch.arange(grid.cols), indexing="ij")
    xy = grid.centre_of(torch.stack([row, col], -1), torch.float64).view(-1, 2)
    maps = []
    for place, aug in zip(batch.global_from_ego, batch.aug_from_ego, strict=True):
        global_from_aug = place @ aug.double().inverse()
        there = xy @ global_from_aug[:2, :2].t() + global_from_aug[:2, 3] - pose()[:2, 3]
        maps.append(world_at(there).t().view(2, grid.rows, grid.cols))
    return torch.stack(maps).float()


@pytest.mark.parametrize(
    ("then", "now"),
    [
        (bda(), bda()),
        (bda(0.3, 1.05), bda(0.3, 1.05)),
        (bda(0.2, 0.95, flip_y=True), bda(0.2, 0.95, flip_y=True)),
        (bda(-0.3, 1.05, flip_x=True), bda(0.4, 0.95, flip_y=True)),  # another augmentation in every frame
    ],
)
def test_a_standing_world_looks_the_same_from_memory(then, now):
    fusion = make_fusion()
    past = bare_frame([0.0, 3.0], [pose(0.0, 0.0, 0.1), pose(5.0, -3.0, -2.0)], [then, then])
    batch = bare_frame([0.5, 3.5], [pose(9.0, 2.0, 0.25), pose(1.0, -1.0, -1.8)], [now, now])
    memory = fusion.remember(None, past, map_of(past))
    with torch.autocast("cpu", torch.bfloat16):
        found = next(fusion.maps(fusion.recall(memory, batch)))
    near = slice(28, 68)  # what both frames cover
    wanted = map_of(batch)
    torch.testing.assert_close(found[..., near, near], wanted[..., near, near], rtol=0, atol=0.02)  # bfloat16, bilinear
    assert (wanted - map_of(past))[..., near, near].abs().max() > 0.5


def test_whole_cells_move_without_loss():
    """8 m ahead are ten columns; what leaves is gone and what appears is zero."""
    fusion = make_fusion(channels=1)
    first = torch.arange(96.0 * 96).view(1, 1, 96, 96) % 128  # exact in bfloat16
    memory = fusion.remember(None, bare_frame(0.0, [pose()]), first)
    found = next(fusion.maps(fusion.recall(memory, bare_frame(0.5, [pose(8.0)]))))
    torch.testing.assert_close(found[..., 1:-1, :86], first[..., 1:-1, 10:], rtol=0, atol=2e-2)
    assert not found[..., 87:].any()


@pytest.mark.parametrize(("elapsed_s", "metres"), [(0.0, 0.0), (-0.5, 5.0), (6.5, 5.0), (0.5, 80.0)])
def test_what_is_not_a_usable_past_is_zero_and_only_in_its_stream(elapsed_s, metres):
    fusion = make_fusion()
    past = bare_frame(10.0, [pose(), pose()])
    memory = fusion.remember(None, past, map_of(past) + 3.0)
    batch = bare_frame([10.0 + elapsed_s, 10.5], [pose(metres), pose(5.0)])
    recalled = fusion.recall(memory, batch)
    assert recalled.usable[0].tolist() == [False, True]
    (found,) = fusion.maps(recalled)
    assert not found[0].any() and found[1].any()


def test_the_newest_frames_stay_and_streams_come_and_go():
    fusion = make_fusion(num_frames=2)
    memory = None
    for step in range(4):
        frame = bare_frame(0.5 * step, [pose(step), pose(step, 1.0)])
        value = torch.tensor([1.0, 10.0]).view(2, 1, 1, 1) * (step + 1)
        memory = fusion.remember(memory, frame, value.expand(2, 2, 96, 96))
    assert [frame.timestamps_s.tolist() for frame in memory.frames] == [[1.5, 1.5], [1.0, 1.0]]
    swapped = memory.select(torch.tensor([1, 0]), torch.tensor([True, False]))
    assert [frame.present.tolist() for frame in swapped.frames] == [[True, False]] * 2
    recalled = fusion.recall(swapped, bare_frame(2.0, [pose(3.0, 1.0), pose(3.0)]))
    centre = [past[:, 0, 48, 48].tolist() for past in fusion.maps(recalled)]
    assert centre == [[40.0, 0.0], [30.0, 0.0]]
    assert memory.select(torch.tensor([0, 1]), torch.tensor([False, False])).frames == ()


def test_aggregation_is_the_convolution_of_all_maps_side_by_side():
    torch.manual_seed(3)
    fusion = make_fusion(num_frames=3).train()
    nn.init.ones_(fusion.norm.weight)
    memory = None
    for step in range(2):  # of three that there is room for
        frame = bare_frame(0.5 * step, [pose(4.0 * step), pose(step, 1.0)])
        memory = fusion.remember(memory, frame, torch.randn(2, 2, 96, 96))
    warped_maps = fusion.recall(memory, bare_frame(1.0, [pose(8.0), pose(2.0, 1.0)]))
    fused = torch.randn(2, 2, 96, 96)
    past = list(fusion.maps(warped_maps))
    stack = torch.cat([fused, *past, torch.zeros_like(fused)], dim=1)
    wanted = fused + fusion.norm(fusion.refine(fusion.reduce(stack)))
    torch.testing.assert_close(fusion.aggregate(fused, warped_maps), wanted, rtol=1e-5, atol=1e-5)
    assert len(past) == 2 and (wanted - fused).abs().max() > 0.5


def test_memory_survives_a_checkpoint():
    fusion = make_fusion()
    past = bare_frame(0.0, [pose()], [bda(0.2, 1.03)])
    memory = fusion.remember(None, past, map_of(past))
    buffer = io.BytesIO()
    torch.save(memory.to("cpu").state(), buffer)
    buffer.seek(0)
    again = MapMemory.from_state(torch.load(buffer, weights_only=True))
    batch = bare_frame(0.5, [pose(4.0)])
    maps = [next(fusion.maps(fusion.recall(each, batch))) for each in (again, memory)]
    assert torch.equal(*maps)


def test_remembering_keeps_no_graph_and_no_alias():
    fusion = make_fusion()
    past = bare_frame(0.0, [pose()])
    fused = map_of(past).requires_grad_()
    cells = fusion.remember(None, past, fused * 1.0).frames[0].cells
    assert not cells.requires_grad and cells.dtype == torch.bfloat16 and cells.is_contiguous()


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="num_frames=0.*model.temporal=null"):
        memory_config(num_frames=0)
    with pytest.raises(ConfigError, match="max_age_s=0"):
        memory_config(max_age_s=0)


# ---------------------------------------------------------------- in the model


@pytest.fixture
def pair():
    """A phase-1 model whose every tensor is random, and the phase-2 model that took its weights."""
    first = dense_model(seed=1)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for value in first.state_dict().values():
            if value.is_floating_point():
                value.add_(0.05 * torch.rand(value.shape, generator=generator))
    second = dense_model(seed=3, temporal=memory_config())
    state = {f"model.{key}": value.clone() for key, value in first.state_dict().items()}
    new = load_model_weights(second, {"state_dict": state}, Path("phase1.ckpt"), ADDED)
    assert set(new) == second.state_dict().keys() - first.state_dict().keys() and new
    assert not [key for key in first.state_dict() if ADDED.match(key)]  # none of phase 1 may be missing
    return first, second


@pytest.mark.slow
@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("steps", [0, 2, 4])
def test_untrained_memory_leaves_phase_1_to_the_last_bit(pair, training, steps):
    """Empty, partly full and full; also in its losses."""
    first, second = (model.train(training) for model in pair)
    memory, batch = fill(second, steps), drive(steps)
    assert (len(memory.frames) if memory else 0) == min(steps, 3)
    second.load_state_dict({key: value for key, value in first.state_dict().items()}, strict=False)  # batch statistics
    one, two = first(batch)[0], second(batch, memory)[0]
    assert torch.equal(one.fused_bev, two.fused_bev) and torch.equal(one.head.logits, two.head.logits)
    if not training:
        terms, more = first.loss(one, batch).terms, second.loss(two, batch).terms
        assert all(torch.equal(terms[name], more[name]) for name in terms)
    assert first(batch)[1] is None


def test_trained_memory_changes_the_output_and_streams_do_not_mix(pair):
    _, model = pair
    model.eval()
    torch.nn.init.normal_(model.temporal.norm.weight)
    memory, batch = fill(model, 3), drive(3)
    with torch.no_grad():
        both = model(batch, memory)[0].head.logits.view(2, -1, 12)
        nothing = model(batch, None)[0].head.logits.view(2, -1, 12)
        half = model(batch, memory.select(torch.tensor([0, 1]), torch.tensor([True, False])))[0]
    half = half.head.logits.view(2, -1, 12)
    assert not torch.allclose(both[0], nothing[0]) and not torch.allclose(both[1], nothing[1])
    torch.testing.assert_close(half[0], both[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(half[1], nothing[1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("steps", [0, 3])
def test_every_parameter_of_the_memory_learns(pair, steps):
    model = pair[1].train()
    memory, batch = fill(model, steps), drive(steps, boxes=(12, 12))
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-2)
    moved = set()
    for _ in range(2):
        model.zero_grad()
        output, new = model(batch, memory)
        model.loss(output, batch).terms["total"].backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
        moved |= {name for name, p in model.temporal.named_parameters() if p.grad.any()}
        optimizer.step()
    assert moved == {name for name, _ in model.temporal.named_parameters()}
    assert len(new.frames) == min(steps + 1, 3) and not any(f.cells.requires_grad for f in new.frames)


def test_a_memory_of_other_streams_is_refused(pair):
    model = pair[1].eval()
    memory = fill(model, 1)
    with pytest.raises(ValueError, match="2 streams, but the batch 1 frames"):
        model(drive(1, points=(10,), boxes=(1,)), memory)


def test_a_jump_of_the_clock_or_the_pose_empties_the_memory(pair):
    model = pair[1].eval()
    memory = fill(model, 2)
    batch = drive(2)
    late = replace(batch, timestamps_s=batch.timestamps_s + 100.0)
    with torch.no_grad():
        assert not model(late, memory)[0].warped_maps.usable.any()
        far = replace(batch, global_from_ego=torch.stack([pose(1000.0), pose(2000.0)]))
        assert not model(far, memory)[0].warped_maps.usable.any()
        assert model(batch, memory)[0].warped_maps.usable[:2].all()
    assert GRID.rows == 48  # the small grid of the model, not the wide one above
