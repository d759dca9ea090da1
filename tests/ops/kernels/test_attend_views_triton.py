import pytest
import torch

from src.ops.backend import implementation
from src.ops.deform_sample import attend_views_reference


@pytest.mark.parametrize(("samples", "queries"), [(2, 5), (1, 0)])
@pytest.mark.parametrize("last", [False, True])
def test_sums(device, samples, queries, last):
    """Channels first and last in memory; points beyond every edge of the image, and far away."""
    draw = torch.Generator().manual_seed(samples + queries)
    views, heads, points = 3, 2, 4
    images = [torch.randn(samples * views, 6, *size, generator=draw) for size in ((6, 8), (3, 4))]
    if last:
        images = [image.contiguous(memory_format=torch.channels_last) for image in images]
    places = 2.6 * torch.rand(samples * views, queries, points, 2, generator=draw) - 1.3
    places[:, ::4, 0] = -3.0
    weights = torch.rand(samples, queries, heads, views, len(images), points, generator=draw)
    moved = ([image.to(device) for image in images], places.to(device), weights.to(device))
    ours = implementation(attend_views_reference)(*moved).cpu()
    torch.testing.assert_close(ours, attend_views_reference(images, places, weights), rtol=1e-5, atol=1e-5)
