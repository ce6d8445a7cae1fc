"""Birth models: targets appear at known places, at the last measurements, or by splitting from other targets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.capacity import warn_of_cap
from servotrack.estimators.rfs.first_state import observation_inverse, sensed_starts, state_from_measurement
from servotrack.estimators.rfs.models import (
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    TargetModel,
    checked_covariance,
)
from servotrack.estimators.rfs.sensors import SensedModel
from servotrack.estimators.rfs.sets import REPORTED
from servotrack.estimators.types import Array


class BirthMixture(NamedTuple):
    """Gaussians over the state of targets that appear; weight 0 marks an unused row.

    Attributes:
        weight: Expected number of targets, or a track's probability of existence. Shape (*batch, K).
        mean: Means of the states. Shape (*batch, K, n); of state and measurement, (*batch, K, n + m), before the
            prediction under a pairwise model.
        covariance: Covariances of the states. Shape (*batch, K, n, n).
    """

    weight: Array
    mean: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Birth:
    """Births at known places, the same at every step.

    Args:
        weights: Expected number of births per step at each place, in (0, 1]. Shape (K,).
        means: Mean state at each place. Shape (K, n).
        covariances: Covariance at each place, positive definite. Shape (K, n, n), or (n, n) for all places.

    Raises:
        ValueError: An argument has a wrong shape, is out of range or is not positive definite.
    """

    weights: Array
    means: Array
    covariances: Array

    def __post_init__(self) -> None:
        means = np.array(self.means, dtype=np.float64)
        if means.ndim != 2 or not np.all(np.isfinite(means)):
            raise ValueError(f"means must be finite with shape (K, n), got shape {means.shape}")
        places, n = means.shape
        weights = np.broadcast_to(np.asarray(self.weights, dtype=np.float64), (places,)).copy()
        if not np.all((weights > 0.0) & (weights <= 1.0)):
            raise ValueError(f"weights must be in (0, 1], got {weights.tolist()}; leave out places without births")
        covariances = np.asarray(self.covariances, dtype=np.float64)
        if covariances.shape not in ((n, n), (places, n, n)):
            raise ValueError(f"covariances must have shape ({n}, {n}) or ({places}, {n}, {n}), got {covariances.shape}")
        covariances = np.broadcast_to(covariances, (places, n, n)).copy()
        for matrix in covariances:
            checked_covariance("covariances", matrix, n, definite=True)
        object.__setattr__(self, "weights", weights)
        object.__setattr__(self, "means", means)
        object.__setattr__(self, "covariances", covariances)


@dataclass(frozen=True, eq=False)
class MeasurementBirth:
    """Births at the last measurements that no known target explains (Reuter et al. 2014, section IV).

    The expected number of births is shared among the last measurements by their probability of being unexplained. The
    position is that of the measurement; unmeasured state entries start at zero with the given deviation.

    Args:
        expected: Expected number of births per step, > 0. Raising it starts tracks sooner and reports more clutter.
        hidden_deviation: Standard deviation of unmeasured state entries (velocities), > 0, in the state's unit. A
            number, or shape (n,), whose entries of measured coordinates are ignored.
        largest: Upper limit of the weight of one measurement, in (0, 1].
        places: Largest number of measurements with a birth; the least explained are taken, and a step that leaves out
            one that is probably new or clutter warns. None: no limit; arrays have room for 100 and double when there
            are more measurements.

    Warns:
        UserWarning: `places` leaves out a measurement that no target explains.

    Raises:
        ValueError: An argument is out of range.
    """

    expected: float = 0.1
    hidden_deviation: ArrayLike = 10.0
    largest: float = 0.1
    places: int | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.expected) and self.expected > 0.0):
            raise ValueError(f"expected must be finite and > 0, got {self.expected!r}")
        deviation = np.asarray(self.hidden_deviation, dtype=np.float64)
        if not (np.all(np.isfinite(deviation)) and np.all(deviation > 0.0)):
            raise ValueError(f"hidden_deviation must be finite and > 0, got {self.hidden_deviation!r}")
        if not 0.0 < self.largest <= 1.0:
            raise ValueError(f"largest must be in (0, 1], got {self.largest!r}")
        if self.places is not None and self.places < 1:
            raise ValueError(f"places must be at least 1 or None, got {self.places!r}")

    def empty(self, batch: int, model: TargetModel, measurements: int = 0) -> BirthMixture:
        """Births of weight 0 for `batch` runs, with room for those at so many measurements."""
        packed = model.packed
        m, n = packed.observation.shape
        width, rows = n + m if packed.pairwise else n, self._rows(measurements)
        return BirthMixture(np.zeros((batch, rows)), np.zeros((batch, rows, width)), np.zeros((batch, rows, n, n)))

    def _rows(self, measurements: int) -> int:
        """Rows of the arrays of births."""
        if self.places is not None:
            return self.places
        rows = 100
        while rows < measurements:
            rows *= 2
        return rows

    def born(
        self,
        model: TargetModel,
        measurements: Array,
        unexplained: Array,
        share: float = 1.0,
        excess: Array | None = None,
    ) -> BirthMixture | None:
        """Births at the measurements of this step, as they are at its time; `predicted` moves them to the next.

        Args:
            model: Model of one target, with the sensor of this step.
            measurements: Measurements of this step. Shape (batch, Z, m).
            unexplained: Probability that a measurement is clutter or new; 0 for unused rows. Shape (batch, Z).
            share: The interval before this step, in which the targets appeared, as a share of the one that `expected`
                is for.
            excess: Noise of each measurement in excess of the sensor's; None or no rows: none. Shape (batch, Z, m, m).

        Returns:
            The births; None if the sensor does not say where a target with a measurement may be.
        """
        batch, number = measurements.shape[:2]
        kept = min(self._rows(number), number)
        if kept == 0:
            return None if isinstance(model, SensedModel) and model.sensor.places is None else self.empty(batch, model)
        z = np.ascontiguousarray(measurements)
        if kept < number and np.any(np.sort(unexplained, axis=1)[:, number - kept - 1] >= REPORTED):
            warn_of_cap("places of births", "births")
        found = self._starts(model, z, excess)
        if found is None:
            return None
        mean, covariance = found
        births, pieces = self.empty(batch, model, number), mean.shape[2]
        if pieces > 1:
            births = BirthMixture(*(np.repeat(field, pieces, axis=1) for field in births))
        _share(births, z, unexplained, mean, covariance, kept, share * self.expected, self.largest)
        return births

    def predicted(self, model: TargetModel, births: BirthMixture) -> BirthMixture:
        """Births moved to the time of the next step.

        Args:
            model: Model of one target over the interval since the births.
            births: Result of `born`.
        """
        packed = model.packed
        mean = np.zeros((*births.weight.shape, packed.observation.shape[1]))
        covariance = np.zeros(births.covariance.shape)
        _move(births, packed.transition, packed.noise, mean, covariance)
        return BirthMixture(births.weight, mean, covariance)

    def _starts(self, model: TargetModel, z: Array, excess: Array | None) -> tuple[Array, Array] | None:
        """Means (batch, Z, c, n) at measurements, and covariances, (1, 1, 1, n, n) if all are the same."""
        if isinstance(model, SensedModel):
            return sensed_starts(model, z, self.hidden_deviation, excess)
        if isinstance(model, RangeBearingModel) or (excess is not None and excess.shape[1] > 0):
            mean, covariance = state_from_measurement(model, z, self.hidden_deviation, excess)
            return mean[:, :, None], covariance[:, :, None]
        # A model's own matrices are the same objects over all intervals; its packed ones are copies.
        own = model if isinstance(model, HiddenMarkovModel | PairwiseMarkovModel) else model.packed
        H, R = own.observation, own.measurement_noise
        kept: _LinearBirth | None = self.__dict__.get("_kept")
        if kept is None or not (_equal(kept.observation, H) and _equal(kept.noise, R)):
            # Under a linear model the covariance is the same at every step.
            _, covariance = state_from_measurement(model, np.zeros((1, 1, z.shape[-1])), self.hidden_deviation)
            kept = _LinearBirth(H, R, observation_inverse(model), covariance[:, :, None])
            object.__setattr__(self, "_kept", kept)
        return np.einsum("rk,...k->...r", kept.inverse, z)[:, :, None], kept.covariance


def _equal(first: Array, second: Array) -> bool:
    """Return True if two arrays are equal; they are the same object where a filter only changes its interval."""
    return first is second or np.array_equal(first, second)


class _LinearBirth(NamedTuple):
    """Cache for births under a linear model: observation and noise, the inverse, and the covariance of a birth."""

    observation: Array
    noise: Array
    inverse: Array
    covariance: Array


def joined_births(first: BirthMixture, second: BirthMixture) -> BirthMixture:
    """Births at the measurements of two scans of one instant.

    Both scans may hold the same target, so the expected number stays that of the first, if it has births.
    """
    rows = max(first.weight.shape[1], second.weight.shape[1])
    weight, mean, covariance = (np.concatenate(pair, axis=1) for pair in zip(first, second, strict=True))
    order = np.argsort(-weight, axis=1, kind="stable")[:, :rows]
    kept = np.take_along_axis(weight, order, axis=1)
    before = first.weight.sum(axis=1)
    wanted = np.where(before > 0.0, before, second.weight.sum(axis=1))
    total = kept.sum(axis=1)
    scale = np.divide(wanted, total, out=np.zeros_like(total), where=total > 0.0)
    return BirthMixture(
        kept * np.minimum(scale, 1.0)[:, None],
        np.take_along_axis(mean, order[:, :, None], axis=1),
        np.take_along_axis(covariance, order[:, :, None, None], axis=1),
    )


@njit(cache=True, nogil=True)
def _share(births, z, unexplained, mean, covariance, kept, expected, largest):  # type: ignore[no-untyped-def]
    """Distribute the expected number of births over the `kept` least explained measurements, and over their pieces."""
    batch, _, pieces, n = mean.shape
    joint = births.mean.shape[2] > n
    for b in range(batch):
        order = np.argsort(-unexplained[b], kind="mergesort")
        total = 0.0
        for k in range(kept):
            total += unexplained[b, order[k]]
        for k in range(kept):
            j = order[k]
            share = expected * unexplained[b, j] / total if total > 0.0 else 0.0
            for piece in range(pieces):
                row = k * pieces + piece
                births.weight[b, row] = min(share, largest) / pieces
                if share <= 0.0:
                    continue
                births.mean[b, row, :n] = mean[b, j, piece]
                if joint:
                    births.mean[b, row, n:] = z[b, j]
                births.covariance[b, row] = covariance[
                    min(b, len(covariance) - 1), min(j, covariance.shape[1] - 1), piece
                ]


@njit(cache=True, nogil=True)
def _move(births, transition, noise, out_mean, out_covariance):  # type: ignore[no-untyped-def]
    """Predict the births with a weight.

    The first measurement of a target is known, so under a pairwise model it influences the next state.
    """
    weight, joint, covariance = births
    batch, rows, n = out_mean.shape
    work = np.empty((n, n))
    for b in range(batch):
        before = -1
        for k in range(rows):
            if not weight[b, k] > 0.0:
                continue
            for r in range(n):
                value = 0.0
                for c in range(joint.shape[2]):
                    value += transition[r, c] * joint[b, k, c]
                out_mean[b, k, r] = value
            # Under a linear sensor all covariances are the same.
            same = before >= 0
            if same:
                for r in range(n):
                    for c in range(n):
                        same = same and covariance[b, k, r, c] == covariance[b, before, r, c]
            if same:
                out_covariance[b, k] = out_covariance[b, before]
                continue
            before = k
            for r in range(n):
                for c in range(n):
                    value = 0.0
                    for j in range(n):
                        value += transition[r, j] * covariance[b, k, j, c]
                    work[r, c] = value
            for r in range(n):
                for c in range(r + 1):
                    value = noise[r, c]
                    for j in range(n):
                        value += work[r, j] * transition[c, j]
                    out_covariance[b, k, r, c] = value
                    out_covariance[b, k, c, r] = value
