"""Validation and normalization of bearing-time records, and tracks as the result of trackers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.hmm.existence import Span
from servotrack.estimators.sonar.array import normalize
from servotrack.estimators.sonar.chain_estimate import TrackHypothesis
from servotrack.estimators.sonar.directions import LINE, Directions
from servotrack.estimators.sonar.rules import JoiningRules
from servotrack.estimators.types import Array, Labels
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


def joined(
    tracks: Sequence[BearingTrack], gap: int, period: float, rules: JoiningRules, directions: Directions = LINE
) -> list[BearingTrack]:
    """Join tracks of which one continues another, and number all tracks anew by evidence.

    Args:
        tracks: Tracks to join.
        gap: Number of rows that may be missing between two parts, besides rows in which another track may hide the
            target. Bearings in the gap are interpolated.
        period: Time between rows, s.
        rules: Thresholds of a continuation.
        directions: Geometry of the bearings.

    Returns:
        Joined tracks, strongest first, with labels from 1.
    """
    left = sorted(tracks, key=lambda track: track.first)
    done: list[BearingTrack] = []
    while left:
        track = left.pop(0)
        # The earliest continuation is taken: a later, better one may continue this continuation.
        fits = (_misfit(track, other, gap, period, tracks, rules, directions) <= 1.0 for other in left)
        at = next((i for i, continued in enumerate(fits) if continued), None)
        if at is None:
            done.append(track)
        else:
            left[at] = _chained(track, left[at], directions)
    done.sort(key=lambda track: -track.evidence)
    return [track._replace(label=label) for label, track in enumerate(done, 1)]


def _misfit(
    track: BearingTrack,
    other: BearingTrack,
    gap: int,
    period: float,
    every: Sequence[BearingTrack],
    rules: JoiningRules,
    directions: Directions,
) -> float:
    """Distance between an extrapolated track and the start of another one, relative to the allowed distance."""
    steps = other.first - track.last
    if not 1 - rules.overlap_rows <= steps <= rules.max_gap_rows or other.last <= track.last:
        return np.inf
    inside = max(1 - steps, 0)
    near = slice(inside, inside + rules.rate_rows)
    rate_before, rate_after = track.rates[-rules.rate_rows :].mean(), other.rates[near].mean()
    ahead = steps + inside
    expected = track.bearings[-1] + 0.5 * (rate_before + rate_after) * ahead * period
    error = abs(directions.difference(expected, other.bearings[inside]))
    allowed = rules.distance + rules.distance_growth * min(ahead, rules.growth_rows)
    misfit = max(float(error / allowed), float(abs(rate_after - rate_before)) / rules.rate_difference)
    if steps > gap + 1:
        begin = track.bearings[-1] + directions.turn(other.bearings[inside], track.bearings[-1])
        way = np.linspace(begin, other.bearings[inside], steps + 1)[1:-1]
        reach = rules.hiding_distance
        hidden = sum(_hides(every, track.last + k, way[k - 1], reach, directions) for k in range(1, steps))
        if steps - 1 - hidden > (rules.direct_gap_rows if misfit < rules.direct_misfit else gap):
            return np.inf
    return misfit


def _hides(tracks: Sequence[BearingTrack], row: int, bearing: float, distance: float, directions: Directions) -> bool:
    """Return True if some track is near enough to a bearing to hide another target."""
    return any(
        track.first <= row <= track.last
        and abs(directions.difference(track.bearings[row - track.first], bearing)) < distance
        for track in tracks
    )


def _chained(track: BearingTrack, other: BearingTrack, directions: Directions) -> BearingTrack:
    inside = max(track.last + 1 - other.first, 0)
    missing = max(other.first - track.last - 1, 0)
    share = np.arange(1, missing + 1) / (missing + 1.0)

    def chain(before: Array, after: Array) -> Array:
        return np.concatenate([before, before[-1] + share * (after[inside] - before[-1]), after[inside:]])

    turn = directions.turn(other.bearings[inside], track.bearings[-1])
    return BearingTrack(
        track.label,
        track.first,
        directions.wrapped(chain(track.bearings, other.bearings - turn)),
        chain(track.rates, other.rates),
        chain(track.deviations, other.deviations),
        np.concatenate([track.presence, np.zeros(missing), other.presence[inside:]]),
        track.evidence + other.evidence,
    )


class CheckedRecord(NamedTuple):
    """Normalized rows, one per period.

    Attributes:
        rows: Normalized rows with noise mean 1; NaN where a row is missing. Shape (P, beams).
        given: Index of each given row among them. Shape (T,).
    """

    rows: Array
    given: Labels

    def restored(self, tracks: Sequence[BearingTrack]) -> list[BearingTrack]:
        """Return the tracks at the given rows only, with their indices."""
        if len(self.given) == len(self.rows):
            return list(tracks)
        found = []
        for track in tracks:
            first, after = np.searchsorted(self.given, [track.first, track.last + 1]).tolist()
            if first < after:
                inside = self.given[first:after] - track.first
                columns = {name: getattr(track, name)[inside] for name in _COLUMNS}
                found.append(track._replace(first=first, **columns))
        return found


_COLUMNS = ("bearings", "rates", "deviations", "presence")


def checked_record(
    record: ArrayLike, beams: int, averages: float, times: ArrayLike | None, period: float
) -> CheckedRecord:
    """Check a record, normalize its rows and place them one period apart.

    A row of NaN is missing, and so is every period without a row. Missing rows carry no information.

    Args:
        record: Beam powers. Shape (T, beams).
        beams: Required number of beams in a row.
        averages: Number M of averages in one beam power.
        times: Times of the rows, s, whole numbers of periods apart within a quarter of one; None: no gaps. Shape (T,).
        period: Time between rows, s.

    Raises:
        ValueError: Rows have another length, powers are infinite or negative, a row is NaN in some beams only, or times
            do not fit the period.
    """
    powers = as_numbers("record", record)
    if powers.size == 0 and powers.ndim < 2:
        powers = powers.reshape(0, beams)
    if powers.ndim != 2 or powers.shape[1] != beams:
        raise ValueError(f"record must have shape (rows, {beams}), got {powers.shape}; set beams to the rows' length")
    given = np.arange(len(powers))
    if times is not None:
        given = _placed(as_numbers("times", times), len(powers), period)
    missing = np.isnan(powers).all(axis=1)
    present = powers[~missing]
    _check_powers("record", present)
    rows = np.full((int(given[-1]) + 1 if len(given) else 0, beams), np.nan)
    if len(present):
        rows[given[~missing]] = normalize(present, averages)
    return CheckedRecord(rows, given)


def checked_row(row: ArrayLike, beams: int, averages: float) -> Array:
    """Check and normalize one row, NaN if it is missing; arguments and errors as in `checked_record`. (beams,)."""
    powers = as_numbers("row", row)
    if powers.shape != (beams,):
        raise ValueError(f"row must have shape ({beams},), got {powers.shape}; set beams to the row's length")
    if np.isnan(powers).all():
        return powers.copy()
    _check_powers("row", powers)
    return normalize(powers, averages)


def _check_powers(name: str, powers: Array) -> None:
    """Raise ValueError unless powers are finite, not negative, within the limit and mostly above 0."""
    remedy = "set the whole row to NaN, which marks it as missing, or leave such beams out and pass the other angles"
    check_within(name, powers, LIMITS.powers, remedy)
    if powers.size and powers.min() < 0.0:
        bad = first_bad(powers, powers < 0.0)
        raise ValueError(f"{name} must be finite and not negative, got {bad}; pass powers, not decibels")
    low = np.median(powers, axis=-1, keepdims=True) < SMALLEST_LEVEL if powers.size else np.zeros(0, np.bool_)
    if low.any():
        raise ValueError(
            f"{name} must be positive in most beams, got the median {np.median(powers, axis=-1).min():g}, below "
            f"{SMALLEST_LEVEL:g}; set the whole row to NaN, which marks it as missing, or pass powers in a larger unit"
        )


def _placed(times: Array, rows: int, period: float, longest_gap: int = 1000) -> Labels:
    """Index of the period of each row."""
    if times.shape != (rows,):
        raise ValueError(f"times must have shape ({rows},), got {times.shape}")
    steps = np.diff(times)
    count = np.rint(steps / period)
    bad = np.flatnonzero(~((count >= 1.0) & (np.abs(steps - count * period) <= 0.25 * period)))
    if len(bad):
        at = int(bad[0])
        raise ValueError(
            f"times must be {period:g} s apart or whole multiples of it, within a quarter of it, got {steps[at]:g} s "
            f"after row {at}: set period to the interval of the rows; rows may be left out"
        )
    long = np.flatnonzero(count > longest_gap)
    if len(long):
        at = int(long[0])
        raise ValueError(
            f"times must have gaps of at most {longest_gap} rows, got {steps[at]:g} s after row {at}: track the parts "
            "before and after it separately"
        )
    return np.concatenate([[0], np.cumsum(count)]).astype(np.int64)[:rows]
