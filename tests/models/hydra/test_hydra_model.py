"""What is HyDRa's own: its terms, cameras that are not there, types, bad settings, fusion, memory."""

import re
from dataclasses import replace

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.models.backbones.bev_decoder import SqueezeFuser
from src.models.hydra.model import HyDRaConfig
from tests.models.dense_bev.dense_frames import GRID, drive, fill, make_batch, pose
from tests.models.hydra.hydra_frames import hydra_model
from tests.models.learning import (
    gradients_are_finite,
    missing_cameras_do_not_matter,
    train_step,
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


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = hydra_model(), make_batch()
    output, terms = missing_cameras_do_not_matter(model, batch, missing)
    if missing == EVERY:
        assert output.views.num_lifted == terms["depth"] == 0


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
