"""Compiled optimal assignment by shortest augmenting paths, for a dozen to hundreds of targets."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.compilation import njit


@njit(cache=True, nogil=True)
def assign(cost, rows, columns):  # type: ignore[no-untyped-def]
    """Assign every row to a different column at the lowest total cost (Jonker and Volgenant, 1987; Crouse, 2016).

    Args:
        cost: Finite costs, shape (>= rows, >= columns); only the leading block is used.
        rows: Number of rows, at most `columns`.
        columns: Number of columns.

    Returns:
        The column of each row, shape (rows,), int64.
    """
    row_price = np.zeros(rows)
    column_price = np.zeros(columns)
    row_of = np.full(columns, -1, np.int64)
    column_of = np.full(rows, -1, np.int64)
    shortest = np.empty(columns)
    previous = np.empty(columns, np.int64)
    done_rows = np.empty(rows, np.bool_)
    done_columns = np.empty(columns, np.bool_)
    for start in range(rows):
        shortest[:] = np.inf
        done_rows[:] = False
        done_columns[:] = False
        row, length, sink = start, 0.0, -1
        while sink < 0:
            done_rows[row] = True
            nearest, best = -1, np.inf
            for column in range(columns):
                if done_columns[column]:
                    continue
                path = length + cost[row, column] - row_price[row] - column_price[column]
                if path < shortest[column]:
                    shortest[column] = path
                    previous[column] = row
                # Among equal columns a free one ends the search at once.
                if shortest[column] < best or (shortest[column] == best and row_of[column] < 0):
                    nearest, best = column, shortest[column]
            length = best
            done_columns[nearest] = True
            if row_of[nearest] < 0:
                sink = nearest
            else:
                row = row_of[nearest]
        row_price[start] += length
        for other in range(rows):
            if done_rows[other] and other != start:
                row_price[other] += length - shortest[column_of[other]]
        for column in range(columns):
            if done_columns[column]:
                column_price[column] -= length - shortest[column]
        column = sink
        while True:
            row = previous[column]
            row_of[column] = row
            column, column_of[row] = column_of[row], column
            if row == start:
                break
    return column_of
