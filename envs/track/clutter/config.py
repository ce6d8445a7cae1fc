"""Parameters of the clutter environment, and the levels that set them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from servotrack.envs.arguments import check_fields, check_keywords, check_level
from servotrack.envs.track.clutter.scenarios import SCENARIOS, Scenario
from servotrack.envs.track.counts import poisson_quantile
from servotrack.estimators.rfs.models import (
    STRUCTURES,
    HiddenMarkovModel,
    PairwiseMarkovModel,
    constant_velocity,
    pairwise_structure,
)
from servotrack.estimators.types import Array

SENSORS = ("position", "range-bearing")
BIRTHS = ("sites", "anywhere")
NOISE_STRUCTURES = ("HMM", *STRUCTURES)

_SITES_HALF_WIDTH = 2000.0
"""Half width at which birth sites have the places of the scenario `paper`, m. They scale with the half width."""
_SENSOR_DISTANCE = 1.5
"""Distance of the range-bearing sensor from the middle of the region, half widths. It stands on the negative x axis, so
that all bearings of the region stay far from pi."""
_MARGIN_DEVIATIONS = 10.0
"""Margin of the spaces around the region, standard deviations of the measurement noise."""


@dataclass(frozen=True)
class ClutterConfig:
    """Parameters of a clutter environment.

    Attributes:
        scenario: `paper` (twelve targets with the birth and death times of Zhang et al. 2017), `random` (births and
            deaths drawn in every episode), or another published scenario with parameters of its own: `vo-ma-2006`,
            `vo-ma-2006-pair`, `vo-demo`, `williams-2015`, `garcia-fernandez-2018`, `pinto-2021`; see
            `servotrack.envs.track.clutter.scenarios`.
        horizon: Scored scans of an episode.
        lag: Delay of answers, scans: the answer to scan k is for scan k - lag. Larger values give smoothers more scans
            to work with. An episode has `horizon` + `lag` answers.
        half_width: Half the side of the square region, m. A path that leaves the region is drawn again in the scenario
            `paper`; in `random` the target disappears.
        period: Time between scans, s.
        structure: Dependence between process and measurement noise: `HMM` (independent) or S1 to S6 (see
            `servotrack.estimators.rfs.models.pairwise_structure`).
        acceleration_noise: Process noise sigma_v of the nearly-constant-velocity model, m/s^1.5. Larger values give
            more curved paths.
        position_noise: Standard deviation of a measured coordinate, m.
        sensor: `position`, or `range-bearing` from (-1.5 half_width, 0).
        range_noise: Standard deviation of a measured range, m.
        bearing_noise: Standard deviation of a measured bearing, rad.
        detection_probability: Probability that a scan contains a measurement of a target.
        clutter_rate: Mean number of false measurements in a scan, uniform over the field of view.
        survival_probability: Probability that a target survives from one scan to the next. It sets the deaths in
            `random`, and is part of the scene model in both scenarios.
        max_targets: Maximum number of targets in an episode.
        initial_targets: Mean number of targets at the first scan, Poisson (`random`).
        birth_rate: Mean number of new targets per scan, Poisson (`random`).
        births: Birth places: `sites` (four Gaussians) or `anywhere` (uniform over the region) (`random`).
        birth_spread: Standard deviation of new positions around a site, m (`random`). Part of the scene model.
        birth_speed: Standard deviation of each coordinate of a new velocity, m/s (`random`). Part of the scene model.
        maneuver_rate: Probability per scan that a target starts to turn at a new rate.
        max_turn_rate: Bound of turn rates, rad/s. They are uniform in [-max_turn_rate, max_turn_rate].
        told_detection_probability: Detection probability in the scene model that agents get; None: the true one.
        told_clutter_rate: Clutter rate in the scene model; None: the true one.
        told_births: Birth places in the scene model, `sites` or `anywhere`; None: the true ones.
        max_measurements: Rows of an observation; None: max_targets plus the 1 - 1e-9 quantile of the number of false
            measurements.
        max_estimates: Rows of an action; None: 2 max_targets + 16.
        cutoff: Cut-off c of the reward and of OSPA, GOSPA and OSPA(2), m.
    """

    scenario: str = "paper"
    horizon: int = 100
    lag: int = 0
    half_width: float = 2000.0
    period: float = 1.0
    structure: str = "S1"
    acceleration_noise: float = 5.0
    position_noise: float = 1.5
    sensor: str = "position"
    range_noise: float = 5.0
    bearing_noise: float = 0.005
    detection_probability: float = 0.98
    clutter_rate: float = 20.0
    survival_probability: float = 0.99
    max_targets: int = 12
    initial_targets: float = 5.0
    birth_rate: float = 0.12
    births: str = "sites"
    birth_spread: float = 10.0
    birth_speed: float = 10.0
    maneuver_rate: float = 0.0
    max_turn_rate: float = 0.0
    told_detection_probability: float | None = None
    told_clutter_rate: float | None = None
    told_births: str | None = None
    max_measurements: int | None = None
    max_estimates: int | None = None
    cutoff: float = 100.0

    def __post_init__(self) -> None:
        """Check every field. A ValueError names the argument, its value and the valid values."""
        for name, options in _CHOICES:
            value = getattr(self, name)
            if value not in options and not (name == "told_births" and value is None):
                raise ValueError(f"{name} must be one of {', '.join(options)}, got {value!r}")
        check_fields(self, _BOUNDS, _WHOLE, _OPTIONAL)
        if self.max_targets < len(self.published.targets):
            raise ValueError(
                f"max_targets must be at least {len(self.published.targets)} in the scenario {self.scenario!r}, got "
                f"{self.max_targets}; choose scenario='random'"
            )
        if self.published.middle is not None and (self.structure != "HMM" or self.maneuver_rate > 0.0):
            raise ValueError(
                f"structure must be 'HMM' and maneuver_rate 0 in the scenario {self.scenario!r}, whose paths are drawn "
                f"backward too, got {self.structure!r} and {self.maneuver_rate}"
            )
        if self.sensor == "range-bearing" and self.structure != "HMM":
            raise ValueError(f"structure must be 'HMM' with a range-bearing sensor, got {self.structure!r}")
        if self.max_measurements is not None and self.max_measurements < self.max_targets:
            raise ValueError(
                f"max_measurements must be at least max_targets = {self.max_targets}, got {self.max_measurements}"
            )
        self.motion  # noqa: B018 - raises if the noise levels violate a condition of the structure

    @property
    def published(self) -> Scenario:
        """Source, targets and births of the scenario."""
        return SCENARIOS[self.scenario]

    @property
    def draws_lives(self) -> bool:
        """True if births and deaths are drawn in every episode."""
        return not self.published.targets

    @cached_property
    def motion(self) -> HiddenMarkovModel | PairwiseMarkovModel:
        """Motion and measurement model of one target."""
        linear = constant_velocity(self.acceleration_noise, self.position_noise, period=self.period)
        return linear if self.structure == "HMM" else pairwise_structure(linear, self.structure)  # type: ignore[arg-type]

    @property
    def sensor_position(self) -> tuple[float, float]:
        """Position of the range-bearing sensor, m."""
        return (-_SENSOR_DISTANCE * self.half_width, 0.0)

    @property
    def sites(self) -> Array:
        """Birth sites, shape (b, 2), m. Those of the scenarios `paper` and `random` scale with the half width."""
        if self.scenario in ("paper", "random"):
            return np.array(SCENARIOS["paper"].birth_places) * (self.half_width / _SITES_HALF_WIDTH)
        return np.array(self.published.birth_places or SCENARIOS["paper"].birth_places)

    @property
    def seen(self) -> tuple[Array, Array]:
        """Field of view of the sensor: lowest and highest false measurement, each of shape (2,)."""
        h = self.half_width
        if self.sensor == "position":
            seen = h if self.published.clutter_half_width is None else min(h, self.published.clutter_half_width)
            return np.array([-seen, -seen]), np.array([seen, seen])
        near, far = (_SENSOR_DISTANCE - 1.0) * h, (_SENSOR_DISTANCE + 1.0) * h
        edge = math.atan2(h, near)
        return np.array([near, -edge]), np.array([math.hypot(far, h), edge])

    @property
    def measurement_bounds(self) -> tuple[Array, Array]:
        """Lowest and highest measurement, each of shape (2,): the field of view with a margin for noise."""
        low, high = self.seen
        if self.sensor == "position":
            low, high = np.full(2, -self.half_width), np.full(2, self.half_width)
            room = np.full(2, _MARGIN_DEVIATIONS * self.position_noise)
        else:
            room = _MARGIN_DEVIATIONS * np.array([self.range_noise, self.bearing_noise])
        return low - room, high + room

    @property
    def estimate_bound(self) -> float:
        """Largest coordinate of an estimate, m."""
        return self.half_width + _MARGIN_DEVIATIONS * self.position_noise

    @property
    def measurement_rows(self) -> int:
        """Rows of an observation."""
        if self.max_measurements is not None:
            return self.max_measurements
        return self.max_targets + poisson_quantile(self.clutter_rate)

    @property
    def estimate_rows(self) -> int:
        """Rows of an action."""
        return 2 * self.max_targets + 16 if self.max_estimates is None else self.max_estimates


_RANDOM = {"scenario": "random", "max_targets": 40}
_LEVELS: tuple[dict[str, Any], ...] = (
    {},
    _RANDOM,
    {**_RANDOM, "detection_probability": 0.6, "clutter_rate": 60.0},
    {**_RANDOM, "maneuver_rate": 0.1, "max_turn_rate": 0.2, "birth_speed": 30.0},
    {**_RANDOM, "sensor": "range-bearing", "structure": "HMM"},
    {**_RANDOM, "detection_probability": 0.8, "told_detection_probability": 0.98},
    {**_RANDOM, "clutter_rate": 40.0, "told_clutter_rate": 5.0},
    {**_RANDOM, "births": "anywhere", "told_births": "sites"},
)

LEVEL_NAMES = (
    "paper",
    "random",
    "low detection",
    "maneuvers",
    "range-bearing",
    "wrong detection",
    "wrong clutter",
    "wrong births",
)
AXES = tuple(f.name for f in fields(ClutterConfig))


def clutter_config(level: int = 0, **axes: Any) -> ClutterConfig:
    """Return the configuration of a level, with some parameters overridden.

    Args:
        level: 0 `paper`, 1 `random`, 2 `low detection`, 3 `maneuvers`, 4 `range-bearing`, 5 `wrong detection`,
            6 `wrong clutter`, 7 `wrong births`. Levels 2 to 7 change `random` in the way that their name says.
        **axes: Fields of `ClutterConfig` with the values to use.

    Raises:
        ValueError: If the level does not exist, a value is outside its bounds, or a published scenario is combined
            with a level.
        TypeError: If a keyword is unknown; the message suggests the nearest known one.
    """
    level = check_level(level, len(_LEVELS))
    check_keywords(axes, AXES)
    settings: Mapping[str, Any] = _LEVELS[level]
    scenario = axes.get("scenario")
    if scenario == "random" and "scenario" not in settings:
        settings = _RANDOM
    if isinstance(scenario, str) and scenario in SCENARIOS and SCENARIOS[scenario].settings:
        if level != 0:
            raise ValueError(
                f"level must be 0 with scenario={scenario!r}, which has parameters of its own, got {level}"
            )
        settings = SCENARIOS[scenario].settings
    return replace(ClutterConfig(), **{**settings, **axes})


_CHOICES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("scenario", tuple(SCENARIOS)),
    ("structure", NOISE_STRUCTURES),
    ("sensor", SENSORS),
    ("births", BIRTHS),
    ("told_births", BIRTHS),
)
_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("horizon", 1, 100_000),
    ("lag", 0, 1000),
    ("half_width", 1.0, 1e6),
    ("period", 1e-3, 1e3),
    ("acceleration_noise", 1e-6, 1e4),
    ("position_noise", 1e-6, 1e4),
    ("range_noise", 1e-6, 1e4),
    ("bearing_noise", 1e-9, 0.2),
    ("detection_probability", 0.0, 1.0),
    ("clutter_rate", 0.0, 500.0),
    ("survival_probability", 0.0, 1.0),
    ("max_targets", 1, 100),
    ("initial_targets", 0.0, 100.0),
    ("birth_rate", 0.0, 100.0),
    ("birth_spread", 0.0, 1e5),
    ("birth_speed", 0.0, 1e4),
    ("maneuver_rate", 0.0, 1.0),
    ("max_turn_rate", 0.0, math.pi),
    ("told_detection_probability", 0.0, 1.0),
    ("told_clutter_rate", 0.0, 500.0),
    ("max_measurements", 1, 100_000),
    ("max_estimates", 1, 10_000),
    ("cutoff", 1e-3, 1e6),
)
_WHOLE = frozenset({"horizon", "lag", "max_targets", "max_measurements", "max_estimates"})
_OPTIONAL = frozenset({"told_detection_probability", "told_clutter_rate", "max_measurements", "max_estimates"})
