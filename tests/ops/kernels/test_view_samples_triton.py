import pytest
import torch

from src.ops.view_samples import (
    view_attention_weights,
    view_attention_weights_reference,
    view_sampling_locations,
    view_sampling_locations_reference,
)
from tests.ops.view_cases import BAND_M, HEADS, SIZE_PX, make_case


@pytest.mark.parametrize(("queries", "points"), [(0, 5), (11, 5), (140, 13)])
def test_places(device, queries, points):
    points, heights, matrices, valid, *_ = make_case(queries, points)
    given = [x.to(device) for x in (points, heights, matrices, valid)]
    places, visible = view_sampling_locations(*given[:2], BAND_M, *given[2:], SIZE_PX)
    expected = view_sampling_locations_reference(points, heights, BAND_M, matrices, valid, SIZE_PX)
    assert torch.equal(visible.cpu(), expected[1])
    torch.testing.assert_close(places.cpu(), expected[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("queries", "points"), [(0, 5), (11, 5), (140, 13)])
def test_weights(device, queries, points):
    *_, logits, camera, visible = make_case(queries, points)
    found = view_attention_weights(*(x.to(device) for x in (logits, camera, visible)), HEADS).cpu()
    torch.testing.assert_close(
        found, view_attention_weights_reference(logits, camera, visible, HEADS), rtol=1e-4, atol=1e-6
    )
