"""Bearing-time records as they come in, and tracks as they go out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.existence import Span
from servotrack.estimators.sonar.array import normalize
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.types import Array

OVERLAP = 10
"""Rows that two parts of one track may have in common."""
RATE_ROWS = 5
"""Rows whose mean rate carries a track on."""
LONGEST = 60
"""Rows between two parts of a track at most, whatever hides them."""
LONG_GAP = 20
"""Rows that may be missing where one part leads right to the other."""
HIDDEN = 8.0
"""Distance within which a target may be hidden by another one, deg."""
JOIN_DISTANCE, JOIN_RATE, JOIN_STEPS = 2.0, 0.3, 15
"""How far two parts of a track may be apart, deg, and how much more per row between them, up to a number of rows."""
JOIN_TURN = 1.0
"""By how much their rates may differ, deg/s."""


class BearingTrack(NamedTuple):
    """One target's track.

    Attributes:
        label: Identity, at least 1.
        first: Its first row in the record.
        bearings: From that row to its last one, deg. Shape (k,).
        rates: deg/s. Shape (k,).
        deviations: Standard deviations of the bearings, deg. Shape (k,).
        presence: Probability that the target is there. Shape (k,).
        evidence: Log likelihood ratio against noise, nats; 0 where the method has none.
    """

    label: int
    first: int
    bearings: Array
    rates: Array
    deviations: Array
    presence: Array
    evidence: float

    @property
    def last(self) -> int:
        """Its last row in the record."""
        return self.first + len(self.bearings) - 1

    @classmethod
    def cut(cls, label: int, chain: TrackHypothesis, span: Span, evidence: float) -> BearingTrack:
        """One span of a chain."""
        rows = slice(span.first, span.last + 1)
        return cls(
            label,
            span.first,
            chain.bearings[rows].copy(),
            chain.rates[rows].copy(),
            chain.deviations[rows].copy(),
            chain.presence[rows].copy(),
            evidence,
        )


def joined(tracks: Sequence[BearingTrack], gap: int, period: float = 1.0) -> list[BearingTrack]:
    """Tracks of which one goes on where another ended, made one; labels are given anew by evidence.

    Args:
        tracks: Any number.
        gap: Rows that may be missing between them, besides those in which the way between them leads by another track;
            bearings there are interpolated.
        period: Time between rows, s.
    """
    left = sorted(tracks, key=lambda track: track.first)
    done: list[BearingTrack] = []
    while left:
        track = left.pop(0)
        # The next one that goes on, in order of starts: a later one that fits better may be its own continuation.
        at = next((i for i, other in enumerate(left) if _misfit(track, other, gap, period, tracks) <= 1.0), None)
        if at is None:
            done.append(track)
        else:
            left[at] = _chained(track, left[at])
    done.sort(key=lambda track: -track.evidence)
    return [track._replace(label=label) for label, track in enumerate(done, 1)]


def _misfit(track: BearingTrack, other: BearingTrack, gap: int, period: float, every: Sequence[BearingTrack]) -> float:
    """Distance between a track carried on and another's start, in what is allowed."""
    steps = other.first - track.last
    if not 1 - OVERLAP <= steps <= LONGEST or other.last <= track.last:
        return np.inf
    inside = max(1 - steps, 0)
    near = slice(inside, inside + RATE_ROWS)
    rate_before, rate_after = track.rates[-RATE_ROWS:].mean(), other.rates[near].mean()
    ahead = steps + inside
    error = abs(track.bearings[-1] + 0.5 * (rate_before + rate_after) * ahead * period - other.bearings[inside])
    allowed = JOIN_DISTANCE + JOIN_RATE * min(ahead, JOIN_STEPS)
    misfit = max(float(error / allowed), float(abs(rate_after - rate_before)) / JOIN_TURN)
    if steps > gap + 1:
        way = np.linspace(track.bearings[-1], other.bearings[inside], steps + 1)[1:-1]
        hidden = sum(_hides(every, track.last + k, way[k - 1]) for k in range(1, steps))
        if steps - 1 - hidden > (LONG_GAP if misfit < 0.5 else gap):
            return np.inf
    return misfit


def _hides(tracks: Sequence[BearingTrack], row: int, bearing: float) -> bool:
    """Whether some track is so near to a bearing that it may hide another target."""
    return any(
        track.first <= row <= track.last and abs(track.bearings[row - track.first] - bearing) < HIDDEN
        for track in tracks
    )


def _chained(track: BearingTrack, other: BearingTrack) -> BearingTrack:
    inside = max(track.last + 1 - other.first, 0)
    missing = max(other.first - track.last - 1, 0)
    share = np.arange(1, missing + 1) / (missing + 1.0)

    def chain(before: Array, after: Array) -> Array:
        return np.concatenate([before, before[-1] + share * (after[inside] - before[-1]), after[inside:]])

    return BearingTrack(
        track.label,
        track.first,
        chain(track.bearings, other.bearings),
        chain(track.rates, other.rates),
        chain(track.deviations, other.deviations),
        np.concatenate([track.presence, np.zeros(missing), other.presence[inside:]]),
        track.evidence + other.evidence,
    )


def checked_record(record: ArrayLike, beams: int, averages: int, times: ArrayLike | None, period: float) -> Array:
    """A record's normalized rows.

    Args:
        record: Beam powers. Shape (T, beams).
        beams: What a row must have.
        averages: M of one beam power.
        times: Of the rows, s, or None. Shape (T,).
        period: Time between rows, s.

    Returns:
        Shape (T, beams), noise mean 1.

    Raises:
        ValueError: For rows of another length, powers that are NaN or negative, or times that are not a period apart.
    """
    try:
        powers = np.asarray(record, np.float64)
    except ValueError:
        raise ValueError(f"record must have rows of {beams} beam powers each, got rows of different lengths") from None
    if powers.size == 0 and powers.ndim < 2:
        powers = powers.reshape(0, beams)
    if powers.ndim != 2 or powers.shape[1] != beams:
        raise ValueError(f"record must have shape (rows, {beams}), got {powers.shape}; set beams to the rows' length")
    if times is not None:
        _check_times(np.asarray(times, np.float64), len(powers), period)
    return normalize(powers, averages) if len(powers) else powers


def checked_row(row: ArrayLike, beams: int, averages: int) -> Array:
    """One normalized row; arguments and errors as `checked_record`. Shape (beams,)."""
    powers = np.asarray(row, np.float64)
    if powers.shape != (beams,):
        raise ValueError(f"row must have shape ({beams},), got {powers.shape}; set beams to the row's length")
    return normalize(powers, averages)


def _check_times(times: Array, rows: int, period: float) -> None:
    if times.shape != (rows,):
        raise ValueError(f"times must have shape ({rows},), got {times.shape}")
    steps = np.diff(times)
    bad = np.flatnonzero(~(np.abs(steps - period) <= 0.01 * period))
    if len(bad):
        at = int(bad[0])
        raise ValueError(
            f"times must be {period:g} s apart, got {steps[at]:g} s after row {at}: fill the gap with rows of ones, "
            "which say nothing, or track the parts on their own"
        )
