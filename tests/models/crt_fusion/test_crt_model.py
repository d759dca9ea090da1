"""What is CRT-Fusion's own: its terms, cameras that are not there, types, bad settings."""

import pytest
import torch

from src.errors import ConfigError
from src.models.crt_fusion.model import GatedFuser
from tests.models.camera_radar_frames import crt_model
from tests.models.frames import GRID, make_batch
from tests.models.learning import autocast_step, gradients_are_finite, missing_cameras_do_not_matter, train_step

TERMS = {"heatmap", "box", "depth", "foreground", "occupancy", "velocity", "total"}
EVERY = [(b, n) for b in range(2) for n in range(4)]


def test_named_terms_and_one_entry_per_sample():
    model, batch = crt_model(), make_batch()
    output, terms = train_step(model, batch)
    assert set(terms) == TERMS and gradients_are_finite(model)
    torch.testing.assert_close(terms["total"], sum(v for k, v in terms.items() if k != "total"))
    assert output.fused_bev.shape == (2, 16, *GRID.cells) and output.lifted.foreground_logits.shape == (8, 4, 6)
    assert len(model.eval().decode(model(batch)[0])) == 2
    found = model.diagnostics(output)
    assert found["lifted_pairs"] == output.lifted.num_lifted / 2 and found["occupied_cells"] == 0.0


@pytest.mark.parametrize("missing", [EVERY[1:2], EVERY])
def test_missing_cameras(missing):
    model, batch = crt_model(), make_batch()
    output, terms = missing_cameras_do_not_matter(model, batch, missing)
    if missing == EVERY:
        assert output.lifted.num_lifted == terms["depth"] == terms["foreground"] == 0


def test_autocast_keeps_positions_and_losses_in_float32():
    model, batch = crt_model(), make_batch()
    output = autocast_step(model, batch)
    assert output.lifted.bev.dtype == output.motion.velocities.dtype == output.head.logits.dtype == torch.float32


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.view_transform.foreground_threshold=1.0", "foreground_threshold=1.0.*below 1"),
        ("model.view_transform.pillars_per_column=0", "pillars_per_column=0"),
        ("model.view_transform.depth_range_m=[2,1]", "depth_range_m"),
        ("model.fused_channels=8", "model.fused_channels=8.*at least 16"),
        ("model.loss.occupancy_weight=-1", "model.loss.occupancy_weight=-1"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        crt_model(overrides)


def test_gates_weigh_both_maps():
    torch.manual_seed(0)
    fuser = GatedFuser(2, 3, 4).eval()
    camera, radar = torch.randn(1, 2, 5, 6), torch.randn(1, 3, 5, 6)
    camera[:, :, 2] = 0.0  # nothing was lifted to this row
    flag = torch.ones(1, 1, 5, 6)
    flag[:, :, 2] = 0.0
    c, r = fuser.camera(torch.cat([camera, flag], 1)), fuser.radar(radar)
    gate = fuser.gates(c + r).sigmoid()
    torch.testing.assert_close(fuser(camera, radar), c * gate[:, :4] + r * gate[:, 4:])
