import gc
import json
import os
import pickle
import shutil
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch

from src.data.augment import AugmentationConfig, BevAugmentationConfig, ImageAugmentationConfig
from src.data.cache import load_index
from src.data.clips import scenes_of, shuffled_frames
from src.data.data_config import DataConfig
from src.data.datamodule import DetectionDataModule
from src.data.frame_loader import collate, dead_workers_named
from src.data.sensor_files import OnBadFile
from src.errors import ConfigError, DataError, HorizonError
from src.structures.taxonomy import RADARS
from tests.data.tiny_set import FIVE_HERTZ, START_S, VERSION, DataSet, Writer, token

BEV = BevAugmentationConfig(scale=[0.95, 1.05], rotation_rad=0.4, flip_probability=0.5)


def config(**changes):
    values = dict(
        root=None, version=VERSION, train_split="train", train_scenes=None, split="val", batch_size=2,
        groups_per_scene=2, stream_sets=1, past_frames=0, past_window_s=None, sensor_dropout=0.0, num_workers=0,
        num_sweeps=2, min_distance_m=1.0, propagate_points=False, on_bad_file=OnBadFile.error, test_resize_offset=0.0,
        num_lidar_sweeps=1, lidar_origins=False,
        deskew_lidar=True, timeline=None, num_future_frames=0,
        augmentation=AugmentationConfig(image=None, bev=BEV),
    )  # fmt: skip
    return DataConfig(**(values | changes))


def module(data_set, sensors=("camera", "radar"), seed=0, temporal=False, **changes):
    cache = data_set.root / "cache"
    return DetectionDataModule(config(**changes), data_set.root, sensors, (32, 80), seed, cache, temporal=temporal)


@pytest.fixture
def drives(data_set, tmp_path):
    """Scenes of 5, 3 and 7 frames for training, of 4, 1 and 3 for validation; poses and boxes, but no other sensor."""
    shutil.copytree(data_set.root / VERSION, tmp_path / VERSION)
    writer = Writer(tmp_path)
    samples, scenes, files, at_s = [], [], [], START_S
    for split, lengths in {"train": (5, 3, 7), "val": (4, 1, 3)}.items():
        for number, length in enumerate(lengths):
            names = [f"{split}-{number}-{k}" for k in range(length)]
            links = ["", *(token("sample", name) for name in names), ""]
            scene = f"scene-{split}-{number}"
            scenes.append({"token": token("scene", scene), "name": scene, "description": "",
                           "first_sample_token": links[1], "last_sample_token": links[-2]})  # fmt: skip
            for k, name in enumerate(names):
                stamp = round(1e6 * (at_s + 0.5 * k))
                samples.append({"token": token("sample", name), "timestamp": stamp, "prev": links[k],
                                "next": links[k + 2], "scene_token": token("scene", scene)})  # fmt: skip
                files.append({"token": token("file", name), "sample_token": token("sample", name), "timestamp": stamp,
                              "ego_pose_token": writer.pose(stamp), "is_key_frame": True, "prev": "", "next": "",
                              "calibrated_sensor_token": token("calibrated_sensor", "LIDAR_LEFT"),
                              "filename": f"samples/{name}.pcd"})  # fmt: skip
            at_s += 30
    content = {"sample": samples, "scene": scenes, "sample_data": files, "ego_pose": writer.tables["ego_pose"]}
    for table, records in (content | {"sample_annotation": [], "instance": []}).items():
        (tmp_path / VERSION / f"{table}.json").write_text(json.dumps(records))
    names = {split: [f"scene-{split}-{number}" for number in range(3)] for split in ("train", "val")}
    (tmp_path / "splits.json").write_text(json.dumps(names))
    return DataSet(tmp_path)


@pytest.fixture
def quick_end(monkeypatch):
    """A loader left in the middle waits 5 s for its workers when it is collected; here 0.2 s."""
    monkeypatch.setattr(torch.utils.data._utils, "MP_STATUS_CHECK_INTERVAL", 0.2)
    yield
    gc.collect()


@pytest.mark.parametrize("num_workers", [0, 2])
def test_batches(data_set, num_workers):
    data = module(data_set, num_workers=num_workers)
    (batch,) = data.train_dataloader()
    assert len(batch) == 2 and batch.images.shape == (2, 4, 3, 32, 80) and batch.images.dtype == torch.uint8
    assert batch.radar_batch.bincount().tolist() == [6 * 2 * 21] * 2
    assert len(batch.boxes) == 2 and not torch.equal(batch.aug_from_ego[0], torch.eye(4))
    batches = list(data.val_dataloader())
    tokens = [token for batch in batches for token in batch.tokens]
    assert tokens == list(data.index.sample_tokens[3:]) == data.evaluation_set().tokens
    assert torch.equal(batches[0].aug_from_ego[0], torch.eye(4))


def test_workers_change_nothing(data_set):
    alone, shared = (list(module(data_set, num_workers=n, batch_size=1).train_dataloader()) for n in (0, 2))
    for a, b in zip(alone, shared, strict=True):
        assert a.tokens == b.tokens and torch.equal(a.radar_points, b.radar_points) and torch.equal(a.images, b.images)


def test_radar_only_reads_no_image(broken_files):
    for path in broken_files.root.glob("samples/CAMERA*/*.jpg"):
        path.unlink()
    (batch,) = module(broken_files, sensors=("radar",)).train_dataloader()
    assert batch.images is None and batch.image_valid is None and batch.pix_from_aug is None


def test_empty_and_full_frames_share_a_batch(data_set):
    reader = module(data_set).reader
    frame = reader.read(0, None)
    empty = replace(frame, radar_points=frame.radar_points[:0], radar_batch=frame.radar_batch[:0])
    batch = collate([empty, frame, empty])
    assert batch.radar_batch.unique().tolist() == [1] and len(batch.boxes) == 3


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 1])
def test_what_is_read_follows_from_the_sensors(lidar_set, num_workers, quick_end):
    timeline = replace(FIVE_HERTZ, horizon_s=0.4, scored_frames=3)  # of which two have the horizon ahead
    chosen = {"num_lidar_sweeps": 2, "timeline": timeline, "num_future_frames": 1, "lidar_origins": True,
              "num_workers": num_workers}  # fmt: skip
    data = module(lidar_set, sensors=("lidar",), **chosen)
    (first,) = data.val_dataloader()
    assert first.radar_points is None and first.radar_batch is None and first.images is None
    assert first.lidar_batch.bincount().tolist() == [80, 80]
    assert len(first.lidar_origins) == 160
    assert first.rays.batch.bincount().tolist() == [120, 120]
    assert first.rays.steps[first.rays.batch == 1].unique_consecutive().tolist() == [0, 1, 2]
    alone = data.reader.read(4, None)
    rows = first.lidar_batch == 1
    assert torch.equal(first.lidar_points[rows], alone.lidar_points)
    assert torch.equal(first.lidar_origins[rows], alone.lidar_origins)
    every = next(iter(module(lidar_set, sensors=("lidar", "camera", "radar")).val_dataloader()))
    assert every.images is not None and len(every.radar_points) and len(every.lidar_points) and every.rays is None


@pytest.mark.parametrize("sensors", [(), ("sonar",), ("radar", "sonar")])
def test_sensors_that_are_none(data_set, sensors):
    with pytest.raises(ValueError, match="sensors must be some of .*'lidar'"):
        module(data_set, sensors=sensors)


def test_lidar_is_dropped_with_the_other_sensors(lidar_set):
    chosen = {"sensor_dropout": 0.99, "timeline": FIVE_HERTZ, "lidar_origins": True}
    data = module(lidar_set, ("lidar", "radar"), temporal=True, **chosen)
    first, second, _ = data.stream()
    assert len(first.lidar_points) and len(first.radar_points)
    assert second.lidar_points.shape == (0, 5) and second.radar_points.shape == (0, 7)
    assert second.lidar_origins.shape == (0, 3) and len(second.lidar_batch) == 0
    shuffled = module(lidar_set, ("lidar",), temporal=True, num_future_frames=1, past_frames=1, batch_size=1, **chosen)
    frame = next(iter(shuffled.train_dataloader()))
    assert len(frame.lidar_points) == 0 and len(frame.rays)  # what is to be predicted stays


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 1])
def test_faults_of_workers_keep_their_message(broken_files, num_workers, quick_end):
    index = load_index(broken_files.root, VERSION, None)
    name = index.filename(index.key_data[4, 4])
    (broken_files.root / name).write_bytes(b"junk")
    data = module(broken_files, num_workers=num_workers)
    with pytest.raises(DataError) as error:
        list(data.val_dataloader())
    text = str(error.value)
    assert name in text and "no DATA line" in text and "Traceback" not in text and "\n" not in text


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 1])
def test_skipped_files_are_counted_and_named_in_the_batch(broken_files, num_workers, quick_end):
    index = load_index(broken_files.root, VERSION, None)
    names = [index.filename(row) for row in index.key_data[3:5, 4]]
    for name in names:
        (broken_files.root / name).unlink()
    data = module(broken_files, on_bad_file=OnBadFile.skip, batch_size=3, num_workers=num_workers)
    (batch,) = data.val_dataloader()
    assert batch.skipped == {RADARS[0]: 2} and len(batch) == 3 and batch.bad_files == names


def test_worker_that_dies_is_a_data_error(data_set, quick_end):
    data = module(data_set, num_workers=1)
    data.reader.read = lambda *_: os.kill(os.getpid(), 9)
    with pytest.raises(DataError, match="DataLoader worker.*lower data.num_workers"):
        list(data.val_dataloader())


def test_other_runtime_errors_are_left_alone():
    with pytest.raises(RuntimeError, match="^shape mismatch$"), dead_workers_named():
        raise RuntimeError("shape mismatch")


def test_errors_travel_between_processes():
    again = pickle.loads(pickle.dumps(DataError("the message")))
    assert isinstance(again, HorizonError) and str(again) == "the message" and again.exit_code == 4


@pytest.mark.parametrize(
    "change",
    [{"batch_size": 0}, {"groups_per_scene": 0}, {"stream_sets": 0}, {"num_sweeps": 0}, {"num_workers": -1},
     {"num_lidar_sweeps": 0}, {"num_future_frames": -1},
     {"sensor_dropout": 1.0}, {"sensor_dropout": -0.1}, {"min_distance_m": float("nan")},
     {"test_resize_offset": float("nan")}],
    ids=str,
)  # fmt: skip
def test_impossible_settings(change):
    with pytest.raises(ConfigError, match=f"data.{next(iter(change))}"):
        config(**change)


def test_too_few_frames_for_a_batch(data_set):
    with pytest.raises(DataError, match="data.batch_size=4.*only 3 frames"):
        module(data_set, batch_size=4).train_dataloader()


@pytest.mark.parametrize("temporal", [False, True])
def test_training_may_keep_to_the_first_scenes(drives, temporal):
    few = module(drives, sensors=("radar",), temporal=temporal, train_scenes=2, groups_per_scene=1)
    seen = {token for batch in few.train_dataloader() for token in batch.tokens}
    assert seen == {token("sample", f"train-{scene}-{k}") for scene, length in ((0, 5), (1, 3)) for k in range(length)}
    assert sum(len(batch) for batch in few.val_dataloader()) == 8
    with pytest.raises(DataError, match="data.train_scenes=4: the split has only 3 scenes"):
        module(drives, sensors=("radar",), train_scenes=4).train_dataloader()


def test_batch_must_divide_among_devices(data_set):
    data = module(data_set, batch_size=3)
    data.trainer = SimpleNamespace(world_size=2, global_rank=0)
    with pytest.raises(ConfigError, match="data.batch_size=3.*divisible.*2"):
        data.train_dataloader()


def test_release_without_annotations_is_read_but_not_trained_on(broken_files):
    folder = broken_files.root / "v1.2-test"
    (broken_files.root / VERSION).rename(folder)
    for name in ("sample_annotation", "instance"):
        (folder / f"{name}.json").unlink()
    data = module(broken_files, version="v1.2-test")
    batches = list(data.val_dataloader())
    assert [len(batch) for batch in batches] == [2, 1] and all(batch.boxes is None for batch in batches)
    with pytest.raises(DataError, match="no annotations"):
        data.train_dataloader()


def test_frames_for_pictures_are_spread_over_the_split(data_set):
    data = module(data_set)
    assert [frame.tokens[0] for (frame,) in data.validation_clips(1, 1)] == [data.evaluation_set().tokens[1]]
    assert [frame.tokens[0] for (frame,) in data.validation_clips(3, 1)] == data.evaluation_set().tokens


def test_identity_holds_no_path(data_set):
    assert str(data_set.root.parent) not in str(module(data_set).identity())


def test_streamed_batches_mark_streams_and_clip_starts(drives):
    data = module(drives, ("radar",), temporal=True, batch_size=2)
    index = data.index
    last = {}
    batches = list(data.train_dataloader())
    assert len(batches) == 7 == len(data.train_dataloader())
    for batch in batches:
        assert batch.streams.tolist() == [0, 1] and batch.starts.dtype == torch.bool
        for stream, (name, start) in enumerate(zip(batch.tokens, batch.starts.tolist(), strict=True)):
            row = index.sample_tokens.tolist().index(name)
            assert start or (row == last[stream] + 1 and index.sample_scenes[row] == index.sample_scenes[last[stream]])
            last[stream] = row
    assert sum(int(batch.starts.sum()) for batch in batches) <= 7
    for batch in (*module(drives, ("radar",)).train_dataloader(), *module(drives, ("radar",)).val_dataloader()):
        assert batch.streams is None and batch.starts is None


def test_streamed_validation_reads_whole_scenes_and_batches_shrink(drives):
    batches = list(module(drives, ("radar",), temporal=True, batch_size=2).val_dataloader())
    assert [batch.streams.tolist() for batch in batches] == [[0, 1]] * 4
    assert [batch.starts.tolist() for batch in batches] == [[1, 1], [0, 1], [0, 0], [0, 0]]
    many = list(module(drives, ("radar",), temporal=True, batch_size=6).val_dataloader())
    assert [len(batch) for batch in many] == [3, 2, 2, 1]  # fewer scenes than streams
    tokens = sorted(name for batch in many for name in batch.tokens)
    assert tokens == sorted(module(drives, ("radar",)).evaluation_set().tokens)


def test_rigid_augmentation_lasts_for_a_clip(drives):
    data = module(drives, ("radar",), temporal=True, batch_size=1)
    matrices, starts = [], []
    for batch in data.train_dataloader():
        matrices.append(batch.aug_from_ego[0])
        starts.append(bool(batch.starts))
    for before, after, start in zip(matrices, matrices[1:], starts[1:], strict=False):
        assert torch.equal(before, after) != start
    assert len({float(matrix.sum()) for matrix in matrices}) == sum(starts) == 6


def test_images_are_augmented_frame_by_frame_within_a_clip(data_set):
    image = ImageAugmentationConfig(resize=[-0.06, 0.11], rotation_deg=5.4, flip_probability=0.5)
    augmentation = AugmentationConfig(image=image, bev=BEV)
    reader = module(data_set).reader
    tokens = [str(name) for name in reader.index.sample_tokens]
    first, second = (reader.read(row, augmentation, 3, 1, clip=tokens[0]) for row in (0, 1))
    alone, other = (reader.read(row, augmentation, 3, 1) for row in (0, 1))
    assert torch.equal(first.aug_from_ego, second.aug_from_ego) and torch.equal(first.aug_from_ego, alone.aug_from_ego)
    assert not torch.equal(second.aug_from_ego, other.aug_from_ego)
    assert torch.equal(first.images, alone.images) and torch.equal(second.images, other.images)

    def crops(frame):  # pixels per metre in the truck's own frame do not know A_t
        return frame.pix_from_aug[0] @ frame.aug_from_ego[0]

    torch.testing.assert_close(crops(second), crops(other), rtol=1e-4, atol=1e-2)
    # The pictures' geometry and the boxes follow the clip's matrix, not the frame's.
    plain = reader.read(1, None)
    matrix = second.aug_from_ego[0].double()
    centres = torch.cat([plain.boxes[0].centers.double(), torch.ones(len(plain.boxes[0]), 1)], 1) @ matrix.T
    torch.testing.assert_close(second.boxes[0].centers.double(), centres[:, :3], rtol=0, atol=1e-4)
    points = torch.cat([plain.radar_points[:, :3].double(), torch.ones(len(plain.radar_points), 1)], 1) @ matrix.T
    torch.testing.assert_close(second.radar_points[:, :3].double(), points[:, :3], rtol=0, atol=1e-4)
    torch.testing.assert_close(second.global_from_ego, plain.global_from_ego)  # memory lives here, unaugmented


def test_sensor_dropout_spares_a_clips_first_frame_and_is_always_the_same_in_validation(data_set):
    def dropped(loader):
        batches = list(loader)
        for batch in batches:
            for row, starts in enumerate(batch.starts):
                points = int((batch.radar_batch == row).sum())
                assert (points == 0) == (not batch.image_valid[row].any()) == (not batch.images[row].any())
                assert points > 0 or not starts
            assert batch.boxes is not None and all(len(boxes) for boxes in batch.boxes)
        return [
            token for batch in batches for row, token in enumerate(batch.tokens) if not (batch.radar_batch == row).any()
        ]

    streamed = {"temporal": True, "batch_size": 1, "groups_per_scene": 1, "split": "train"}
    made = [module(data_set, seed=seed, sensor_dropout=0.8, **streamed) for seed in (0, 1)]
    in_validation = [dropped(one.val_dataloader()) for one in made]
    assert in_validation[0] == in_validation[1] == dropped(made[0].val_dataloader())
    frames = [frame.tokens[0] for frame in made[0].stream() if len(frame.radar_points) == 0]
    assert sorted(frames) == sorted(in_validation[0]) and len(frames) > 0
    assert dropped(made[0].train_dataloader()) and not dropped(module(data_set, **streamed).train_dataloader())
    plain = [module(data_set, seed=seed, sensor_dropout=0.8, augmentation=None, **streamed) for seed in (0, 1)]
    assert dropped(plain[0].train_dataloader()) != dropped(plain[1].train_dataloader())


def test_shuffled_frames_bring_their_past(drives):
    """Scenes of 5, 3 and 7 frames; where a scene had not begun, a frame repeats itself."""
    data = module(drives, ("radar",), temporal=True, past_frames=3)
    scenes = [data.index.sample_tokens[scene].tolist() for scene in scenes_of(data.index, np.arange(len(data.index)))]
    batches = list(data.train_dataloader())
    assert len(batches) == 7
    for batch in batches:
        assert batch.streams is None and len(batch.past) == 3
        for row, name in enumerate(batch.tokens):
            (scene,) = (scene for scene in scenes if name in scene)
            at = scene.index(name)
            before = [scene[at - k] if at >= k else name for k in (3, 2, 1)]
            assert [frame.tokens[row] for frame in batch.past] == before
            for frame in batch.past:
                assert torch.equal(frame.aug_from_ego[row], batch.aug_from_ego[row]) and frame.boxes is None
    assert not next(iter(data.val_dataloader())).past
    assert not next(iter(module(drives, ("radar",), past_frames=3).train_dataloader())).past


def test_the_past_of_a_first_frame_sees_nothing(data_set):
    data = module(data_set, temporal=True, past_frames=2, batch_size=1, sensor_dropout=0.99)
    (first,) = (batch for batch in data.train_dataloader() if batch.past[1].tokens == batch.tokens)
    assert len(first.radar_points) and first.image_valid.all()  # never without sensors, having no past
    for frame in first.past:
        assert len(frame.radar_points) == 0 and not frame.image_valid.any() and not frame.skipped
        assert torch.equal(frame.timestamps_s, first.timestamps_s)
    others = [batch for batch in data.train_dataloader() if batch.past[1].tokens != batch.tokens]
    assert others and all(len(batch.radar_points) == 0 and len(batch.past[1].radar_points) for batch in others)


def test_a_window_gives_every_frame_what_it_holds_and_no_stream(drives):
    """Scenes of 4, 1 and 3 frames, half a second apart."""
    order = module(drives, ("radar",)).evaluation_set().tokens
    first = [0, 0, 0, 0, 4, 5, 5, 5]
    for window_s, depth in ((0.55, 1), (1.05, 2), (9.0, 3)):
        data = module(drives, ("radar",), temporal=True, past_window_s=window_s)
        expected = [
            [order[at - k] if at - k >= first[at] else order[at] for k in range(depth, 0, -1)] for at in range(8)
        ]
        batches = list(data.val_dataloader())
        assert all(batch.streams is None for batch in batches)
        rows = [(batch, row) for batch in batches for row in range(len(batch))]
        assert [[past.tokens[row] for past in batch.past] for batch, row in rows] == expected
        frames = list(data.stream())
        assert [[past.tokens[0] for past in frame.past] for frame in frames] == expected
        assert [bool(frame.starts) for frame in frames] == [1, 0, 0, 0, 1, 1, 0, 0]
        assert all(batch.streams is not None and not batch.past for batch in data.train_dataloader())
    with pytest.raises(ConfigError, match=r"past_window_s=0.3: no frame of the split 'val' has another"):
        module(drives, ("radar",), temporal=True, past_window_s=0.3).val_dataloader()
    alone = module(drives, ("radar",), past_window_s=0.3)  # single frames remember nothing anyway
    assert not any(batch.past for batch in alone.val_dataloader())
    for changes, words in (({"past_window_s": 0.0}, "above 0"), ({"timeline": FIVE_HERTZ}, "data.timeline says")):
        with pytest.raises(ConfigError, match=words):
            config(**({"past_window_s": 0.55} | changes))


def test_no_point_is_older_than_the_window(data_set):
    """Of a past frame the newest sweeps are left, whose age counts from the frame that they are for."""
    whole = module(data_set, temporal=True, past_frames=1, batch_size=1)
    whole = {batch.tokens[0]: batch for batch in whole.train_dataloader()}
    window_s = 0.52
    data = module(data_set, temporal=True, past_frames=1, past_window_s=window_s, batch_size=1)
    lost = 0
    for batch in data.train_dataloader():
        there = whole[batch.tokens[0]]
        for one, all_of_it in zip((batch, *batch.past), (there, *there.past), strict=True):
            age_s = float(batch.timestamps_s - one.timestamps_s) + all_of_it.radar_points[:, -1].double()
            assert torch.equal(one.radar_points, all_of_it.radar_points[age_s <= window_s])
            assert len(one.radar_batch) == len(one.radar_points) and one.image_valid.equal(all_of_it.image_valid)
            lost += int((age_s > window_s).sum())
    assert lost


def test_stream_of_scenes(drives):
    data = module(drives, ("radar",))
    frames = list(data.stream())
    assert [frame.tokens[0] for frame in frames] == data.evaluation_set().tokens
    assert [bool(frame.starts) for frame in frames] == [1, 0, 0, 0, 1, 1, 0, 0]
    assert all(len(frame) == 1 and frame.streams.tolist() == [0] for frame in frames)
    assert torch.equal(frames[0].aug_from_ego[0], torch.eye(4))
    one = list(data.stream(["scene-val-2"]))
    assert [frame.tokens for frame in one] == [frame.tokens for frame in frames[5:]] and bool(one[0].starts)
    with pytest.raises(ConfigError, match="scene 'scene-val-9': the split 'val' has no such.*'scene-val-0'"):
        data.stream(["scene-val-9"])  # before the first frame is read
    with pytest.raises(ConfigError, match="'scene-train-0': the split 'val'"):
        data.stream(["scene-train-0"])


def test_clips_for_pictures_end_at_spread_frames(drives):
    data = module(drives, ("radar",))
    order = data.evaluation_set().tokens
    clips = data.validation_clips(2, 3)
    assert [clip[-1].tokens[0] for clip in clips] == [order[2], order[5]]
    assert [[frame.tokens[0] for frame in clip] for clip in clips] == [order[:3], order[5:6]]
    assert [[bool(frame.starts) for frame in clip] for clip in clips] == [[1, 0, 0], [1]]


def test_dropped_key_frame_is_a_longer_step_of_the_same_clip(drives):
    samples = drives.records("sample")
    (lost,) = (record for record in samples if record["token"] == token("sample", "val-0-1"))
    for record in samples:
        record["next"] = lost["next"] if record["next"] == lost["token"] else record["next"]
        record["prev"] = lost["prev"] if record["prev"] == lost["token"] else record["prev"]
    drives.table("sample").write_text(json.dumps([record for record in samples if record is not lost]))
    files = [record for record in drives.records("sample_data") if record["sample_token"] != lost["token"]]
    drives.table("sample_data").write_text(json.dumps(files))
    frames = list(module(drives, ("radar",), temporal=True).stream(["scene-val-0"]))
    times = torch.cat([frame.timestamps_s for frame in frames])
    torch.testing.assert_close(times.diff(), torch.tensor([1.0, 0.5], dtype=torch.float64), rtol=0, atol=1e-5)
    assert [bool(frame.starts) for frame in frames] == [1, 0, 0]


@pytest.mark.parametrize("field", ["timestamp", "prev"])
@pytest.mark.parametrize("shift_us", [0, -100], ids=["duplicate", "reversed"])
def test_time_that_stands_still_or_runs_back_within_a_scene(drives, shift_us, field):
    """By the samples' own time stamps, or by those of the key frames that give the frames their time."""
    table = "sample" if field == "prev" else "sample_data"
    first = drives.records(table)[0]["timestamp"]
    drives.edit(table, 1, timestamp=first + shift_us)
    with pytest.raises(
        DataError, match=f"sample.json: sample '{token('sample', 'train-0-1')}'.*{field}=.*(later|earl)"
    ):
        module(drives, ("radar",), temporal=True)


@pytest.mark.parametrize("split", ["train", "val"])
def test_poses_that_jump_between_frames(drives, split):
    pose = 2 if split == "train" else 16
    translation = drives.records("ego_pose")[pose]["translation"]
    drives.edit("ego_pose", pose, translation=[translation[0] + 500, *translation[1:]])
    data = module(drives, ("radar",), temporal=True)
    with pytest.raises(DataError, match=f"{token('sample', f'{split}-0-1')}.*m/s.*damaged"):
        data.train_dataloader() if split == "train" else data.val_dataloader()


@pytest.mark.parametrize("temporal", [False, True])
def test_training_resumes_at_the_trainers_step_and_validation_does_not(drives, temporal):
    def read(steps, limit=float("inf"), kind="train"):
        data = module(drives, ("radar",), temporal=temporal, batch_size=3)
        data.trainer = SimpleNamespace(world_size=1, global_rank=0, global_step=steps, num_training_batches=limit)
        loader = data.train_dataloader() if kind == "train" else data.val_dataloader()
        assert len(loader) == (5 if kind == "train" else 4 if temporal else 3)
        return [tuple(batch.tokens) for batch in loader]

    epochs = [read(0), read(5), read(10)]
    assert len(set(sum(epochs, []))) > 10 and all(len(epoch) == 5 for epoch in epochs)
    assert read(3) == epochs[0][3:] and read(7) == epochs[1][2:] and read(14) == epochs[2][4:]
    assert read(5, limit=4) == epochs[1][1:]  # Trainer(limit_train_batches=4): step 5 is the second of epoch 1
    assert read(7, kind="val") == read(0, kind="val")


def test_ranks_of_the_module_read_one_process_s_batches(drives):
    def read(rank, world_size, kind):
        data = module(drives, ("radar",), temporal=True, batch_size=4)
        data.trainer = SimpleNamespace(
            world_size=world_size, global_rank=rank, global_step=0, num_training_batches=float("inf")
        )
        loader = data.train_dataloader() if kind == "train" else data.val_dataloader()
        return [list(zip(batch.streams.tolist(), batch.tokens, batch.starts.tolist(), strict=True)) for batch in loader]

    alone, parts = read(0, 1, "train"), [read(rank, 2, "train") for rank in range(2)]
    assert alone == [left + right for left, right in zip(*parts, strict=True)]
    tokens = [entry[1] for rank in range(4) for batch in read(rank, 4, "val") for entry in batch]
    assert sorted(tokens) == sorted(module(drives, ("radar",)).evaluation_set().tokens)


class Recorder(L.LightningModule):
    """Notes which frames come in which epoch, and when validation runs; may save and stop before a step."""

    def __init__(self, stop_at=None, checkpoint=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.stop_at, self.checkpoint = stop_at, checkpoint
        self.seen = []

    def on_train_batch_start(self, batch, index):
        if self.trainer.global_step == self.stop_at:
            self.trainer.save_checkpoint(self.checkpoint)
            raise Stopped

    def training_step(self, batch, index):
        starts = None if batch.starts is None else tuple(batch.starts.tolist())
        self.seen.append((self.current_epoch, index, *batch.tokens, starts, float(batch.aug_from_ego.sum())))
        return self.weight**2

    def validation_step(self, batch, index):
        assert len(batch)
        self.seen.append(("validation", self.trainer.global_step, *batch.tokens))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


class Stopped(Exception):
    pass


def fit(data, folder, epochs, checkpoint=None, resume=None, stop_at=None):
    trainer = L.Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False,
        enable_checkpointing=False, use_distributed_sampler=False, num_sanity_val_steps=0, default_root_dir=folder,
    )  # fmt: skip
    recorder = Recorder(stop_at, checkpoint)
    with pytest.raises(Stopped) if stop_at is not None else nullcontext():
        trainer.fit(recorder, data, ckpt_path=resume, weights_only=True)
    if checkpoint and stop_at is None:
        trainer.save_checkpoint(checkpoint)
    return recorder.seen


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 1])
def test_lightning_epochs_differ_and_resume(data_set, tmp_path, num_workers):
    def make():
        return module(data_set, ("radar",), batch_size=1, num_workers=num_workers)

    whole = fit(make(), tmp_path, 3)
    epochs = [[entry for entry in whole if entry[0] == epoch] for epoch in range(3)]
    assert all(len({entry[2] for entry in epoch}) == 3 for epoch in epochs)
    assert len({entry[-1] for epoch in epochs for entry in epoch}) == 9  # fresh augmentation every time
    expected = shuffled_frames(np.arange(3), 1, 0, 2).samples.ravel()
    index = load_index(data_set.root, VERSION, None)
    assert [entry[2] for entry in epochs[2]] == list(index.sample_tokens[expected])
    first = fit(make(), tmp_path, 2, checkpoint=tmp_path / "two.ckpt")
    rest = fit(make(), tmp_path, 3, resume=tmp_path / "two.ckpt")
    assert first + rest == whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("temporal", "num_workers", "stop_at"),
    [(True, 0, 2), (True, 1, 7), (True, 0, 5), (True, 0, 9), (False, 0, 7), (False, 1, 5)],
)
def test_lightning_resumes_in_the_middle_of_an_epoch(
    drives, tmp_path, temporal, num_workers, stop_at, quick_end, recwarn
):
    """Frames, augmentation, epochs and validations of a run cut in two are those of a run in one piece."""

    def make():
        return module(drives, ("radar",), temporal=temporal, batch_size=3, num_workers=num_workers)

    whole = fit(make(), tmp_path, 3)
    assert [entry[:2] for entry in whole if entry[0] != "validation"] == [(e, i) for e in range(3) for i in range(5)]
    validated = sorted({entry[1] for entry in whole if entry[0] == "validation"})
    assert validated == [5, 10, 15]
    first = fit(make(), tmp_path, 3, checkpoint=tmp_path / "mid.ckpt", stop_at=stop_at)
    rest = fit(make(), tmp_path, 3, resume=tmp_path / "mid.ckpt")
    assert len([entry for entry in first if entry[0] != "validation"]) == stop_at
    assert first + rest == whole
    assert not [warning for warning in recwarn if "resumable" in str(warning.message)]


def test_the_digest_is_of_the_samples_that_are_read(drives):
    first, again = module(drives), module(drives)
    assert first.samples_digest == again.samples_digest and len(first.samples_digest) == 16
    others = (
        module(drives, **changes) for changes in ({"train_scenes": 2}, {"train_split": "val"}, {"split": "train"})
    )
    assert len({first.samples_digest, *(other.samples_digest for other in others)}) == 4
    assert first.state_dict() == {"data": first.identity(), "samples_digest": first.samples_digest}
