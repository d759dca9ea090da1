"""Memory of maps: alignment under ego motion and augmentation, what is usable, streams, storage."""

import io

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.map_memory import MapMemory, TemporalFusion
from tests.models.dense_bev.dense_frames import memory_config
from tests.models.frames import pose
from tests.models.moving import bare_frame, bda

WIDE = BEVGrid(cells=(96, 96), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))


def make_fusion(channels=2, **changes):
    torch.manual_seed(0)
    return TemporalFusion(memory_config(**changes), channels, WIDE)


def remember(fusion, memory, batch, fused):
    return fusion.remember(fusion.recall(memory, batch).frames, batch, fused)


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
    memory = remember(fusion, None, past, map_of(past))
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
    memory = remember(fusion, None, bare_frame(0.0, [pose()]), first)
    found = next(fusion.maps(fusion.recall(memory, bare_frame(0.5, [pose(8.0)]))))
    torch.testing.assert_close(found[..., 1:-1, :86], first[..., 1:-1, 10:], rtol=0, atol=2e-2)
    assert not found[..., 87:].any()


@pytest.mark.parametrize(("elapsed_s", "metres"), [(0.0, 0.0), (-0.5, 5.0), (6.5, 5.0), (0.5, 80.0)])
def test_what_is_not_a_usable_past_is_zero_and_only_in_its_stream(elapsed_s, metres):
    fusion = make_fusion()
    past = bare_frame(10.0, [pose(), pose()])
    memory = remember(fusion, None, past, map_of(past) + 3.0)
    batch = bare_frame([10.0 + elapsed_s, 10.5], [pose(metres), pose(5.0)])
    recalled = fusion.recall(memory, batch)
    assert recalled.usable[0].tolist() == [False, True]
    (found,) = fusion.maps(recalled)
    assert not found[0].any() and found[1].any()


def test_the_newest_frames_stay_and_streams_come_and_go():
    fusion = make_fusion(num_frames=2)
    memory = None
    for step in range(4):
        frame = bare_frame(0.5 * step, [pose(step), pose(step, 1.0)], [torch.eye(4), bda(0.2)])
        value = torch.tensor([1.0, 10.0]).view(2, 1, 1, 1) * (step + 1)
        memory = remember(fusion, memory, frame, value.expand(2, 2, 96, 96))
    assert [frame.timestamps_s.tolist() for frame in memory.frames] == [[1.5, 1.5], [1.0, 1.0]]
    swapped = memory.select(torch.tensor([1, 0]), torch.tensor([True, False]))
    assert [frame.present.tolist() for frame in swapped.frames] == [[True, False]] * 2
    assert torch.equal(swapped.frames[0].aug_from_ego, torch.stack([bda(0.2), torch.eye(4)]))
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
        memory = remember(fusion, memory, frame, torch.randn(2, 2, 96, 96))
    recalled = fusion.recall(memory, bare_frame(1.0, [pose(8.0), pose(2.0, 1.0)]))
    fused = torch.randn(2, 2, 96, 96)
    past = list(fusion.maps(recalled))
    stack = torch.cat([fused, *past, torch.zeros_like(fused)], dim=1)
    wanted = fused + fusion.norm(fusion.refine(fusion.reduce(stack)))
    torch.testing.assert_close(fusion.aggregate(fused, recalled), wanted, rtol=1e-5, atol=1e-5)
    assert len(past) == 2 and (wanted - fused).abs().max() > 0.5


def test_memory_survives_a_checkpoint():
    fusion = make_fusion()
    past = bare_frame(0.0, [pose()], [bda(0.2, 1.03)])
    memory = remember(fusion, None, past, map_of(past))
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
    cells = remember(fusion, None, past, fused * 1.0).frames[0].cells
    assert not cells.requires_grad and cells.dtype == torch.bfloat16 and cells.is_contiguous()


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="num_frames=0.*model.temporal=null"):
        memory_config(num_frames=0)
    with pytest.raises(ConfigError, match="max_age_s=0"):
        memory_config(max_age_s=0)
