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
    constant_velocity,
)
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
    straight = constant_velocity(process_noise, measurement_noise, period=period)
    if not math.isfinite(turn_rate):
        raise ValueError(f"turn_rate must be finite, got {turn_rate!r}")
    return replace(straight, transition=_turn(turn_rate, period))


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
    return _accelerated(process_noise, measurement_noise, period, dimensions, white=False)


def white_acceleration(
    process_noise: float, measurement_noise: float, *, period: float = 1.0, dimensions: int = 2
) -> HiddenMarkovModel:
    """`constant_velocity` with the state of `constant_acceleration`, to stand beside it among the modes.

    The acceleration of the state has no influence on the motion; it is drawn anew at every scan, with the variance of
    the mean acceleration between two scans.

    Args:
        process_noise: sigma_v as in `constant_velocity`, m/s^1.5.
        measurement_noise: Standard deviation of a measured coordinate, m.
        period: Time between scans, s.
        dimensions: Number of spatial axes.

    Raises:
        ValueError: A value is not positive.
    """
    return _accelerated(process_noise, measurement_noise, period, dimensions, white=True)


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
    if F.shape != (4, 4) or not np.allclose(F, _turn(0.0, period), rtol=0.0, atol=1e-9 * max(1.0, abs(period))):
        raise ValueError(
            f"model must have the state [x, vx, y, vy] and constant velocity, got transition {F.tolist()}; "
            "pass your own modes to InteractingModels"
        )
    models = [model, with_motion(model, F, agility**2 * Q)]
    if turn_rate > 0.0:
        models += [with_motion(model, _turn(sign * turn_rate, period), Q) for sign in (1.0, -1.0)]
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


def with_motion(model: Model, transition: Array, process_noise: Array) -> Model:
    """Return the model with other F and Q; the measurement, and F2 and H2 of a pairwise model, stay.

    Raises:
        ValueError: F and Q do not fit the model, or leave a pairwise model without a valid noise.
    """
    if not isinstance(model, PairwiseMarkovModel):
        return replace(model, transition=transition, process_noise=process_noise)
    n = model.observation.shape[1]
    hidden = HiddenMarkovModel(transition, process_noise, model.observation, model.measurement_noise)
    return PairwiseMarkovModel.from_hidden_markov(hidden, model.transition[:n, n:], model.transition[n:, n:])


def _turn(rate: float, period: float) -> Array:
    """Transition of [x, vx, y, vy] in a turn; its limit for a rate of 0."""
    angle = rate * period
    along = period * float(np.sinc(angle / np.pi))
    across = period * float(np.sinc(0.5 * angle / np.pi)) * math.sin(0.5 * angle)
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, along, 0.0, -across], [0.0, c, 0.0, -s], [0.0, across, 1.0, along], [0.0, s, 0.0, c]])


def _accelerated(noise: float, measured: float, t: float, dimensions: int, *, white: bool) -> HiddenMarkovModel:
    """A model with the state [x, vx, ax, ...]; white: the acceleration is independent from scan to scan."""
    simple = constant_velocity(noise, measured, period=t, dimensions=dimensions)
    axes = np.eye(dimensions)
    if white:
        F = np.array([[1.0, t, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
        Q = noise**2 * np.array([[t**3 / 3.0, t**2 / 2.0, 0.0], [t**2 / 2.0, t, 0.0], [0.0, 0.0, 1.0 / t]])
    else:
        F = np.array([[1.0, t, t**2 / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        Q = noise**2 * np.array(
            [[t**5 / 20.0, t**4 / 8.0, t**3 / 6.0], [t**4 / 8.0, t**3 / 3.0, t**2 / 2.0], [t**3 / 6.0, t**2 / 2.0, t]]
        )
    return HiddenMarkovModel(
        transition=np.kron(axes, F),
        process_noise=np.kron(axes, Q),
        observation=np.kron(axes, np.array([[1.0, 0.0, 0.0]])),
        measurement_noise=simple.measurement_noise,
    )


def _probabilities(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, one entry per model, got {array.shape}")
    if not (np.all(array >= 0.0) and np.allclose(array.sum(axis=-1), 1.0, rtol=0.0, atol=1e-9)):
        raise ValueError(f"{name} must hold probabilities that sum to 1, got {array.tolist()}")
    array.setflags(write=False)
    return array


def _stationary(switching: Array) -> Array:
    """Stationary distribution of a Markov chain; the uniform one is added where it is not unique."""
    S = len(switching)
    system = np.vstack([switching.T - np.eye(S), np.ones((1, S))])
    found = np.linalg.lstsq(system, np.append(np.zeros(S), 1.0), rcond=None)[0]
    found = np.maximum(found, 0.0)
    return np.asarray(found / found.sum())
