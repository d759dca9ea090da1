"""The whole dense detector: one forward and backward, empty inputs, sample isolation, sizes, learning."""

from dataclasses import fields

import pytest
import torch
import torch.nn.functional as F

from src.assembly import build_model
from src.config import compose_config
from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models import FAMILIES
from src.models.backbones.bev_decoder import BEVDecoder, BEVDecoderConfig
from src.models.backbones.image import NeckName
from src.models.camera_radar import CameraRadarLossConfig
from src.models.dense_bev.model import DenseBEV, DenseBEVConfig
from src.structures.boxes import Boxes3D
from tests.models.dense_bev.dense_frames import dense_config, dense_model, memory_config
from tests.models.frames import GRID, backbone, make_batch
from tests.models.learning import (
    autocast_step,
    gradients_are_finite,
    little_input_gives_finite_losses,
    overfitted_precision,
    parameters_that_stay,
    samples_do_not_mix,
    train_step,
    weight_multiplies_or_switches_off,
)

STEPS = 140
TERMS = {"heatmap", "box", "depth", "total"}


def test_shapes_named_terms_and_one_entry_per_sample():
    model, batch = dense_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert output.lifted.bev.shape == (2, 12, 48, 64) and output.lifted.depth_logits.shape == (2, 4, 16, 4, 6)
    assert output.radar_bev.shape == (2, 8, 48, 64) and output.fused_bev.shape == (2, 16, 48, 64)
    assert output.head.logits.shape == (2 * 48 * 64, 12) and len(output.head.bev) == 2 * 48 * 64
    for value in (output.lifted.bev, output.radar_bev, output.fused_bev):
        assert value.is_contiguous(memory_format=torch.channels_last)
    assert output.head.bev.features.is_contiguous()  # cells are rows without a copy
    boxes = model.eval().decode(model(batch)[0])
    assert len(boxes) == 2 and all(isinstance(b, Boxes3D) and b.scores is not None for b in boxes)


@pytest.mark.parametrize("changes", [{}, {"image_stride_px": 8}, {"neck": NeckName.secondfpn16}])
def test_every_parameter_learns(changes):
    model, batch = dense_model(**changes), make_batch(boxes=(12, 12))  # every class, hence every branch of the head
    assert parameters_that_stay(model, batch, lr=1e-3) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        {"points": (0, 0)},
        {"points": (150, 0)},
        {"boxes": (0, 0)},
        {"points": (0, 120), "boxes": (0, 5)},
        {"points": (1,), "boxes": (1,)},
    ],
)
@pytest.mark.parametrize("temporal", [None, memory_config()])
def test_empty_inputs_give_finite_losses(shape, temporal):
    model, batch = dense_model(temporal=temporal), make_batch(**shape)
    little_input_gives_finite_losses(model, batch)


@pytest.mark.parametrize("missing", [[(0, 1)], [(b, n) for b in range(2) for n in range(4)]])
def test_missing_cameras(missing):
    model, batch = dense_model(), make_batch()
    for sample, camera in missing:
        batch.image_valid[sample, camera] = False
        batch.pix_from_aug[sample, camera] = 0.0
        batch.images[sample, camera] = 0
    output, terms = train_step(model, batch)
    assert all(value.isfinite() for value in terms.values()) and gradients_are_finite(model)
    assert len(missing) == 1 or (output.lifted.num_lifted == 0 and float(terms["depth"].detach()) == 0.0)


def test_what_a_missing_camera_shows_does_not_matter():
    model, batch = dense_model().eval(), make_batch()
    batch.image_valid[:, 2] = False
    before = model(batch)[0]
    batch.images[:, 2] = 255 - batch.images[:, 2]
    after = model(batch)[0]
    assert torch.equal(before.head.logits, after.head.logits)
    assert torch.equal(model.loss(before, batch).terms["depth"], model.loss(after, batch).terms["depth"])


def test_two_samples_do_not_mix():
    samples_do_not_mix(dense_model().eval(), make_batch(points=(150, 0), seed=3), make_batch)


@pytest.mark.parametrize("name", [field.name for field in fields(CameraRadarLossConfig)])
def test_weights_multiply_and_null_switches_a_term_off(name):
    weight_multiplies_or_switches_off(dense_model().eval(), make_batch(), name, TERMS)


@pytest.mark.parametrize("temporal", [None, memory_config()])
def test_autocast_keeps_positions_and_losses_in_float32(temporal):
    model, batch = dense_model(temporal=temporal), make_batch()
    output = autocast_step(model, batch)
    assert output.lifted.bev.dtype == output.radar_bev.dtype == output.head.logits.dtype == torch.float32
    assert output.fused_bev.dtype == torch.bfloat16


def test_sites_made_in_inference_serve_a_backward_pass():
    model, batch = dense_model(), make_batch()
    with torch.inference_mode():
        model.eval().decode(model(batch)[0])
    train_step(model.train(), batch)
    assert gradients_are_finite(model)


def test_diagnostics_count_pillars_pairs_frames_and_objects():
    model, batch = dense_model(temporal=memory_config()), make_batch(points=(150, 0))
    output, _ = model(batch)
    found = {name: float(value) for name, value in model.diagnostics(output).items()}
    assert 0 < found["pillars"] <= 75 and found["remembered_frames"] == 0.0
    assert found["lifted_pairs"] == output.lifted.num_lifted / 2 and 1 / 16 <= found["depth_confidence"] <= 1
    assert "objects" not in found
    assert model.loss(output, batch).diagnostics["objects"] == 5.0
    memory = model(batch)[1]
    later = make_batch()
    later.timestamps_s += 0.5
    assert model.diagnostics(model(later, memory)[0])["remembered_frames"] == 1.0


def test_images_and_annotations_are_needed_where_they_are():
    model, batch = dense_model(), make_batch()
    output, _ = model(batch)
    batch.boxes = None
    with pytest.raises(ValueError, match="FrameBatch.boxes is None"):
        model.loss(output, batch)
    batch.images = None
    with pytest.raises(ValueError, match="FrameBatch.images is None"):
        model(batch)


def test_relations_between_parts_are_named():
    with pytest.raises(ConfigError, match="backbone=null"):
        DenseBEV(dense_config(), GRID, None, 0.2)
    with pytest.raises(ConfigError, match=r"secondfpn16.*\[16\].*\[8\]"):
        DenseBEV(dense_config(image_stride_px=8), GRID, backbone(NeckName.secondfpn16), 0.2)
    odd = BEVGrid(cells=(48, 62), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    with pytest.raises(ConfigError, match=r"grid.cells=\[48, 62\].*multiple of 4"):
        DenseBEV(dense_config(), odd, backbone(), 0.2)
    for lists, message in ((([16], [2, 2]), "same length"), (([16, 8], [2, 2]), "at least 16"), (([], []), "same")):
        with pytest.raises(ConfigError, match=message):
            BEVDecoderConfig(stage_channels=lists[0], stage_strides=lists[1], blocks_per_stage=1)
    with pytest.raises(ConfigError, match="blocks_per_stage=0"):
        BEVDecoderConfig(stage_channels=[16], stage_strides=[2], blocks_per_stage=0)
    with pytest.raises(ConfigError, match="depth_weight=-1"):
        dense_config(depth_weight=-1.0)


@pytest.mark.parametrize("strides", [[2], [1, 2], [4, 2], [2, 2, 2]])
def test_the_decoder_comes_back_to_every_cell(strides):
    config = BEVDecoderConfig(stage_channels=[16, 24, 16][: len(strides)], stage_strides=strides, blocks_per_stage=1)
    decoder = BEVDecoder(config, 16, 5, GRID)
    x = torch.randn(2, 16, 48, 64)
    y = decoder(x)
    assert y.shape == (2, 5, 48, 64)
    y.sum().backward()
    assert gradients_are_finite(decoder)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "low", "high"), [("paper", 36e6, 46e6), ("mini", 2.4e6, 3.0e6), ("debug", 0, 1e6)])
def test_sizes_stand_beside_horizon3ds(scale, low, high):
    """40.6 M and 2.4 M parameters there (phase 1); the memory adds little."""
    config, _ = compose_config([f"scale={scale}", "model=dense_bev", "phase=phase2", "data.root=x"])
    assert type(config.model) is DenseBEVConfig and FAMILIES["dense_bev"] == (DenseBEVConfig, DenseBEV)
    parts = {name: sum(p.numel() for p in part.parameters()) for name, part in build_model(config).named_children()}
    memory = parts.pop("temporal")
    assert low < sum(parts.values()) < high and 0 < memory < 0.05 * sum(parts.values()) + 1e4


@pytest.mark.parametrize("phase", ["phase1", "phase2"])
def test_phase_1_has_no_memory(phase):
    config, tree = compose_config(["scale=debug", "model=dense_bev", f"phase={phase}"])
    settings = config.model.temporal
    assert (settings is None) == (tree["model"]["temporal"] is None) == (phase == "phase1")
    assert config.model.memory_frames == (0 if settings is None else settings.num_frames)
    assert config.model.memory_max_age_s == (None if settings is None else 6.0)
    assert (build_model(config).temporal is None) == (settings is None)


@pytest.mark.exhaustive
def test_two_frames_can_be_learnt_by_heart():
    """Over 0.9 AP at one cell, averaged over the classes present."""
    assert overfitted_precision(dense_model(), make_batch(boxes=(5, 4)), STEPS, 4e-3, falling=100) > 0.9


def test_the_decoder_joins_the_finest_and_the_coarsest_stage():
    """The literal form: interpolate, concatenate, convolve."""
    torch.manual_seed(0)
    config = BEVDecoderConfig(stage_channels=[16, 24], stage_strides=[2, 2], blocks_per_stage=1)
    decoder = BEVDecoder(config, 16, 5, GRID).double()
    fused = torch.randn(2, 16, *GRID.cells, dtype=torch.float64)
    for training in (True, False):
        decoder.train(training)
        finest = decoder.stages[0](fused)
        coarsest = F.interpolate(decoder.stages[1](finest), size=finest.shape[-2:], mode="bilinear")
        joined = decoder.join(torch.cat([finest, coarsest], dim=1))
        joined = F.interpolate(joined, size=fused.shape[-2:], mode="bilinear")
        torch.testing.assert_close(decoder(fused), decoder.output(decoder.lateral(fused) + joined))
