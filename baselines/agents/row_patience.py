"""Rows that wait for their identity: a filter may drop a target that one scan missed and know it again in the next."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from servotrack.estimators.rfs import RowAllocation, SetEstimate
from servotrack.estimators.rfs.sets import HELD, RowState
from servotrack.estimators.types import Array, Labels, Mask

PATIENCE = 5
"""Scans for which a row is kept silently for an identity that the filter does not mention."""


class ReservedRows(NamedTuple):
    """Rows of an answer, N scenes.

    Attributes:
        rows: Which identity owns which row.
        absent: Scans since the filter last mentioned the row's identity. Shape (N, rows).
        states: The identity's state then. Shape (N, rows, n).
    """

    rows: RowState
    absent: Labels
    states: Array


def no_rows(allocation: RowAllocation, scenes: int, n: int) -> ReservedRows:
    """All rows free."""
    shape = scenes, allocation.rows
    return ReservedRows(allocation.initial((scenes,)), np.zeros(shape, np.int64), np.zeros((*shape, n)))


def allocate_rows(allocation: RowAllocation, memory: ReservedRows, estimate: SetEstimate) -> tuple[ReservedRows, Array]:
    """An answer in which identities keep their rows over short silences.

    Args:
        allocation: Gives identities rows.
        memory: What this function or `no_rows` returned.
        estimate: Of a batch of N scenes.

    Returns:
        The new memory, and the answer, shape (N, rows, 1 + d).
    """
    owners = memory.rows.label
    mentioned, _ = _find(owners, estimate)
    waiting = (owners > 0) & ~mentioned & (memory.absent < PATIENCE)
    extended = replace(
        estimate,
        held_labels=np.concatenate([estimate.held_labels, np.where(waiting, owners, 0)], axis=1),
        held_states=np.concatenate([estimate.held_states, memory.states], axis=1),
        held_existence=np.concatenate([estimate.held_existence, np.where(waiting, HELD, 0.0)], axis=1),
    )
    rows, answer = allocation.step(memory.rows, extended)
    mentioned, states = _find(rows.label, estimate)
    kept = (rows.label == owners) & (owners > 0)
    absent = np.where(kept & ~mentioned, memory.absent + 1, 0)
    return ReservedRows(rows, absent, np.where(mentioned[..., None], states, memory.states)), answer


def _find(owners: Labels, estimate: SetEstimate) -> tuple[Mask, Array]:
    """Whether each row's identity is in the estimate, shape (N, rows), and its state there, shape (N, rows, n)."""
    labels = np.concatenate([estimate.labels, estimate.held_labels], axis=1)
    states = np.concatenate([estimate.states, estimate.held_states], axis=1)
    if labels.shape[1] == 0:
        return np.zeros(owners.shape, np.bool_), np.zeros((*owners.shape, states.shape[2]))
    same = (owners[:, :, None] == labels[:, None, :]) & (owners[:, :, None] > 0)
    found = np.take_along_axis(states, same.argmax(axis=2)[..., None], axis=1)
    return same.any(axis=2), found
