"""Memory of streams: motion from past to present, what is usable, streams that come and go, bounded size, storage."""

import io

import pytest
import torch

from src.models.horizon3d.dptf_memory import DPTFFrame, DPTFMemory, StoredCells
from tests.gaussian_sets import gaussians_at
from tests.models.moving import UTM, bare_frame, bda, pose, tensors_of

DIM = 3


def gaussians_for(b, value=0.0):
    """A set whose means tell stream and value."""
    means = torch.arange(b, dtype=torch.float32)[:, None, None] + torch.full((b, 4, 2), value)
    return gaussians_at(means, features=torch.zeros(b, 4, DIM))


def cells_for(counts, value=0.0):
    """counts[i] cells for stream i, whose first coordinate is the stream and whose second tells value and order."""
    rows = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    order = torch.cat([torch.arange(count) for count in counts]) if counts else torch.zeros(0)
    xy = torch.stack([rows.float(), value + 0.01 * order.float()], dim=1)
    return StoredCells(xy=xy, velocities=torch.zeros_like(xy), features=xy.repeat(1, 2)[:, :DIM], rows=rows)


def remembered(batch, cells=None, gaussians=None, present=True):
    present = torch.as_tensor(present).expand(len(batch)).clone()
    return DPTFFrame(batch.timestamps_s, batch.global_from_ego, present, cells, gaussians)


def frames_of(b, steps, counts=None):
    """DPTFMemory after `steps` frames of `b` streams, half a second apart; frame k holds the value 10 k."""
    memory = DPTFMemory(())
    for k in range(steps):
        batch = bare_frame(0.5 * k, [pose(10.0 * k + i) for i in range(b)])
        frame = remembered(batch, cells_for(counts or [2] * b, 10.0 * k), gaussians_for(b, value=10.0 * k))
        memory = memory.push(frame, 8, 4)
    return memory


def test_motion_by_hand():
    """The truck drives 10 m ahead and turns left: what was 12 m ahead is 2 m to its right."""
    batch = bare_frame(1.5, [pose(10.0, 0.0, torch.pi / 2)], [bda(scale=2.0, flip_y=True)])
    motion = remembered(bare_frame(1.0, [pose()])).motion(batch, 6.0)
    assert motion.usable.tolist() == [True] and motion.elapsed_s.tolist() == [0.5]
    point = motion.aug_from_past[0] @ torch.tensor([12.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(point[:2], torch.tensor([0.0, 4.0]), rtol=0, atol=1e-5)  # flipped and twice as far


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.9])
def test_global_coordinates_do_not_cost_precision(yaw):
    """Float32 steps are 0.5 m at UTM northings: motion must be that of the same drive near the origin."""
    matrices = []
    for origin in ((0.0, 0.0), UTM):
        before = remembered(bare_frame(0.0, [pose(0.0, 0.0, yaw, origin)]))
        now = bare_frame(4.0, [pose(88.3, 31.7, yaw + 0.3, origin, 0.02)], [bda(0.2, 0.97)])
        matrices.append(before.motion(now, 6.0).aug_from_past)
    torch.testing.assert_close(matrices[0], matrices[1], rtol=0, atol=1e-4)
    assert matrices[0].dtype == torch.float32


def test_motion_is_the_same_under_autocast():
    past = remembered(bare_frame(0.0, [pose(3.3, 4.4, 0.1, UTM)]))
    batch = bare_frame(0.5, [pose(14.1, 5.2, 0.2, UTM)], [bda(0.3, 1.04)])
    plain = past.motion(batch, 6.0).aug_from_past
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(past.motion(batch, 6.0).aug_from_past, plain)


@pytest.mark.parametrize(
    ("elapsed_s", "distance_m", "present", "usable"),
    [
        (0.5, 10.0, True, True),
        (0.5, 10.0, False, False),
        (0.0, 0.0, True, False),  # a repeated stamp
        (-0.5, 10.0, True, False),  # a clock that ran back
        (0.6, 10.0, True, True),
        (0.61, 10.0, True, False),  # too old
        (0.5, 49.9, True, True),
        (0.5, 50.1, True, False),  # a jump of the localisation
        (float("nan"), 10.0, True, False),
        (0.5, float("nan"), True, False),
    ],
)
def test_what_is_not_a_usable_past_is_masked_and_harmless(elapsed_s, distance_m, present, usable):
    """Another stream, always usable, stays so."""
    past = remembered(bare_frame(0.0, [pose(), pose()]), present=[present, True])
    batch = bare_frame([elapsed_s, 0.25], [pose(distance_m), pose(2.0)])
    motion = past.motion(batch, 0.6)
    assert motion.usable.tolist() == [usable, True]
    assert motion.aug_from_past.isfinite().all() and motion.elapsed_s.isfinite().all()
    assert motion.elapsed_s.tolist() == pytest.approx([elapsed_s if usable else 0.0, 0.25])


def test_the_age_limit_counts_from_time_stamps_not_from_the_number_of_frames():
    past = remembered(bare_frame(10.0, [pose()]))
    for elapsed, usable in ((0.5, True), (1.0, True), (3.5, True), (6.0, True), (6.001, False)):
        assert past.motion(bare_frame(10.0 + elapsed, [pose(5.0)]), 6.0).usable.tolist() == [usable]


def test_a_jump_cuts_off_all_that_lies_before_it_and_only_in_its_stream():
    """300 m in half a second; in 3.5 s they would pass for a drive, so the neighbours decide."""
    memory = frames_of(2, 8)
    batch = bare_frame(4.0, [pose(70.0 + 300.0), pose(81.0)])
    assert memory.frames[-1].motion(batch, 6.0).usable.tolist() == [True, True]
    assert memory.frames[0].motion(batch, 6.0).usable.tolist() == [False, True]
    cut = memory.before(batch)
    assert all(frame.present.tolist() == [False, True] for frame in cut.frames)
    assert not any(frame.motion(batch, 6.0).usable[0] for frame in cut.frames)
    assert all(frame.motion(batch, 6.0).usable[1] for frame in cut.frames)
    assert len(cut.select(torch.tensor([0]), torch.tensor([True])).frames) == 0


def test_no_jump_where_the_vehicle_drove_or_stood():
    memory = frames_of(1, 3)
    for elapsed, distance in ((0.5, 12.0), (0.5, 0.0), (2.0, 150.0)):
        batch = bare_frame(1.0 + elapsed, [pose(20.0 + distance)])
        assert memory.before(batch) == memory
    assert DPTFMemory(()).before(bare_frame(0.0, [pose()])) == DPTFMemory(())


def test_frames_that_are_not_in_the_past_give_up_their_places():
    """Frames at 1.0, 0.5 and 0.0 s; in two streams of different clocks a place is free when both give it up."""
    for now, left in ((1.0, [0.5, 0.0]), (0.7, [0.5, 0.0]), (0.5, [0.0]), (-1.0, [])):
        past = frames_of(1, 3).before(bare_frame(now, [pose(20.0)]))
        assert [float(frame.timestamps_s[0]) for frame in past.frames] == left
    past = frames_of(2, 3).before(bare_frame([1.0, 0.5], [pose(20.0), pose(11.0)]))
    assert [frame.present.tolist() for frame in past.frames] == [[True, False], [True, True]]


def test_select_follows_streams_that_move_vanish_restart_and_appear():
    memory = frames_of(4, 3, counts=[2, 0, 3, 1])
    # New streams: old stream 2, a new one, old stream 0, old stream 3 restarting; old stream 1 is gone.
    rows, keep = torch.tensor([2, 0, 0, 3]), torch.tensor([True, False, True, False])
    chosen = memory.select(rows, keep)
    assert chosen.batch_size == 4 and len(chosen.frames) == 3
    for old, new in zip(memory.frames, chosen.frames, strict=True):
        assert new.present.tolist() == [True, False, True, False]
        assert torch.equal(new.timestamps_s, old.timestamps_s[rows])
        assert torch.equal(new.global_from_ego, old.global_from_ego[rows])
        assert new.cells.rows.tolist() == [0, 0, 0, 2, 2]  # ascending
        for new_row, old_row in ((0, 2), (2, 0)):
            mine, theirs = new.cells.rows == new_row, old.cells.rows == old_row
            for name in ("xy", "velocities", "features"):
                assert torch.equal(getattr(new.cells, name)[mine], getattr(old.cells, name)[theirs])
        assert new.gaussians.valid.any(1).tolist() == [True, False, True, False]
        assert torch.equal(new.gaussians.means[[0, 2]], old.gaussians.means[[2, 0]])


def test_select_to_fewer_and_to_more_streams():
    memory = frames_of(2, 2)
    fewer = memory.select(torch.tensor([1]), torch.tensor([True]))
    assert fewer.batch_size == 1 and set(fewer.frames[0].cells.xy[:, 0].tolist()) == {1.0}
    more = memory.select(torch.tensor([0, 1, 0]), torch.tensor([False, True, False]))
    assert more.frames[0].present.tolist() == [False, True, False] and more.frames[0].cells.rows.tolist() == [1, 1]


def test_frames_that_no_lane_has_any_more_are_dropped_oldest_first():
    memory = frames_of(2, 2).select(torch.tensor([0, 1]), torch.tensor([True, False]))
    for k in (2, 3):  # stream 1 starts anew at frame 2
        batch = bare_frame(0.5 * k, [pose(10.0 * k + i) for i in range(2)])
        memory = memory.push(remembered(batch, cells_for([2, 2], 10.0 * k)), 8, 4)
    only_second = memory.select(torch.tensor([1]), torch.tensor([True]))
    assert [float(frame.timestamps_s) for frame in only_second.frames] == [1.5, 1.0]  # newest first, no gap
    assert memory.select(torch.tensor([0, 1]), torch.tensor([False, False])).frames == ()


@pytest.mark.parametrize(("cell_frames", "gaussian_frames"), [(8, 4), (2, 4), (3, 0), (0, 2)])
def test_push_keeps_no_more_than_either_path_looks_at(cell_frames, gaussian_frames):
    memory, sizes = DPTFMemory(()), []
    for k in range(30):
        batch = bare_frame(0.5 * k, [pose(10.0 * k), pose()])
        memory = memory.push(remembered(batch, cells_for([3, 2]), gaussians_for(2)), cell_frames, gaussian_frames)
        sizes.append(sum(tensor.numel() for tensor in tensors_of(memory)))
    longest = max(cell_frames, gaussian_frames)
    assert len(memory.frames) == longest
    assert [frame.cells is not None for frame in memory.frames] == [age < cell_frames for age in range(longest)]
    assert [frame.gaussians is not None for frame in memory.frames] == [age < gaussian_frames for age in range(longest)]
    assert [float(frame.timestamps_s[0]) for frame in memory.frames] == [0.5 * (29 - age) for age in range(longest)]
    assert set(sizes[longest:]) == {sizes[-1]}


def test_state_survives_a_checkpoint_file():
    memory = frames_of(2, 5)
    half = memory.frames[0].cells
    half.features = half.features.bfloat16()
    file = io.BytesIO()
    torch.save({"memory": memory.state()}, file)
    file.seek(0)
    again = DPTFMemory.from_state(torch.load(file, weights_only=True)["memory"])
    pairs = list(zip(tensors_of(memory), tensors_of(again), strict=True))
    assert len(pairs) == 5 * (3 + 4) + 4 * 9
    assert all(torch.equal(a, b) and a.dtype == b.dtype for a, b in pairs)
    assert again.frames[4].gaussians is None and again.frames[0].cells.features.dtype == torch.bfloat16
    assert DPTFMemory.from_state(DPTFMemory(()).state()) == DPTFMemory(())


def test_to_takes_every_tensor_along():
    assert {tensor.device.type for tensor in tensors_of(frames_of(2, 5).to("meta"))} == {"meta"}
