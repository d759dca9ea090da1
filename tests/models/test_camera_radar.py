"""What the dense detectors of radar and cameras share: bad input, samples apart, losses, learning, sizes."""

from dataclasses import fields

import pytest

from src.assembly import build_model as full_model
from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from src.models.crt_fusion.model import CRTFusionLossConfig
from src.models.hydra.model import HyDRaLossConfig
from tests.models.camera_radar_frames import settings, small_model
from tests.models.crt_fusion.test_crt_model import TERMS as CRT_TERMS
from tests.models.frames import GRID, make_batch
from tests.models.hydra.test_hydra_model import TERMS as HYDRA_TERMS
from tests.models.learning import (
    images_and_annotations_are_needed,
    little_input_gives_finite_losses,
    overfitted_precision,
    parameters_that_stay,
    samples_do_not_mix,
    weight_multiplies_or_switches_off,
)

FAMILIES = {
    "crt_fusion": (CRTFusionLossConfig, CRT_TERMS),
    "hydra": (HyDRaLossConfig, HYDRA_TERMS),
}
WEIGHTS = [(name, field.name) for name, (loss, _) in FAMILIES.items() for field in fields(loss)]


@pytest.fixture(params=FAMILIES)
def family(request):
    return request.param


@pytest.fixture
def model(family):
    return small_model(family)


def test_every_parameter_learns(model):
    assert parameters_that_stay(model, make_batch(boxes=(12, 12)), lr=1e-3) == []


@pytest.mark.parametrize(
    "shape", [{"points": (0, 0)}, {"points": (150, 0)}, {"boxes": (0, 0)}, {"points": (1,), "boxes": (1,)}]
)
def test_empty_inputs_give_finite_losses(model, shape):
    batch = make_batch(**shape)
    little_input_gives_finite_losses(model, batch)


def test_two_samples_do_not_mix(model):
    samples_do_not_mix(model.eval(), make_batch(points=(150, 40), seed=3), make_batch)


@pytest.mark.parametrize(("name", "weight"), WEIGHTS)
def test_weights_multiply_and_null_switches_a_term_off(name, weight):
    weight_multiplies_or_switches_off(small_model(name).eval(), make_batch(), weight, FAMILIES[name][1])


def test_images_and_annotations_are_needed_where_they_are(model):
    images_and_annotations_are_needed(model, make_batch())


def test_it_needs_a_backbone(family):
    config, _ = compose_config([*settings(family), "phase=phase1"])
    with pytest.raises(ConfigError, match=f"backbone=null: model={family}"):
        build_model(config.model, GRID, None, config.phase.options)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 36e6, 48e6), ("mini", 2.4e6, 3.0e6), ("debug", 0, 1e6)])
def test_sizes_stand_beside_horizon3ds(family, scale, low, high):
    """40.6 M and 2.4 M parameters there."""
    config, _ = compose_config([f"scale={scale}", f"model={family}", "phase=phase1", "data.root=x"])
    assert low < sum(p.numel() for p in full_model(config).parameters()) < high


@pytest.mark.slow
@pytest.mark.exhaustive
def test_two_frames_are_overfitted(model):
    """Over 0.9 AP at one cell, averaged over the classes present."""
    assert overfitted_precision(model, make_batch(boxes=(5, 4)), 140, 4e-3, 100) > 0.9
