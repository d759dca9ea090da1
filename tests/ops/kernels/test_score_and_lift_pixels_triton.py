import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.score_and_lift_pixels import score_and_lift_pixels, score_and_lift_pixels_reference

GRID = BEVGrid(cells=(24, 20), cell_m=0.8, centre_m=(1.0, -2.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize(("bins", "size"), [(1, (3, 5)), (7, (9, 17))])
def test_scores_and_points(device, bins, size, channels_last):
    draw = torch.Generator().manual_seed(0)
    depths = 3 * torch.randn(2 * 3, bins, *size, generator=draw)
    depths[:, 0, 0], depths[:, -1, 1] = 20.0, 20.0  # the first bin and the last have one neighbour
    if channels_last:
        depths = depths.contiguous(memory_format=torch.channels_last)
    keypoints = torch.randn(2, 3, *size, generator=draw)
    matrices = torch.eye(4) + 0.1 * torch.randn(2, 3, 4, 4, generator=draw)
    matrices[..., :2, :] *= 0.15
    matrices = matrices.mT.contiguous().mT  # as an inverse lies in memory
    valid = torch.tensor([[True, True, False], [True, False, True]])
    inputs = (keypoints, depths.unflatten(0, (2, 3)), torch.linspace(2.0, 9.0, bins), matrices, valid)
    wanted = score_and_lift_pixels_reference(*inputs, (8 * size[0], 8 * size[1]), GRID, None)
    found = score_and_lift_pixels(*(x.to(device) for x in inputs), (8 * size[0], 8 * size[1]), GRID, None)
    for value, expected in zip(found, wanted, strict=True):
        torch.testing.assert_close(value.cpu(), expected, rtol=1e-5, atol=1e-4)
    assert 0 < (wanted[0] > 0).sum() < wanted[0][valid].numel()
