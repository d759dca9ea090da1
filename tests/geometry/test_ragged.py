import torch

from src.geometry.ragged import enumerate_items, enumerate_windows


def test_items_stand_end_to_end():
    owners, positions = enumerate_items(torch.tensor([2, 0, 3]))
    assert owners.tolist() == [0, 0, 2, 2, 2] and positions.tolist() == [0, 1, 0, 1, 2]
    assert [len(part) for part in enumerate_items(torch.zeros(0, dtype=torch.int64))] == [0, 0]


def test_windows_are_row_major_and_may_be_empty_or_negative():
    low = torch.tensor([[3, 1], [5, 5], [-1, 0]])
    high = torch.tensor([[4, 2], [4, 9], [0, 0]])
    window, row, col = enumerate_windows(low, high)
    found = list(zip(window.tolist(), row.tolist(), col.tolist(), strict=True))
    assert found == [(0, 1, 3), (0, 1, 4), (0, 2, 3), (0, 2, 4), (2, 0, -1), (2, 0, 0)]
