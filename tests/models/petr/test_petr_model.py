"""The whole of PETR: gradients, bad input, samples and cameras that must not matter, memory, learning, sizes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from src.models.petr.model import PETRLossConfig
from tests.models.dense_bev.dense_frames import GRID, drive, fill, make_batch
from tests.models.learning import (
    average_precision,
    gradients_are_finite,
    parameters_that_stay,
    samples_do_not_mix,
    train_step,
    weight_multiplies_or_switches_off,
)
from tests.models.petr.petr_frames import SMALL, petr_model

TERMS = {"class", "box", "total"}
EVERY = [(b, n) for b in range(2) for n in range(4)]


def test_named_terms_and_one_entry_per_sample():
    model, batch = petr_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    assert output.head.logits.shape == (2, 32, 12) and len(output.layers) == 2
    assert len(model.eval().decode(model(batch)[0])) == 2
    assert model.diagnostics(output) == {"queries": 32}


def test_every_parameter_learns():
    """But for the first self-attention: features begin at zero, so there is nothing yet to tell one another."""
    stay = parameters_that_stay(petr_model(), make_batch(boxes=(12, 12)), lr=1e-3)
    first = "decoder.layers.0.self_attention."
    assert {f"{first}value.weight"} <= set(stay)
    assert set(stay) <= {
        f"{first}{name}" for name in ("query.weight", "query.bias", "key.weight", "key.bias", "value.weight")
    }


@pytest.mark.parametrize("boxes", [(0, 0), (1, 0)])
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_frames_without_radar_or_boxes_give_finite_losses(boxes, phase):
    model, batch = petr_model(phase=phase), make_batch(boxes=boxes)
    batch = replace(batch, radar_points=None, radar_batch=None)
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = petr_model(), make_batch()
    for sample, camera in missing:
        batch.image_valid[sample, camera] = False
        batch.pix_from_aug[sample, camera] = 0.0
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    model.eval()
    before = model(batch)[0]
    for sample, camera in missing:
        batch.images[sample, camera] = 255 - batch.images[sample, camera]
    assert torch.equal(before.head.logits, model(batch)[0].head.logits)
    batch.images[1, 3] = 255 - batch.images[1, 3]
    assert torch.equal(before.head.logits, model(batch)[0].head.logits) == (missing == EVERY)


def test_two_samples_do_not_mix():
    samples_do_not_mix(petr_model().eval(), make_batch(points=(150, 40), seed=3), make_batch)


def test_what_is_remembered_is_seen_and_old_frames_too():
    model = petr_model(phase="phase2").eval()
    batch = drive(2)
    logits = [model(batch, memory)[0].head.logits for memory in (None, fill(model, 1), fill(model, 2))]
    assert logits[0].shape[1] == 32 + 8
    assert not torch.equal(logits[0], logits[1]) and not torch.equal(logits[1], logits[2])


@pytest.mark.parametrize("name", [field.name for field in fields(PETRLossConfig)])
def test_weights_multiply_and_null_switches_a_term_off(name):
    weight_multiplies_or_switches_off(petr_model().eval(), make_batch(), name, TERMS)


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_autocast_keeps_positions_and_losses_in_float32(phase):
    model, batch = petr_model(phase=phase), make_batch()
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = model(batch)
        terms = model.loss(output, batch).terms
    terms["total"].backward()
    assert output.head.codes.dtype == output.head.logits.dtype == torch.float32
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())
    assert gradients_are_finite(model)


def test_images_and_annotations_are_needed_where_they_are():
    model, batch = petr_model(phase="phase2"), make_batch()
    output, memory = model(batch)
    with pytest.raises(ValueError, match="FrameBatch.boxes is None"):
        model.loss(output, replace(batch, boxes=None))
    with pytest.raises(ValueError, match="FrameBatch.images is None"):
        model(replace(batch, images=None))
    with pytest.raises(ValueError, match="2 streams, but the batch 1 frames"):
        model(make_batch(points=(9,), boxes=(0,)), memory)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.decoder.num_heads=3", "model.decoder.num_heads=3.*divide model.channels=32"),
        ("model.decoder.num_layers=0", "num_layers=0"),
        ("model.image_stride_px=5", r"stride \[8, 16, 32\] px, but the model asks for \[5\]"),
        ("model.position.num_depth_bins=0", "num_depth_bins=0"),
        ("model.position.depth_range_m=[2,1]", "depth_range_m"),
        ("model.position.z_range_m=[1]", "model.position.z_range_m"),
        ("model.loss.class_weight=-1", "model.loss.class_weight=-1"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        petr_model(overrides)


def test_it_needs_a_backbone():
    config, _ = compose_config([*SMALL, "phase=phase1"])
    with pytest.raises(ConfigError, match="backbone=null: model=petr"):
        build_model(config.model, GRID, None, config.phase.options)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 34e6, 44e6), ("mini", 2.0e6, 3.0e6), ("debug", 0, 1e6)])
def test_sizes_stand_beside_horizon3ds(scale, low, high):
    """40.6 M and 2.4 M parameters there."""
    from src.assembly import build_model as build

    config, _ = compose_config([f"scale={scale}", "model=petr", "phase=phase1", "data.root=x"])
    count = sum(p.numel() for p in build(config).parameters())
    assert low < count < high, count


@pytest.mark.slow
def test_two_frames_are_overfitted():
    """Over 0.9 AP at one cell, averaged over the classes present."""
    model, batch = petr_model(), make_batch(boxes=(5, 4))
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    steps = 300
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 3e-3 * min(1.0, (steps - step) / 150)
        train_step(model, batch)
        torch.nn.utils.clip_grad_norm_(model.parameters(), 35.0)
        optimizer.step()
    with torch.no_grad():
        found = model.decode(model(batch)[0])  # in training mode: two frames are all the statistics there are
    precision = np.mean([average_precision(found, batch.boxes, label) for label in range(5)])
    assert precision > 0.9, precision
