"""CenterPoint on LiDAR: what it reads, gradients, samples that must not mix, and that it learns two frames."""

from dataclasses import fields, replace

import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models import build_model
from src.models.centerpoint.model import CenterPoint
from src.structures.batch import FrameBatch
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from tests.models.learning import gradients_are_finite, parameters_that_stay, train_step

GRID = BEVGrid((32, 32), 0.8, (0.0, 0.0), (-3.0, 5.0))
LIDAR = ("model=centerpoint", "phase=phase1", "scale=debug", "data.world.lidar=true")


def make_model(**changes) -> CenterPoint:
    torch.manual_seed(0)
    config, _ = compose_config([*LIDAR, *(f"{key}={value}" for key, value in changes.items())])
    return build_model(config.model, GRID, None, config.phase.options)


def box(x, y, label=0):
    return Boxes3D(
        centers=torch.tensor([[x, y, 0.5]]), sizes=torch.tensor([[1.9, 4.5, 1.7]]), yaws=torch.tensor([0.3]),
        velocities=torch.tensor([[8.0, 0.0]]), labels=torch.tensor([label]), attributes=torch.tensor([-1]),
        num_points=torch.tensor([9]),
    )  # fmt: skip


def make_batch(points=(120, 80)) -> FrameBatch:
    """Points scattered around one car of each sample, columns x, y, z, intensity, dt."""
    generator = torch.Generator().manual_seed(0)
    boxes = [box(4.0, -3.0), box(-5.0, 6.0)][: len(points)]
    clouds = []
    for number, count in enumerate(points):
        cloud = torch.rand(count, 5, generator=generator) * torch.tensor([4.0, 3.0, 2.0, 50.0, 0.4])
        cloud[:, :2] += boxes[number].centers[0, :2] - torch.tensor([2.0, 1.5])
        clouds.append(cloud)
    b = len(points)
    return FrameBatch(
        tokens=[f"frame {number}" for number in range(b)],
        timestamps_s=torch.zeros(b, dtype=torch.float64),
        global_from_ego=torch.eye(4, dtype=torch.float64).repeat(b, 1, 1),
        aug_from_ego=torch.eye(4).repeat(b, 1, 1),
        lidar_points=torch.cat(clouds),
        lidar_batch=torch.arange(b).repeat_interleave(torch.tensor(points)),
        boxes=boxes,
    )


@pytest.mark.slow
def test_it_reads_lidar_alone():
    config, _ = compose_config(list(LIDAR))
    assert config.model.sensors == ("lidar",) and config.image_size_px is None
    assert config.model.memory_frames == 0 and config.model.memory_max_age_s is None
    with pytest.raises(ConfigError, match="data.world.lidar=true"):
        compose_config(list(LIDAR[:3]))
    with pytest.raises(ConfigError, match="use phase=phase1"):
        compose_config([LIDAR[0], "phase=phase2", *LIDAR[2:]])
    with pytest.raises(ValueError, match="FrameBatch.lidar_points is None"):
        make_model()(replace(make_batch(), lidar_points=None, lidar_batch=None))


@pytest.mark.slow
@pytest.mark.parametrize("points", [(120, 80), (60, 0), (0, 0)])
def test_every_parameter_has_a_finite_gradient(points):
    model = make_model().train()
    _, terms = train_step(model, make_batch(points))
    assert set(terms) == {"heatmap", "box", "total"} and torch.isfinite(terms["total"])
    assert gradients_are_finite(model)


def test_every_parameter_learns():
    """With an object of every class, each on a point of its own."""
    batch = make_batch()
    for sample in range(2):
        places = batch.lidar_points[batch.lidar_batch == sample][: len(CLASSES), :2].tolist()
        objects = [box(*place, label) for label, place in enumerate(places)]
        names = [field.name for field in fields(Boxes3D) if field.name != "scores"]
        batch.boxes[sample] = Boxes3D(**{n: torch.cat([getattr(one, n) for one in objects]) for n in names})
    assert parameters_that_stay(make_model().train(), batch, lr=1e-2) == []


def test_samples_do_not_mix():
    model = make_model().eval()
    both, first = model(make_batch())[0], model(make_batch((120,)))[0]
    rows = both.lidar_bev.indices[:, 0] == 0
    torch.testing.assert_close(both.head.logits[rows], first.head.logits)


def test_a_term_is_switched_off_by_null():
    model = make_model(**{"model.loss.box_weight": "null"}).train()
    batch = make_batch()
    assert set(model.loss(model(batch)[0], batch).terms) == {"heatmap", "total"}
    with pytest.raises(ConfigError, match="model.loss.box_weight=-1.0: must not be negative"):
        make_model(**{"model.loss.box_weight": -1})


@pytest.mark.slow
def test_two_frames_are_overfitted():
    model, batch = make_model().train(), make_batch()
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    for _ in range(150):
        train_step(model, batch)
        optimizer.step()
    for boxes, truth in zip(model.eval().decode(model(batch)[0]), batch.boxes, strict=True):
        assert boxes.labels[0] == truth.labels[0] and boxes.scores[0] > 0.5
        assert (boxes.centers[0, :2] - truth.centers[0, :2]).norm() < 0.5
