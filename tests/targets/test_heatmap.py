"""Head targets against OpenPCDet's own and against hand-made scenes."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from src.geometry.bev_grid import BEVGrid
from src.ops.sites import Sites
from src.structures.boxes import Boxes3D
from src.structures.taxonomy import CLASSES
from src.targets.heatmap import GROUP_OF_CLASS, HEAD_GROUPS, HeadTargets, gaussian_radius, head_targets

GRID = BEVGrid(cells=(384, 384), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
CASE = np.load(Path(__file__).parents[1] / "golden" / "voxelnext_head_targets" / "case.npz")
NAMES = json.loads(str(CASE["meta_json"]))["names"]
COLUMNS = [CLASSES.index(name) for name in NAMES]


def make_boxes(rows: np.ndarray | torch.Tensor, dtype: torch.dtype = torch.float64, **columns: torch.Tensor) -> Boxes3D:
    """Boxes from rows x, y, z, l, w, h, yaw, vx, vy, label."""
    rows = torch.as_tensor(rows).to(dtype).reshape(-1, 10)
    labels = rows[:, 9].long()
    return Boxes3D(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7:9], labels, torch.full_like(labels, -1), **columns)


def golden_boxes(dtype: torch.dtype) -> list[Boxes3D]:
    """The golden boxes with our class order, padding removed."""
    samples = []
    for rows in CASE["boxes"]:
        rows = rows[rows[:, 9] > 0].copy()
        rows[:, 9] = [COLUMNS[int(number) - 1] for number in rows[:, 9]]
        samples.append(make_boxes(rows, dtype))
    return samples


def golden_sites() -> Sites:
    """The golden cells."""
    return Sites.from_indices(torch.from_numpy(CASE["cells"].astype(np.int64)), (2, 384, 384))[0]


@pytest.mark.parametrize(
    ("dtype", "tolerance", "code_tolerance"), [(torch.float64, 1e-9, 1e-9), (torch.float32, 5e-5, 1e-4)]
)
def test_golden_targets(dtype: torch.dtype, tolerance: float, code_tolerance: float) -> None:
    sites = golden_sites()
    targets = head_targets(golden_boxes(dtype), sites, GRID)
    np.testing.assert_allclose(targets.heatmap[:, COLUMNS], CASE["heatmap"], rtol=0, atol=tolerance)
    first_row = torch.tensor([0, int(sites.indices()[:, 0].bincount(minlength=sites.shape[0])[0])])
    batch = sites.indices()[targets.rows, 0]
    for group in range(len(HEAD_GROUPS)):
        for sample in range(2):
            mine = (targets.groups == group) & (batch == sample)
            mask = CASE[f"g{group}/mask"][sample]
            assert (targets.rows[mine] - first_row[sample]).tolist() == CASE[f"g{group}/row"][sample][mask].tolist()
            expected = CASE[f"g{group}/target"][sample][mask]
            np.testing.assert_allclose(targets.codes[mine], expected, rtol=0, atol=code_tolerance)
    assert targets.num_distant == 0 and targets.num_shared == 2


def test_golden_boxes_without_a_near_cell_change_nothing() -> None:
    sites, boxes = golden_sites(), golden_boxes(torch.float64)
    before = head_targets(boxes, sites, GRID)
    rows = CASE["far_boxes"].copy()
    rows[:, 9] = [COLUMNS[int(number) - 1] for number in rows[:, 9]]
    far = make_boxes(rows)
    both = [torch.cat([getattr(boxes[0], name), getattr(far, name)]) for name in ("centers", "sizes", "yaws")]
    rest = [torch.cat([getattr(boxes[0], name), getattr(far, name)]) for name in ("velocities", "labels", "attributes")]
    after = head_targets([Boxes3D(*both, *rest), boxes[1]], sites, GRID)
    assert after.num_distant == len(far)
    assert torch.equal(after.heatmap, before.heatmap)
    assert torch.equal(after.rows, before.rows)


@pytest.mark.parametrize("overlap", [0.1, 0.5, 0.7])
def test_golden_radius(overlap: float) -> None:
    length, width = torch.from_numpy(CASE["radius/lw"]).double().unbind(1)
    expected = CASE[f"radius/overlap_{overlap}"]
    np.testing.assert_allclose(gaussian_radius(length, width, overlap), expected, rtol=0, atol=1e-9)


def dense_oracle(boxes: list[Boxes3D], sites: Sites) -> tuple[list[int], torch.Tensor]:
    """Section 7 word by word, one object and one cell at a time."""
    cells = sites.indices()
    heatmap = torch.zeros(len(cells), 12, dtype=torch.float64)
    assigned = []
    for sample, table in enumerate(boxes):
        for k in range(len(table)):
            gx, gy = ((table.centers[k, :2] + 153.6) / 0.8).tolist()
            distances = {
                row: (int(col) - gx) ** 2 + (int(iy) - gy) ** 2
                for row, (b, iy, col) in enumerate(cells.tolist())
                if b == sample
            }
            best = min(distances, key=lambda row: (distances[row], row), default=None)
            if best is None or distances[best] > 64:
                continue
            assigned.append(best)
            sigma = (2 * max(2, int(gaussian_radius(*(table.sizes[k, :2] / 0.8), 0.1))) + 1) / 6
            for row in distances:
                offset = (cells[row] - cells[best]).double().square().sum().item()
                value = np.exp(-min(offset, distances[row]) / (2 * sigma**2))
                heatmap[row, table.labels[k]] = max(value, heatmap[row, table.labels[k]].item())
    return assigned, heatmap


def random_scene(seed: int, objects: int = 12, cells: int = 150) -> tuple[list[Boxes3D], Sites]:
    """Two samples of objects of every size near a patch of cells that touches the grid's corner."""
    generator = torch.Generator().manual_seed(seed)
    boxes = []
    for _ in range(2):
        rows = torch.rand(objects, 10, generator=generator, dtype=torch.float64)
        rows[:, :2] = rows[:, :2] * 40 - 153.6
        rows[:, 3:6] = 0.3 + rows[:, 3:6] * torch.tensor([16.0, 3.0, 3.0])
        rows[:, 9] = torch.randint(0, 12, (objects,), generator=generator)
        boxes.append(make_boxes(rows))
    indices = torch.randint(0, 60, (cells, 3), generator=generator)
    indices[:, 0] %= 2
    return boxes, Sites.unique(indices, (2, 384, 384))[0]


@pytest.mark.parametrize("seed", range(3))
def test_equals_a_direct_evaluation(seed: int) -> None:
    boxes, sites = random_scene(seed)
    targets = head_targets(boxes, sites, GRID)
    rows, heatmap = dense_oracle(boxes, sites)
    assert targets.rows.tolist() == rows
    torch.testing.assert_close(targets.heatmap, heatmap, rtol=0, atol=1e-10)


def test_ties_go_to_the_lowest_key_and_the_cell_is_exactly_one() -> None:
    sites, _ = Sites.from_indices(torch.tensor([[0, 10, 12], [0, 12, 10], [0, 10, 8], [0, 8, 10]]), (1, 384, 384))
    box = make_boxes(torch.tensor([[-153.6 + 8, -153.6 + 8, 0.5, 4, 2, 1.5, 0, 1, 2, 0]]), torch.float64)
    targets = head_targets([box], sites, GRID)
    assert sites.indices()[targets.rows].tolist() == [[0, 8, 10]]
    assert targets.heatmap[targets.rows, 0].tolist() == [1.0]
    assert int((targets.heatmap == 1).sum()) == 1


def test_boxes_that_supervise_nothing() -> None:
    sites, _ = Sites.from_indices(torch.tensor([[0, 192, 192], [0, 383, 383]]), (1, 384, 384))
    good = [0.1, 0.1, 0.5, 4, 2, 1.5, 0.3, float("nan"), float("nan"), 0]
    outside, unseen, flat, broken = list(good), list(good), list(good), list(good)
    outside[0], flat[4], broken[6] = 153.7, 0.0, float("inf")
    table = make_boxes(torch.tensor([good, outside, unseen, flat, broken]), torch.float32)
    table.num_points = torch.tensor([3, 5, 0, 5, 5])
    targets = head_targets([table], sites, GRID)
    assert len(targets.rows) == 1 and targets.num_distant == 0
    assert targets.codes[0, :8].isfinite().all() and targets.codes[0, 8:].isnan().all()


@pytest.mark.parametrize(("cells", "objects"), [(0, 3), (5, 0), (0, 0)])
def test_empty_inputs(cells: int, objects: int) -> None:
    indices = torch.stack([torch.zeros(cells), torch.arange(cells), torch.arange(cells)], 1).long()
    rows = torch.tensor([[0.0, 0, 0, 4, 2, 1, 0, 0, 0, 0]]).repeat(objects, 1)
    targets = head_targets(
        [make_boxes(rows, torch.float32), Boxes3D.empty()], Sites.from_indices(indices, (2, 384, 384))[0], GRID
    )
    assert targets.heatmap.shape == (cells, 12) and targets.codes.shape == (0, 10)
    assert float(targets.heatmap.sum()) == 0 and targets.num_distant == objects


def test_no_more_than_500_objects_of_a_group() -> None:
    sites, _ = Sites.from_indices(torch.tensor([[0, 192, 192], [1, 192, 192]]), (2, 384, 384))
    many = torch.tensor([[0.0, 0, 0, 4, 2, 1, 0, 0, 0, 0]]).repeat(520, 1)
    many[::2, 9] = 1
    many[:, 2] = torch.arange(520)
    one_class = many.clone()
    one_class[:, 9] = 5
    targets = head_targets([make_boxes(one_class), make_boxes(many)], sites, GRID)
    sample = sites.indices()[targets.rows, 0]
    assert torch.bincount(sample).tolist() == [500, 520]
    assert targets.codes[sample == 0, 2].tolist() == list(range(500))
    assert targets.num_shared == 1020


TURNS = {
    "flip x": torch.tensor([[-1.0, 0.0], [0.0, 1.0]]),
    "flip y": torch.tensor([[1.0, 0.0], [0.0, -1.0]]),
    "quarter turn": torch.tensor([[0.0, -1.0], [1.0, 0.0]]),
    "half turn": torch.tensor([[-1.0, 0.0], [0.0, -1.0]]),
}


@pytest.mark.parametrize("turn", TURNS)
def test_augmentation_moves_targets_with_the_scene(turn: str) -> None:
    """A cell stands for its lower corner here, so equivariance holds for the lattice of corners, exactly."""
    generator = torch.Generator().manual_seed(3)
    indices = torch.cat([torch.zeros(300, 1), torch.randint(170, 215, (300, 2), generator=generator)], 1).long()
    sites, _ = Sites.unique(indices, (1, 384, 384))
    rows = torch.rand(9, 10, generator=generator, dtype=torch.float64)
    rows[:, :2] = rows[:, :2] * 30 - 15
    rows[:, 3:6] = 0.4 + rows[:, 3:6] * torch.tensor([8.0, 2.0, 2.0])
    rows[:, 9] = torch.arange(9)
    boxes = make_boxes(rows)
    aug_from_ego = torch.eye(4, dtype=torch.float64)
    aug_from_ego[:2, :2] = TURNS[turn]

    corners = sites.indices()[:, 1:].flip(1).double() - 192
    moved = (corners @ TURNS[turn].double().T + 192).long().flip(1)
    moved_sites, order = Sites.from_indices(torch.cat([sites.indices()[:, :1], moved], 1), (1, 384, 384))
    before, after = head_targets([boxes], sites, GRID), head_targets([boxes.transform(aug_from_ego)], moved_sites, GRID)
    torch.testing.assert_close(after.heatmap, before.heatmap[order], rtol=0, atol=1e-9)
    assert torch.equal(order[after.rows], before.rows)
    expected = torch.cat([before.codes[:, :2], before.codes[:, 6:8], before.codes[:, 8:]], 1).reshape(9, 3, 2)
    expected = (expected @ TURNS[turn].double().T).reshape(9, 6)
    found = torch.cat([after.codes[:, :2], after.codes[:, 6:8], after.codes[:, 8:]], 1)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.codes[:, 2:6], before.codes[:, 2:6])


def test_groups_hold_every_class_once() -> None:
    assert sorted(name for group in HEAD_GROUPS for name in group) == sorted(CLASSES)
    assert [CLASSES[i] in HEAD_GROUPS[group] for i, group in enumerate(GROUP_OF_CLASS)] == [True] * 12
    assert HeadTargets.__dataclass_fields__.keys() >= {"heatmap", "rows"}
