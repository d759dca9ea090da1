import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.models.heads.decode import ATTRIBUTE_RULES
from src.models.layers.doppler import Doppler
from src.ops.box_codes import decoded_boxes, decoded_boxes_reference
from tests.models.radial import MEASURED

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(8.0, 0.0), z_range_m=(-3.0, 5.0))


@pytest.mark.parametrize(("radar", "turned"), [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize(("count", "points"), [(0, 60), (300, 60), (300, 0)])
def test_boxes(device, count, points, radar, turned):
    draw = torch.Generator().manual_seed(count + points)
    seen = torch.rand(points, 7, generator=draw) * torch.tensor([12.8, 9.6, 1, 1, 80, 80, 1])
    moved = seen - torch.tensor([-1.6, 4.8, 0, 0, 40, 40, 0])
    doppler = Doppler.measure(moved, torch.arange(points) % 2, GRID, MEASURED)
    codes = 2 * torch.randn(count, 12, generator=draw)  # wider than a box code
    codes[:, 8:10] *= torch.tensor([0.1, 1.0, 20.0])[torch.arange(count) % 3, None]
    codes[::5, 6:8] = codes[::5, 8:10]  # ahead, and not at all
    codes[:1, 6:8] = 0.0
    indices = torch.stack([torch.arange(70) % 2, torch.arange(70) % 12, torch.arange(70) % 16], dim=1)
    rows, labels = torch.randint(0, 70, (count,), generator=draw), torch.arange(count) % 12
    inputs = (codes, rows, indices, labels, torch.rand(count, generator=draw))
    measured = (doppler.keys, doppler.velocities)
    given = measured if radar else None
    wanted = decoded_boxes_reference(*inputs, 0.3, GRID, ATTRIBUTE_RULES, given, turned)
    given = tuple(x.to(device) for x in given) if radar else None
    found = decoded_boxes(*(x.to(device) for x in inputs), 0.3, GRID, ATTRIBUTE_RULES, given, turned).cpu()
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)
    if count and turned:
        straight = decoded_boxes_reference(
            *inputs, 0.3, GRID, ATTRIBUTE_RULES, (doppler.keys, doppler.velocities), False
        )
        assert (wanted[:, 7:9] != straight[:, 7:9]).any(1).float().mean() > 0.1
