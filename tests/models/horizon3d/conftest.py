"""The small model and its frames, whose cameras look along the diagonals."""

from functools import partial

import pytest
import torch

from src.models.layers.views import CameraViews
from tests.models import frames
from tests.models.frames import GRID, SIZE
from tests.models.horizon3d import small_model
from tests.models.surroundings import DIAGONALS, rigs


@pytest.fixture
def grid():
    return GRID


@pytest.fixture
def make_batch():
    """Random frames: (points per sample, boxes per sample) -> FrameBatch."""
    return partial(frames.make_batch, headings=DIAGONALS, origin=(0.0, 0.0))


@pytest.fixture
def make_views():
    """Random image features of the four cameras for b samples."""

    def build(b=1, strides=(8, 16, 32), channels=16):
        levels = [torch.randn(b, 4, channels, SIZE[0] // stride, SIZE[1] // stride) for stride in strides]
        return CameraViews(levels, rigs(b, SIZE, DIAGONALS), torch.ones(b, 4, dtype=torch.bool), SIZE)

    return build


@pytest.fixture
def make_config():
    return small_model.make_config


@pytest.fixture
def make_model():
    return small_model.make_model
