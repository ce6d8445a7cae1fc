"""Bearing-time records as they come in, and tracks as they go out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.hmm.existence import Span
from servotrack.estimators.sonar.array import normalize
from servotrack.estimators.sonar.followed import Followed

Array = NDArray[np.float64]


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
    def cut(cls, label: int, chain: Followed, span: Span, evidence: float) -> BearingTrack:
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
