"""Trainings over damaged sensor files: they end with all their numbers, and say which files they did without."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from src.assembly import build_datamodule, data_root
from src.config import compose_config
from src.data.clips import shuffled_frames
from src.data.schema import CHANNELS, DatasetIndex
from src.data.splits import split_samples
from src.structures.taxonomy import CAMERAS, RADARS
from tests.faults.mutations import cut, empty
from tests.running import command

ROOT = Path(__file__).resolve().parents[2]
TINY = (
    "scale=debug", "phase=phase1", "trainer=cpu", "trainer.num_pictures=0", "data.on_bad_file=skip",
    "data.world.num_train_scenes=1", "data.world.num_val_scenes=1", "data.world.key_frames_per_scene=6",
)  # fmt: skip
NUM_SWEEPS = 2  # of each radar at debug scale
DEADLINE_S = 400


def train(outputs: Path, *overrides: str, expect: int = 0) -> subprocess.CompletedProcess:
    return command("train", *TINY, f"paths.outputs={outputs}", *overrides, expect=expect, timeout=DEADLINE_S)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, DatasetIndex]:
    """A world of twelve frames, and its tables."""
    config, _ = compose_config([*TINY, f"paths.outputs={tmp_path_factory.mktemp('whole')}"])
    root = data_root(config)
    return root, build_datamodule(config, root).index


@pytest.fixture
def world(whole, tmp_path) -> Path:
    """A copy to break."""
    return shutil.copytree(whole[0], tmp_path / "world")


def files_of(index: DatasetIndex, samples: np.ndarray) -> list[str]:
    """Sensor files that a training reads for these frames."""
    names = []
    for sample in samples:
        for channel in (*CAMERAS, *RADARS):
            row = int(index.key_data[sample, CHANNELS.index(channel)])
            for _ in range(NUM_SWEEPS if channel in RADARS else 1):
                if row >= 0:
                    names.append(index.filename(row))
                    row = int(index.data_previous[row])
    return sorted(set(names))


def spoil(root: Path, names: list[str], rng: random.Random) -> None:
    """Cut, empty, fill with zeros or remove each of the files."""
    for name in names:
        path = root / name
        content = path.read_bytes()
        damage = rng.choice([cut(rng, content[:-40], []), empty(rng, content, []), None])
        path.unlink() if damage is None else path.write_bytes(damage)


def report_of(outputs: Path) -> tuple[dict, str]:
    """run.json and log.txt of the only run."""
    (folder,) = outputs.glob("horizon3d-phase1-debug-*")
    assert (folder / "metrics.json").is_file() and (folder / "submission.json").is_file()
    return json.loads((folder / "run.json").read_text()), (folder / "log.txt").read_text()


@pytest.mark.slow
def test_an_epoch_over_one_percent_of_damaged_files_ends_and_names_them(whole, world, tmp_path):
    """Read by a worker process; each file is counted as often as it was wanted."""
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    rng = random.Random(seed)
    index = whole[1]
    names = files_of(index, np.arange(len(index)))
    damaged = sorted(rng.sample(names, -(-len(names) // 100)))
    spoil(world, damaged, rng)
    result = train(tmp_path / "outputs", f"data.root={world}", "data.num_workers=1")
    record, log = report_of(tmp_path / "outputs")
    assert record["skipped_names"] == damaged
    wanted = sum(files_of(index, [sample]).count(name) for sample in range(len(index)) for name in damaged)
    assert sum(record["skipped_files"].values()) == wanted
    assert set(record["skipped_files"]) == {name.split("/")[1] for name in damaged}
    for name in damaged:
        assert name in log and name in result.stdout
    assert record["steps"] == 3


@pytest.mark.faults
def test_damaged_files_of_one_rank_block_nobody_and_are_in_the_report(whole, world, tmp_path):
    """Two gloo processes with a worker each; only the second meets damage, in training, where it computes gradients
    with the other at every step."""
    index = whole[1]
    order = shuffled_frames(split_samples(index, "train"), 2, seed=0, epoch=0).samples
    others = set(files_of(index, order[:, 0])) | set(files_of(index, split_samples(index, "val")))
    mine = [name for name in files_of(index, order[:, 1]) if name not in others]
    cameras = [name for name in mine if "CAMERA" in name][:3]
    damaged = sorted([*cameras, *[name for name in mine if "RADAR" in name][:4]])
    assert len(damaged) == 7
    spoil(world, damaged, random.Random(0))
    place = (f"data.root={world}", "data.num_workers=1", "trainer=ddp", "trainer.devices=2", "trainer.accelerator=cpu")
    train(tmp_path / "outputs", *place)
    record, log = report_of(tmp_path / "outputs")
    assert record["skipped_names"] == damaged and record["processes"] == 2
    assert all(name in log for name in damaged)
    stopped = train(tmp_path / "stopped", *place, "data.on_bad_file=error", expect=4)
    assert any(name in stopped.stderr for name in damaged) and "data.on_bad_file=skip" in stopped.stderr
