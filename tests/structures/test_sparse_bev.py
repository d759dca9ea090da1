import pytest
import torch

from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV, SparseMap


def bev(cells: list[list[int]], features: torch.Tensor, shape: tuple[int, ...] = (2, 3, 4)) -> SparseBEV:
    sites, order = Sites.from_indices(torch.tensor(cells, dtype=torch.int64).reshape(-1, 3), shape)
    return SparseBEV(sites, features[order])


def test_dense_map_holds_each_row_at_its_cell() -> None:
    sparse = bev([[1, 2, 3], [0, 0, 1]], torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    dense = sparse.to_dense()
    assert dense.shape == (2, 2, 3, 4) and sparse.batch_size == 2 and sparse.channels == 2 and len(sparse) == 2
    assert sparse.indices.tolist() == [[0, 0, 1], [1, 2, 3]]
    assert dense[1, :, 2, 3].tolist() == [1, 2] and dense[0, :, 0, 1].tolist() == [3, 4]
    assert dense.count_nonzero() == 4


def test_three_dimensional_maps_become_dense_too() -> None:
    sites, _ = Sites.from_indices(torch.tensor([[1, 1, 2, 3]]), (2, 2, 3, 4))
    dense = SparseMap(sites, torch.tensor([[5.0]])).to_dense()
    assert dense.shape == (2, 1, 2, 3, 4) and dense[1, 0, 1, 2, 3] == 5 and dense.count_nonzero() == 1


def test_a_dense_map_hands_its_gradient_to_the_rows() -> None:
    features = torch.tensor([[1.0], [2.0]], requires_grad=True)
    dense = bev([[0, 0, 0], [1, 2, 3]], features).to_dense()
    assert dense[1, 0, 2, 3] == 2 and dense[0, 0, 2, 3] == 0 and dense[0, 0, 0, 0] == 1
    dense.sum().backward()
    assert features.grad.tolist() == [[1], [1]]


def test_union_fills_the_absent_side_with_zeros() -> None:
    left = torch.tensor([[1.0], [2.0]], requires_grad=True)
    a = bev([[0, 0, 0], [1, 1, 1]], left)
    b = bev([[0, 2, 2], [1, 1, 1], [1, 2, 0]], torch.tensor([[10.0, 1.0], [20.0, 2.0], [30.0, 3.0]]))
    first, second = a.union(b)
    assert isinstance(first, SparseBEV) and first.sites is second.sites
    assert first.indices.tolist() == [[0, 0, 0], [0, 2, 2], [1, 1, 1], [1, 2, 0]]
    assert first.features.tolist() == [[1], [0], [2], [0]]
    assert second.features.tolist() == [[0, 0], [10, 1], [20, 2], [30, 3]]
    (first.features * torch.arange(1.0, 5.0)[:, None]).sum().backward()
    assert left.grad.tolist() == [[1], [3]]


def test_empty_maps_work() -> None:
    empty = bev([], torch.zeros(0, 1))
    full = bev([[1, 1, 1]], torch.ones(1, 1))
    assert not empty.to_dense().any() and empty.to_dense().shape == (2, 1, 3, 4)
    first, second = empty.union(full)
    assert first.features.tolist() == [[0]] and second.features.tolist() == [[1]]


def test_what_does_not_fit_is_refused() -> None:
    sites, _ = Sites.from_indices(torch.tensor([[0, 0, 0]]), (1, 3, 4))
    with pytest.raises(ValueError, match=r"SparseBEV.features must be \[1, C\], but got \[2, 5\]"):
        SparseBEV(sites, torch.zeros(2, 5))
    cube, _ = Sites.from_indices(torch.tensor([[0, 0, 0, 0]]), (1, 3, 4, 5))
    with pytest.raises(ValueError, match="batch, rows, cols"):
        SparseBEV(cube, torch.zeros(1, 5))
    with pytest.raises(ValueError, match="different grids"):
        bev([[0, 0, 0]], torch.zeros(1, 1)).union(bev([[0, 0, 0]], torch.zeros(1, 1), shape=(2, 3, 5)))
