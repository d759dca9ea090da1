"""Minimum-cost assignment of rows to columns (Hungarian method by shortest augmenting paths)."""

from __future__ import annotations

import numpy as np

Array = np.ndarray

HIGHEST = 1e9
"""Stands for costs that are not finite: a loss that has diverged must reach the check of the step, not loop here."""


def assign(
    cost: Array,  # [n, m]
) -> tuple[Array, Array]:  # [k] int64 rows, ascending, [k] int64 columns; k = min(n, m)
    """Pairs of rows and columns, each in one pair at most, whose costs have the least sum (Jonker and Volgenant)."""
    cost = np.nan_to_num(np.asarray(cost, np.float64), nan=HIGHEST, posinf=HIGHEST, neginf=-HIGHEST)
    if cost.shape[0] > cost.shape[1]:
        columns, rows = assign(cost.T)
        order = rows.argsort()
        return rows[order], columns[order]
    owners = np.full(cost.shape[1], -1)  # row of each column
    row_price, column_price = np.zeros(cost.shape[0]), np.zeros(cost.shape[1])
    for row in range(len(cost)):
        _augment(row, cost, owners, row_price, column_price)
    columns = np.flatnonzero(owners >= 0)
    order = owners[columns].argsort()
    return owners[columns][order], columns[order]


def _augment(row: int, cost: Array, owners: Array, row_price: Array, column_price: Array) -> None:
    """Give a row a column along the shortest path of reduced costs; what lies on the path moves on. In place."""
    shortest, before = np.full(len(owners), np.inf), np.full(len(owners), -1)
    done = np.zeros(len(owners), bool)
    current, column, length = row, -1, 0.0
    while current >= 0:
        reduced = length + cost[current] - row_price[current] - column_price
        nearer = ~done & (reduced < shortest)
        shortest[nearer], before[nearer] = reduced[nearer], column
        column = int(np.argmin(np.where(done, np.inf, shortest)))
        length = shortest[column]
        done[column] = True
        current = owners[column]
    passed = done.copy()
    passed[column] = False
    row_price[row] += length
    row_price[owners[passed]] += length - shortest[passed]
    column_price[passed] -= length - shortest[passed]
    while column >= 0:
        owners[column] = row if before[column] < 0 else owners[before[column]]
        column = before[column]
