from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from src.data.clips import (
    FrameKey,
    Schedule,
    ScheduleSampler,
    frames_in_order,
    scenes_of,
    shuffled_frames,
    streamed_groups,
    whole_scenes,
)
from src.errors import DataError

CASES = [([20] * 12, 2, 8), ([7, 1, 12, 3], 3, 4), ([5], 2, 4), ([2, 1], 5, 3), ([40, 39], 1, 8), ([9, 4, 4], 100, 2)]


def scenes(lengths):
    """Rows that ascend within a scene without being neighbours, so that a row tells its scene and place."""
    return [1000 * (number + 1) + 3 * np.arange(length) for number, length in enumerate(lengths)]


def follows(row, before):
    """Whether a row is the next frame of the same scene."""
    return row == before + 3


@pytest.mark.parametrize(("lengths", "groups", "streams"), CASES)
@pytest.mark.parametrize("epoch", [0, 1])
def test_training_streams_hold_consecutive_frames_between_starts(lengths, groups, streams, epoch):
    schedule = streamed_groups(scenes(lengths), groups, streams, 1, 3, epoch)
    total = sum(lengths)
    assert schedule.samples.shape == schedule.clips.shape == (total // streams, streams)  # the same in every epoch
    rows = schedule.samples.ravel().tolist()
    assert len(set(rows)) == len(rows) > total - streams and set(rows) <= set(np.concatenate(scenes(lengths)).tolist())
    starts = schedule.samples == schedule.clips
    assert starts[0].all()
    for stream in range(streams):
        clip = None
        for step, (row, start) in enumerate(zip(schedule.samples[:, stream], starts[:, stream], strict=True)):
            assert start or follows(row, schedule.samples[step - 1, stream])
            clip = row if start else clip
            assert schedule.clips[step, stream] == clip
    groups_at_most = sum(min(groups, length) for length in lengths)
    assert starts.sum() <= groups_at_most + streams - 1  # a stream's end cuts one group more


def test_a_scene_is_cut_into_groups_of_nearly_equal_length():
    clips = streamed_groups(scenes([7]), 3, 1, 1, 0, 0).clips[:, 0]
    assert dict(zip(*np.unique(clips, return_counts=True), strict=True)) == {1000: 3, 1009: 2, 1015: 2}


def test_a_group_cut_by_the_end_of_a_stream_becomes_two_clips():
    schedule = streamed_groups(scenes([7]), 1, 3, 1, 0, 0)
    assert schedule.samples.T.tolist() == [[1000, 1003], [1006, 1009], [1012, 1015]]
    assert schedule.clips.T.tolist() == [[1000] * 2, [1006] * 2, [1012] * 2]


@pytest.mark.parametrize("world_size", [1, 2])
def test_sets_of_streams_take_turns(world_size):
    def schedule(stream_sets):
        return lambda epoch: streamed_groups(scenes([8, 8, 8]), 2, 2 * 3 // stream_sets, stream_sets, 0, epoch)

    together = list(ScheduleSampler(schedule(1), 0, 1))  # six streams at every step
    ranks = [list(ScheduleSampler(schedule(3), rank, world_size)) for rank in range(world_size)]
    turns = [sum(of_step, []) for of_step in zip(*ranks, strict=True)]
    assert [len(batch) for batch in turns] == [2] * 12
    # Three steps of two streams are one step of six: same frames, same streams, same clips.
    assert [turns[at] + turns[at + 1] + turns[at + 2] for at in range(0, 12, 3)] == together


@pytest.mark.parametrize(("streams", "sets"), [(2, 12), (4, 6), (8, 3), (9, 2), (13, 1), (40, 1)])
def test_there_are_no_more_sets_of_streams_than_groups_fill(streams, sets):
    """24 groups of ten frames: more sets would tear them into shorter clips."""
    schedule = streamed_groups(scenes([20] * 12), 2, streams, 12, 0, 0)
    assert schedule.stream_sets == sets and schedule.samples.shape == (240 // (streams * sets) * sets, streams)


def test_order_follows_seed_and_epoch():
    def orders(make):
        return {(seed, epoch): make(seed, epoch).samples.tobytes() for seed in (0, 1) for epoch in (0, 1)}

    for make in (
        lambda seed, epoch: streamed_groups(scenes([4] * 9), 2, 3, 1, seed, epoch),
        lambda seed, epoch: shuffled_frames(np.arange(20), 2, seed, epoch),
    ):
        assert len(set(orders(make).values())) == 4 and orders(make) == orders(make)


def test_validation_streams_are_filled_longest_scene_first():
    schedule = whole_scenes(scenes([2, 4, 1, 3]), 2, 1)
    # Placed: 4 frames in stream 0, 3 in stream 1, 2 in stream 1, 1 in stream 0; read in the order of the table.
    assert schedule.samples.T.tolist() == [[2000, 2003, 2006, 2009, 3000], [1000, 1003, 4000, 4003, 4006]]
    assert schedule.clips.T.tolist() == [[2000] * 4 + [3000], [1000] * 2 + [4000] * 3]


@pytest.mark.parametrize("world_size", [1, 2, 4])
@pytest.mark.parametrize("lengths", [[20] * 16, [7, 1, 12, 3], [5], [9, 4, 4, 30, 2, 2, 2]], ids=str)
def test_validation_reads_every_frame_once_and_no_scene_is_cut(lengths, world_size):
    schedule = whole_scenes(scenes(lengths), 8, world_size)
    seen, steps = [], []
    for rank in range(world_size):
        sampler = ScheduleSampler(lambda epoch: schedule, rank, world_size)
        batches = list(sampler)
        assert len(sampler) == max(1, len(batches)) and all(batches)
        last = {}
        for keys in batches:
            streams = [key.stream for key in keys]
            assert streams == sorted(set(streams)) and {stream * world_size // 8 for stream in streams} == {rank}
            for key in keys:
                assert key.starts == (key.sample % 1000 == 0)  # the first of its scene and nothing else
                assert key.starts or follows(key.sample, last[key.stream])
                last[key.stream] = key.sample
                seen.append(key.sample)
        steps.append(len(batches))
    assert sorted(seen) == np.concatenate(scenes(lengths)).tolist()
    assert max(steps) - min(steps) <= max(lengths) and (len(lengths) < world_size or min(steps) > 0)


def test_rank_without_frames_reports_one_step_and_yields_none():
    schedule = whole_scenes(scenes([5]), 2, 2)
    idle = ScheduleSampler(lambda epoch: schedule, 1, 2)
    assert len(idle) == 1 and list(idle) == []


@pytest.mark.parametrize("world_size", [2, 4])
@pytest.mark.parametrize("temporal", [True, False])
def test_ranks_together_read_the_batches_of_one_process(world_size, temporal):
    def schedule(epoch):
        if temporal:
            return streamed_groups(scenes([7, 9, 3, 12]), 2, 4, 1, 5, epoch)
        return shuffled_frames(np.arange(31), 4, 5, epoch)

    def batches(rank, world_size):
        return list(ScheduleSampler(schedule, rank, world_size, lambda steps: (2, 0)))

    parts = [batches(rank, world_size) for rank in range(world_size)]
    alone = batches(0, 1)
    assert len(alone) == 7 and alone == [sum(of_step, []) for of_step in zip(*parts, strict=True)]
    assert {key.epoch for batch in alone for key in batch} == {2}
    streams = [[key.stream for key in batch] for batch in alone]
    assert streams == [[0, 1, 2, 3] if temporal else [None] * 4] * 7


def test_iteration_starts_at_the_position_that_is_asked_for_when_it_begins():
    at = [(0, 0)]
    sampler = ScheduleSampler(
        lambda epoch: streamed_groups(scenes([8, 8]), 2, 2, 1, 0, epoch), 0, 1, lambda steps: at[0]
    )
    whole = {0: list(sampler)}
    started = iter(sampler)
    first = next(started)
    at[0] = (1, 0)
    assert [first, *started] == whole[0]  # fetching ahead is not disturbed by steps trained meanwhile
    whole[1] = list(sampler)
    assert whole[0] != whole[1] and len(whole[1]) == 8
    for epoch, done in ((0, 3), (1, 0), (1, 7)):
        at[0] = (epoch, done)
        assert list(sampler) == whole[epoch][done:] and len(sampler) == 8


def test_frames_without_order():
    schedule = shuffled_frames(np.arange(23), 6, 4, 0)
    assert schedule.clips is None and schedule.samples.shape == (3, 6)
    assert len(set(schedule.samples.ravel().tolist())) == 18
    # The order of one device is that of numpy's permutation, as it always was.
    expected = np.random.default_rng((4, 0)).permutation(np.arange(23))[:18]
    assert schedule.samples.ravel().tolist() == expected.tolist()


def test_validation_of_frames_keeps_the_order_of_the_table():
    schedule = frames_in_order(np.arange(7), 6)
    parts = [list(ScheduleSampler(lambda epoch: schedule, rank, 3)) for rank in range(3)]
    frames = [[key.sample for batch in part for key in batch] for part in parts]
    assert [len(part) for part in frames] == [3, 2, 2] and sorted(sum(frames, [])) == list(range(7))
    (only,) = list(ScheduleSampler(lambda epoch: frames_in_order(np.arange(2), 4), 0, 1))
    assert only == [FrameKey(0, 0), FrameKey(0, 1)]


def index_of(owners, times_s, x_m):
    n = len(owners)
    return SimpleNamespace(
        sample_scenes=np.array(owners), frame_times_us=(1e6 * np.array(times_s)).astype(np.int64),
        frame_poses=np.arange(n), pose_translations=np.stack([x_m, np.zeros(n), np.zeros(n)], 1),
        sample_tokens=np.array([f"t{row}" for row in range(n)]), root=Path("data"), version="v",
    )  # fmt: skip


def test_scenes_are_in_table_order_and_their_frames_in_order_of_time():
    index = index_of([1, 0, 1, 0, 2, 1], [2.0, 8.5, 1.0, 8.0, 5.0, 9.0], [20.0, 0.0, 0.0, 0.0, 0.0, 160.0])
    found = scenes_of(index, np.arange(6))
    assert [scene.tolist() for scene in found] == [[2, 0, 5], [3, 1], [4]]  # 7 s are missing before row 5: a gap only
    assert [scene.tolist() for scene in scenes_of(index, np.array([1, 3]))] == [[3, 1]]


@pytest.mark.parametrize("x_m", [70.0, np.nan])
def test_jump_between_two_frames_of_a_scene(x_m):
    index = index_of([0, 0, 0], [1.0, 1.5, 2.0], [0.0, 10.0, x_m])
    with pytest.raises(DataError, match=r"ego_pose.json: from sample t1 to the next, t2, the ego moves at (120|nan)"):
        scenes_of(index, np.arange(3))
    assert [scene.tolist() for scene in scenes_of(index, np.arange(3), jumps_allowed=True)] == [[0, 1, 2]]
    assert len(scenes_of(index_of([0, 0, 1], [1.0, 1.5, 2.0], [0.0, 10.0, 70.0]), np.arange(3))) == 2


def test_schedule_is_split_into_blocks_of_streams():
    table = np.arange(12).reshape(3, 4)
    samplers = [ScheduleSampler(lambda epoch: Schedule(table, table), rank, 2) for rank in range(2)]
    assert [[key.stream for key in next(iter(sampler))] for sampler in samplers] == [[0, 1], [2, 3]]
