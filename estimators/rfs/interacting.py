"""Motion modes for targets that maneuver: ready models, and sets of models for an interacting multiple model filter.

A target moves by one of S models at a time and changes between them as a Markov chain (Blom and Bar-Shalom 1988). All
models share the state and the measurement. Models of different order get a common state: `constant_acceleration` and
`white_acceleration` have the state [x, vx, ax, y, vy, ay], and `constant_velocity` and `coordinated_turn` the state
[x, vx, y, vy].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.interacting_kernel import PackedModes
from servotrack.estimators.rfs.models import (
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    TargetModel,
    checked_period,
)
from servotrack.estimators.rfs.motion import (
    Agile,
    ConstantAcceleration,
    CoordinatedTurn,
    Motion,
    Turning,
    WhiteAcceleration,
    turn,
)
from servotrack.estimators.rfs.sensors import Sensor, model_at
from servotrack.estimators.types import Array

Model = HiddenMarkovModel | PairwiseMarkovModel | RangeBearingModel


@dataclass(frozen=True, eq=False)
class InteractingModels:
    """Motion modes of a target and the probabilities of changes between them.

    Args:
        models: One model per mode; all have the same measurement and are either all pairwise or all hidden Markov. The
            first one is the nominal one.
        switching: Probability of mode c at a scan if the mode was r at the scan before; rows sum to one. Shape (S, S).
            Raising the diagonal makes the modes last longer: maneuvers are smoother, and are noticed later.
        initial: Probabilities of the modes of a new target; None: the stationary ones of `switching`. Shape (S,).

    Raises:
        ValueError: There is no model, models do not fit together, or probabilities are invalid.
    """

    models: Sequence[TargetModel]
    switching: Array
    initial: Array | None = None

    def __post_init__(self) -> None:
        models = tuple(self.models)
        object.__setattr__(self, "models", models)
        S = len(models)
        if S == 0:
            raise ValueError("models must hold at least one model, got none")
        first = models[0].packed
        for k, model in enumerate(models[1:], 1):
            other = model.packed
            for name in ("kind", "pairwise", "observation", "measurement_noise", "sensor", "angular"):
                if not np.array_equal(getattr(first, name), getattr(other, name)):
                    raise ValueError(f"models must share their measurement: models[{k}] and models[0] differ in {name}")
        switching = _probabilities("switching", self.switching, (S, S))
        object.__setattr__(self, "switching", switching)
        initial = _stationary(switching) if self.initial is None else self.initial
        object.__setattr__(self, "initial", _probabilities("initial", initial, (S,)))

    def at(self, dt: float | None = None, sensor: Sensor | None = None) -> InteractingModels:
        """The same modes for another interval and another sensor; arguments and errors as in `GaussianSetFilter.at`.

        Changes between the modes follow the interval: a whole number of periods by a power of `switching`, the rest by
        a share of it.
        """
        models = [model_at(model, dt, sensor) for model in self.models]
        periods = models[0].period / self.models[0].period
        whole = int(periods)
        rest = (1.0 - (periods - whole)) * np.eye(len(models)) + (periods - whole) * self.switching
        switching = np.einsum("rk,kc->rc", _power(self.switching, whole), rest)
        return InteractingModels(models, switching, self.initial)

    @cached_property
    def packed(self) -> PackedModes:
        """Arrays of the modes for the compiled kernels."""
        packed = [model.packed for model in self.models]
        return PackedModes(
            np.stack([one.transition for one in packed]),
            np.stack([one.noise for one in packed]),
            np.array(self.switching),
            np.array(self.initial),
        )


def lasting(scans: ArrayLike) -> Array:
    """Switching probabilities of modes that last for some scans on average; all changes are equally likely.

    Args:
        scans: Mean number of scans of each mode, at least 1. Shape (S,).

    Returns:
        Shape (S, S).

    Raises:
        ValueError: A duration is less than one scan or not finite.
    """
    duration = np.atleast_1d(np.asarray(scans, dtype=np.float64))
    if duration.ndim != 1 or not np.all(np.isfinite(duration) & (duration >= 1.0)):
        raise ValueError(f"scans must be finite and at least 1, shape (S,), got {scans!r}")
    S = len(duration)
    if S == 1:
        return np.ones((1, 1))
    leaving = 1.0 / duration
    switching = np.repeat(leaving[:, None] / (S - 1), S, axis=1)
    np.fill_diagonal(switching, 1.0 - leaving)
    return switching


def coordinated_turn(
    turn_rate: float, process_noise: float, measurement_noise: float, *, period: float = 1.0
) -> HiddenMarkovModel:
    """Turn at a known rate with nearly constant speed (Bar-Shalom, Li and Kirubarajan 2001); state [x, vx, y, vy].

    Args:
        turn_rate: Rate of the turn, rad/s, positive counterclockwise; 0 is `constant_velocity`.
        process_noise: sigma_v as in `constant_velocity`, m/s^1.5.
        measurement_noise: Standard deviation of a measured coordinate, m.
        period: Time between scans, s.

    Raises:
        ValueError: A value is not finite, or a noise or the period is not positive.
    """
    return _positions(CoordinatedTurn(process_noise, turn_rate), measurement_noise, period, 2, 2)


def constant_acceleration(
    process_noise: float, measurement_noise: float, *, period: float = 1.0, dimensions: int = 2
) -> HiddenMarkovModel:
    """Nearly constant acceleration, positions measured; the state is [x, vx, ax, y, vy, ay, ...].

    Args:
        process_noise: sigma_a: the acceleration is a random walk of this intensity, m/s^2.5.
        measurement_noise: Standard deviation of a measured coordinate, m.
        period: Time between scans, s.
        dimensions: Number of spatial axes.

    Raises:
        ValueError: A value is not positive.
    """
    return _positions(ConstantAcceleration(process_noise, dimensions), measurement_noise, period, dimensions, 3)


def white_acceleration(
    process_noise: float, measurement_noise: float, *, period: float = 1.0, dimensions: int = 2
) -> HiddenMarkovModel:
    """`constant_velocity` with the state of `constant_acceleration`, to stand beside it; see `WhiteAcceleration`.

    Args:
        process_noise: sigma_v as in `constant_velocity`, m/s^1.5.
        measurement_noise: Standard deviation of a measured coordinate, m.
        period: Time between scans, s.
        dimensions: Number of spatial axes.

    Raises:
        ValueError: A value is not positive.
    """
    return _positions(WhiteAcceleration(process_noise, dimensions), measurement_noise, period, dimensions, 3)


def maneuvers(
    model: Model, *, agility: float = 3.0, turn_rate: float = 0.15, straight: float = 20.0, turning: float = 5.0
) -> InteractingModels:
    """Modes of a target that maneuvers, made from the model of its straight motion.

    The modes are the model itself, the model with more process noise, and turns to the left and to the right.

    Args:
        model: Model with the state [x, vx, y, vy], hidden or pairwise Markov or a range-bearing sensor.
        agility: Factor on the standard deviation of the process noise of the second mode, at least 1. Raising it
            follows stronger maneuvers and admits more clutter.
        turn_rate: Rate of the turns, rad/s; 0 leaves the turns out. Best near the typical rate of the targets.
        straight: Mean duration of the first mode, scans. Raising it is better where targets maneuver rarely.
        turning: Mean duration of each other mode, scans.

    Raises:
        ValueError: An argument is out of range, or the model has another state.
    """
    if not (math.isfinite(agility) and agility >= 1.0):
        raise ValueError(f"agility must be finite and at least 1, got {agility!r}")
    if not (math.isfinite(turn_rate) and turn_rate >= 0.0):
        raise ValueError(f"turn_rate must be finite and >= 0, got {turn_rate!r}")
    F, Q = hidden_motion(model)
    period = float(F[0, 1])
    if F.shape != (4, 4) or not np.allclose(F, turn(0.0, period), rtol=0.0, atol=1e-9 * max(1.0, abs(period))):
        raise ValueError(
            f"model must have the state [x, vx, y, vy] and constant velocity, got transition {F.tolist()}; "
            "pass your own modes to InteractingModels"
        )
    own = model.source.model.motion if isinstance(model, PairwiseMarkovModel) and model.source else None
    motion = own if isinstance(model, PairwiseMarkovModel) else model.motion
    models = [model, with_motion(model, F, agility**2 * Q, motion and Agile(motion, agility))]
    if turn_rate > 0.0:
        for rate in (turn_rate, -turn_rate):
            models.append(with_motion(model, turn(rate, period), Q, motion and Turning(motion, rate)))
    return InteractingModels(models, lasting([straight] + [turning] * (len(models) - 1)))


def hidden_motion(model: Model) -> tuple[Array, Array]:
    """F and Q of p(x_k | x_{k-1}) of a model, each of shape (n, n).

    For a pairwise model these are F1 + F2 H and Sigma11 + F2 R F2^T (Zhang et al. 2017, section 3.1).
    """
    if not isinstance(model, PairwiseMarkovModel):
        return model.transition, model.process_noise
    H, n = model.observation, model.observation.shape[1]
    F2 = model.transition[:n, n:]
    F, Q = model.transition[:n, :n] + F2 @ H, model.noise[:n, :n] + F2 @ model.measurement_noise @ F2.T
    return F, 0.5 * (Q + Q.T)


def with_motion(model: Model, transition: Array, process_noise: Array, motion: Motion | None = None) -> Model:
    """Return the model with other F and Q; the measurement, and F2 and H2 of a pairwise model, stay.

    Args:
        model: The model.
        transition: F. Shape (n, n).
        process_noise: Q. Shape (n, n).
        motion: F and Q as functions of the interval; None: scans at the model's period only.

    Raises:
        ValueError: F and Q do not fit the model, or leave a pairwise model without a valid noise.
    """
    if not isinstance(model, PairwiseMarkovModel):
        return replace(model, transition=transition, process_noise=process_noise, motion=motion)
    n = model.observation.shape[1]
    hidden = HiddenMarkovModel(
        transition, process_noise, model.observation, model.measurement_noise, motion, model.period
    )
    return PairwiseMarkovModel.from_hidden_markov(hidden, model.transition[:n, n:], model.transition[n:, n:])


def _positions(motion: Motion, deviation: float, period: float, dimensions: int, order: int) -> HiddenMarkovModel:
    """A motion whose positions, the first of `order` entries of each axis, are measured."""
    if not (np.isfinite(deviation) and deviation > 0.0):
        raise ValueError(f"measurement_noise must be finite and > 0, got {deviation!r}")
    if not checked_period(period) > 0.0:
        raise ValueError(f"period must be finite and > 0, got {period!r}")
    F, Q = motion(period)
    axes, first = np.eye(dimensions), np.eye(order)[:1]
    observation = np.kron(axes, first).astype(np.float64)
    return HiddenMarkovModel(F, Q, observation, deviation**2 * axes, motion, period)


def _probabilities(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, one entry per model, got {array.shape}")
    if not (np.all(array >= 0.0) and np.allclose(array.sum(axis=-1), 1.0, rtol=0.0, atol=1e-9)):
        raise ValueError(f"{name} must hold probabilities that sum to 1, got {array.tolist()}")
    array.setflags(write=False)
    return array


def _stationary(switching: Array) -> Array:
    """Stationary distribution of a Markov chain; where it is not unique, that of a start with equal probabilities."""
    S = len(switching)
    # A chain that stays where it is at every second scan has the same one and no cycles. 2^60 scans are enough.
    return np.asarray(np.einsum("rc->c", _power(0.5 * (np.eye(S) + switching), 2**60)) / S)


def _power(matrix: Array, exponent: int) -> Array:
    """Power of a matrix of probabilities.

    Libraries of linear algebra round differently, so products are sums in order.
    """
    found, square = np.eye(len(matrix)), matrix
    while exponent:
        if exponent & 1:
            found = np.einsum("rk,kc->rc", found, square)
        square = np.einsum("rk,kc->rc", square, square)
        # Every squaring doubles what rounding took from the sums.
        square = square / np.einsum("rc->r", square)[:, None]
        exponent >>= 1
    return found
