import gc
import os
import pickle
from dataclasses import replace
from types import SimpleNamespace

import lightning as L
import numpy as np
import pytest
import torch
from tiny_set import VERSION

from src.data.augment import AugmentationConfig, BevAugmentationConfig
from src.data.cache import load_index
from src.data.datamodule import DataConfig, DetectionDataModule, FrameSampler, collate, dead_workers_named
from src.data.reader import OnBadFile
from src.errors import ConfigError, DataError, HorizonError
from src.structures.taxonomy import RADARS

BEV = BevAugmentationConfig(scale=[0.95, 1.05], rotation_rad=0.4, flip_probability=0.5)


def config(**changes):
    values = dict(
        root=None, version=VERSION, train_split="train", split="val", batch_size=2, num_workers=0, num_sweeps=2,
        min_distance_m=1.0, propagate_points=False, on_bad_file=OnBadFile.error, test_resize_offset=0.0,
        augmentation=AugmentationConfig(image=None, bev=BEV), world=None,
    )  # fmt: skip
    return DataConfig(**(values | changes))


def module(data_set, image_size_px=(32, 80), seed=0, **changes):
    return DetectionDataModule(config(**changes), data_set.root, image_size_px, seed, data_set.root / "cache")


@pytest.fixture
def quick_end(monkeypatch):
    """A loader left in the middle waits 5 s for its workers when it is collected; here 0.2 s."""
    monkeypatch.setattr(torch.utils.data._utils, "MP_STATUS_CHECK_INTERVAL", 0.2)
    yield
    gc.collect()


def samplers(n, world_size, batch_size, seed, epoch=0):
    return [FrameSampler(np.arange(n), rank, world_size, batch_size, seed, lambda: epoch) for rank in range(world_size)]


def test_training_ranks_get_equal_whole_batches_without_repeats():
    parts = [[sample for _, sample in s] for s in samplers(23, 3, 2, seed=4)]
    assert [len(part) for part in parts] == [6, 6, 6] == [len(s) for s in samplers(23, 3, 2, seed=4)]
    assert len(set(sum(parts, []))) == 18


def test_steps_hold_the_same_frames_on_any_number_of_devices():
    alone = [sample for _, sample in samplers(24, 1, 6, seed=4)[0]]
    parts = [[sample for _, sample in s] for s in samplers(24, 3, 2, seed=4)]
    for step in range(4):
        assert set(alone[6 * step : 6 * step + 6]) == {x for part in parts for x in part[2 * step : 2 * step + 2]}


def test_order_follows_seed_and_epoch():
    orders = {(seed, epoch): tuple(samplers(20, 1, 1, seed, epoch)[0]) for seed in (0, 1) for epoch in (0, 1)}
    assert len({tuple(sample for _, sample in order) for order in orders.values()}) == 4
    assert {epoch for epoch, _ in orders[0, 1]} == {1}


def test_validation_covers_every_frame_once():
    parts = [[sample for _, sample in s] for s in samplers(7, 3, 2, seed=None)]
    assert sorted(sum(parts, [])) == list(range(7)) and [len(part) for part in parts] == [3, 2, 2]


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
    (batch,) = module(broken_files, image_size_px=None).train_dataloader()
    assert batch.images is None and batch.image_valid is None and batch.pix_from_aug is None


def test_empty_and_full_frames_share_a_batch(data_set):
    reader = module(data_set).reader
    frame = reader.read(0, None)
    empty = replace(frame, radar_points=frame.radar_points[:0], radar_batch=frame.radar_batch[:0])
    batch = collate([empty, frame, empty])
    assert batch.radar_batch.unique().tolist() == [1] and len(batch.boxes) == 3


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


def test_skipped_files_are_counted_in_the_batch(broken_files):
    index = load_index(broken_files.root, VERSION, None)
    for row in index.key_data[3:5, 4]:
        (broken_files.root / index.filename(row)).unlink()
    data = module(broken_files, on_bad_file=OnBadFile.skip, batch_size=3)
    (batch,) = data.val_dataloader()
    assert batch.skipped == {RADARS[0]: 2} and len(batch) == 3


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
    [{"batch_size": 0}, {"num_sweeps": 0}, {"num_workers": -1}, {"min_distance_m": float("nan")},
     {"test_resize_offset": float("nan")}],
    ids=str,
)  # fmt: skip
def test_impossible_settings(change):
    with pytest.raises(ConfigError, match=f"data.{next(iter(change))}"):
        config(**change)


def test_too_few_frames_for_a_batch(data_set):
    with pytest.raises(DataError, match="data.batch_size=4.*only 3 frames"):
        module(data_set, batch_size=4).train_dataloader()


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
    assert [frame.tokens[0] for frame in data.validation_frames(1)] == [data.evaluation_set().tokens[1]]
    assert [frame.tokens[0] for frame in data.validation_frames(3)] == data.evaluation_set().tokens


def test_identity_holds_no_path(data_set):
    assert str(data_set.root.parent) not in str(module(data_set).identity())


class Recorder(L.LightningModule):
    """Notes which frames come in which epoch."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(()))
        self.seen = []

    def training_step(self, batch, index):
        self.seen.append((self.current_epoch, batch.tokens[0], float(batch.aug_from_ego.sum())))
        return self.weight**2

    def validation_step(self, batch, index):
        assert len(batch)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def fit(data, folder, epochs, checkpoint=None, resume=None):
    trainer = L.Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False,
        enable_checkpointing=False, use_distributed_sampler=False, num_sanity_val_steps=0, default_root_dir=folder,
    )  # fmt: skip
    recorder = Recorder()
    trainer.fit(recorder, data, ckpt_path=resume, weights_only=True)
    if checkpoint:
        trainer.save_checkpoint(checkpoint)
    return recorder.seen


@pytest.mark.parametrize("num_workers", [0, 1])
def test_lightning_epochs_differ_and_resume_goes_on(data_set, tmp_path, num_workers):
    def make():
        return module(data_set, None, batch_size=1, num_workers=num_workers)

    whole = fit(make(), tmp_path, 3)
    epochs = [[entry[1:] for entry in whole if entry[0] == epoch] for epoch in range(3)]
    assert all(len({token for token, _ in epoch}) == 3 for epoch in epochs)
    assert len({matrix for epoch in epochs for _, matrix in epoch}) == 9  # fresh augmentation every time
    expected = [sample for _, sample in FrameSampler(np.arange(3), 0, 1, 1, 0, lambda: 2)]
    index = load_index(data_set.root, VERSION, None)
    assert [token for token, _ in epochs[2]] == list(index.sample_tokens[expected])
    first = fit(make(), tmp_path, 2, checkpoint=tmp_path / "two.ckpt")
    rest = fit(make(), tmp_path, 3, resume=tmp_path / "two.ckpt")
    assert first + rest == whole
