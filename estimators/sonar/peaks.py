"""Detect before track: peaks of every row, tracked by nearest neighbors or by Kalman filters with assignment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import find_peaks

from servotrack.estimators.metrics.assignment import assign
from servotrack.estimators.rfs.sets import TENTATIVE_EXISTENCE, SetEstimate
from servotrack.estimators.sonar.array import bearings
from servotrack.estimators.sonar.record import BearingTrack, checked_record, checked_row
from servotrack.estimators.types import Array, Labels


def peaks(row: Array, beam_bearings: Array, averages: int, threshold: float) -> Array:
    """Find the bearings of the peaks of a normalized row, by a parabola through three beams.

    Args:
        row: Normalized beam powers. Shape (beams,).
        beam_bearings: Bearings of the beams, deg. Shape (beams,).
        averages: Number M of averages in one beam power.
        threshold: Smallest height and prominence of a peak, in standard deviations of the noise.

    Returns:
        Bearings, highest peak first, deg. Shape (peaks,).
    """
    score = (row - 1.0) * np.sqrt(averages)
    at, _ = find_peaks(score, height=threshold, prominence=threshold)
    before, here, after = score[at - 1], score[at], score[at + 1]
    bend = before - 2.0 * here + after
    part = np.where(bend < 0.0, 0.5 * (before - after) / np.minimum(bend, -1e-12), 0.0)
    return (beam_bearings[at] + part * (beam_bearings[1] - beam_bearings[0]))[np.argsort(-here)]


class PeakState(NamedTuple):
    """State of a tracker of peaks.

    Attributes:
        mean: Bearing and rate of each track, deg and deg/s. Shape (n, 2).
        covariance: Covariance of each mean. Shape (n, 2, 2).
        label: Identity of each track. Shape (n,).
        hits: Number of rows with a peak of the track, up to `confirm`. Shape (n,).
        missed: Number of rows since the last peak. Shape (n,).
        next_label: Next new identity.
        answers: Estimates not yet returned, oldest first.
    """

    mean: Array
    covariance: Array
    label: Labels
    hits: Labels
    missed: Labels
    next_label: int
    answers: tuple[SetEstimate, ...]


@dataclass(frozen=True)
class PeakTracker(ABC):
    """Base class of the trackers of peaks.

    Attributes:
        beams: Number of beams from 0 to 180 deg.
        averages: Number M of averages in one beam power.
        period: Time between rows, s.
        threshold: Smallest height of a peak, in standard deviations of the noise. Larger values give fewer false
            tracks and miss weak targets.
        confirm: Number of rows with a peak that confirms a track.
        misses: Number of rows without a peak after which a track ends.
        lag: Delay of the estimates of `step`, rows.
    """

    beams: int = 721
    averages: int = 1110
    period: float = 1.0
    threshold: float = 4.0
    confirm: int = 3
    misses: int = 4
    lag: int = 5

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names it."""
        for name in ("beams", "averages", "confirm", "misses"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)!r}")
        if self.lag < 0:
            raise ValueError(f"lag must be >= 0, got {self.lag!r}")
        for name in ("period", "threshold"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """Track all targets of a whole record; arguments, result and errors as in `HMMBearings.track`."""
        checked = checked_record(record, self.beams, self.averages, times, self.period)
        rows = checked.rows
        state = self._empty()
        found: dict[int, list[tuple[int, Array, float]]] = {}
        for k, row in enumerate(rows):
            state, estimate = self._advance(state, row)
            for label, value, spread in zip(estimate.labels, estimate.states, estimate.covariances, strict=True):
                found.setdefault(int(label), []).append((k, value, float(np.sqrt(spread[0, 0]))))
        tracks = []
        for label, (_, points) in enumerate(sorted(found.items()), 1):
            steps = np.array([k for k, _, _ in points])
            every = np.arange(steps[0], steps[-1] + 1)
            columns = np.array([[*value, spread] for _, value, spread in points])
            bearing, rate, deviation = (np.interp(every, steps, column) for column in columns.T)
            tracks.append(BearingTrack(label, int(steps[0]), bearing, rate, deviation, np.ones(len(every)), 0.0))
        return checked.restored(tracks)

    def initial(self, row: ArrayLike) -> PeakState:
        """Return the state before the first row; only the length of `row` is used."""
        checked_row(row, self.beams, self.averages)
        return self._empty()

    def step(self, state: PeakState, row: ArrayLike) -> tuple[PeakState, SetEstimate]:
        """Update with one row; the estimate is that of the row `lag` before, empty during the first `lag` rows."""
        after, estimate = self._advance(state, checked_row(row, self.beams, self.averages))
        answers = (*state.answers, estimate)
        due = answers[0] if len(answers) > self.lag else _nothing()
        return after._replace(answers=answers[1:] if len(answers) > self.lag else answers), due

    def _empty(self) -> PeakState:
        none = np.zeros(0, np.int64)
        return PeakState(np.zeros((0, 2)), np.zeros((0, 2, 2)), none, none, none, 1, ())

    def _advance(self, state: PeakState, row: Array) -> tuple[PeakState, SetEstimate]:
        # A missing row has no peaks.
        found = np.zeros(0) if np.isnan(row[0]) else peaks(row, bearings(self.beams), self.averages, self.threshold)
        mean, covariance = self._predict(state)
        partner = self._associate(mean, covariance, found)
        seen = partner >= 0
        self._correct(mean, covariance, partner, found)
        hits = np.minimum(np.where(seen, state.hits + 1, state.hits), self.confirm)
        missed = np.where(seen, 0, state.missed + 1)
        lasting = np.where(hits >= self.confirm, self.misses, 1)
        keep = (missed < lasting) | seen
        new = np.setdiff1d(np.arange(len(found)), partner)
        ones = np.ones(len(new), np.int64)
        start = np.column_stack([found[new], np.zeros(len(new))])
        after = PeakState(
            np.concatenate([mean[keep], start]),
            np.concatenate([covariance[keep], np.broadcast_to(self._start(), (len(new), 2, 2))]),
            np.concatenate([state.label[keep], state.next_label + np.arange(len(new))]),
            np.concatenate([hits[keep], ones]),
            np.concatenate([missed[keep], 0 * ones]),
            state.next_label + len(new),
            (),
        )
        shown = after.hits >= self.confirm
        return after, SetEstimate(
            after.mean[shown],
            after.label[shown],
            np.ones(int(shown.sum())),
            after.covariance[shown],
            np.asarray(float(shown.sum())),
            after.label[~shown],
            after.mean[~shown],
            np.full(int((~shown).sum()), TENTATIVE_EXISTENCE),
        )

    @abstractmethod
    def _start(self) -> Array:
        """Return the covariance of a new track. Shape (2, 2)."""

    @abstractmethod
    def _predict(self, state: PeakState) -> tuple[Array, Array]:
        """Predict means and covariances one row ahead, as new arrays."""

    @abstractmethod
    def _associate(self, mean: Array, covariance: Array, found: Array) -> Labels:
        """Return the index of each track's peak, -1 without one."""

    @abstractmethod
    def _correct(self, mean: Array, covariance: Array, partner: Labels, found: Array) -> None:
        """Update the tracks with their peaks, in place."""


@dataclass(frozen=True)
class PeakNearestNeighbor(PeakTracker):
    """Nearest-neighbor tracker: every track, oldest first, takes the nearest remaining peak.

    Attributes:
        gate: Largest distance between a track and its peak, deg.
    """

    gate: float = 3.0

    def _start(self) -> Array:
        return np.zeros((2, 2))

    def _predict(self, state: PeakState) -> tuple[Array, Array]:
        return state.mean.copy(), state.covariance.copy()

    def _associate(self, mean: Array, covariance: Array, found: Array) -> Labels:
        partner = np.full(len(mean), -1)
        free = np.ones(len(found), np.bool_)
        for i, (bearing, _) in enumerate(mean):
            distance = np.where(free, np.abs(found - bearing), np.inf)
            if len(found) and distance.min() < self.gate:
                partner[i] = int(distance.argmin())
                free[partner[i]] = False
        return partner

    def _correct(self, mean: Array, covariance: Array, partner: Labels, found: Array) -> None:
        seen = partner >= 0
        rate = (found[partner[seen]] - mean[seen, 0]) / self.period
        mean[seen, 0], mean[seen, 1] = found[partner[seen]], rate


@dataclass(frozen=True)
class PeakKalmanHungarian(PeakTracker):
    """Kalman filters of nearly constant rate, with optimal assignment of peaks to tracks.

    Attributes:
        acceleration: Standard deviation of the acceleration, deg/s^2. Larger values follow maneuvers faster.
        noise: Standard deviation of a peak's bearing, deg.
        rate: Standard deviation of a new track's rate, deg/s.
        gate: Largest innovation of an assigned peak, in standard deviations.
    """

    acceleration: float = 0.1
    noise: float = 0.3
    rate: float = 1.0
    gate: float = 4.0

    def _start(self) -> Array:
        return np.diag([self.noise**2, self.rate**2])

    def _predict(self, state: PeakState) -> tuple[Array, Array]:
        t = self.period
        F = np.array([[1.0, t], [0.0, 1.0]])
        step = np.array([t * t / 2.0, t])
        return state.mean @ F.T, F @ state.covariance @ F.T + self.acceleration**2 * np.outer(step, step)

    def _associate(self, mean: Array, covariance: Array, found: Array) -> Labels:
        tracks, count = len(mean), len(found)
        variance = covariance[:, 0, 0] + self.noise**2
        # One extra column per track means no peak, at the cost of the gate; pairs beyond the gate cost more.
        cost = np.full((tracks, count + tracks), self.gate**2)
        distance = (mean[:, :1] - found) ** 2 / variance[:, None]
        cost[:, :count] = np.where(distance < self.gate**2, distance, 2.0 * self.gate**2)
        partner = np.asarray(assign(cost, tracks, count + tracks))
        return np.where(partner < count, partner, -1)

    def _correct(self, mean: Array, covariance: Array, partner: Labels, found: Array) -> None:
        for i in np.flatnonzero(partner >= 0):
            gain = covariance[i, :, 0] / (covariance[i, 0, 0] + self.noise**2)
            mean[i] += gain * (found[partner[i]] - mean[i, 0])
            covariance[i] -= np.outer(gain, covariance[i, 0])


def _nothing() -> SetEstimate:
    none, labels = np.zeros((0, 2)), np.zeros(0, np.int64)
    return SetEstimate(none, labels, np.zeros(0), np.zeros((0, 2, 2)), np.asarray(0.0), labels, none, np.zeros(0))
