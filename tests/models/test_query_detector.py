"""What every query detector must do: bad input, samples that must not mix, memory, weights, learning, sizes."""

from dataclasses import fields

import pytest
import torch

from src.assembly import build_model as full_model
from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from tests.models.frames import GRID, drive, fill, make_batch
from tests.models.learning import (
    autocast_step,
    gradients_are_finite,
    images_and_annotations_are_needed,
    little_input_gives_finite_losses,
    missing_cameras_do_not_matter,
    overfitted_precision,
    samples_do_not_mix,
    train_step,
    weight_multiplies_or_switches_off,
)
from tests.models.query_frames import FAMILIES, settings, small_model

TERMS = {name: {"class", "box", "total"} for name in FAMILIES}
TERMS["far3d"] |= {"keypoint", "depth"}
TERMS["sparc"] |= {"keypoint", "depth", "heatmap"}
MILLIONS = {
    "far3d": {"paper": (34, 46), "mini": (2.0, 3.0)},
    "petr": {"paper": (34, 44), "mini": (2.0, 3.0)},
    "rctrans": {"paper": (50, 65), "mini": (2.0, 3.0)},
    "sparc": {"paper": (34, 44), "mini": (2.3, 3.0)},
}
OVERFITTING = {
    "far3d": (240, 150, 2e-3),
    "petr": (300, 150, 3e-3),
    "rctrans": (240, 150, 2e-3),
    "sparc": (240, 150, 2e-3),
}
"""Steps, how many before the end the rate begins to fall, and the rate."""
EVERY = [(b, n) for b in range(2) for n in range(4)]

pytestmark = pytest.mark.parametrize("family", FAMILIES)


def weights_of(family):
    return [field.name for field in fields(settings(family).model.loss) if field.name != "denoising_weight"]


def test_named_terms_of_every_layer_and_one_entry_per_sample(family):
    model, batch = small_model(family), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS[family] and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert len(output.layers) == model.config.decoder.num_layers == 2
    assert len(model.eval().decode(model(batch)[0])) == 2


@pytest.mark.parametrize(
    "shape", [{"points": (0, 0)}, {"points": (150, 0)}, {"boxes": (0, 0)}, {"points": (1,), "boxes": (1,)}]
)
@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_empty_inputs_give_finite_losses(family, shape, phase):
    model, batch = small_model(family, phase=phase), make_batch(**shape)
    little_input_gives_finite_losses(model, batch)


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(family, missing):
    model, batch = small_model(family), make_batch()
    missing_cameras_do_not_matter(model, batch, missing)
    before = model(batch)[0]
    batch.images[1, 3] = 255 - batch.images[1, 3]
    assert torch.equal(before.head.logits, model(batch)[0].head.logits) == (missing == EVERY)


def test_two_samples_do_not_mix(family):
    samples_do_not_mix(small_model(family).eval(), make_batch(points=(150, 40), seed=3), make_batch)


def test_what_is_remembered_is_seen_and_old_frames_too(family):
    model = small_model(family, phase="phase2").eval()
    batch, kept = drive(2), model.config.temporal.queries_per_frame
    outputs = [model(batch, memory)[0] for memory in (None, fill(model, 1), fill(model, 2))]
    nothing, last, both = (output.head.logits for output in outputs)
    assert len(nothing[0]) == len(small_model(family)(batch)[0].head.logits[0]) + kept
    assert not torch.equal(nothing, last) and not torch.equal(last, both)
    assert [float(model.diagnostics(output)["remembered_frames"]) for output in outputs] == [0, 1, 2]


def test_by_how_much_the_logits_of_a_frame_differ_is_of_its_queries_alone(family):
    """Of the first sample 1 and 5 are valid, of the second one query is."""
    model = small_model(family).eval()
    with torch.no_grad():
        output, _ = model(make_batch())
    valid, logits = output.head.valid.zero_(), output.head.logits.fill_(torch.nan)
    valid[0, :2] = valid[1, 2] = True
    logits[0, 0], logits[0, 1], logits[1, 2] = 1.0, 5.0, 7.0
    told = model.diagnostics(output)
    assert (float(told["logit_spread"]), float(told["queries"])) == (1.0, 1.5)


def test_weights_multiply_and_null_switches_a_term_off(family):
    for name in weights_of(family):
        weight_multiplies_or_switches_off(small_model(family).eval(), make_batch(), name, TERMS[family])
        with pytest.raises(ConfigError, match=f"model.loss.{name}=-1"):
            small_model(family, f"model.loss.{name}=-1")


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_autocast_keeps_boxes_and_losses_in_float32(family, phase):
    model, batch = small_model(family, phase=phase), make_batch()
    output = autocast_step(model, batch)
    assert output.head.codes.dtype == output.head.logits.dtype == torch.float32


def test_what_is_missing_or_does_not_fit_is_refused(family):
    model, batch = small_model(family, phase="phase2"), make_batch()
    _, memory = model(batch)
    images_and_annotations_are_needed(model, batch)
    with pytest.raises(ValueError, match="2 streams, but the batch 1 frames"):
        model(make_batch(points=(9,), boxes=(0,)), memory)
    config = settings(family)
    with pytest.raises(ConfigError, match=f"backbone=null.*model={family}"):
        build_model(config.model, GRID, None, config.phase.options)
    for override, message in (("num_heads=3", "num_heads=3.*divide model.channels=32"), ("num_layers=0", "num_layers")):
        with pytest.raises(ConfigError, match=f"model.decoder.{message}"):
            small_model(family, f"model.decoder.{override}")
    with pytest.raises(ConfigError, match="max_boxes=501"):
        small_model(family, "model.head.max_boxes=501")


@pytest.mark.slow
@pytest.mark.parametrize("scale", ["paper", "mini"])
def test_sizes_stand_beside_horizon3ds(family, scale):
    """40.6 M and 2.4 M parameters there."""
    config, _ = compose_config([f"scale={scale}", f"model={family}", "phase=phase1", "data.root=x"])
    low, high = MILLIONS[family][scale]
    count = sum(parameter.numel() for parameter in full_model(config).parameters())
    assert 1e6 * low < count < 1e6 * high, count


@pytest.mark.slow
@pytest.mark.exhaustive
def test_two_frames_are_overfitted(family):
    """Over 0.9 AP at one cell, averaged over the classes present."""
    model, batch = small_model(family), make_batch(boxes=(5, 4))
    steps, falling, rate = OVERFITTING[family]
    assert overfitted_precision(model, batch, steps, rate, falling) > 0.9
