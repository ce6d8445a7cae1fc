"""The scene model that agents get. On mismatched levels some of its parameters are wrong on purpose."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from servotrack.envs.track.clutter.config import ClutterConfig
from servotrack.estimators.rfs.models import (
    HiddenMarkovModel,
    PairwiseMarkovModel,
    RangeBearingModel,
    constant_velocity,
)
from servotrack.estimators.rfs.spawn import Spawn
from servotrack.estimators.types import Array

Model = HiddenMarkovModel | PairwiseMarkovModel | RangeBearingModel


class SceneModel(NamedTuple):
    """Model of the scene that agents get. On mismatched levels some of its parameters are wrong on purpose.

    Attributes:
        model: Motion and measurement model of a target in d dimensions, state [x, vx, y, vy, ...] of n = 2 d entries.
        hidden_markov: The same model with independent noises, for filters that cannot use a pairwise Markov model.
        survival_probability: Probability that a target survives from one scan to the next.
        detection_probability: Probability that a scan contains a measurement of a target.
        clutter_rate: Mean number of false measurements in a scan.
        seen_low, seen_high: Bounds of the uniformly distributed false measurements, shape (d,).
        birth_means: Mean states of new targets, shape (b, n); None if targets appear anywhere.
        birth_covariance: Covariance of the states of new targets, shape (n, n).
        birth_weights: Expected number of new targets per scan at each mean, shape (b,). Shape (1,) if targets appear
            anywhere.
        region_low, region_high: Corners of the region of the targets, shape (d,), m.
        cutoff: Cut-off c of the scores, m.
        lag: Delay of the answers, scans: the answer to scan k is for scan k - lag.
        least_existence: Existence below which a filter may drop a track. It must be below that of a target's first
            detection, which is small where new targets may appear anywhere.
        spawn: Targets that split off others.
        clutter_map: Clutter intensity as a function of measurements (Z, m), of the same rate; None: uniform.
        maneuver: Probability of a maneuver in one period; 0 if targets do not stop or turn suddenly.
        agility: Factor on the process noise in a maneuver.
    """

    model: Model
    hidden_markov: HiddenMarkovModel | RangeBearingModel
    survival_probability: float
    detection_probability: float
    clutter_rate: float
    seen_low: Array
    seen_high: Array
    birth_means: Array | None
    birth_covariance: Array
    birth_weights: Array
    region_low: Array
    region_high: Array
    cutoff: float
    lag: int = 0
    least_existence: float = 1e-3
    spawn: tuple[Spawn, ...] = ()
    clutter_map: Callable[[Array], Array] | None = None
    maneuver: float = 0.0
    agility: float = 1.0

    @property
    def clutter_intensity(self) -> float:
        """Expected number of false measurements in a scan per unit of measurement space."""
        return self.clutter_rate / float(np.prod(self.seen_high - self.seen_low))


def scene_model_of(config: ClutterConfig) -> SceneModel:
    """Return the scene model of an environment with these parameters."""
    linear = constant_velocity(config.acceleration_noise, config.position_noise, period=config.period)
    model: Model = config.motion
    hidden_markov: HiddenMarkovModel | RangeBearingModel = linear
    if config.sensor == "range-bearing":
        noise = np.diag([config.range_noise**2, config.bearing_noise**2])
        model = hidden_markov = RangeBearingModel(
            linear.transition, linear.process_noise, linear.observation, noise, config.sensor_position
        )
    low, high = config.seen
    births = config.told_births or (config.births if config.draws_lives else "sites")
    sites = config.sites
    means = np.zeros((len(sites), 4))
    means[:, [0, 2]] = sites
    if births == "anywhere":
        weights = np.array([config.birth_rate])
    elif config.draws_lives:
        weights = np.full(len(sites), config.birth_rate / len(sites))
    else:
        weights = np.full(len(sites), config.published.birth_weight)
    spread = np.array([config.birth_spread, config.birth_speed] * 2)
    detection, clutter = config.told_detection_probability, config.told_clutter_rate
    return SceneModel(
        model=model,
        hidden_markov=hidden_markov,
        survival_probability=config.survival_probability,
        detection_probability=config.detection_probability if detection is None else detection,
        clutter_rate=config.clutter_rate if clutter is None else clutter,
        seen_low=low,
        seen_high=high,
        birth_means=None if births == "anywhere" else means,
        birth_covariance=np.diag(spread**2),
        birth_weights=weights,
        region_low=np.full(2, -config.half_width),
        region_high=np.full(2, config.half_width),
        cutoff=config.cutoff,
        lag=config.lag,
        least_existence=config.published.least_existence,
        spawn=_spawn(config),
    )


def _spawn(config: ClutterConfig) -> tuple[Spawn, ...]:
    if config.published.spawn is None:
        return ()
    weight, spread, speed = config.published.spawn
    return (Spawn(weight, np.diag(np.array([spread, speed] * 2) ** 2)),)
