"""suite=reader: every stage is measured where the reader does it, and naive implementations read the same."""

import time
import types

import numpy as np
import pytest
import torch
from PIL import Image

from src.benchmark import suite_reader as suite
from src.benchmark.suite_reader import (
    STAGES,
    fields_one_by_one,
    loader_row,
    naive_image,
    time_frames,
)
from src.benchmark.timing import timed_parts
from src.config import compose_config
from src.data import images, sensor_files
from src.data.images import read_image, width_fit
from src.data.pcd import read_radar_points
from src.structures.taxonomy import RADARS


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """Few and small frames; the world is written once."""
    small = ["scale=debug", "data.world.num_train_scenes=1", "data.world.num_val_scenes=1"]
    small += ["data.world.key_frames_per_scene=3", f"paths.outputs={tmp_path_factory.mktemp('outputs')}"]
    return compose_config(small)[0]


@pytest.fixture(autouse=True)
def short(monkeypatch):
    for name in ("READER_FRAMES", "LOADER_FRAMES", "COMPARISON_ROUNDS"):
        monkeypatch.setattr(suite, name, 4)


def test_every_part_of_the_suite(config):
    result = suite.measure(config, {})
    pipelines = {row["pipeline"]: row["frames/s (CPU)"] for row in result["frames with and without augmentation"]}
    assert list(pipelines) == ["training", "test"] and min(pipelines.values()) > 0
    stages = {row["stage"]: row for row in result["stages"]}
    assert {*STAGES, "assembling", "collate"} - set(stages) == {"LiDAR files", "LiDAR compensation"}
    assert all(row["training ms"] > 0 for row in stages.values())
    for run in ("training", "test"):
        assert sum(row[f"{run} share"] for row in stages.values()) == pytest.approx(1)
    assert stages["mirror and rotate"]["test ms"] < 0.1 * stages["mirror and rotate"]["training ms"]
    for rows in (result["images of one frame"], result["radar files of one frame"]):
        assert len(rows) >= 2 and rows[0]["ratio"] == 1 and all(row["ms"] > 0 for row in rows)
    assert result["image_px"] == "320x152" and result["network_px"] and result["radar_files"] == 12
    (row,) = result["loader"]
    assert row["frames"] == 4 and row["worker CPU ms/frame"] > 0


def test_measuring_leaves_the_reader_as_it_was(config):
    places = [(images, "decode"), (images, "resample"), (images, "turn"), (sensor_files, "read_radar_points")]
    before = [getattr(module, name) for module, name in places]
    with pytest.raises(RuntimeError), timed_parts(torch.nn.Module(), STAGES, time.process_time):
        assert images.resample is not before[1]
        raise RuntimeError
    assert [getattr(module, name) for module, name in places] == before


def test_naive_implementations_read_what_the_reader_reads(config):
    datamodule = suite.build_datamodule(config, suite.data_root(config))
    sample = suite.full_samples(datamodule)[0]
    for path in suite.sweep_paths(datamodule, sample, RADARS, 2):
        np.testing.assert_array_equal(fields_one_by_one(path), read_radar_points(path))
    row = datamodule.index.key_data[sample, 0]
    path = datamodule.index.root / datamodule.index.filename(row)
    found = naive_image(str(path), (96, 320))
    with Image.open(path) as image:
        source_px = image.size[::-1]
    expected = read_image(path, source_px, width_fit(source_px, (96, 320)))
    assert found.shape == expected.shape and np.abs(found.astype(int) - expected).mean() < 3


def test_a_worker_s_seconds_are_its_own(config, monkeypatch):
    """A reader that takes its time in the worker costs the training process nothing."""
    make = suite.build_datamodule

    def slow(*arguments):
        datamodule = make(*arguments)
        read = datamodule.reader.read
        datamodule.reader.read = types.MethodType(lambda _, *given: (busy(0.05), read(*given))[1], datamodule.reader)
        return datamodule

    def busy(seconds):
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    monkeypatch.setattr(suite, "build_datamodule", slow)
    row = loader_row(config)
    assert row["worker CPU ms/frame"] > 50 > row["training process CPU ms/frame"]


def test_frames_without_images(config):
    datamodule = suite.build_datamodule(config, suite.data_root(config))
    datamodule.reader.settings = datamodule.settings = types.SimpleNamespace(
        **{**vars(datamodule.settings), "image_size_px": None}
    )
    columns = time_frames(datamodule, [0], None)
    assert sum(columns["JPEG decode"]) == 0 < min(columns["radar files"])
