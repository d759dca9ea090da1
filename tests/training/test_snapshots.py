"""Pictures of a detector: clips are streamed, and the memory is shown as the model read it and as it would lie else."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from src.geometry.bev_grid import BEVGrid
from src.models.detector import Detector, Objective
from src.models.horizon3d.bev_path import BEVPathConfig, WarpedCells
from src.models.horizon3d.dptf import DPTFConfig, DPTFOutput, warped_evidence
from src.models.horizon3d.gaussian_path import GaussianPathConfig, Sampling, VelocityFrom
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.evidence import Evidence
from src.structures.gaussians import GaussianSet
from src.training.snapshots import draw_frames, memory_of, scene_of
from tests.gaussian_sets import gaussians_at

GRID = BEVGrid(cells=(64, 64), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
VELOCITY = torch.tensor([6.0, -2.0])


def frame(number: int) -> FrameBatch:
    boxes = Boxes3D(
        centers=torch.tensor([[5.0, 2.0, 0.0]]),
        sizes=torch.tensor([[4.0, 2.0, 2.0]]),
        yaws=torch.zeros(1),
        velocities=VELOCITY[None],
        labels=torch.zeros(1, dtype=torch.int64),
        attributes=torch.full((1,), -1),
        num_points=torch.full((1,), 7),
    )
    return FrameBatch(
        tokens=[f"token/{number}"],
        timestamps_s=torch.tensor([0.5 * number], dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64)[None],
        aug_from_ego=torch.eye(4)[None],
        radar_points=torch.zeros(0, 7),
        radar_batch=torch.zeros(0, dtype=torch.int64),
        boxes=[boxes],
        streams=torch.zeros(1, dtype=torch.int64),
        starts=torch.tensor([number == 0]),
    )


@dataclass
class Output:
    dptf: DPTFOutput | None


def recollection(compensated: bool) -> tuple[GaussianSet, WarpedCells]:
    """One thing 1.5 s old of each kind, and a Gaussian that is padding; last seen at (-4, 5)."""
    xy = torch.tensor([[-4.0, 5.0]]) + (VELOCITY * 1.5 if compensated else 0)
    g = 2
    history = gaussians_at(
        xy.expand(1, g, 2).clone(),
        velocities=VELOCITY.expand(1, g, 2),
        features=torch.zeros(1, g, 4),
        sources=torch.full((1, g), 3),
        elapsed_s=torch.full((1, g), 1.5),
        valid=torch.tensor([[True, False]]),
    )
    cells = WarpedCells(
        indices=torch.zeros(1, 4, dtype=torch.int64),
        xy=xy,
        velocities=VELOCITY[None],
        elapsed_s=torch.tensor([1.5]),
        features=torch.zeros(1, 4),
    )
    return history, cells


class Recorder(Detector):
    """Writes down what it is called with; remembers the tokens it has seen."""

    def __init__(self, dptf: DPTFConfig | None) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self.config = SimpleNamespace(dptf=dptf)
        self.calls: list[tuple[str, Any]] = []

    def forward(self, batch: FrameBatch, memory: Any = None) -> tuple[Output, Any]:
        assert not self.training and not torch.is_grad_enabled()
        self.calls.append((batch.tokens[0], memory))
        if self.config.dptf is None:
            return Output(None), None
        history, cells = recollection(True) if memory else (None, None)
        return Output(DPTFOutput(history, cells, None, None)), [*(memory or []), batch.tokens[0]]

    def loss_terms(self, output: Any, batch: FrameBatch) -> Objective:
        raise NotImplementedError

    def evidence(self, output: Output) -> Evidence:
        return evidence_of(self.config.dptf, output.dptf)

    def decode(self, output: Any) -> list[Boxes3D]:
        return [Boxes3D.empty()]


def evidence_of(settings: DPTFConfig | None, dptf: DPTFOutput | None) -> Evidence:
    return Evidence(**warped_evidence(settings, dptf)) if settings is not None and dptf is not None else Evidence()


def config(bev: bool = True, gaussians: bool = True, compensated: bool = True) -> DPTFConfig:
    bev_path = BEVPathConfig(
        num_frames=8, memory_threshold=0.1, max_cells_per_frame=9, velocity_compensation=compensated,
        spatial_dilation=False,
    )  # fmt: skip
    gaussian_path = GaussianPathConfig(
        num_frames=4, gaussians_per_frame=9, min_contribution=0.0, sampling=Sampling.random,
        velocity_from=VelocityFrom.gaussian, velocity_compensation=compensated, forget_refuted=False,
        self_attention=None,
    )  # fmt: skip
    return DPTFConfig(
        max_age_s=6.0,
        min_speed_mps=0.0,
        bev_path=bev_path if bev else None,
        gaussian_path=gaussian_path if gaussians else None,
    )


@pytest.mark.slow
def test_clips_are_streamed_and_their_last_frames_drawn(tmp_path: Path) -> None:
    model = Recorder(config()).train()
    clips = [[frame(0), frame(1), frame(2)], [frame(7)]]
    paths = draw_frames(model, iter(clips), GRID, tmp_path)
    assert [path.name for path in paths] == [
        "frame_0_token_2.png", "memory_0_token_2.png", "frame_1_token_7.png", "memory_1_token_7.png"
    ]  # fmt: skip
    assert all(path.stat().st_size > 5000 for path in paths)
    assert model.calls == [
        ("token/0", None), ("token/1", ["token/0"]), ("token/2", ["token/0", "token/1"]), ("token/7", None)
    ]  # fmt: skip
    assert model.training


def test_a_model_without_memory_gives_the_frame_alone(tmp_path: Path) -> None:
    paths = draw_frames(Recorder(None).eval(), [[frame(3)]], GRID, tmp_path)
    assert [path.name for path in paths] == ["frame_0_token_3.png"]


@pytest.mark.parametrize("compensated", [True, False])
def test_both_places_whichever_the_model_used(compensated: bool) -> None:
    history, cells = recollection(compensated)
    evidence = evidence_of(config(compensated=compensated), DPTFOutput(history, cells, None, None))
    shown = memory_of(evidence, scene_of(frame(0), Boxes3D.empty(), evidence, GRID))
    assert len(shown.ground_truth) == 1
    for memory in (shown.gaussians, shown.cells):
        assert len(memory) == 1  # padding is not shown
        assert np.allclose(memory.stayed, [[-4, 5]]) and np.allclose(memory.moved, [[5, 2]])
        assert memory.compensated == compensated
    assert shown.gaussians.gaussians is not None and shown.cells.gaussians is None and shown.queries is None
    evidence = Evidence(warped_queries=evidence.warped_cells)
    shown = memory_of(evidence, scene_of(frame(0), Boxes3D.empty(), evidence, GRID))
    assert shown.gaussians is None and shown.cells is None and len(shown.queries) == 1


def test_paths_that_are_off_or_have_nothing_yet() -> None:
    history, cells = recollection(True)
    scene = scene_of(frame(0), Boxes3D.empty(), Evidence(), GRID)

    def shown(settings: DPTFConfig | None, history: GaussianSet | None, cells: WarpedCells | None) -> Any:
        return memory_of(evidence_of(settings, DPTFOutput(history, cells, None, None)), scene)

    no_cells = shown(config(bev=False), history, None)
    assert no_cells.cells is None and len(no_cells.gaussians) == 1
    no_history = shown(config(gaussians=False), None, cells)
    assert no_history.gaussians is None and len(no_history.cells) == 1
    first = shown(config(), None, None)
    assert len(first.gaussians) == 0 and len(first.cells) == 0
    assert shown(None, history, cells) is None


def test_lidar_points_are_shown() -> None:
    points = torch.tensor([[5.0, 2.0, 1.0, 9.0, 0.0]])
    batch = replace(frame(0), lidar_points=points, lidar_batch=torch.zeros(1, dtype=torch.int64))
    scene = scene_of(batch, Boxes3D.empty(), Evidence(), GRID)
    assert scene.lidar_points.tolist() == points.tolist()
    assert scene_of(frame(0), Boxes3D.empty(), Evidence(), GRID).lidar_points is None
