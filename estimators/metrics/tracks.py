"""Tracks (states of one identity over steps), as lists and as arrays with NaN where a track does not exist."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import as_numbers


class Track(NamedTuple):
    """States of one identity.

    Attributes:
        steps: Steps at which the track exists, increasing; gaps are allowed. Shape (k,), int.
        states: State at each of these steps. Shape (k, d).
    """

    steps: Labels
    states: Array


def stack_tracks(tracks: Sequence[Track], length: int, dimension: int) -> Array:
    """Put tracks on one time axis.

    Args:
        tracks: Tracks, possibly none.
        length: Number of steps T.
        dimension: Dimension d of a state.

    Returns:
        States, shape (number of tracks, T, d), NaN where a track does not exist.

    Raises:
        ValueError: A track has steps outside 0..T - 1, or states of another shape.
    """
    stacked = np.full((len(tracks), length, dimension), np.nan)
    for row, track in enumerate(tracks):
        steps, states = _checked(row, track, length, dimension)
        stacked[row, steps] = states
    return stacked


class Members(NamedTuple):
    """Tracks that exist at one step.

    Attributes:
        rows: Indices of the tracks, increasing. Shape (k,).
        states: States of these tracks. Shape (k, d).
    """

    rows: NDArray[np.intp]
    states: Array


class _Steps(Sequence[Members]):
    """Members of T steps, sliced from whole arrays on access to save memory in long sequences."""

    def __init__(self, bounds: Labels, rows: NDArray[np.intp], states: Array) -> None:
        self._bounds, self._rows, self._states = bounds, rows, states

    def __len__(self) -> int:
        return len(self._bounds) - 1

    @overload
    def __getitem__(self, step: int) -> Members: ...

    @overload
    def __getitem__(self, step: slice) -> list[Members]: ...

    def __getitem__(self, step: int | slice) -> Members | list[Members]:
        if isinstance(step, slice):
            return [self[one] for one in range(*step.indices(len(self)))]
        one = range(len(self))[step]
        inside = slice(self._bounds[one], self._bounds[one + 1])
        return Members(self._rows[inside], self._states[inside])


def members_by_step(tracks: Sequence[Track], length: int, dimension: int) -> Sequence[Members]:
    """List the tracks that exist at each step, in memory proportional to the number of states.

    Args:
        tracks: Tracks, possibly none. States with NaN count as not existing.
        length: Number of steps T.
        dimension: Dimension d of a state.

    Returns:
        Members of each of the T steps.

    Raises:
        ValueError: A track has steps outside 0..T - 1, or states of another shape.
    """
    present = [_present(_checked(row, track, length, dimension)) for row, track in enumerate(tracks)]
    bounds = np.zeros(length + 1, np.int64)
    for track in present:
        # A track occurs at most once per step.
        bounds[track.steps + 1] += 1
    np.cumsum(bounds, out=bounds)
    rows, states = np.empty(bounds[-1], np.intp), np.empty((bounds[-1], dimension))
    free = bounds[:-1].copy()
    for row, track in enumerate(present):
        places = free[track.steps]
        rows[places], states[places] = row, track.states
        free[track.steps] += 1
    return _Steps(bounds, rows, states)


def _present(track: Track) -> Track:
    """Remove the steps at which a track does not exist."""
    exists = ~np.isnan(track.states).any(axis=1)
    return track if exists.all() else Track(track.steps[exists], track.states[exists])


def _checked(row: int, track: Track, length: int, dimension: int) -> Track:
    steps, states = np.asarray(track.steps, dtype=np.int64), np.asarray(track.states, dtype=np.float64)
    if states.shape != (len(steps), dimension):
        raise ValueError(f"tracks[{row}].states must have shape ({len(steps)}, {dimension}), got {states.shape}")
    if len(steps) and not (steps.min() >= 0 and steps.max() < length):
        raise ValueError(
            f"tracks[{row}].steps must lie in 0..{length - 1}, got {steps.min()}..{steps.max()}; raise length"
        )
    return Track(steps, states)


def tracks_from_rows(labels: ArrayLike, states: ArrayLike) -> list[Track]:
    """Make tracks from labeled rows of every step.

    Args:
        labels: Identity in each row at each step, negative for an empty row. Shape (T, n), int.
        states: State in each row at each step. Shape (T, n, d).

    Returns:
        One track per label, in the order of their first appearance.

    Raises:
        ValueError: Shapes disagree, or a label occurs twice in a step.
    """
    names, values = as_numbers("labels", labels).astype(np.int64), as_numbers("states", states)
    if names.ndim != 2 or values.shape[:2] != names.shape or values.ndim != 3:
        raise ValueError(
            f"labels and states must have shapes (T, n) and (T, n, d), got {names.shape} and {values.shape}"
        )
    steps, rows = np.nonzero(names >= 0)
    found = names[steps, rows]
    _, first, inverse = np.unique(found, return_index=True, return_inverse=True)
    # A stable sort keeps the steps of a label in order.
    order = np.argsort(inverse, kind="stable")
    twice = np.flatnonzero((np.diff(inverse[order]) == 0) & (np.diff(steps[order]) == 0))
    if len(twice):
        raise ValueError(f"labels must be unique in every step, got {found[order[twice[0]]]} twice in one")
    bounds = np.searchsorted(inverse[order], np.arange(len(first) + 1))
    tracks = []
    for label in np.argsort(first, kind="stable").tolist():
        members = order[bounds[label] : bounds[label + 1]]
        tracks.append(Track(steps[members].astype(np.int64), values[steps[members], rows[members]]))
    return tracks
