"""Places and weights of image attention without gradient are those of the layer that has one."""

import torch

from src.models.layers.image_attention import ImageCrossAttention
from src.models.layers.views import CameraViews
from src.ops.view_samples import BEYOND, view_attention_weights_reference, view_sampling_locations_reference
from tests.ops.view_cases import BAND_M, HEADS, SIZE_PX, make_case


def test_places_are_the_pixels_of_the_views():
    points, heights, matrices, valid, *_ = make_case()
    places, visible = view_sampling_locations_reference(points, heights, BAND_M, matrices, valid, SIZE_PX)
    low, high = BAND_M
    lifted = torch.cat([points, (low + (high - low) * heights.sigmoid())[..., None]], -1)
    pixels, expected = CameraViews([], matrices, valid, SIZE_PX).project(lifted)
    assert torch.equal(visible, expected) and 0.05 < visible.float().mean() < 0.9
    unit = (places.unflatten(0, valid.shape).transpose(1, 2) + 1) / 2 * torch.tensor([SIZE_PX[1], SIZE_PX[0]])
    torch.testing.assert_close(unit[visible], pixels[visible], rtol=1e-4, atol=1e-3)
    assert (places.unflatten(0, valid.shape).transpose(1, 2)[~visible] == BEYOND).all()


def test_weights_are_those_of_the_layer():
    *_, logits, camera, visible = make_case()
    b, q, n, p = visible.shape
    layer = ImageCrossAttention(8, p, n, camera.shape[2] // (HEADS * p))
    layer.logits = torch.nn.Identity()
    layer.logits.weight = torch.zeros(n * camera.shape[2], 8)
    weights = layer._weights(logits, torch.eye(4).expand(b, n, 4, 4), visible)
    torch.testing.assert_close(
        view_attention_weights_reference(logits, torch.zeros_like(camera), visible, HEADS), weights
    )
    shifted = logits + camera.flatten(1)[:, None]
    torch.testing.assert_close(
        view_attention_weights_reference(logits, camera, visible, HEADS),
        view_attention_weights_reference(shifted, torch.zeros_like(camera), visible, HEADS),
    )
