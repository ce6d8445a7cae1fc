"""Motion and measurement models of one target: hidden Markov, pairwise Markov, and range-bearing sensor.

The pairwise Markov model (PMM) makes the pair of state and measurement a Markov chain,

    (x_k, y_k) = B (x_{k-1}, y_{k-1}) + w_k,   w_k ~ N(0, Sigma)                    (Pieczynski and Desbouvries 2003)

and the hidden Markov model (HMM) is the case whose B has zero y columns. `PairwiseMarkovModel.from_hidden_markov`
makes the PMM that keeps an HMM's p(x_k | x_{k-1}) and p(y_k | x_k) for free F2 and H2 (Zhang et al. 2017, section 3.1;
Petetin and Desbouvries 2013); `STRUCTURES` names the readings S1 to S6 of the paper's letters a, b, c, d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.gaussians import EXTENDED, LINEAR, UNSCENTED, PackedModel, pack_model
from servotrack.estimators.rfs.motion import AxisMotion, ConstantVelocity, Motion
from servotrack.estimators.types import Array

Structure = Literal["S1", "S2", "S3", "S4", "S5", "S6"]

STRUCTURES: tuple[Structure, ...] = ("S1", "S2", "S3", "S4", "S5", "S6")
"""Interpretations of the letters a, b, c, d in Zhang et al. 2017; `pairwise_structure` defines each."""


class TargetModel(Protocol):
    """Model of one target that every filter here accepts."""

    @property
    def packed(self) -> PackedModel:
        """Arrays of the model for the compiled kernels."""

    @property
    def period(self) -> float:
        """Interval that the model's transition and noise are for, s."""

    def at(self, dt: float) -> TargetModel:
        """The same model for another interval.

        Args:
            dt: Interval, s, at least 0.

        Raises:
            ValueError: The model has no motion for this interval.
        """


def checked_matrix(name: str, value: ArrayLike, shape: tuple[int | None, int | None]) -> Array:
    """Return a finite float64 matrix of the given shape (None: any size), or raise ValueError naming the argument."""
    matrix = np.array(value, dtype=np.float64)
    if matrix.ndim != 2 or any(size not in (None, got) for size, got in zip(shape, matrix.shape, strict=True)):
        wanted = tuple("any" if size is None else size for size in shape)
        raise ValueError(f"{name} must be a matrix of shape {wanted}, got shape {matrix.shape}")
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name} must be finite, got {matrix.tolist()}")
    matrix.setflags(write=False)
    return matrix


class MovingModel(Protocol):
    """Model with a transition and a process noise over its period."""

    @property
    def transition(self) -> Array:
        """F. Shape (n, n)."""

    @property
    def process_noise(self) -> Array:
        """Q. Shape (n, n)."""

    @property
    def motion(self) -> Motion | None:
        """Transition and process noise as functions of the interval, or None."""

    @property
    def period(self) -> float:
        """Interval of the transition, s."""


def checked_period(period: float) -> float:
    """Return the interval of a model, which is 0 for two scans at one instant, or raise ValueError."""
    if not (math.isfinite(period) and period >= 0.0):
        raise ValueError(f"period must be finite and >= 0, got {period!r}")
    return float(period)


def moved(model: MovingModel, dt: float) -> tuple[Array, Array]:
    """Transition and process noise of a model over another interval than its own.

    Args:
        model: The model.
        dt: Interval, s, at least 0; over 0 s nothing moves.

    Raises:
        ValueError: The model has no `motion`.
    """
    n = model.transition.shape[0]
    if dt == 0.0:
        return np.eye(n), np.zeros((n, n))
    if dt == model.period:
        return model.transition, model.process_noise
    if model.motion is None:
        raise ValueError(
            f"dt must be the model's period, {model.period:g} s, or 0, got {dt!r}: the model knows its transition over "
            "one period only; give it motion=, for example ConstantVelocity(process_noise)"
        )
    return model.motion(dt)


def checked_covariance(name: str, value: ArrayLike, size: int, *, definite: bool) -> Array:
    """Return a symmetric positive (semi)definite matrix, or raise ValueError naming argument and eigenvalue."""
    matrix = checked_matrix(name, value, (size, size))
    scale = float(np.abs(matrix).max(initial=0.0))
    if np.abs(matrix - matrix.T).max(initial=0.0) > 1e-12 * scale:
        raise ValueError(f"{name} must be symmetric, got {matrix.tolist()}")
    smallest = float(np.linalg.eigvalsh(matrix).min())
    # Rounding alone moves the eigenvalues by this much.
    tolerance = 1e-13 * size * scale
    if smallest < -tolerance or (definite and smallest <= tolerance):
        wanted = "positive definite" if definite else "positive semidefinite"
        raise ValueError(
            f"{name} must be {wanted}, got smallest eigenvalue {smallest:.3g}; add variance to its diagonal"
        )
    return matrix


@dataclass(frozen=True, eq=False)
class HiddenMarkovModel:
    """x_k = F x_{k-1} + u, y_k = H x_k + v with independent Gaussian u and v.

    Args:
        transition: F. Shape (n, n).
        process_noise: Q, positive semidefinite. Shape (n, n).
        observation: H. Shape (m, n).
        measurement_noise: R, positive definite. Shape (m, m).
        motion: Transition and process noise as functions of the interval, for scans at varying intervals. None: the
            model serves scans at its period only.
        period: Interval that `transition` and `process_noise` are for, s.

    Raises:
        ValueError: A matrix has a wrong shape, or is not symmetric or positive (semi)definite; the period is
            negative.
    """

    transition: Array
    process_noise: Array
    observation: Array
    measurement_noise: Array
    motion: Motion | None = None
    period: float = 1.0

    def __post_init__(self) -> None:
        F = checked_matrix("transition", self.transition, (None, None))
        n = F.shape[0]
        H = checked_matrix("observation", self.observation, (None, n))
        object.__setattr__(self, "transition", checked_matrix("transition", F, (n, n)))
        object.__setattr__(self, "observation", H)
        Q = checked_covariance("process_noise", self.process_noise, n, definite=False)
        R = checked_covariance("measurement_noise", self.measurement_noise, H.shape[0], definite=True)
        object.__setattr__(self, "process_noise", Q)
        object.__setattr__(self, "measurement_noise", R)
        object.__setattr__(self, "period", checked_period(self.period))

    def at(self, dt: float) -> HiddenMarkovModel:
        """The same model for another interval; arguments and errors as in `TargetModel`."""
        if dt == self.period:
            return self
        return HiddenMarkovModel.over(self, dt, self.observation, self.measurement_noise)

    @classmethod
    def over(cls, model: MovingModel, dt: float, H: Array, R: Array) -> HiddenMarkovModel:
        """The motion of a model over an interval with a linear measurement, whose matrices were checked before.

        Args:
            model: The model.
            dt: Interval, s, at least 0.
            H: Observation of a `HiddenMarkovModel` or a `LinearSensor`. Shape (m, n).
            R: Measurement noise of the same. Shape (m, m).

        Raises:
            ValueError: The model has no motion for the interval, or the observation is of another state.
        """
        n = model.transition.shape[0]
        F, Q = moved(model, dt)
        if isinstance(model.motion, AxisMotion) and F.shape == (n, n) and np.isfinite(Q[0, 0]):
            # Positive semidefinite by its formula.
            F.setflags(write=False)
            Q.setflags(write=False)
        else:
            F, Q = checked_matrix("transition", F, (n, n)), checked_covariance("process_noise", Q, n, definite=False)
        fields = {
            "transition": F,
            "process_noise": Q,
            "observation": H if H.shape[1] == n else checked_matrix("observation", H, (None, n)),
            "measurement_noise": R,
            "motion": model.motion,
            "period": checked_period(dt),
        }
        made = object.__new__(cls)
        # A filter makes a model for every interval: checks of what was checked before would take most of a step.
        made.__dict__.update(fields)
        return made

    @property
    def joint_noise(self) -> Array:
        """Sigma_HMM = [[Q, Q H^T], [H Q, H Q H^T + R]]. Shape (n + m, n + m)."""
        Q, H, R = self.process_noise, self.observation, self.measurement_noise
        n = Q.shape[0]
        joint = np.empty((n + R.shape[0], n + R.shape[0]))
        HQ = H @ Q
        joint[:n, :n], joint[:n, n:], joint[n:, :n], joint[n:, n:] = Q, Q @ H.T, HQ, HQ @ H.T + R
        return joint

    @cached_property
    def packed(self) -> PackedModel:
        """Arrays of the model for the compiled kernels."""
        F, H = self.transition, self.observation
        m, n = H.shape
        B = np.zeros((n + m, n + m))
        B[:n, :n], B[n:, :n] = F, H @ F
        return pack_model(LINEAR, False, B, self.joint_noise, H, self.measurement_noise)


class PairwiseSource(NamedTuple):
    """Origin of a pairwise Markov model.

    Attributes:
        model: The hidden Markov model.
        F2: Influence of y_{k-1} on x_k over the model's period. Shape (n, m).
        H2: Influence of y_{k-1} on y_k over the model's period. Shape (m, m).
    """

    model: HiddenMarkovModel
    F2: Array
    H2: Array


@dataclass(frozen=True, eq=False)
class PairwiseMarkovModel:
    """(x_k, y_k) = B (x_{k-1}, y_{k-1}) + w_k, w_k ~ N(0, Sigma), and y | x ~ N(H x, R) at a target's birth.

    Args:
        transition: B. Shape (n + m, n + m).
        noise: Sigma, positive definite. Shape (n + m, n + m).
        observation: H. Shape (m, n).
        measurement_noise: R, positive definite. Shape (m, m).
        source: The hidden Markov model behind it with F2 and H2, for scans at varying intervals; `from_hidden_markov`
            sets it. None: the model serves scans at its period only.
        period: Interval that `transition` and `noise` are for, s.

    Raises:
        ValueError: A matrix has a wrong shape, or is not symmetric or positive definite; the period is negative.
    """

    transition: Array
    noise: Array
    observation: Array
    measurement_noise: Array
    source: PairwiseSource | None = None
    period: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", checked_period(self.period))
        H = checked_matrix("observation", self.observation, (None, None))
        m, n = H.shape
        object.__setattr__(self, "observation", H)
        object.__setattr__(self, "transition", checked_matrix("transition", self.transition, (n + m, n + m)))
        object.__setattr__(self, "noise", checked_covariance("noise", self.noise, n + m, definite=True))
        R = checked_covariance("measurement_noise", self.measurement_noise, m, definite=True)
        object.__setattr__(self, "measurement_noise", R)

    @classmethod
    def from_hidden_markov(cls, model: HiddenMarkovModel, F2: ArrayLike, H2: ArrayLike) -> PairwiseMarkovModel:
        """The PMM that keeps the HMM's p(x_k | x_{k-1}) and p(y_k | x_k) (Zhang et al. 2017, section 3.1).

        F1 = F - F2 H, H1 = H F - H2 H, Sigma = Sigma_HMM - G R G^T with G = [F2; H2].

        Args:
            model: The HMM, with positive definite Q.
            F2: Influence of y_{k-1} on x_k. Shape (n, m).
            H2: Influence of y_{k-1} on y_k. Shape (m, m).

        Raises:
            ValueError: Sigma is not positive definite. The message names the condition that F2 and H2 violate.
        """
        F, H, R = model.transition, model.observation, model.measurement_noise
        m, n = H.shape
        F2, H2 = checked_matrix("F2", F2, (n, m)), checked_matrix("H2", H2, (m, m))
        margin = definiteness_margin(model, F2, H2)
        if margin <= 0.0:
            raise ValueError(
                "F2 and H2 must keep R^-1 - F2^T Q^-1 F2 - (H2 - H F2)^T R^-1 (H2 - H F2) positive definite, got its "
                f"smallest eigenvalue over that of R^-1 as {margin:.3g}; raise the process noise Q or shrink F2 and H2"
            )
        G = np.vstack([F2, H2])
        B = np.block([[F - F2 @ H, F2], [H @ F - H2 @ H, H2]])
        sigma = model.joint_noise - G @ R @ G.T
        return cls(B, 0.5 * (sigma + sigma.T), H, R, PairwiseSource(model, F2, H2), model.period)

    def at(self, dt: float) -> PairwiseMarkovModel:
        """The same model for another interval; arguments and errors as in `TargetModel`.

        F2 and H2 follow from the correlation of process noise and last measurement noise, which is that of one period:
        F2(dt) = L(dt) L(period)^-1 F2 with Q = L L^T, and H2 - H F2 is the memory of the measurement noise, which
        stays. So Sigma stays positive definite at every interval.
        """
        if dt == self.period:
            return self
        if dt <= 0.0:
            raise ValueError(
                f"dt must be > 0 under a pairwise Markov model, got {dt!r}: its measurements are one chain per target"
            )
        if self.source is None:
            raise ValueError(
                f"dt must be the model's period, {self.period:g} s, got {dt!r}: the model knows one transition only; "
                "make it by PairwiseMarkovModel.from_hidden_markov of a model with motion="
            )
        hidden, F2, H2 = self.source
        H, then = hidden.observation, hidden.at(dt)
        root = np.linalg.cholesky(hidden.process_noise)
        pushed = np.linalg.cholesky(then.process_noise) @ np.linalg.solve(root, F2)
        found = PairwiseMarkovModel.from_hidden_markov(then, pushed, H2 - H @ F2 + H @ pushed)
        return replace(found, source=self.source, period=dt)

    @cached_property
    def packed(self) -> PackedModel:
        """Arrays of the model for the compiled kernels."""
        return pack_model(LINEAR, True, self.transition, self.noise, self.observation, self.measurement_noise)


@dataclass(frozen=True, eq=False)
class RangeBearingModel:
    """x_k = F x_{k-1} + u; y is range and bearing of the position from a sensor, with Gaussian noise.

    Args:
        transition: F. Shape (n, n).
        process_noise: Q, positive semidefinite. Shape (n, n).
        position: Rows that select the position from the state. Shape (2, n).
        measurement_noise: R of range (m^2) and bearing (rad^2), positive definite. Shape (2, 2).
        sensor: Position of the sensor. Shape (2,), m.
        transform: "ekf" linearizes the measurement at the mean, "ukf" uses the unscented transform.
        motion: Transition and process noise as functions of the interval; None: scans at the period only.
        period: Interval that `transition` and `process_noise` are for, s.

    Raises:
        ValueError: A matrix, the sensor's position, the transform or the period is invalid.
    """

    transition: Array
    process_noise: Array
    position: Array
    measurement_noise: Array
    sensor: tuple[float, float] = (0.0, 0.0)
    transform: Literal["ekf", "ukf"] = "ukf"
    motion: Motion | None = None
    period: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", checked_period(self.period))
        # The rules for the dynamics and the selection are those of a hidden Markov model.
        linear = HiddenMarkovModel(self.transition, self.process_noise, self.position, self.measurement_noise)
        if linear.observation.shape[0] != 2:
            raise ValueError(f"position must select 2 coordinates, got {linear.observation.shape[0]} rows")
        object.__setattr__(self, "transition", linear.transition)
        object.__setattr__(self, "process_noise", linear.process_noise)
        object.__setattr__(self, "position", linear.observation)
        object.__setattr__(self, "measurement_noise", linear.measurement_noise)
        sensor = np.asarray(self.sensor, dtype=np.float64)
        if sensor.shape != (2,) or not np.all(np.isfinite(sensor)):
            raise ValueError(f"sensor must be two finite coordinates, got {self.sensor!r}")
        if self.transform not in ("ekf", "ukf"):
            raise ValueError(f'transform must be "ekf" or "ukf", got {self.transform!r}')

    def at(self, dt: float) -> RangeBearingModel:
        """The same model for another interval; arguments and errors as in `TargetModel`."""
        if dt == self.period:
            return self
        F, Q = moved(self, dt)
        return replace(self, transition=F, process_noise=Q, period=dt)

    @cached_property
    def packed(self) -> PackedModel:
        """Arrays of the model for the compiled kernels."""
        n = self.transition.shape[0]
        B, sigma = np.zeros((n + 2, n + 2)), np.zeros((n + 2, n + 2))
        B[:n, :n], sigma[:n, :n] = self.transition, self.process_noise
        kind = EXTENDED if self.transform == "ekf" else UNSCENTED
        return pack_model(kind, False, B, sigma, self.position, self.measurement_noise, self.sensor, (False, True))


def definiteness_margin(model: HiddenMarkovModel, F2: ArrayLike, H2: ArrayLike) -> float:
    """Smallest generalized eigenvalue of the condition on F2 and H2; Sigma is positive definite if it is above 0.

    With R = L L^T it is the smallest eigenvalue of L^T (R^-1 - F2^T Q^-1 F2 - Phi^T R^-1 Phi) L, Phi = H2 - H F2. It
    is 1 at F2 = 0, H2 = 0, and minus infinity for a singular Q, which allows no pairwise model.
    """
    Q, H, R = model.process_noise, model.observation, model.measurement_noise
    F2, H2 = np.asarray(F2, dtype=np.float64), np.asarray(H2, dtype=np.float64)
    eigenvalues = np.linalg.eigvalsh(Q)
    if eigenvalues.min() <= 1e-13 * Q.shape[0] * eigenvalues.max():
        return -np.inf
    L = np.linalg.cholesky(R)
    memory = np.linalg.solve(L, (H2 - H @ F2) @ L)
    push = np.linalg.solve(np.linalg.cholesky(Q), F2 @ L)
    return float(np.linalg.eigvalsh(np.eye(R.shape[0]) - push.T @ push - memory.T @ memory).min())


def constant_velocity(
    process_noise: float, measurement_noise: float, *, period: float = 1.0, dimensions: int = 2
) -> HiddenMarkovModel:
    """Nearly constant velocity with full-rank Q, positions measured; the state is [x, vx, y, vy, ...].

    Args:
        process_noise: sigma_v, so that Q = sigma_v^2 [[t^3/3, t^2/2], [t^2/2, t]] per axis, m/s^1.5.
        measurement_noise: sigma_w, standard deviation of a measured coordinate, m.
        period: t, s.
        dimensions: Number of spatial axes.

    Raises:
        ValueError: A value is not positive.
    """
    for name, value in (("process_noise", process_noise), ("measurement_noise", measurement_noise), ("period", period)):
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be finite and > 0, got {value!r}")
    motion = ConstantVelocity(process_noise, dimensions)
    F, Q = motion(period)
    axes = np.eye(dimensions)
    return HiddenMarkovModel(
        transition=F,
        process_noise=Q,
        observation=np.kron(axes, np.array([[1.0, 0.0]])),
        measurement_noise=measurement_noise**2 * axes,
        motion=motion,
        period=period,
    )


def pairwise_structure(
    model: HiddenMarkovModel,
    structure: Structure = "S1",
    letters: tuple[float, float, float, float] = (0.7, 0.7, 0.1, 0.1),
) -> PairwiseMarkovModel:
    """Build the PMM of a planar constant-velocity HMM for one interpretation of Zhang et al. 2017's letters a, b, c, d.

    S1: F2 has a, b on the positions, H2 = diag(c, d). S2: F2 has a on positions and b on velocities, H2 = diag(c, d).
    S3: F2 has a, b on positions and c, d on velocities, H2 = 0. S4: S1 with (c, d) and (a, b) swapped. S5: S2 with
    them swapped. S6: F2 = 0, H2 = diag(a, b), that is, colored measurement noise only.

    Args:
        model: Model with state [x, vx, y, vy] and measurement [x, y], as returned by `constant_velocity`.
        structure: "S1" to "S6".
        letters: a, b, c, d.

    Raises:
        ValueError: The structure is unknown, the model has another state, or the noise is not positive definite.
    """
    if structure not in STRUCTURES:
        raise ValueError(f"structure must be one of {', '.join(STRUCTURES)}, got {structure!r}")
    if model.observation.shape != (2, 4):
        raise ValueError(f"model must have 4 states and 2 measurements, got observation {model.observation.shape}")
    a, b, c, d = letters
    position_x, position_y, velocity_x, velocity_y, memory = {
        "S1": (a, b, 0.0, 0.0, (c, d)),
        "S2": (a, a, b, b, (c, d)),
        "S3": (a, b, c, d, (0.0, 0.0)),
        "S4": (c, d, 0.0, 0.0, (a, b)),
        "S5": (c, c, d, d, (a, b)),
        "S6": (0.0, 0.0, 0.0, 0.0, (a, b)),
    }[structure]
    F2 = np.array([[position_x, 0.0], [velocity_x, 0.0], [0.0, position_y], [0.0, velocity_y]])
    return PairwiseMarkovModel.from_hidden_markov(model, F2, np.diag(memory))
