"""Global nearest neighbor: Kalman tracks, one assignment per step, M-of-N confirmation (Blackman and Popoli 1999)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.capacity import warn_of_cap
from servotrack.estimators.rfs.first_state import state_from_measurement
from servotrack.estimators.rfs.gaussians import detected_mean, weigh_pairs
from servotrack.estimators.rfs.matching import most_likely_pairs
from servotrack.estimators.rfs.mixture import Mixture, empty_mixture, predict_components
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.recursion import check_positive_definite, resized
from servotrack.estimators.rfs.scan_noise import no_excess, read_noise
from servotrack.estimators.rfs.sensors import SensedModel, Sensor, model_at
from servotrack.estimators.rfs.sets import (
    TENTATIVE_EXISTENCE,
    SetEstimate,
    check_runs,
    empty_extraction,
    estimate_from_extraction,
    read_measurements,
)
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, Labels


class GNNState(NamedTuple):
    """State of a `GlobalNearestNeighbor`.

    Attributes:
        tracks: One Gaussian per track; its weight is 1 for a confirmed track, else 0.
        hits: Bit mask of the last steps with a detection, the newest in bit 0. Shape (*batch, T).
        age: Number of steps since the track's first measurement, including that step. Shape (*batch, T).
        next_label: The next new identity. Shape (*batch,).
    """

    tracks: Mixture
    hits: Labels
    age: Labels
    next_label: Labels


@dataclass(frozen=True, eq=False)
class GlobalNearestNeighbor:
    """Hard assignment of measurements to Kalman tracks; unassigned measurements start new tracks.

    Args:
        model: Motion and measurement model of one target.
        hidden_deviation: Standard deviation of unmeasured state entries (velocities) of a new track, in the state's
            unit.
        gate_probability: Probability that a target's measurement lies in its gate, in (0, 1). Raising it loses fewer
            detections and admits more clutter.
        confirm: M and N: a track is confirmed after M detections in its first or last N steps.
        misses: A confirmed track ends after this many steps without a detection.
        capacity: Largest number of tracks; further measurements start no track. None: no limit; the arrays have room
            for 200 tracks and double when more may be needed.

    Warns:
        UserWarning: `capacity` keeps measurements from starting tracks.

    Raises:
        ValueError: An argument is out of range.
    """

    model: TargetModel
    hidden_deviation: float = 10.0
    gate_probability: float = 0.999
    confirm: tuple[int, int] = (3, 5)
    misses: int = 4
    capacity: int | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.hidden_deviation) and self.hidden_deviation > 0.0):
            raise ValueError(f"hidden_deviation must be finite and > 0, got {self.hidden_deviation!r}")
        if not 0.0 < self.gate_probability < 1.0:
            raise ValueError(f"gate_probability must be in (0, 1), got {self.gate_probability!r}")
        wanted, window = self.confirm
        if not 1 <= wanted <= window <= 60:
            raise ValueError(f"confirm must be (M, N) with 1 <= M <= N <= 60, got {self.confirm!r}")
        if not 1 <= self.misses <= 60:
            raise ValueError(f"misses must be from 1 to 60, got {self.misses!r}")
        if self.capacity is not None and self.capacity < 1:
            raise ValueError(f"capacity must be at least 1, got {self.capacity!r}")

    @cached_property
    def _gate(self) -> float:
        return float(chdtri(self.model.packed.observation.shape[0], 1.0 - self.gate_probability))

    def initial(self, measurement: ArrayLike, sensor: Sensor | None = None) -> GNNState:
        """State before the first measurement: no tracks. Only the measurement's batch axis is read."""
        m = self.model.packed.observation.shape[0] if sensor is None else sensor.size
        z, _, single = read_measurements(measurement, m)
        state = self._empty(z.shape[0])
        return first_row(state) if single else state

    def step(
        self,
        state: GNNState,
        measurement: ArrayLike,
        dt: float | None = None,
        sensor: Sensor | None = None,
        noise: ArrayLike | None = None,
    ) -> tuple[GNNState, SetEstimate]:
        """Predict, assign, update; arguments and errors as in `GaussianSetFilter.step`. Counts are of scans."""
        if dt is not None or sensor is not None:
            now = replace(self, model=model_at(self.model, dt, sensor))
            return now.step(resized(state, sum(now.model.packed.observation.shape)), measurement, noise=noise)
        m, n = self.model.packed.observation.shape
        z, number, single = read_measurements(measurement, m)
        check_runs(state.next_label, z.shape[0], single)
        if single:
            state = add_axis(state)
        batch = z.shape[0]
        capacity = state.hits.shape[1]
        while self.capacity is None and capacity < int((state.tracks.number + number).max()):
            capacity *= 2
        predicted = empty_mixture(batch, state.hits.shape[1], n + m)
        _predict(self.model.packed, state.tracks, predicted)
        if isinstance(self.model, SensedModel):
            self.model.attach(predicted)
        excess = no_excess(batch, m) if noise is None else read_noise(noise, measurement, self.model.packed)
        start, start_covariance = state_from_measurement(self.model, z, self.hidden_deviation, excess)
        new = self._empty(batch, capacity)
        extraction = empty_extraction(batch, capacity, n)
        for b in range(batch):
            self._assign(state, predicted, z[b, : number[b]], excess[b], b, start[b], start_covariance[b], new)
            count = new.tracks.number[b]
            confirmed = new.tracks.weight[b, :count] > 0.0
            extraction.number[b] = count
            extraction.reported[b, :count] = confirmed
            extraction.existence[b, :count] = np.where(confirmed, 1.0, TENTATIVE_EXISTENCE)
            extraction.label[b, :count] = new.tracks.label[b, :count]
            extraction.state[b, :count] = new.tracks.mean[b, :count, :n]
            extraction.covariance[b, :count] = new.tracks.covariance[b, :count, :n, :n]
            extraction.expected[b] = confirmed.sum()
        return (first_row(new) if single else new), estimate_from_extraction(extraction, single)

    def _empty(self, batch: int, capacity: int | None = None) -> GNNState:
        m, n = self.model.packed.observation.shape
        shape = (batch, capacity or self.capacity or 200)
        tracks = empty_mixture(*shape, n + m)
        return GNNState(tracks, np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.ones(batch, np.int64))

    def _assign(
        self,
        state: GNNState,
        predicted: Mixture,
        z: Array,
        excess: Array,
        b: int,
        start: Array,
        start_covariance: Array,
        new: GNNState,
    ) -> None:
        """Step run b (assignment, correction, confirmation, deletion, new tracks) and write it to row b of `new`."""
        model = self.model.packed
        n = model.observation.shape[1]
        T, Z = int(predicted.number[b]), len(z)
        track, measurement, likelihood, part, gain, posterior, positive_definite = weigh_pairs(
            model, T, predicted.mean[b], predicted.covariance[b], z, excess, Z, self._gate
        )
        check_positive_definite(positive_definite)
        partner = most_likely_pairs(track, measurement, likelihood, T, Z)
        row = np.zeros((T, Z), np.int64)
        row[track, measurement] = part
        chosen = np.where(partner >= 0, row[np.arange(T), partner], -1) if Z else partner
        _correct(model, partner, chosen, gain, posterior, z, b, predicted)

        wanted, window = self.confirm
        hits = (state.hits[b, :T] << 1 | (partner >= 0)) & ((1 << max(window, self.misses)) - 1)
        age = state.age[b, :T] + 1
        recent = _count_bits(hits & ((1 << window) - 1))
        confirmed = (state.tracks.weight[b, :T] > 0.0) | (recent >= wanted)
        hopeful = recent + np.maximum(window - age, 0) >= wanted
        keep = np.flatnonzero(np.where(confirmed, (hits & ((1 << self.misses) - 1)) != 0, hopeful))
        count = len(keep)
        tracks = new.tracks
        tracks.mean[b, :count], tracks.covariance[b, :count] = predicted.mean[b, keep], predicted.covariance[b, keep]
        tracks.detected[b, :count], tracks.label[b, :count] = predicted.detected[b, keep], predicted.label[b, keep]
        tracks.weight[b, :count] = confirmed[keep]
        new.hits[b, :count], new.age[b, :count] = hits[keep], age[keep]

        left = np.setdiff1d(np.arange(Z), partner)
        if count + len(left) > new.hits.shape[1]:
            warn_of_cap("capacity", "tracks")
            left = left[: new.hits.shape[1] - count]
        fresh = slice(count, count + len(left))
        tracks.mean[b, fresh, :n], tracks.mean[b, fresh, n:] = start[left], z[left]
        tracks.covariance[b, fresh, :n, :n] = start_covariance[left]
        tracks.detected[b, fresh] = True
        tracks.weight[b, fresh] = wanted == 1
        tracks.label[b, fresh] = state.next_label[b] + np.arange(len(left))
        new.hits[b, fresh], new.age[b, fresh] = 1, 1
        tracks.number[b] = count + len(left)
        new.next_label[b] = state.next_label[b] + len(left)


def _count_bits(values: Labels) -> Labels:
    """Number of ones in each value."""
    return ((values[:, None] >> np.arange(60)) & 1).sum(axis=1)


@njit(cache=True, nogil=True)
def _predict(model, tracks, out):  # type: ignore[no-untyped-def]
    """Predict the tracks of every run."""
    size = model.transition.shape[0]
    work = np.empty((size, size))
    for b in range(tracks.number.shape[0]):
        predict_components(model, tracks, b, work, out)
        out.number[b] = tracks.number[b]


@njit(cache=True, nogil=True)
def _correct(model, partner, row, gain, posterior, z, b, tracks):  # type: ignore[no-untyped-def]
    """Correct the tracks of run b with their assigned measurement; tracks without one keep their prediction.

    `row` is the row of each pair in the gains and posteriors, shape (T,).
    """
    m, n = model.observation.shape
    innovation = np.empty(m)
    corrected = np.empty(n + m)
    for i in range(partner.shape[0]):
        tracks.detected[b, i] = partner[i] >= 0
        if partner[i] < 0:
            continue
        detected_mean(model, tracks.mean[b, i], gain[row[i]], z[partner[i]], innovation, corrected)
        tracks.mean[b, i] = corrected
        tracks.covariance[b, i] = 0.0
        tracks.covariance[b, i, :n, :n] = posterior[row[i]]
