"""Reserve a target's action row for up to 5 scans after its track disappears.

A filter may drop a target that one scan missed and report it again in the next: the target then keeps its row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servotrack.estimators.rfs import RowAllocation, SetEstimate
from servotrack.estimators.rfs.sets import HELD, RowState
from servotrack.estimators.types import Array, Labels, Mask

RESERVED_SCANS = 5
"""Scans for which a row stays reserved for an identity that the filter no longer reports."""


class ReservedRows(NamedTuple):
    """Owners of the rows of an answer, N scenes.

    Attributes:
        rows: Identity that owns each row.
        absent: Scans since the filter last reported the row's identity. Shape (N, rows).
        states: Last reported state of the row's identity. Shape (N, rows, n).
    """

    rows: RowState
    absent: Labels
    states: Array


def no_rows(allocation: RowAllocation, scenes: int, n: int) -> ReservedRows:
    """Return the memory of scenes whose rows are all free; `n` is the size of a state."""
    shape = scenes, allocation.rows
    return ReservedRows(allocation.initial((scenes,)), np.zeros(shape, np.int64), np.zeros((*shape, n)))


def allocate_rows(allocation: RowAllocation, memory: ReservedRows, estimate: SetEstimate) -> tuple[ReservedRows, Array]:
    """Return an answer in which identities keep their rows over gaps of up to `RESERVED_SCANS` scans.

    Args:
        allocation: Gives identities rows.
        memory: Result of the last call, or of `no_rows`.
        estimate: Estimate of N scenes.

    Returns:
        The new memory, and the answer, shape (N, rows, 1 + d).
    """
    owners = memory.rows.label
    reported, _ = _find(owners, estimate)
    waiting = (owners > 0) & ~reported & (memory.absent < RESERVED_SCANS)
    extended = replace(
        estimate,
        held_labels=np.concatenate([estimate.held_labels, np.where(waiting, owners, 0)], axis=1),
        held_states=np.concatenate([estimate.held_states, memory.states], axis=1),
        held_existence=np.concatenate([estimate.held_existence, np.where(waiting, HELD, 0.0)], axis=1),
    )
    rows, answer = allocation.step(memory.rows, extended)
    reported, states = _find(rows.label, estimate)
    kept = (rows.label == owners) & (owners > 0)
    absent = np.where(kept & ~reported, memory.absent + 1, 0)
    return ReservedRows(rows, absent, np.where(reported[..., None], states, memory.states)), answer


def select_scene(memory: ReservedRows, k: int) -> ReservedRows:
    """Return the memory of scene `k`, with a leading axis of one."""
    return ReservedRows(RowState(memory.rows.label[k : k + 1]), memory.absent[k : k + 1], memory.states[k : k + 1])


def join_scenes(memories: Sequence[ReservedRows]) -> ReservedRows:
    """Concatenate the memories of several scenes."""
    return ReservedRows(
        RowState(np.concatenate([memory.rows.label for memory in memories])),
        np.concatenate([memory.absent for memory in memories]),
        np.concatenate([memory.states for memory in memories]),
    )


def _find(owners: Labels, estimate: SetEstimate) -> tuple[Mask, Array]:
    """Return which rows' identities the estimate holds, shape (N, rows), and their states, shape (N, rows, n)."""
    labels = np.concatenate([estimate.labels, estimate.held_labels], axis=1)
    states = np.concatenate([estimate.states, estimate.held_states], axis=1)
    if labels.shape[1] == 0:
        return np.zeros(owners.shape, np.bool_), np.zeros((*owners.shape, states.shape[2]))
    same = (owners[:, :, None] == labels[:, None, :]) & (owners[:, :, None] > 0)
    found = np.take_along_axis(states, same.argmax(axis=2)[..., None], axis=1)
    return same.any(axis=2), found
