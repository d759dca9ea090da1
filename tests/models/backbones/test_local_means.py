import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from src.geometry.bev_grid import BEVGrid
from src.models.backbones.local_means import LocalMeans
from src.models.backbones.sparse_voxel import POINT_SCALES
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV

GRID = BEVGrid(cells=(12, 16), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
SCALES = torch.tensor(POINT_SCALES)
ROW, COL = 5, 7


def layer() -> LocalMeans:
    torch.manual_seed(0)
    return LocalMeans(SCALES, GRID, channels=4)


def sites(cells: list[tuple[int, int, int]], samples: int = 1) -> SparseBEV:
    found, _ = Sites.from_indices(torch.tensor(cells), (samples, *GRID.cells))
    return SparseBEV(found, torch.zeros(len(found), 4))


def point(row: int, col: int, velocity: tuple[float, float] = (0.0, 0.0), rcs: float = 0.0) -> Tensor:
    centre = GRID.centre_of(torch.tensor([row, col]))
    return torch.tensor([*centre.tolist(), 1.0, rcs, *velocity, 0.25])


def measured(bev: SparseBEV, points: list[Tensor], samples: list[int] | None = None) -> Tensor:
    batch = torch.tensor(samples if samples is not None else [0] * len(points))
    return layer().measure(bev, torch.stack(points), batch)


def test_one_point_in_a_lonely_cell() -> None:
    found = measured(sites([(0, ROW, COL)]), [point(ROW, COL, (-30.0, 10.0), rcs=5.0)])
    speeds = [-30 / 20, 10 / 20]
    assert found[0].tolist() == pytest.approx(
        [0, 0, 1 / 5, 5 / 20, *speeds, 0.25 / 0.5, *speeds, math.log(2)], abs=1e-5
    )


def test_a_moving_point_decides_the_weighted_velocity() -> None:
    bev = sites([(0, ROW, COL)])
    standing = [point(ROW, COL, (0.05, 0.0)) for _ in range(4)]
    found = measured(bev, [*standing, point(ROW, COL, (30.0, 0.0))])[0]
    assert found[4].item() == pytest.approx((30 + 4 * 0.05) / 5 / 20, rel=1e-5)
    assert found[7].item() == pytest.approx(30 / 20, rel=0.01)


def test_a_neighbour_is_seen_from_its_side() -> None:
    found = measured(sites([(0, ROW, COL), (0, ROW, COL + 1)]), [point(ROW, COL + 1, (8.0, 0.0))])
    assert found[:, 0].tolist() == pytest.approx([1.0, 0.0], abs=1e-5)  # one cell ahead of the first, in the second
    assert found[:, 4].tolist() == pytest.approx([0.4, 0.4])


def test_more_of_the_same_points_change_only_the_weight() -> None:
    bev = sites([(0, ROW, COL), (0, ROW + 1, COL), (0, ROW + 1, COL + 1)])
    points = [point(ROW, COL, (20.0, 1.0)), point(ROW + 1, COL + 1, (25.0, -1.0), rcs=3.0)]
    once, often = measured(bev, points), measured(bev, 7 * points)
    assert torch.allclose(once[:, :-1], often[:, :-1], atol=1e-5)
    assert torch.allclose(often[:, -1].expm1(), 7 * once[:, -1].expm1(), rtol=1e-4)


def test_window_against_dense_sums() -> None:
    random = torch.Generator().manual_seed(3)
    cells = (torch.rand(2, *GRID.cells, generator=random) < 0.5).nonzero()
    found, _ = Sites.from_indices(cells, (2, *GRID.cells))
    bev = SparseBEV(found, torch.zeros(len(found), 4))
    count = 90
    low = torch.tensor([GRID.x_min_m, GRID.y_min_m, -3.0, -10.0, -30.0, -30.0, 0.0])
    points = low + torch.rand(count, 7, generator=random) * torch.tensor([12.8, 9.6, 8.0, 40.0, 60.0, 60.0, 0.5])
    batch = torch.randint(2, (count,), generator=random)
    means = layer().measure(bev, points, batch)

    active = torch.zeros(2, 1, *GRID.cells)
    active[cells[:, 0], 0, cells[:, 1], cells[:, 2]] = 1
    # Columns of the sums: number of points, x, vx, the norm of the velocity, its product with vy.
    sums = torch.zeros(2, 5, *GRID.cells, dtype=torch.float64)
    for row, sample in zip(points.double(), batch.tolist(), strict=True):
        cell_row, cell_col = GRID.cell_of(row[:2].float()).tolist()
        speed = row[4:6].norm()
        sums[sample, :, cell_row, cell_col] += torch.stack([speed / speed, row[0], row[4], speed, speed * row[5]])
    kernel = torch.ones(5, 1, 3, 3, dtype=torch.float64)
    for _ in range(2):
        sums = F.conv2d(sums * active, kernel, padding=1, groups=5)
    number, x, vx, speed, product = sums[cells[:, 0], :, cells[:, 1], cells[:, 2]].unbind(1)
    seen = number > 0
    assert seen.sum() > 50
    centre = GRID.centre_of(cells[:, 1:])[:, 0]
    assert torch.allclose(means[seen, 0].double(), ((x / number - centre) / 0.8)[seen], atol=1e-4)
    assert torch.allclose(means[seen, 4].double(), (vx / number / 20)[seen], atol=1e-5)
    assert torch.allclose(means[seen, 8].double(), (product / speed / 20)[seen], atol=1e-4)
    assert torch.allclose(means[:, 9].double(), number.log1p(), atol=1e-5)
    assert (means[~seen] == 0).all()


def test_samples_do_not_mix() -> None:
    bev = sites([(0, ROW, COL), (1, ROW, COL)], samples=2)
    found = measured(bev, [point(ROW, COL, (9.0, 0.0)), point(ROW, COL, (-9.0, 0.0))], [0, 1])
    assert found[:, 7].tolist() == pytest.approx([0.45, -0.45])


@pytest.mark.parametrize(
    "points",
    [torch.zeros(0, 7), torch.tensor([[500.0, 0, 0, 0, 30, 0, 0]]), point(1, 1, (30.0, 0.0))[None]],
    ids=["none", "outside the grid", "in a cell without a site"],
)
def test_without_a_point_near(points: Tensor) -> None:
    bev = sites([(0, ROW, COL)])
    embed = layer()
    batch = torch.zeros(len(points), dtype=torch.int64)
    assert (embed.measure(bev, points, batch) == 0).all()
    out = embed(bev, points, batch)
    assert torch.equal(out.features, embed.embed.bias[None])
    assert len(embed(sites([(0, 1, 1)]).with_features(torch.ones(1, 4)), points, batch)) == 1


def test_an_empty_map_keeps_its_parameters_in_the_graph() -> None:
    embed = layer()
    nothing, _ = Sites.from_indices(torch.zeros(0, 3, dtype=torch.int64), (1, *GRID.cells))
    out = embed(SparseBEV(nothing, torch.zeros(0, 4)), point(ROW, COL)[None], torch.zeros(1, dtype=torch.int64))
    out.features.sum().backward()
    assert len(out) == 0 and embed.embed.weight.grad is not None
