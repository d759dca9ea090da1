import pytest
import torch
import torch.nn.functional as F

from src.ops.concat_conv import concat_conv2d


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("present", [1, 2, 3])
def test_agrees_with_the_convolution_of_the_concatenation(present, bias):
    """Values and gradients; of three maps the last may be missing."""
    torch.manual_seed(0)
    maps = [torch.randn(2, 4, 5, 6, dtype=torch.float64, requires_grad=True) for _ in range(present)]
    weight = torch.randn(7, 12, 1, 1, dtype=torch.float64, requires_grad=True)
    offset = torch.randn(7, dtype=torch.float64, requires_grad=True) if bias else None
    leaves = [*maps, weight, *([offset] if bias else [])]
    pull = torch.randn(2, 7, 5, 6, dtype=torch.float64)
    results = []
    whole = [*maps, *[torch.zeros(2, 4, 5, 6, dtype=torch.float64)] * (3 - present)]
    for out in (concat_conv2d(iter(maps), weight, offset), F.conv2d(torch.cat(whole, dim=1), weight, offset)):
        results.append((out, *torch.autograd.grad((out * pull).sum(), leaves)))
    torch.testing.assert_close(*results)


def test_maps_of_unequal_width():
    torch.manual_seed(0)
    maps = [torch.randn(1, width, 3, 4, dtype=torch.float64) for width in (5, 1, 3)]
    weight = torch.randn(2, 9, 1, 1, dtype=torch.float64)
    torch.testing.assert_close(concat_conv2d(maps, weight, None), F.conv2d(torch.cat(maps, dim=1), weight))
    with pytest.raises(ValueError, match="at most 9 channels, but got 12"):
        concat_conv2d([*maps, maps[-1]], weight, None)


def test_nothing_to_convolve():
    with pytest.raises(ValueError, match="at least one"):
        concat_conv2d([], torch.ones(1, 1, 1, 1), None)
