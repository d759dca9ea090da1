"""What of SpaRC no other query detector has: its terms without cameras, its diagnostics, mistakes in its settings."""

import pytest
import torch

from src.errors import ConfigError
from tests.models.frames import make_batch
from tests.models.learning import parameters_that_stay, train_step
from tests.models.query_frames import small_model


def test_every_parameter_learns():
    assert parameters_that_stay(small_model("sparc"), make_batch(boxes=(12, 12)), lr=1e-3) == []


def test_without_cameras_their_terms_are_zero_and_their_queries_padding():
    model, batch = small_model("sparc"), make_batch()
    batch.image_valid[:] = False
    batch.pix_from_aug[:] = 0.0
    output, terms = train_step(model, batch)
    assert terms["depth"] == terms["keypoint"] == 0 and not output.proposals.queries.valid[:, 40:48].any()
    found = model.diagnostics(output)
    assert found["radar_points"] == len(output.radar.bev) / 2 and found["queries"] <= 48


def test_layers_predict_relative_to_where_queries_began_and_look_where_the_last_one_predicted():
    model, batch = small_model("sparc").eval(), make_batch()
    with torch.no_grad():
        model.head.box[-1].weight.zero_()
        model.head.box[-1].bias[:3] = torch.tensor([3.0, -2.0, 0.5])
    looked = []
    for layer in model.decoder.layers:
        layer.register_forward_pre_hook(lambda _, arguments: looked.append(arguments[0].centers))
    output, _ = model(batch)
    began = output.proposals.queries.centers
    moved = began + torch.tensor([3.0, -2.0, 0.5])
    torch.testing.assert_close(torch.stack(looked), torch.stack([began, moved]))
    torch.testing.assert_close(torch.stack([one.codes[..., :3] for one in output.layers]), torch.stack([moved, moved]))


def test_autocast_keeps_places_in_float32():
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = small_model("sparc")(make_batch())
    assert output.radar.means.dtype == torch.float32


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.channels=6", "model.channels=6.*multiple of 4"),
        ("model.radar_encoder.num_heads=3", "model.radar_encoder.num_heads=3.*divide"),
        ("model.fusion.image_stride_px=4", r"image_stride_px=4.*\[8, 16, 32\]"),
        ("model.queries.num_radar=0", "num_radar=0"),
        ("model.queries.keypoint_nms_cells=2", "keypoint_nms_cells=2.*odd"),
        ("model.queries.depth_range_m=[2,1]", "depth_range_m"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        small_model("sparc", overrides)
