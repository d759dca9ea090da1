"""What of Far3D no other query detector has: cameras alone, adaptive queries that count, mistakes in its settings."""

from dataclasses import replace

import pytest
import torch

from src.errors import ConfigError
from tests.models.frames import make_batch
from tests.models.learning import gradients_are_finite, parameters_that_stay, train_step
from tests.models.query_frames import small_model


def test_every_parameter_learns():
    """But for the first self-attention's keys where every feature begins at zero: those of adaptive queries do not."""
    model = small_model("far3d", "model.queries.score_threshold=0.01")
    assert parameters_that_stay(model, make_batch(boxes=(12, 12)), lr=1e-3) == []


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_frames_need_no_radar(phase):
    model, batch = small_model("far3d", phase=phase), make_batch()
    batch = replace(batch, radar_points=None, radar_batch=None)
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)


@torch.no_grad()
def test_adaptive_queries_are_asked_beside_the_anchors():
    batch = make_batch()
    shy, eager = (small_model("far3d", f"model.queries.score_threshold={t}").eval() for t in (0.99, 0.01))
    outputs = [model(batch)[0] for model in (shy, eager)]
    few, many = (float(shy.diagnostics(output)["adaptive_queries"]) for output in outputs)
    assert few == 0 < many == float(outputs[1].adaptive.valid.sum()) / 2
    assert outputs[0].head.valid.sum() == 2 * 32 and outputs[1].head.valid.sum() == 2 * (32 + many)
    assert not torch.equal(outputs[0].head.logits[:, :32], outputs[1].head.logits[:, :32])  # they see one another


def test_without_cameras_their_terms_are_zero():
    model, batch = small_model("far3d"), make_batch()
    batch.image_valid[:] = False
    batch.pix_from_aug[:] = 0.0
    _, terms = train_step(model, batch)
    assert terms["depth"] == terms["keypoint"] == 0


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.channels=6", "model.channels=6.*multiple of 4"),
        ("model.num_queries=0", "num_queries=0"),
        ("model.decoder.num_points=0", "num_points=0"),
        ("model.queries.score_threshold=0", "score_threshold=0"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        small_model("far3d", overrides)
