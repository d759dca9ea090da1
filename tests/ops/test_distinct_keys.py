import pytest
import torch

from src.ops.distinct_keys import distinct_keys, grouped_keys

KEYS = torch.tensor([7, 3, 90, 3, 50, 12, 7])  # from 50 on there is no cell


@pytest.mark.parametrize(("size", "wanted"), [(6, [3, 7, 12, 50, 50, 50]), (4, [3, 7, 12, 50]), (3, [3, 7, 12])])
def test_distinct_keys_by_hand(size, wanted):
    assert distinct_keys(KEYS, 50, size).tolist() == wanted


def test_groups_by_hand():
    found, rows, groups = grouped_keys(KEYS, 50, 6)
    assert found.tolist() == [3, 7, 12, 50, 50, 50]
    assert rows[[0, 1, 3, 5, 6]].tolist() == [1, 0, 0, 2, 1] and (rows[[2, 4]] >= 3).all()
    assert groups.order.tolist() == [1, 3, 0, 6, 5, 4, 2] and groups.starts.tolist() == [0, 2, 4, 5, 5, 5, 5]


def test_rows_stay_within_places_that_are_too_few():
    found, rows, _ = grouped_keys(KEYS, 50, 2)
    assert found.tolist() == [3, 7] and rows.tolist() == [1, 0, 1, 0, 1, 1, 1]
