"""Best assignments of rows to columns, at most one to one, by Murty's method.

Murty (1968), "An algorithm for ranking all the assignments in order of increasing cost", splits the set of assignments
without the best one into subproblems. Each differs from the solved problem in one row, so its solution is one shortest
augmenting path from there (Miller, Stone and Cox 1997, "Optimizing Murty's ranked assignment method"; Jonker and
Volgenant 1987).

A row may stay unassigned at cost 0: each row has a column of its own for that. Unassigned columns count as assigned to
identical dummy rows of cost 0, so that the problem is square and every subproblem has exactly one open column.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels, Mask

FREE, REMOVED, OPEN = range(-1, -4, -1)
"""Owners of a column without a row: a dummy row, a row that is fixed, or none at the moment."""


class Solution(NamedTuple):
    """Optimal assignment with its dual variables, changed in place; C = m + n columns.

    Attributes:
        match: Column of each row. Shape (n,).
        owner: Row of each column, or FREE, REMOVED, OPEN. Shape (C,).
        rows: Dual variables of the rows. Shape (n,).
        columns: Dual variables of the columns. Shape (C,).
        free: Dual variable that all free columns have. Shape (1,).
    """

    match: Labels
    owner: Labels
    rows: Array
    columns: Array
    free: Array


class Search(NamedTuple):
    """Work arrays of a search for the shortest path.

    Attributes:
        distance: Length of the shortest path to each column. Shape (C,).
        before: Row from which that path enters the column. Shape (C,).
        scanned: Mask of columns whose length is final. Shape (C,), bool.
        banned: Mask of columns that the source must not take. Shape (C,), bool.
    """

    distance: Array
    before: Labels
    scanned: Mask
    banned: Mask


class Nodes(NamedTuple):
    """Solved subproblems whose solutions are not yet listed.

    Attributes:
        total: Cost of the solution. Shape (K,).
        first: Rows before this one are fixed to their columns. Shape (K,).
        banned: Mask of columns that row `first` must not take. Shape (K, C), bool.
        match: Column of each row. Shape (K, n).
        rows: Dual variables of the rows. Shape (K, n).
        columns: Dual variables of the columns. Shape (K, C).
        free: Dual variable that all free columns have. Shape (K, 1).
    """

    total: Array
    first: Labels
    banned: Mask
    match: Labels
    rows: Array
    columns: Array
    free: Array


@njit(cache=True, nogil=True)
def longer(array):  # type: ignore[no-untyped-def]
    """Copy an array into one with twice as many rows; the new ones are uninitialized."""
    copy = np.empty((2 * array.shape[0], *array.shape[1:]), array.dtype)
    copy[: array.shape[0]] = array
    return copy


@njit(cache=True, nogil=True)
def _augment(cost, source, target, solution, search, limit):  # type: ignore[no-untyped-def]
    """Assign row `source` along a shortest augmenting path and keep the dual variables feasible.

    Args:
        cost: Costs, infinite if forbidden. Shape (n, C).
        source: The row without a column.
        target: The open column, at which the path ends; -1 for any free one.
        solution: A `Solution`, updated if there is a path.
        search: A `Search`.
        limit: Longest path of interest.

    Returns:
        Length of the path, which is the increase of the cost; infinite if there is none within the limit.
    """
    match, owner, rows, columns, free = solution
    distance, before, scanned, banned = search
    number = cost.shape[1]
    for c in range(number):
        distance[c] = np.inf
        before[c] = source
        scanned[c] = owner[c] == REMOVED
    row, reached, end = source, 0.0, -1
    entrance, entered = -1, 0.0
    while end < 0:
        for c in range(number):
            if scanned[c] or (row == source and banned[c]):
                continue
            if row == FREE:
                length = reached + (free[0] - columns[c])
            else:
                length = reached + (cost[row, c] - rows[row] - columns[c])
            if length < distance[c]:
                distance[c], before[c] = length, row
        nearest, reached = -1, np.inf
        for c in range(number):
            if not scanned[c] and distance[c] < reached:
                nearest, reached = c, distance[c]
        if nearest < 0 or reached > limit:
            return np.inf
        scanned[nearest] = True
        if nearest == target or (target < 0 and owner[nearest] == FREE):
            end = nearest
        elif owner[nearest] == FREE:
            # All dummy rows are alike, so every free column is as near as the first one.
            entrance, entered = nearest, reached
            for c in range(number):
                if owner[c] == FREE and not scanned[c]:
                    distance[c], scanned[c] = reached, True
            row = FREE
        else:
            row = owner[nearest]
    total = distance[end]
    rows[source] += total
    for c in range(number):
        if scanned[c] and c != end and owner[c] != REMOVED:
            columns[c] -= total - distance[c]
            if owner[c] >= 0:
                rows[owner[c]] += total - distance[c]
    if entrance >= 0:
        free[0] -= total - entered
    c = end
    while True:
        row = before[c]
        if row == FREE:
            owner[c], c = FREE, entrance
            continue
        previous = match[row]
        match[row], owner[c] = c, row
        if row == source:
            return total
        c = previous


@njit(cache=True, nogil=True)
def _cost_of(cost, match):  # type: ignore[no-untyped-def]
    """Sum of the costs of an assignment."""
    total = 0.0
    for row in range(match.shape[0]):
        total += cost[row, match[row]]
    return total


@njit(cache=True, nogil=True)
def _put(nodes, place, total, first, banned, solution):  # type: ignore[no-untyped-def]
    """Write a solved subproblem."""
    nodes.total[place], nodes.first[place] = total, first
    nodes.banned[place], nodes.match[place] = banned, solution.match
    nodes.rows[place], nodes.columns[place], nodes.free[place] = solution.rows, solution.columns, solution.free


@njit(cache=True, nogil=True)
def _take(nodes, place, last, parent, parent_banned):  # type: ignore[no-untyped-def]
    """Copy a subproblem to `parent` and fill its place with the last one: its total cost and its `first`."""
    total, first = nodes.total[place], nodes.first[place]
    parent.match[:], parent.rows[:], parent.columns[:] = nodes.match[place], nodes.rows[place], nodes.columns[place]
    parent.free[:], parent_banned[:] = nodes.free[place], nodes.banned[place]
    nodes.total[place], nodes.first[place] = nodes.total[last], nodes.first[last]
    nodes.banned[place], nodes.match[place] = nodes.banned[last], nodes.match[last]
    nodes.rows[place], nodes.columns[place], nodes.free[place] = nodes.rows[last], nodes.columns[last], nodes.free[last]
    return total, first


@njit(cache=True, nogil=True)
def _empty_solution(n, number):  # type: ignore[no-untyped-def]
    """Nothing assigned, all dual variables zero."""
    return Solution(
        np.full(n, -1, np.int64), np.full(number, FREE, np.int64), np.zeros(n), np.zeros(number), np.zeros(1)
    )


@njit(cache=True, nogil=True)
def _branch(parent, row, child):  # type: ignore[no-untyped-def]
    """Start a subproblem: rows before `row` are fixed, and the column of `row` is open."""
    child.match[:], child.rows[:], child.columns[:] = parent.match, parent.rows, parent.columns
    child.free[:], child.owner[:] = parent.free, FREE
    for i in range(parent.match.shape[0]):
        child.owner[parent.match[i]] = REMOVED if i < row else i
    child.owner[parent.match[row]] = OPEN


@njit(cache=True, nogil=True)
def best_assignments(cost, most, gap, limit):  # type: ignore[no-untyped-def]
    """Rank the assignments of rows to columns by their total cost.

    Args:
        cost: Cost of each pair, infinite if it is forbidden; an unassigned row costs 0. Shape (n, m).
        most: Largest number of assignments, at least 1. The time grows linearly with it.
        gap: Largest difference to the cost of the best assignment.
        limit: Largest total cost.

    Returns:
        Total costs, ascending (k,); column of each row, -1 for unassigned (k, n).
    """
    n, m = cost.shape
    number = m + n
    wide = np.full((n, number), np.inf)
    child, parent = _empty_solution(n, number), _empty_solution(n, number)
    search = Search(
        np.empty(number), np.empty(number, np.int64), np.empty(number, np.bool_), np.zeros(number, np.bool_)
    )
    parent_banned = np.zeros(number, np.bool_)
    for i in range(n):
        wide[i, m + i] = 0.0
        for j in range(m):
            wide[i, j] = cost[i, j]
        child.rows[i] = wide[i].min()
    for i in range(n):
        _augment(wide, i, -1, child, search, np.inf)
    best = _cost_of(wide, child.match)
    limit = min(limit, best + gap)
    found, totals, choices = 0, np.empty(4), np.empty((4, n), np.int64)
    nodes = Nodes(
        np.empty(4),
        np.empty(4, np.int64),
        np.empty((4, number), np.bool_),
        np.empty((4, n), np.int64),
        np.empty((4, n)),
        np.empty((4, number)),
        np.empty((4, 1)),
    )
    _put(nodes, 0, best, 0, parent_banned, child)
    active = 1 if best <= limit else 0
    while active > 0 and found < most:
        active -= 1
        total, first = _take(nodes, np.argmin(nodes.total[: active + 1]), active, parent, parent_banned)
        if found == totals.shape[0]:
            totals, choices = longer(totals), longer(choices)
        totals[found] = total
        for i in range(n):
            choices[found, i] = parent.match[i] if parent.match[i] < m else -1
        found += 1
        if found == most:
            break
        for i in range(first, n):
            place, bound = active, limit
            if active >= most - found:
                place = int(np.argmax(nodes.total[:active]))
                bound = min(bound, nodes.total[place])
            _branch(parent, i, child)
            if i == first:
                search.banned[:] = parent_banned
            else:
                search.banned[:] = False
            search.banned[parent.match[i]] = True
            if _augment(wide, i, parent.match[i], child, search, bound - total) == np.inf:
                continue
            if place == nodes.total.shape[0]:
                nodes = Nodes(
                    longer(nodes.total),
                    longer(nodes.first),
                    longer(nodes.banned),
                    longer(nodes.match),
                    longer(nodes.rows),
                    longer(nodes.columns),
                    longer(nodes.free),
                )
            _put(nodes, place, _cost_of(wide, child.match), i, search.banned, child)
            if place == active:
                active += 1
    return totals[:found], choices[:found]
