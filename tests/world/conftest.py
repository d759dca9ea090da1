"""Small worlds that several tests share; every value that is not named here comes from conf/data/synthetic.yaml."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from src.world.world_config import WorldConfig
from src.world.write import VERSION, ensure_world

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = {
    "num_train_scenes": 2,
    "num_val_scenes": 1,
    "key_frames_per_scene": 5,
    "seed": 3,
    "num_workers": 1,
    "image_width_px": 240,
    "image_height_px": 114,
    "radar_sweeps_per_key_frame": 3,
}


def stated_values():
    """The `world` block of conf/data/synthetic.yaml."""
    text = (REPOSITORY / "conf" / "data" / "synthetic.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)["world"]


def small_config(**changes):
    """The default world, shrunk; `changes` win."""
    return WorldConfig(**(stated_values() | SMALL | changes))


class StoredWorld:
    """The tables of a world, read without the code under test."""

    def __init__(self, root):
        self.root = Path(root)
        folder = self.root / VERSION
        self.tables = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")}
        self.rows = {name: {row["token"]: row for row in table} for name, table in self.tables.items()}

    def __getitem__(self, name):
        return self.tables[name]

    def channel(self, data):
        calibration = self.rows["calibrated_sensor"][data["calibrated_sensor_token"]]
        return self.rows["sensor"][calibration["sensor_token"]]["channel"]

    def category(self, annotation):
        instance = self.rows["instance"][annotation["instance_token"]]
        return self.rows["category"][instance["category_token"]]["name"]

    def matrix(self, row):
        """[4, 4] of a row with translation and rotation (w, x, y, z)."""
        w, x, y, z = row["rotation"]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        result = np.eye(4)
        result[:3, :3] += 2 * w * cross + 2 * cross @ cross
        result[:3, 3] = row["translation"]
        return result

    def global_from_sensor(self, data):
        pose = self.rows["ego_pose"][data["ego_pose_token"]]
        return self.matrix(pose) @ self.matrix(self.rows["calibrated_sensor"][data["calibrated_sensor_token"]])

    def radar(self, data):
        """[n, 7] of one file, by hand."""
        raw = (self.root / data["filename"]).read_bytes()
        header, body = raw.split(b"DATA binary\n")
        points = np.frombuffer(body, "<f4").reshape(-1, 7).astype(np.float64)
        assert f"POINTS {len(points)}\n".encode() in header
        return points


@pytest.fixture(scope="session")
def make_config():
    """`small_config` for tests that need other values."""
    return small_config


@pytest.fixture(scope="session")
def config():
    return small_config()


@pytest.fixture(scope="session")
def world(config, tmp_path_factory):
    return StoredWorld(ensure_world(config, tmp_path_factory.mktemp("worlds") / "small", progress=False))


@pytest.fixture(scope="session")
def stored_world():
    """Reads the tables of a world."""
    return StoredWorld


@pytest.fixture(scope="session")
def default_values():
    """The default world's config as stated in conf/."""
    return stated_values()
