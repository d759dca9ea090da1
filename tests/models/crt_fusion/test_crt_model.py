"""The whole of CRT-Fusion: gradients, bad input, samples and cameras that must not matter, learning, sizes."""

from dataclasses import fields

import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from src.models.crt_fusion.model import CRTFusionLossConfig
from tests.models.crt_fusion.crt_frames import SMALL, crt_model
from tests.models.dense_bev.dense_frames import GRID, backbone, make_batch
from tests.models.learning import (
    gradients_are_finite,
    images_and_annotations_are_needed,
    missing_cameras_do_not_matter,
    overfitted_precision,
    parameters_that_stay,
    samples_do_not_mix,
    train_step,
    weight_multiplies_or_switches_off,
)

TERMS = {"heatmap", "box", "depth", "foreground", "occupancy", "velocity", "total"}
EVERY = [(b, n) for b in range(2) for n in range(4)]


def test_named_terms_and_one_entry_per_sample():
    model, batch = crt_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert output.fused_bev.shape == (2, 16, *GRID.cells) and output.views.foreground_logits.shape == (8, 4, 6)
    assert len(model.eval().decode(model(batch)[0])) == 2
    found = model.diagnostics(output)
    assert found["lifted_pairs"] == output.views.num_lifted / 2 and found["occupied_cells"] == 0.0


def test_every_parameter_learns():
    assert parameters_that_stay(crt_model(), make_batch(boxes=(12, 12)), lr=1e-3) == []


@pytest.mark.parametrize(
    "shape", [{"points": (0, 0)}, {"points": (150, 0)}, {"boxes": (0, 0)}, {"points": (1,), "boxes": (1,)}]
)
def test_empty_inputs_give_finite_losses(shape):
    model, batch = crt_model(), make_batch(**shape)
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    assert len(model.eval().decode(model(batch)[0])) == len(batch)


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = crt_model(), make_batch()
    output, terms = missing_cameras_do_not_matter(model, batch, missing)
    if missing == EVERY:
        assert output.views.num_lifted == terms["depth"] == terms["foreground"] == 0


def test_two_samples_do_not_mix():
    samples_do_not_mix(crt_model().eval(), make_batch(points=(150, 40), seed=3), make_batch)


@pytest.mark.parametrize("name", [field.name for field in fields(CRTFusionLossConfig)])
def test_weights_multiply_and_null_switches_a_term_off(name):
    weight_multiplies_or_switches_off(crt_model().eval(), make_batch(), name, TERMS)


def test_autocast_keeps_positions_and_losses_in_float32():
    model, batch = crt_model(), make_batch()
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = model(batch)
        terms = model.loss(output, batch).terms
    terms["total"].backward()
    assert output.views.bev.dtype == output.motion.velocities.dtype == output.head.logits.dtype == torch.float32
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())
    assert gradients_are_finite(model)


def test_images_and_annotations_are_needed_where_they_are():
    model, batch = crt_model(), make_batch()
    images_and_annotations_are_needed(model, batch)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.view_transform.foreground_threshold=1.0", "foreground_threshold=1.0.*below 1"),
        ("model.view_transform.pillars_per_column=0", "pillars_per_column=0"),
        ("model.view_transform.depth_range_m=[2,1]", "depth_range_m"),
        ("model.fused_channels=8", "model.fused_channels=8.*at least 16"),
        ("model.loss.occupancy_weight=-1", "model.loss.occupancy_weight=-1"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        crt_model(overrides)


def test_it_needs_a_backbone():
    config, _ = compose_config([*SMALL, "phase=phase1"])
    with pytest.raises(ConfigError, match="backbone=null: model=crt_fusion"):
        build_model(config.model, GRID, None, config.phase.options)
    assert backbone() is not None


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 36e6, 48e6), ("mini", 2.4e6, 3.0e6), ("debug", 0, 1e6)])
def test_sizes_stand_beside_horizon3ds(scale, low, high):
    """40.6 M and 2.4 M parameters there."""
    from src.assembly import build_model as build

    config, _ = compose_config([f"scale={scale}", "model=crt_fusion", "phase=phase1", "data.root=x"])
    assert low < sum(p.numel() for p in build(config).parameters()) < high


@pytest.mark.slow
def test_two_frames_are_overfitted():
    """Over 0.9 AP at one cell, averaged over the classes present."""
    model, batch = crt_model(), make_batch(boxes=(5, 4))
    assert overfitted_precision(model, batch, 140, 4e-3, 100) > 0.9
