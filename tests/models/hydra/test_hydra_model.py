"""What is HyDRa's own: its terms, cameras that are not there, types, bad settings, fusion, memory."""

import pytest
import torch

from src.errors import ConfigError
from src.models.hydra.squeeze_fuser import SqueezeFuser
from tests.models.camera_radar_frames import hydra_model
from tests.models.frames import GRID, drive, make_batch
from tests.models.learning import autocast_step, gradients_are_finite, missing_cameras_do_not_matter, train_step

TERMS = {"heatmap", "box", "depth", "foreground", "total"}
EVERY = [(b, n) for b in range(2) for n in range(4)]


def test_named_terms_and_one_entry_per_sample():
    model, batch = hydra_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert output.fused_bev.shape == (2, 16, *GRID.cells) and output.foreground_logits.shape == (2, *GRID.cells)
    assert len(model.eval().decode(model(batch)[0])) == 2
    found = model.diagnostics(output)
    assert found["lifted_pairs"] == output.lifted.num_lifted / 2 and found["foreground_cells"] == 0.0


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = hydra_model(), make_batch()
    output, terms = missing_cameras_do_not_matter(model, batch, missing)
    if missing == EVERY:
        assert output.lifted.num_lifted == terms["depth"] == 0


def test_autocast_keeps_positions_and_losses_in_float32():
    model, batch = hydra_model(), make_batch()
    output = autocast_step(model, batch)
    kept = (output.lifted.bev, output.foreground_logits, output.head.logits)
    assert all(value.dtype == torch.float32 for value in kept)


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


def test_what_is_remembered_is_the_refined_map_without_its_graph():
    output, memory = hydra_model(phase="phase2").train()(drive(0))
    (frame,) = memory.frames
    assert not frame.cells.requires_grad and output.fused_bev.requires_grad
    assert torch.equal(frame.cells, output.fused_bev.detach().permute(0, 2, 3, 1).to(torch.bfloat16))
