"""The whole of SpaRC: gradients, bad input, samples and cameras that must not matter, learning, sizes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from src.models.sparc.model import SpaRCLossConfig
from tests.models.dense_bev.dense_frames import GRID, make_batch
from tests.models.learning import (
    average_precision,
    gradients_are_finite,
    parameters_that_stay,
    samples_do_not_mix,
    train_step,
    weight_multiplies_or_switches_off,
)
from tests.models.sparc.sparc_frames import SMALL, sparc_model

TERMS = {"class", "box", "heatmap", "keypoint", "depth", "total"}
EVERY = [(b, n) for b in range(2) for n in range(4)]


def test_named_terms_and_one_entry_per_sample():
    model, batch = sparc_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert output.head.logits.shape == (2, 40 + 8 + 8, 12) and len(output.layers) == 2
    assert len(model.eval().decode(model(batch)[0])) == 2
    found = model.diagnostics(output)
    assert found["radar_points"] == len(output.radar.bev) / 2 and found["queries"] <= 56


def test_every_parameter_learns():
    assert parameters_that_stay(sparc_model(), make_batch(boxes=(12, 12)), lr=1e-3) == []


@pytest.mark.parametrize(
    "shape", [{"points": (0, 0)}, {"points": (150, 0)}, {"boxes": (0, 0)}, {"points": (1,), "boxes": (1,)}]
)
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_empty_inputs_give_finite_losses(shape, phase):
    model, batch = sparc_model(phase=phase), make_batch(**shape)
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    assert len(model.eval().decode(model(batch)[0])) == len(batch)


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = sparc_model(), make_batch()
    for sample, camera in missing:
        batch.image_valid[sample, camera] = False
        batch.pix_from_aug[sample, camera] = 0.0
    output, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    if missing == EVERY:
        assert terms["depth"] == terms["keypoint"] == 0 and not output.proposals.queries.valid[:, 40:48].any()
    model.eval()
    before = model(batch)[0]
    for sample, camera in missing:
        batch.images[sample, camera] = 255 - batch.images[sample, camera]
    after = model(batch)[0]
    assert torch.equal(before.head.logits, after.head.logits)
    assert torch.equal(model.loss(before, batch).terms["total"], model.loss(after, batch).terms["total"])


def test_two_samples_do_not_mix():
    samples_do_not_mix(sparc_model().eval(), make_batch(points=(150, 40), seed=3), make_batch)


@pytest.mark.parametrize("name", [field.name for field in fields(SpaRCLossConfig)])
def test_weights_multiply_and_null_switches_a_term_off(name):
    weight_multiplies_or_switches_off(sparc_model().eval(), make_batch(), name, TERMS)


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_autocast_keeps_positions_and_losses_in_float32(phase):
    model, batch = sparc_model(phase=phase), make_batch()
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = model(batch)
        terms = model.loss(output, batch).terms
    terms["total"].backward()
    assert output.head.codes.dtype == output.head.logits.dtype == output.radar.means.dtype == torch.float32
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())
    assert gradients_are_finite(model)


def test_images_and_annotations_are_needed_where_they_are():
    model, batch = sparc_model(), make_batch()
    output, _ = model(batch)
    with pytest.raises(ValueError, match="FrameBatch.boxes is None"):
        model.loss(output, replace(batch, boxes=None))
    with pytest.raises(ValueError, match="FrameBatch.images is None"):
        model(replace(batch, images=None))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.channels=6", "model.channels=6.*multiple of 4"),
        ("model.decoder.num_heads=3", "model.decoder.num_heads=3.*divide model.channels=32"),
        ("model.decoder.num_layers=0", "num_layers=0"),
        ("model.radar_encoder.num_heads=3", "model.radar_encoder.num_heads=3.*divide"),
        ("model.fusion.image_stride_px=4", r"image_stride_px=4.*\[8, 16, 32\]"),
        ("model.queries.num_radar=0", "num_radar=0"),
        ("model.queries.keypoint_nms_cells=2", "keypoint_nms_cells=2.*odd"),
        ("model.queries.depth_range_m=[2,1]", "depth_range_m"),
        ("model.head.max_boxes=501", "max_boxes=501"),
        ("model.loss.class_weight=-1", "model.loss.class_weight=-1"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        sparc_model(overrides)


def test_it_needs_a_backbone():
    config, _ = compose_config([*SMALL, "phase=phase1"])
    with pytest.raises(ConfigError, match="backbone=null: model=sparc"):
        build_model(config.model, GRID, None, config.phase.options)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 34e6, 44e6), ("mini", 2.3e6, 3.0e6), ("debug", 0, 1e6)])
def test_sizes_stand_beside_horizon3ds(scale, low, high):
    """40.6 M and 2.4 M parameters there."""
    from src.assembly import build_model as build

    config, _ = compose_config([f"scale={scale}", "model=sparc", "phase=phase1", "data.root=x"])
    assert low < sum(p.numel() for p in build(config).parameters()) < high


@pytest.mark.slow
def test_two_frames_are_overfitted():
    """Over 0.9 AP at one cell, averaged over the classes present."""
    model, batch = sparc_model(), make_batch(boxes=(5, 4))
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    steps = 150
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 3e-3 * min(1.0, (steps - step) / 100)
        train_step(model, batch)
        torch.nn.utils.clip_grad_norm_(model.parameters(), 35.0)
        optimizer.step()
    with torch.no_grad():
        found = model.decode(model(batch)[0])  # in training mode: two frames are all the statistics there are
    assert np.mean([average_precision(found, batch.boxes, label) for label in range(5)]) > 0.9
