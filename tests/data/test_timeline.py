"""LiDAR frames between key frames and rays of other times, on a truck that drives a curve among known points."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from src.data.cache import load_index
from src.data.clips import FrameKey
from src.data.datamodule import DetectionDataModule
from src.data.sensor_files import OnBadFile
from src.data.timeline import LidarTimeline, SweepTimeline, TimelineConfig
from src.errors import ConfigError, DataError
from src.geometry.transforms import invert_rigid
from src.structures.taxonomy import LIDARS
from tests.data.test_datamodule import config
from tests.data.test_lidar import TURNED, apply
from tests.data.tiny_set import (
    FIVE_HERTZ,
    LIDAR_CHANNELS,
    START_S,
    STATIC,
    VERSION,
    ego_pose,
    lidar_bytes,
    mount,
)

ONLY_LIDAR = {"image_size_px": None, "num_sweeps": 0, "num_lidar_sweeps": 1, "timeline": FIVE_HERTZ}
KEY_S = START_S + 0.5  # of sample 1; sweeps are 0.1 s apart from 0.5 s before the first key frame to the last one


def test_past_frames_are_the_sweeps_of_their_moments_in_their_own_ego_frames(lidar_set):
    frame = lidar_set.reader(**ONLY_LIDAR).read(1, TURNED, 1, 1, history=[-3, -2, -1])
    to_aug = frame.aug_from_ego[0].double().numpy()
    for back, past in zip((0.6, 0.4, 0.2), frame.past, strict=True):
        assert float(past.timestamps_s) == pytest.approx(KEY_S - back, abs=1e-6)
        np.testing.assert_allclose(past.global_from_ego[0], ego_pose(KEY_S - back), atol=1e-6)
        expected = apply(to_aug @ invert_rigid(ego_pose(KEY_S - back)), STATIC)
        np.testing.assert_allclose(past.lidar_points[:, :3], np.tile(expected, (2, 1)), atol=5e-3)
        assert past.boxes is None and past.radar_points is None and past.rays is None
        assert past.tokens == [f"{frame.tokens[0]}-{back}s"] and torch.equal(past.aug_from_ego, frame.aug_from_ego)


def test_where_a_scene_had_not_begun_a_past_frame_sees_nothing(lidar_set):
    frame = lidar_set.reader(**ONLY_LIDAR).read(0, None, history=[-4, -2])
    early, late = frame.past
    assert early.tokens == frame.tokens and torch.equal(early.timestamps_s, frame.timestamps_s)
    assert torch.equal(early.global_from_ego, frame.global_from_ego) and len(early.lidar_points) == 0
    assert len(late.lidar_points) == 2 * len(STATIC) and late.tokens != frame.tokens


def test_past_frames_that_see_nothing_come_before_those_that_see(broken_lidar):
    """A memory would forget at one of the key frame's own time what it has taken in before."""
    reader = broken_lidar.reader(**ONLY_LIDAR, on_bad_file=OnBadFile.skip)
    for row in reader.timeline.sweeps(1, -2):
        if row >= 0:
            (broken_lidar.root / reader.index.filename(int(row))).unlink()
    frame = reader.read(1, None, history=[-3, -2, -1])
    nothing, *seen = frame.past
    assert nothing.tokens == frame.tokens and len(nothing.lidar_points) == 0
    assert [KEY_S - float(past.timestamps_s) for past in seen] == pytest.approx([0.6, 0.2], abs=1e-6)
    assert all(len(past.lidar_points) == 2 * len(STATIC) for past in seen)


@pytest.mark.parametrize("augmentation", [None, TURNED])
def test_rays_end_at_what_stands_there_and_begin_where_the_sensor_was(lidar_set, augmentation):
    steps = [-2, 0, 1, 2]
    frame = lidar_set.reader(**ONLY_LIDAR, num_future_frames=2).read(1, augmentation, 1, 1, targets=steps)
    rays, aug_from_ego = frame.rays, frame.aug_from_ego[0].double().numpy()
    assert rays.steps.tolist() == [step for step in steps for _ in range(2 * len(STATIC))]
    aug_from_global = aug_from_ego @ invert_rigid(ego_pose(KEY_S))
    np.testing.assert_allclose(rays.points, np.tile(apply(aug_from_global, STATIC), (8, 1)), atol=2e-2)
    np.testing.assert_allclose(rays.directions.norm(dim=1), 1, atol=1e-6)
    assert (rays.ranges > 0).all() and rays.speeds.isnan().all() and (rays.batch == 0).all()
    for row, channel in ((45, "LIDAR_LEFT"), (85, "LIDAR_LEFT"), (105, "LIDAR_REAR"), (150, "LIDAR_REAR")):
        time_s = float(rays.times_s[row])
        assert time_s == pytest.approx(0.2 * int(rays.steps[row]), abs=0.07)
        sensor = (aug_from_global @ ego_pose(KEY_S + time_s) @ mount(channel))[:3, 3]
        if LIDAR_CHANNELS[row // len(STATIC) % 2] == channel:
            np.testing.assert_allclose(rays.origins[row], sensor, atol=2e-2)


def test_moments_without_sweeps_give_no_rays_and_ends_at_the_sensor_no_ray(broken_lidar):
    reader = broken_lidar.reader(**ONLY_LIDAR, num_future_frames=2, min_distance_m=0.0)
    assert len(reader.read(2, None, targets=[1, 2]).rays) == 0
    index = reader.index
    row = int(index.key_data[1, 10])
    cloud = np.zeros((3, 4))
    cloud[1] = [0, 9, 0, 1]
    (broken_lidar.root / index.filename(row)).write_bytes(lidar_bytes(cloud, np.full(3, index.data_times_us[row])))
    assert len(reader.read(1, None, targets=[0]).rays) == 1 + len(STATIC)
    (broken_lidar.root / index.filename(row)).write_bytes(lidar_bytes(cloud[:0], np.zeros(0)))
    assert len(reader.read(1, None, targets=[0]).rays) == len(STATIC)


def test_returns_of_the_truck_itself_are_input_but_no_targets(broken_lidar):
    reader = broken_lidar.reader(**ONLY_LIDAR, num_future_frames=1, min_distance_m=0.0)
    row = int(reader.index.key_data[1, 10])
    in_ego = np.array([[0.0, 0.0, 2.0], [-11.0, 1.0, 3.0], [0.0, 0.0, 0.1], [0.0, 2.0, 2.0], [7.0, 0.0, 2.0]])
    points = np.zeros((5, 4))
    points[:, :3] = apply(invert_rigid(mount("LIDAR_LEFT")), in_ego)
    (broken_lidar.root / reader.index.filename(row)).write_bytes(
        lidar_bytes(points, np.full(5, reader.index.data_times_us[row]))
    )
    frame = reader.read(1, None, targets=[0])
    assert len(frame.lidar_points) == 5 + len(STATIC) and len(frame.rays) == 3 + len(STATIC)
    np.testing.assert_allclose(frame.rays.points[:3], in_ego[2:], atol=1e-3)


def test_the_nearest_sweep_counts_within_the_tolerance_and_the_scene(lidar_set):
    index = load_index(lidar_set.root, VERSION, None)
    timeline, key_us = SweepTimeline(index, LIDARS), int(index.frame_times_us[1])
    left, rear = (LIDARS.index(channel) for channel in LIDAR_CHANNELS)
    found = timeline.nearest(1, key_us + 148_000, 60_000)  # the rear LiDAR is 14 ms early
    assert index.data_times_us[found[left]] == key_us + 100_000
    assert index.data_times_us[found[rear]] == key_us + 186_000
    assert (np.delete(found, [left, rear]) == -1).all()
    assert (timeline.nearest(1, key_us + 50_000, 40_000) >= 0).sum() == 1
    assert (timeline.nearest(1, key_us + 600_000, 60_000) == -1).all()
    assert (timeline.nearest(1, int(index.frame_times_us[3]), 60_000) == -1).all()  # another scene's


def test_targets_are_drawn_among_those_that_exist(lidar_set):
    timeline = LidarTimeline(load_index(lidar_set.root, VERSION, None), FIVE_HERTZ)
    assert timeline.targets(0, 4, 2, None) == [0, 1, 2, 3, 4, 5] and timeline.targets(2, 4, 2, None) == [0]
    draws = {tuple(timeline.targets(0, 4, 2, np.random.default_rng(seed))) for seed in range(200)}
    assert {len(draw) for draw in draws} == {4}
    assert {draw[0] for draw in draws} == {-2, -1} and {draw[1] for draw in draws} == {0}
    assert {draw[2:] for draw in draws} == {(a, b) for a in range(1, 6) for b in range(a + 1, 6)}
    assert timeline.targets(2, 0, 2, np.random.default_rng(0)) == [0]
    assert not timeline.is_whole(0)
    horizons = [LidarTimeline(timeline.index, replace(FIVE_HERTZ, horizon_s=seconds)) for seconds in (1.0, 1.2)]
    assert [one.is_whole(0) for one in horizons] == [True, False]
    slow = replace(FIVE_HERTZ, history_stride=3)
    assert slow.history(4) == [-12, -9, -6, -3] and slow.last_step == 15


def test_what_a_timeline_cannot_be():
    for changes in ({"interval_s": 0.0}, {"history_stride": 0}, {"horizon_s": 0.1}, {"num_past_targets": -1}):
        with pytest.raises(ConfigError, match=f"data.timeline.{next(iter(changes))}"):
            TimelineConfig(**(vars(FIVE_HERTZ) | changes))
    with pytest.raises(ConfigError, match="data.num_future_frames=2: .*data.timeline"):
        config(num_future_frames=2)
    with pytest.raises(ConfigError, match="data.timeline: .*reads .*radar"):
        config(timeline=FIVE_HERTZ).reader_settings(("radar",), None)


def test_data_without_lidar_or_without_sweeps_between_are_refused(data_set, broken_tables, tmp_path):
    for row, sensor in enumerate(broken_tables.records("sensor")):
        if sensor["channel"].startswith("LIDAR"):
            broken_tables.edit("sensor", row, channel="SONAR")
    faults = {
        "holds no LiDAR files, but the model reads lidar": (config(), broken_tables),
        "none between, which the model reads.*data.world.lidar=true": (config(timeline=FIVE_HERTZ), data_set),
    }
    for message, (settings, data) in faults.items():
        with pytest.raises(DataError, match=message):
            DetectionDataModule(settings, data.root, ("lidar",), None, 0, tmp_path, temporal=True)


def test_a_damaged_file_stops_or_is_counted_once_in_a_frame(broken_lidar):
    reader = broken_lidar.reader(**ONLY_LIDAR, num_future_frames=2)
    row = int(reader.timeline.sweeps(1, -2)[0])
    name = reader.index.filename(row)
    (broken_lidar.root / name).unlink()
    with pytest.raises(DataError, match=f"{name.rpartition('/')[2]}.*no such file"):
        reader.read(1, None, history=[-2], targets=[-2, 0])
    skipping = broken_lidar.reader(**ONLY_LIDAR, num_future_frames=2, on_bad_file=OnBadFile.skip)
    frame = skipping.read(1, None, history=[-2], targets=[-2, 0])
    assert frame.bad_files == [name] and frame.skipped["LIDAR_LEFT"] == 1
    assert len(frame.past[0].lidar_points) == len(STATIC) and len(frame.rays) == 3 * len(STATIC)
    rear_s = 1e-6 * reader.index.data_times_us[reader.timeline.sweeps(1, -2)[-3:].max()]
    assert float(frame.past[0].timestamps_s) == pytest.approx(rear_s)  # the frame is that of what is left


def test_a_pose_that_jumps_stops_or_is_counted(broken_lidar):
    index = load_index(broken_lidar.root, VERSION, None)
    jumped = int(LidarTimeline(index, FIVE_HERTZ).sweeps(1, 2)[0])
    poses = broken_lidar.records("ego_pose")
    time_us = int(index.pose_times_us[index.data_poses[jumped]])
    at = next(row for row, pose in enumerate(poses) if pose["timestamp"] == time_us)
    broken_lidar.edit("ego_pose", at, translation=[0.0, 0.0, 0.0])
    with pytest.raises(DataError, match="ego_pose.json"):
        broken_lidar.reader(**ONLY_LIDAR, num_future_frames=2).read(1, None, targets=[0, 2])
    skipping = broken_lidar.reader(**ONLY_LIDAR, num_future_frames=2, on_bad_file=OnBadFile.skip)
    frame = skipping.read(1, None, targets=[0, 2])
    assert (frame.rays.steps == 2).sum() <= len(STATIC) and frame.skipped["LIDAR_LEFT (ego pose)"] == 1
    assert frame.rays.points.abs().max() < 200


def test_nothing_needs_labels(broken_lidar):
    for name in ("sample_annotation", "instance"):
        broken_lidar.table(name).unlink()
    with pytest.raises(DataError, match="sample_annotation"):
        load_index(broken_lidar.root, VERSION, None)
    timeline = replace(FIVE_HERTZ, horizon_s=0.4)
    settings = config(timeline=timeline, num_future_frames=2, past_frames=2, batch_size=1)
    data = DetectionDataModule(
        settings, broken_lidar.root, ("lidar",), None, 0, broken_lidar.root / "cache", temporal=True, labels=False
    )
    batches = list(data.train_dataloader())
    assert len(batches) == 3 and all(batch.boxes is None and len(batch.past) == 2 for batch in batches)
    assert all(len(batch.rays) and batch.streams is None for batch in batches)
    (first, *_), ((*past, again),) = list(data.val_dataloader()), data.validation_clips(1, 1)
    assert len(first.past) == len(past) == 2 and torch.equal(first.rays.points, again.rays.points)


def test_frames_with_a_past_of_the_timeline_are_no_stream_and_streams_have_no_rays(lidar_set, tmp_path):
    def data(temporal=True, **changes):
        settings, place = config(timeline=FIVE_HERTZ, **changes), (lidar_set.root, ("lidar",), None, 0, tmp_path)
        return DetectionDataModule(settings, *place, temporal=temporal)

    with pytest.raises(ConfigError, match="data.past_frames=2: must be 0 to follow scenes.*src.evaluate"):
        data(past_frames=2).stream()  # before the first frame is read
    assert len(list(data().stream())) == 3
    with pytest.raises(ConfigError, match="data.past_frames=0: must be at least 1 with data.num_future_frames=2"):
        data(num_future_frames=2)
    data(temporal=False, num_future_frames=2)


def test_draws_follow_seed_and_epoch_alone(lidar_set, tmp_path):
    settings = config(timeline=FIVE_HERTZ, num_future_frames=1, past_frames=2, batch_size=1)

    def steps(seed, epoch):
        data = DetectionDataModule(settings, lidar_set.root, ("lidar",), None, seed, tmp_path, temporal=True)
        frames = data._frames(settings.augmentation, training=True)
        return [tuple(frames[FrameKey(epoch, row)].rays.steps.unique().tolist()) for row in (0, 1)]

    assert steps(0, 0) == steps(0, 0)
    assert len({str(steps(0, epoch)) for epoch in range(6)}) > 1 and len({str(steps(seed, 0)) for seed in range(6)}) > 1
