"""Validation and normalization of bearing-time records, and tracks as the result of trackers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.existence import Span
from servotrack.estimators.sonar.array import normalize
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.rules import JoiningRules
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers, check_within, first_bad

SMALLEST_LEVEL = 1e-30
"""Smallest median of a row's powers: below it their ratios would overflow."""


class BearingTrack(NamedTuple):
    """Track of one target in a record.

    Attributes:
        label: Identity, at least 1.
        first: Index of the first row of the track in the record.
        bearings: Bearings from the first row to the last one, deg. Shape (k,).
        rates: Bearing rates, deg/s. Shape (k,).
        deviations: Standard deviations of the bearings, deg. Shape (k,).
        presence: Probability that the target exists. Shape (k,).
        evidence: Log likelihood ratio against noise, nats; 0 for methods without one.
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
        """Index of the last row of the track in the record."""
        return self.first + len(self.bearings) - 1

    @classmethod
    def cut(cls, label: int, chain: TrackHypothesis, span: Span, evidence: float) -> BearingTrack:
        """Cut one span out of a chain."""
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


def joined(tracks: Sequence[BearingTrack], gap: int, period: float, rules: JoiningRules) -> list[BearingTrack]:
    """Join tracks of which one continues another, and number all tracks anew by evidence.

    Args:
        tracks: Tracks to join.
        gap: Number of rows that may be missing between two parts, besides rows in which another track may hide the
            target. Bearings in the gap are interpolated.
        period: Time between rows, s.
        rules: Thresholds of a continuation.

    Returns:
        Joined tracks, strongest first, with labels from 1.
    """
    left = sorted(tracks, key=lambda track: track.first)
    done: list[BearingTrack] = []
    while left:
        track = left.pop(0)
        # The earliest continuation is taken: a later, better one may continue this continuation.
        at = next((i for i, other in enumerate(left) if _misfit(track, other, gap, period, tracks, rules) <= 1.0), None)
        if at is None:
            done.append(track)
        else:
            left[at] = _chained(track, left[at])
    done.sort(key=lambda track: -track.evidence)
    return [track._replace(label=label) for label, track in enumerate(done, 1)]


def _misfit(
    track: BearingTrack,
    other: BearingTrack,
    gap: int,
    period: float,
    every: Sequence[BearingTrack],
    rules: JoiningRules,
) -> float:
    """Distance between an extrapolated track and the start of another one, relative to the allowed distance."""
    steps = other.first - track.last
    if not 1 - rules.overlap_rows <= steps <= rules.max_gap_rows or other.last <= track.last:
        return np.inf
    inside = max(1 - steps, 0)
    near = slice(inside, inside + rules.rate_rows)
    rate_before, rate_after = track.rates[-rules.rate_rows :].mean(), other.rates[near].mean()
    ahead = steps + inside
    error = abs(track.bearings[-1] + 0.5 * (rate_before + rate_after) * ahead * period - other.bearings[inside])
    allowed = rules.distance + rules.distance_growth * min(ahead, rules.growth_rows)
    misfit = max(float(error / allowed), float(abs(rate_after - rate_before)) / rules.rate_difference)
    if steps > gap + 1:
        way = np.linspace(track.bearings[-1], other.bearings[inside], steps + 1)[1:-1]
        hidden = sum(_hides(every, track.last + k, way[k - 1], rules.hiding_distance) for k in range(1, steps))
        if steps - 1 - hidden > (rules.direct_gap_rows if misfit < rules.direct_misfit else gap):
            return np.inf
    return misfit


def _hides(tracks: Sequence[BearingTrack], row: int, bearing: float, distance: float) -> bool:
    """Return True if some track is near enough to a bearing to hide another target."""
    return any(
        track.first <= row <= track.last and abs(track.bearings[row - track.first] - bearing) < distance
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
    """Check a record and normalize its rows.

    Args:
        record: Beam powers. Shape (T, beams).
        beams: Required number of beams in a row.
        averages: Number M of averages in one beam power.
        times: Times of the rows, s; None: not checked. Shape (T,).
        period: Time between rows, s.

    Returns:
        Normalized rows with noise mean 1. Shape (T, beams).

    Raises:
        ValueError: Rows have another length, powers are NaN or negative, or times are not one period apart.
    """
    powers = as_numbers("record", record)
    if powers.size == 0 and powers.ndim < 2:
        powers = powers.reshape(0, beams)
    if powers.ndim != 2 or powers.shape[1] != beams:
        raise ValueError(f"record must have shape (rows, {beams}), got {powers.shape}; set beams to the rows' length")
    if times is not None:
        _check_times(as_numbers("times", times), len(powers), period)
    _check_powers("record", powers)
    return normalize(powers, averages) if len(powers) else powers


def checked_row(row: ArrayLike, beams: int, averages: int) -> Array:
    """Check and normalize one row; arguments and errors as in `checked_record`. Shape (beams,)."""
    powers = as_numbers("row", row)
    if powers.shape != (beams,):
        raise ValueError(f"row must have shape ({beams},), got {powers.shape}; set beams to the row's length")
    _check_powers("row", powers)
    return normalize(powers, averages)


def _check_powers(name: str, powers: Array) -> None:
    """Raise ValueError unless powers are finite, not negative, within the limit and mostly above 0."""
    check_within(name, powers, LIMITS.powers, "leave such rows out")
    if powers.size and powers.min() < 0.0:
        bad = first_bad(powers, powers < 0.0)
        raise ValueError(f"{name} must be finite and not negative, got {bad}; pass powers, not decibels")
    low = np.median(powers, axis=-1, keepdims=True) < SMALLEST_LEVEL if powers.size else np.zeros(0, np.bool_)
    if low.any():
        raise ValueError(
            f"{name} must be positive in most beams, got the median {np.median(powers, axis=-1).min():g}, below "
            f"{SMALLEST_LEVEL:g}; leave such rows out, or pass powers in a larger unit"
        )


def _check_times(times: Array, rows: int, period: float) -> None:
    if times.shape != (rows,):
        raise ValueError(f"times must have shape ({rows},), got {times.shape}")
    steps = np.diff(times)
    bad = np.flatnonzero(~(np.abs(steps - period) <= 0.01 * period))
    if len(bad):
        at = int(bad[0])
        raise ValueError(
            f"times must be {period:g} s apart, got {steps[at]:g} s after row {at}: fill the gap with rows of ones, "
            "which carry no information, or track the parts separately"
        )
