"""Golden cases of the encoders: recorded values and the rule that makes their weights."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

GOLDEN = Path(__file__).parents[2] / "golden"


def seeded(name: str) -> np.random.RandomState:
    return np.random.RandomState(zlib.crc32(name.encode()) & 0xFFFFFFFF)


def weight_of(name: str, shape: list[int]) -> Tensor:
    """The weight rule of the golden READMEs."""
    if name.endswith("num_batches_tracked"):
        return torch.tensor(0)
    random = seeded(name)
    if name.endswith("running_mean"):
        value = 0.1 * random.standard_normal(shape)
    elif name.endswith("running_var"):
        value = 0.5 + random.random_sample(shape)
    elif len(shape) >= 2:
        value = random.standard_normal(shape) * np.sqrt(2 / np.prod(shape[1:]))
    elif name.endswith("weight"):
        value = 0.75 + 0.5 * random.random_sample(shape)
    else:
        value = 0.1 * random.standard_normal(shape)
    return torch.from_numpy(np.asarray(value, dtype=np.float32))


@dataclass
class GoldenCase:
    """One folder of tests/golden: arrays, description and weights under their published names."""

    arrays: dict[str, np.ndarray]
    meta: dict
    weights: dict[str, Tensor]

    def input_of(self, size: str) -> Tensor:
        entry = self.meta["inputs"][size]
        return torch.from_numpy(seeded(entry["name"]).standard_normal(entry["shape"]).astype(np.float32))

    def check_map(self, key: str, found: Tensor, tolerance: float) -> None:
        """Compare a dense stage output [B, C, H, W] with the recorded slice and statistics, relative to its maximum."""
        assert list(found.shape) == self.arrays[f"{key}/shape"].tolist()
        scale = self.arrays[f"{key}/absmax"].max()
        values = found.double().numpy()
        step = found.shape[1] // 16
        for name, value in {
            "slice": values[:, ::step],
            "mean": values.mean((2, 3)),
            "std": values.std((2, 3)),
            "absmax": np.abs(values).max((2, 3)),
        }.items():
            assert np.abs(value - self.arrays[f"{key}/{name}"]).max() <= tolerance * scale, f"{key}/{name}"


@pytest.fixture(scope="session")
def golden() -> Callable[[str], GoldenCase]:
    def load(folder: str) -> GoldenCase:
        with np.load(GOLDEN / folder / "case.npz") as file:
            arrays = {name: file[name] for name in file.files}
        listed = json.loads((GOLDEN / folder / "tensors.json").read_text())
        listed = listed["tensors"] if isinstance(listed, dict) else listed
        weights = {entry["name"]: weight_of(entry["name"], entry["shape"]) for entry in listed}
        return GoldenCase(arrays, json.loads(str(arrays.pop("meta_json"))), weights)

    return load
