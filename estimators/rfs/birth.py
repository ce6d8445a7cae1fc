"""Birth models: targets appear at known places, at the last measurements, or by splitting from other targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.rfs.models import RangeBearingModel, TargetModel, checked_covariance
from servotrack.estimators.types import Array


class BirthMixture(NamedTuple):
    """Gaussians over the state of targets that appear at the next step; weight 0 marks an unused row.

    Attributes:
        weight: Expected number of targets, or a track's probability of existence. Shape (*batch, K).
        mean: Means of the states. Shape (*batch, K, n).
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
        places: Largest number of measurements with a birth; the least explained are taken.

    Raises:
        ValueError: An argument is out of range.
    """

    expected: float = 0.1
    hidden_deviation: ArrayLike = 10.0
    largest: float = 0.1
    places: int = 100

    def __post_init__(self) -> None:
        if not (np.isfinite(self.expected) and self.expected > 0.0):
            raise ValueError(f"expected must be finite and > 0, got {self.expected!r}")
        deviation = np.asarray(self.hidden_deviation, dtype=np.float64)
        if not (np.all(np.isfinite(deviation)) and np.all(deviation > 0.0)):
            raise ValueError(f"hidden_deviation must be finite and > 0, got {self.hidden_deviation!r}")
        if not 0.0 < self.largest <= 1.0:
            raise ValueError(f"largest must be in (0, 1], got {self.largest!r}")
        if self.places < 1:
            raise ValueError(f"places must be at least 1, got {self.places!r}")

    def empty(self, batch: int, n: int) -> BirthMixture:
        """Births of weight 0 for `batch` runs."""
        return BirthMixture(
            np.zeros((batch, self.places)), np.zeros((batch, self.places, n)), np.zeros((batch, self.places, n, n))
        )

    def next(self, model: TargetModel, measurements: Array, unexplained: Array) -> BirthMixture:
        """Births of the next step, predicted to that step.

        Args:
            model: Model of one target.
            measurements: Measurements of this step. Shape (batch, Z, m).
            unexplained: Probability that a measurement is clutter or new; 0 for unused rows. Shape (batch, Z).
        """
        batch, kept = measurements.shape[0], min(self.places, measurements.shape[1])
        packed = model.packed
        n = packed.observation.shape[1]
        births = self.empty(batch, n)
        if kept == 0:
            return births
        z, chance = _least_explained(np.ascontiguousarray(measurements), unexplained, kept)
        mean, covariance = self._born(model, z)
        _fill(births, z, chance, mean, covariance, packed.transition, self.expected, self.largest)
        return births

    def _born(self, model: TargetModel, z: Array) -> tuple[Array, Array]:
        """Means (batch, Z, n) at measurements, and covariances one step later, (1, 1, n, n) if all are the same."""
        if isinstance(model, RangeBearingModel):
            mean, covariance = state_from_measurement(model, z, self.hidden_deviation)
            return mean, _next_covariance(model, covariance)
        kept: _LinearBirth | None = self.__dict__.get("_kept")
        if kept is None or kept.model is not model:
            # Under a linear model the covariance is the same at every step.
            _, covariance = state_from_measurement(model, np.zeros((1, 1, z.shape[-1])), self.hidden_deviation)
            kept = _LinearBirth(model, _inverse(model), _next_covariance(model, covariance))
            object.__setattr__(self, "_kept", kept)
        return np.einsum("rk,...k->...r", kept.inverse, z), kept.covariance


class _LinearBirth(NamedTuple):
    """Cache for births under a linear model: inverse of the observation, and covariance one step later."""

    model: TargetModel
    inverse: Array
    covariance: Array


@njit(cache=True, nogil=True)
def _least_explained(measurements, unexplained, kept):  # type: ignore[no-untyped-def]
    """The `kept` least explained measurements of each run, the least first, and their probability of being new."""
    batch, _, m = measurements.shape
    z, chance = np.empty((batch, kept, m)), np.empty((batch, kept))
    for b in range(batch):
        order = np.argsort(-unexplained[b], kind="mergesort")
        for k in range(kept):
            z[b, k], chance[b, k] = measurements[b, order[k]], unexplained[b, order[k]]
    return z, chance


@njit(cache=True, nogil=True)
def _fill(births, z, chance, mean, covariance, transition, expected, largest):  # type: ignore[no-untyped-def]
    """Distribute the expected number of births and predict those of positive weight.

    The first measurement of a target is known, so under a pairwise model it influences the next state.
    """
    batch, kept, n = mean.shape
    for b in range(batch):
        total = 0.0
        for k in range(kept):
            total += chance[b, k]
        for k in range(kept):
            share = expected * chance[b, k] / total if total > 0.0 else 0.0
            births.weight[b, k] = min(share, largest)
            if share <= 0.0:
                continue
            for r in range(n):
                value = 0.0
                for c in range(n):
                    value += transition[r, c] * mean[b, k, c]
                for c in range(z.shape[2]):
                    value += transition[r, n + c] * z[b, k, c]
                births.mean[b, k, r] = value
            births.covariance[b, k] = covariance[min(b, len(covariance) - 1), min(k, covariance.shape[1] - 1)]


@dataclass(frozen=True, eq=False)
class Spawn:
    """Splitting of targets: N(d + F_beta x, Q_beta + F_beta P F_beta^T) with weight w_beta (Wu and Hu 2010, step 2.2).

    Args:
        weight: w_beta, expected number of targets split off per target and step, in (0, 1].
        noise: Q_beta, positive definite. Shape (n, n).
        transition: F_beta; None for the identity. Shape (n, n).
        offset: d; None for zero. Shape (n,).

    Raises:
        ValueError: An argument is out of range or has a wrong shape.
    """

    weight: float
    noise: Array
    transition: Array | None = None
    offset: Array | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.weight <= 1.0:
            raise ValueError(f"weight must be in (0, 1], got {self.weight!r}")
        n = np.asarray(self.noise).shape[0]
        noise = np.array(checked_covariance("noise", self.noise, n, definite=True))
        transition = np.eye(n) if self.transition is None else np.array(self.transition, dtype=np.float64)
        offset = np.zeros(n) if self.offset is None else np.array(self.offset, dtype=np.float64)
        if transition.shape != (n, n) or offset.shape != (n,):
            raise ValueError(
                f"transition and offset must match noise of shape ({n}, {n}), got {transition.shape}, {offset.shape}"
            )
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "transition", transition)
        object.__setattr__(self, "offset", offset)


def pack_spawns(spawns: Sequence[Spawn], n: int) -> tuple[Array, Array, Array, Array]:
    """Pack spawn terms for the kernels: weights (S,), offsets (S, n), transitions (S, n, n), noises (S, n, n)."""
    for spawn in spawns:
        if spawn.noise.shape != (n, n):
            raise ValueError(f"spawn noise must have shape ({n}, {n}), got {spawn.noise.shape}")
    terms = len(spawns)
    return (
        np.array([s.weight for s in spawns]),
        np.array([s.offset for s in spawns], dtype=np.float64).reshape(terms, n),
        np.array([s.transition for s in spawns], dtype=np.float64).reshape(terms, n, n),
        np.array([s.noise for s in spawns], dtype=np.float64).reshape(terms, n, n),
    )


def state_from_measurement(model: TargetModel, z: Array, hidden_deviation: ArrayLike) -> tuple[Array, Array]:
    """Distribution of the state given one measurement only.

    Args:
        model: Model of one target.
        z: Measurements. Shape (*batch, m).
        hidden_deviation: Standard deviation of the unmeasured state entries; a number or shape (n,).

    Returns:
        mean (*batch, n), zero in unmeasured entries; covariance (*batch, n, n).
    """
    packed, inverse = model.packed, _inverse(model)
    n = len(inverse)
    deviation = np.broadcast_to(np.asarray(hidden_deviation, dtype=np.float64), (n,))
    blind = np.eye(n) - inverse @ packed.observation
    hidden = blind @ np.diag(deviation**2) @ blind.T
    if isinstance(model, RangeBearingModel):
        distance, bearing = z[..., 0], z[..., 1]
        cosine, sine = np.cos(bearing), np.sin(bearing)
        position = packed.sensor + np.stack([distance * cosine, distance * sine], axis=-1)
        polar = np.stack(
            [np.stack([cosine, -distance * sine], axis=-1), np.stack([sine, distance * cosine], axis=-1)], axis=-2
        )
        noise = np.einsum("...ij,jk,...lk->...il", polar, packed.measurement_noise, polar)
    else:
        position = z
        noise = np.broadcast_to(packed.measurement_noise, (*z.shape[:-1], *packed.measurement_noise.shape))
    mean = np.einsum("rk,...k->...r", inverse, position)
    return mean, hidden + np.einsum("rk,...kl,cl->...rc", inverse, noise, inverse)


def _next_covariance(model: TargetModel, covariance: Array) -> Array:
    """Covariances (batch, Z, n, n) one step later."""
    n = covariance.shape[-1]
    B, sigma = model.packed.transition[:n], model.packed.noise[:n, :n]
    moved = np.einsum("rk,bzkl,cl->bzrc", B[:, :n], covariance, B[:, :n]) + sigma
    return 0.5 * (moved + np.swapaxes(moved, -1, -2))


def _inverse(model: TargetModel) -> Array:
    """Pseudoinverse of the observation: from a measurement to the measured state entries. Shape (n, m)."""
    return np.asarray(np.linalg.pinv(model.packed.observation), dtype=np.float64)
