"""What of PETR no other query detector has: cameras alone, anchors, mistakes in its settings."""

from dataclasses import replace

import pytest

from src.errors import ConfigError
from tests.models.frames import make_batch
from tests.models.learning import gradients_are_finite, parameters_that_stay, train_step
from tests.models.query_frames import small_model


def test_every_parameter_learns():
    assert parameters_that_stay(small_model("petr"), make_batch(boxes=(12, 12)), lr=1e-3) == []


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_frames_need_no_radar(phase):
    model, batch = small_model("petr", phase=phase), make_batch()
    batch = replace(batch, radar_points=None, radar_batch=None)
    output, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    assert model.diagnostics(output)["queries"] == 32


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.image_stride_px=5", r"stride \[8, 16, 32\] px, but the model asks for \[5\]"),
        ("model.position.num_depth_bins=0", "num_depth_bins=0"),
        ("model.position.depth_range_m=[2,1]", "depth_range_m"),
        ("model.position.z_range_m=[1]", "model.position.z_range_m"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        small_model("petr", overrides)
