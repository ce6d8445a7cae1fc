"""Particle filter of the total image Jacobian (Zhang 2011's reference method; Zhao, Chen and Zhang 2008)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from math import lgamma, log, pi
from typing import NamedTuple

import numpy as np

from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState, present_estimate
from servotrack.estimators.jacobian.contract import LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.prior import JacobianPrior, RandomWalk
from servotrack.estimators.jacobian.shared_covariance import interval
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array, Labels


class ParticleState(NamedTuple):
    """State of `ParticleJacobian`.

    Attributes:
        alignment: Encoder history and newest frame.
        particles: Rows of the Jacobian, one cloud per feature. Shape (*batch, m, N, n + 1).
        log_weights: Logarithms of the normalized weights. Shape (*batch, m, N).
        draws: Number of steps of the random table used so far. Shape (*batch,), int.
    """

    alignment: AlignmentState
    particles: Array
    log_weights: Array
    draws: Labels


@dataclass(frozen=True)
class ParticleJacobian:
    """Bootstrap particle filter on x' = x + w, dy = J ds + v (Zhang 2011, eq. 9), resampled systematically.

    With independent noise the rows of the Jacobian stay independent given the data, so each feature has its own cloud
    over n + 1 numbers: exact, with far fewer particles than one cloud over m (n + 1). Random numbers come from a table
    drawn once from `seed`, so that a batch row uses the same numbers in every batch.

    Args:
        particles: Number N of particles per feature. Larger values are more accurate and slower.
        degrees_of_freedom: Degrees of freedom of a Student-t likelihood; inf is the normal likelihood. Smaller values
            tolerate more outliers.
        resample_below: Effective share of the particles below which they are resampled, in (0, 1]. Larger values
            resample more often.
        kernel: Regularization (Musso, Oudjane and Le Gland 2001): resampled particles are spread by this multiple of
            the optimal normal kernel. 0 is the filter without regularization.
        seed: Seed of the table of random numbers.
        walk: Process noise of the Jacobian; larger values follow changes faster and average fewer frames.
        measurement_noise: Standard deviation (scale, with Student-t) of dy about J ds, px.
        prior: Mean and spread of the Jacobian before the first increment.
        alignment: Pairing of joints and features by time stamps.
        table_steps: Steps after which the table of random numbers repeats, at least 2. It should exceed the memory of
            the weights; memory grows in proportion.
    """

    particles: int = 300
    degrees_of_freedom: float = np.inf
    resample_below: float = 0.5
    kernel: float = 0.5
    seed: int = 0
    walk: RandomWalk = field(default_factory=RandomWalk)
    measurement_noise: float = 3.0
    prior: JacobianPrior = field(default_factory=JacobianPrior)
    alignment: Alignment = field(default_factory=Alignment)
    table_steps: int = 256

    def __post_init__(self) -> None:
        for name, count in (("particles", self.particles), ("table_steps", self.table_steps)):
            if count < 2:
                raise ValueError(f"{name} must be at least 2, got {count}")
        if not self.degrees_of_freedom > 0.0:
            raise ValueError(
                f"degrees_of_freedom must be > 0, got {self.degrees_of_freedom}; inf is the normal likelihood"
            )
        if not 0.0 < self.resample_below <= 1.0:
            raise ValueError(f"resample_below must be in (0, 1], got {self.resample_below}")
        if not 0.0 <= self.kernel < np.inf:
            raise ValueError(f"kernel must be finite and >= 0, got {self.kernel}")
        if not 0.0 < self.measurement_noise < np.inf:
            raise ValueError(f"measurement_noise must be finite and > 0 px, got {self.measurement_noise}")

    def initial(self, measurement: ServoMeasurement) -> ParticleState:
        """State before the first increment. Raises ValueError as `checked` does."""
        alignment = self.alignment.initial(measurement)
        mean, _ = self.prior.moments(alignment)
        *batch, m, _ = mean.shape
        return ParticleState(
            alignment,
            self._cloud(mean),
            np.full((*batch, m, self.particles), -np.log(self.particles)),
            np.zeros(batch, dtype=np.int64),
        )

    def step(self, state: ParticleState, measurement: ServoMeasurement) -> tuple[ParticleState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        alignment, increment = self.alignment.step(state.alignment, measurement)
        *_, m, _, columns = state.particles.shape
        normals, uniforms = _random_table(self.seed, self.table_steps, m, self.particles, columns)
        place = state.draws % self.table_steps
        spread = self.walk.deviations(columns - 1, increment.time)[..., None, None, :]
        # Normals with index 0 drive the random walk, those with index 1 the regularization.
        particles = state.particles + spread * normals[place, 0]

        predicted = np.einsum("...ipj,...j->...ip", particles, interval(increment))
        log_density = self._log_density(increment.features[..., None] - predicted)
        joint = state.log_weights + log_density
        highest = joint.max(axis=-1, keepdims=True)
        total = highest + np.log(np.sum(np.exp(joint - highest), axis=-1, keepdims=True))
        log_weights = joint - total
        weights = np.exp(log_weights)

        jacobian = np.einsum("...ip,...ipj->...ij", weights, particles)
        nis = self._nis(state.log_weights, predicted, increment.features)
        low = np.sum(weights**2, axis=-1) * self.particles * self.resample_below > 1.0
        if low.any():
            drawn = self._resampled(particles, weights, uniforms[place], normals[place, 1])
            equal = np.full_like(log_weights, -np.log(self.particles))
            particles, log_weights = select_rows(low, (drawn, equal), (particles, log_weights))

        before = np.einsum("...ip,...ipj->...ij", np.exp(state.log_weights), state.particles)
        particles, log_weights, jacobian, draws = select_rows(
            increment.fresh,
            (particles, log_weights, jacobian, state.draws + 1),
            (state.particles, state.log_weights, before, state.draws),
        )
        estimate = present_estimate(
            alignment.frame_features,
            jacobian,
            increment,
            measurement.goal,
            np.where(increment.fresh, total[..., 0].sum(axis=-1), 0.0),
            np.where(increment.fresh, nis, 0.0),
        )
        return ParticleState(alignment, particles, log_weights, draws), estimate

    def forget(self, state: ParticleState) -> ParticleState:
        """Keep the mean and draw a new cloud around it with the prior's spread."""
        mean = np.einsum("...ip,...ipj->...ij", np.exp(state.log_weights), state.particles)
        equal = np.full_like(state.log_weights, -np.log(self.particles))
        return state._replace(particles=self._cloud(mean), log_weights=equal)

    def _cloud(self, mean: Array) -> Array:
        m, columns = mean.shape[-2:]
        normals, _ = _random_table(self.seed, self.table_steps, m, self.particles, columns)
        return mean[..., None, :] + self.prior.deviations(columns - 1) * normals[-1, 0]

    def _log_density(self, residual: Array) -> Array:
        scaled = (residual / self.measurement_noise) ** 2
        if np.isinf(self.degrees_of_freedom):
            return -0.5 * scaled - 0.5 * np.log(2.0 * np.pi * self.measurement_noise**2)
        nu = self.degrees_of_freedom
        return _student_t_log_scale(nu, self.measurement_noise) - 0.5 * (nu + 1.0) * np.log1p(scaled / nu)

    def _nis(self, log_weights: Array, predicted: Array, measured: Array) -> Array:
        """Squared innovation over the predicted variance of the cloud, mean over features. Shape (*batch,)."""
        weights = np.exp(log_weights)
        center = np.einsum("...ip,...ip->...i", weights, predicted)
        variance = np.einsum("...ip,...ip->...i", weights, (predicted - center[..., None]) ** 2)
        return np.mean((measured - center) ** 2 / (variance + self.measurement_noise**2), axis=-1)

    def _resampled(self, particles: Array, weights: Array, uniform: Array, normals: Array) -> Array:
        """Resample systematically, then spread the particles with a normal kernel of the cloud's covariance."""
        count, columns = particles.shape[-2:]
        edges = np.cumsum(weights, axis=-1)
        edges /= edges[..., -1:]
        # The number of evenly spaced pointers between two edges is the number of copies of a particle.
        upto = np.ceil(edges * count - uniform[..., None]).astype(np.int64)
        copies = np.diff(upto, axis=-1, prepend=0).ravel()
        taken = np.repeat(np.tile(np.arange(count), copies.size // count), copies)
        chosen = np.take_along_axis(particles, taken.reshape(upto.shape)[..., None], axis=-2)
        if self.kernel == 0.0:
            return chosen
        center = np.einsum("...p,...pj->...j", weights, particles)
        offset = particles - center[..., None, :]
        covariance = np.einsum("...p,...pi,...pj->...ij", weights, offset, offset)
        # The floor keeps the covariance regular when the cloud has collapsed onto a few particles.
        floor = 1e-9 * np.einsum("...ii->...", covariance)[..., None, None] + 1e-12
        root = np.linalg.cholesky(covariance + floor * np.eye(columns))
        width = self.kernel * (4.0 / ((columns + 2) * count)) ** (1.0 / (columns + 4))
        return chosen + width * np.einsum("...ij,...pj->...pi", root, normals)


def _student_t_log_scale(degrees_of_freedom: float, scale: float) -> float:
    """Logarithm of the normalizing factor of a Student-t density."""
    nu = degrees_of_freedom
    return lgamma(0.5 * (nu + 1.0)) - lgamma(0.5 * nu) - 0.5 * log(nu * pi * scale**2)


@lru_cache(maxsize=8)
def _random_table(seed: int, steps: int, features: int, particles: int, columns: int) -> tuple[Array, Array]:
    """Normals (steps, 2, m, N, n + 1) for walk and kernel, uniforms (steps, m) for resampling."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((steps, 2, features, particles, columns))
    uniforms = rng.random((steps, features))
    return normals, uniforms
