"""The whole of HyDRa: gradients, bad input, samples and cameras that must not matter, memory, learning, sizes."""

import re
from dataclasses import fields, replace

import pytest
import torch
from torch import nn

from src.config import compose_config
from src.errors import ConfigError
from src.models import build_model
from src.models.backbones.bev_decoder import SqueezeFuser
from src.models.hydra.model import HyDRaConfig, HyDRaLossConfig
from tests.models.dense_bev.dense_frames import GRID, drive, fill, make_batch, pose
from tests.models.hydra.hydra_frames import SMALL, hydra_model
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

TERMS = {"heatmap", "box", "depth", "foreground", "total"}
EVERY = [(b, n) for b in range(2) for n in range(4)]
ADDED = re.compile(HyDRaConfig.new_in_temporal_phase)


def test_named_terms_and_one_entry_per_sample():
    model, batch = hydra_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert output.fused_bev.shape == (2, 16, *GRID.cells) and output.foreground_logits.shape == (2, *GRID.cells)
    assert len(model.eval().decode(model(batch)[0])) == 2
    found = model.diagnostics(output)
    assert found["lifted_pairs"] == output.views.num_lifted / 2 and found["foreground_cells"] == 0.0


def test_every_parameter_learns():
    assert parameters_that_stay(hydra_model(), make_batch(boxes=(12, 12)), lr=1e-3) == []


@pytest.mark.parametrize(
    "shape", [{"points": (0, 0)}, {"points": (150, 0)}, {"boxes": (0, 0)}, {"points": (1,), "boxes": (1,)}]
)
def test_empty_inputs_give_finite_losses(shape):
    model, batch = hydra_model(), make_batch(**shape)
    _, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    assert len(model.eval().decode(model(batch)[0])) == len(batch)


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = hydra_model(), make_batch()
    output, terms = missing_cameras_do_not_matter(model, batch, missing)
    if missing == EVERY:
        assert output.views.num_lifted == terms["depth"] == 0


def test_two_samples_do_not_mix():
    samples_do_not_mix(hydra_model().eval(), make_batch(points=(150, 40), seed=3), make_batch)


@pytest.mark.parametrize("name", [field.name for field in fields(HyDRaLossConfig)])
def test_weights_multiply_and_null_switches_a_term_off(name):
    weight_multiplies_or_switches_off(hydra_model().eval(), make_batch(), name, TERMS)


def test_autocast_keeps_positions_and_losses_in_float32():
    model, batch = hydra_model(), make_batch()
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = model(batch)
        terms = model.loss(output, batch).terms
    terms["total"].backward()
    kept = (output.views.bev, output.foreground_logits, output.head.logits)
    assert all(value.dtype == torch.float32 for value in kept)
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())
    assert gradients_are_finite(model)


def test_images_and_annotations_are_needed_where_they_are():
    model, batch = hydra_model(), make_batch()
    images_and_annotations_are_needed(model, batch)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.view_transform.attention_heads=3", "attention_channels=8.*multiple of attention_heads=3"),
        ("model.refinement.num_queries=0", "model.refinement.num_queries=0"),
        ("model.refinement.num_queries=4000", "num_queries=4000.*3072 cells"),
        ("model.refinement.num_points=0", "model.refinement.num_points=0"),
        ("model.fused_channels=18", "model.fused_channels=18.*multiple of 4"),
        ("model.loss.foreground_weight=-1", "model.loss.foreground_weight=-1"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        hydra_model(overrides)


def test_it_needs_a_backbone():
    config, _ = compose_config([*SMALL, "phase=phase1"])
    with pytest.raises(ConfigError, match="backbone=null: model=hydra"):
        build_model(config.model, GRID, None, config.phase.options)


def test_channels_are_weighted_by_the_means_of_all():
    torch.manual_seed(0)
    fuser, camera, radar = SqueezeFuser(5, 8).eval(), torch.randn(2, 2, 5, 6), torch.randn(2, 3, 5, 6)
    joined = torch.cat([camera, radar], 1)
    with torch.no_grad():
        first, _, last = fuser.excitation
        weight = last(first(joined.flatten(2).mean(2)).clamp(min=0)).sigmoid()
        wanted = fuser.conv((joined * weight.view(2, 5, 1, 1)).permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
        torch.testing.assert_close(fuser(camera, radar), fuser.norm(wanted).clamp(min=0))


# ---------------------------------------------------------------- memory


@pytest.fixture
def pair():
    """A phase-1 model and the phase-2 model that took its weights."""
    first, second = hydra_model(seed=1), hydra_model(phase="phase2", seed=3)
    new = second.load_state_dict(first.state_dict(), strict=False)
    assert new.missing_keys and all(ADDED.match(key) for key in new.missing_keys) and not new.unexpected_keys
    return first, second


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("steps", [0, 1, 3])
def test_untrained_memory_leaves_phase_1_to_the_last_bit(pair, training, steps):
    first, second = (model.train(training) for model in pair)
    memory, batch = fill(second, steps), drive(steps)
    second.load_state_dict(first.state_dict(), strict=False)  # batch statistics
    one, two = first(batch)[0], second(batch, memory)[0]
    assert torch.equal(one.head.logits, two.head.logits) and first(batch)[1] is None
    assert second.diagnostics(two)["remembered_frames"] == min(steps, 2)


def test_a_clip_that_starts_forgets_and_so_does_a_jump(pair):
    """The stream that starts anew detects as without a past, the other with it."""
    model = pair[1].eval()
    nn.init.normal_(model.temporal.norm.weight)
    memory, batch = fill(model, 3), drive(3)
    late = replace(batch, timestamps_s=batch.timestamps_s + 100.0)
    far = replace(batch, global_from_ego=torch.stack([pose(1000.0), pose(2000.0)]))
    with torch.no_grad():
        both, nothing, half = (
            model(batch, past)[0].head.logits.view(2, -1, 12)
            for past in (memory, None, memory.select(torch.tensor([0, 1]), torch.tensor([True, False])))
        )
        assert not model(late, memory)[0].warped_maps.usable.any()
        assert not model(far, memory)[0].warped_maps.usable.any()
    assert not torch.allclose(both[0], nothing[0]) and not torch.allclose(both[1], nothing[1])
    torch.testing.assert_close(half[0], both[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(half[1], nothing[1], rtol=1e-4, atol=1e-4)


def test_what_is_remembered_is_the_refined_map_without_its_graph(pair):
    output, memory = pair[1].train()(drive(0))
    (frame,) = memory.frames
    assert not frame.cells.requires_grad and output.fused_bev.requires_grad
    assert torch.equal(frame.cells, output.fused_bev.detach().permute(0, 2, 3, 1).to(torch.bfloat16))


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 36e6, 48e6), ("mini", 2.4e6, 3.0e6), ("debug", 0, 1e6)])
def test_sizes_stand_beside_horizon3ds(scale, low, high):
    """40.6 M and 2.4 M parameters there."""
    from src.assembly import build_model as build

    config, _ = compose_config([f"scale={scale}", "model=hydra", "phase=phase1", "data.root=x"])
    assert low < sum(p.numel() for p in build(config).parameters()) < high


@pytest.mark.slow
def test_two_frames_are_overfitted():
    """Over 0.9 AP at one cell, averaged over the classes present."""
    model, batch = hydra_model(), make_batch(boxes=(5, 4))
    assert overfitted_precision(model, batch, 140, 4e-3, 100) > 0.9
