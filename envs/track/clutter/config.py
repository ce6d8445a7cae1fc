"""Every parameter of the clutter world, and the levels that set them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from servotrack.envs.arguments import check_fields, check_keywords, check_level
from servotrack.envs.track.counts import poisson_quantile
from servotrack.estimators.rfs.models import (
    STRUCTURES,
    HiddenMarkovModel,
    PairwiseMarkovModel,
    constant_velocity,
    pairwise_structure,
)
from servotrack.estimators.types import Array

SCENARIOS = ("paper", "random")
SENSORS = ("position", "range-bearing")
BIRTHS = ("sites", "anywhere")
NOISE_STRUCTURES = ("HMM", *STRUCTURES)

PAPER_COUNT = 12
"""Targets of the paper's scenario."""
BIRTH_SITES = np.array([(0.0, 0.0), (400.0, -600.0), (-800.0, -200.0), (-200.0, 800.0)])
"""Where targets appear, m; read at the default half width of 2000 m and scaled with it."""
_SITES_HALF_WIDTH = 2000.0
_SENSOR_DISTANCE = 1.5
"""The range-bearing sensor stands on the x axis, left of the region, this many half widths from its middle: no bearing
of the region is near pi."""
_REACH = 10.0
"""Standard deviations of measurement noise that the spaces leave room for around the region."""


@dataclass(frozen=True)
class ClutterConfig:
    """All that defines a clutter world.

    Attributes:
        scenario: `paper` (paper 004's twelve targets) or `random` (births and deaths drawn anew in every episode).
        horizon: Scans of an episode.
        half_width: The region is [-half_width, half_width] squared, m. A target that leaves it is drawn again in the
            scenario `paper`, and gone in `random`.
        period: Time between scans, s.
        structure: `HMM`, or S1 to S6: how process and measurement noise depend on each other (see
            `servotrack.estimators.rfs.models.pairwise_structure`).
        acceleration_noise: sigma_v of nearly constant velocity, m/s^1.5.
        position_noise: Standard deviation of a measured coordinate, m.
        sensor: `position`, or `range-bearing` from (-1.5 half_width, 0).
        range_noise: Standard deviation of a measured range, m.
        bearing_noise: Standard deviation of a measured bearing, rad.
        detection_probability: That a target is in a scan.
        clutter_rate: Mean number of false measurements in a scan, uniform over what the sensor sees.
        survival_probability: From scan to scan; decides deaths in `random`, and is told to agents.
        max_targets: Most targets of an episode.
        initial_targets: Mean number at the first scan, Poisson (`random`).
        birth_rate: Mean number of new targets per scan, Poisson (`random`).
        births: `sites` or `anywhere` (`random`).
        birth_spread: Standard deviation of new positions about a site, m (`random`; told always).
        birth_speed: Standard deviation of a new velocity's coordinates, m/s (`random`; told always).
        maneuver_rate: Probability per scan that a target takes up a new turn rate.
        max_turn_rate: Turn rates are uniform up to this, either way, rad/s.
        told_detection_probability: What agents are told; None: the truth.
        told_clutter_rate: What agents are told; None: the truth.
        told_births: What agents are told: `sites`, `anywhere`; None: the truth.
        max_measurements: Rows of an observation; None: max_targets and the 1 - 1e-9 quantile of the clutter.
        max_estimates: Rows of an action; None: 2 max_targets + 16.
        cutoff: The c of reward and scores, m.
    """

    scenario: str = "paper"
    horizon: int = 100
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
        """Check every field; raises ValueError that names the argument, the value and what would be right."""
        for name, options in _CHOICES:
            value = getattr(self, name)
            if value not in options and not (name == "told_births" and value is None):
                raise ValueError(f"{name} must be one of {', '.join(options)}, got {value!r}")
        check_fields(self, _BOUNDS, _WHOLE, _OPTIONAL)
        if self.scenario == "paper" and self.max_targets < PAPER_COUNT:
            raise ValueError(
                f"max_targets must be at least {PAPER_COUNT} in the paper's scenario, got {self.max_targets}; "
                "choose scenario='random'"
            )
        if self.sensor == "range-bearing" and self.structure != "HMM":
            raise ValueError(f"structure must be 'HMM' with a range-bearing sensor, got {self.structure!r}")
        if self.max_measurements is not None and self.max_measurements < self.max_targets:
            raise ValueError(
                f"max_measurements must be at least max_targets = {self.max_targets}, got {self.max_measurements}"
            )
        self.motion  # noqa: B018 - a structure that the noise levels do not admit fails here, with its condition named

    @cached_property
    def motion(self) -> HiddenMarkovModel | PairwiseMarkovModel:
        """Motion and position measurement of one target."""
        linear = constant_velocity(self.acceleration_noise, self.position_noise, period=self.period)
        return linear if self.structure == "HMM" else pairwise_structure(linear, self.structure)  # type: ignore[arg-type]

    @property
    def sensor_position(self) -> tuple[float, float]:
        """Where the range-bearing sensor stands, m."""
        return (-_SENSOR_DISTANCE * self.half_width, 0.0)

    @property
    def sites(self) -> Array:
        """Birth sites, shape (4, 2), m."""
        return BIRTH_SITES * (self.half_width / _SITES_HALF_WIDTH)

    @property
    def seen(self) -> tuple[Array, Array]:
        """What the sensor sees, as the lowest and highest measurement of clutter, each shape (2,)."""
        h = self.half_width
        if self.sensor == "position":
            return np.array([-h, -h]), np.array([h, h])
        near, far = (_SENSOR_DISTANCE - 1.0) * h, (_SENSOR_DISTANCE + 1.0) * h
        edge = math.atan2(h, near)
        return np.array([near, -edge]), np.array([math.hypot(far, h), edge])

    @property
    def measurement_bounds(self) -> tuple[Array, Array]:
        """Lowest and highest measurement, each shape (2,): what the sensor sees, with room for noise."""
        low, high = self.seen
        if self.sensor == "position":
            room = np.full(2, _REACH * self.position_noise)
        else:
            room = _REACH * np.array([self.range_noise, self.bearing_noise])
        return low - room, high + room

    @property
    def estimate_bound(self) -> float:
        """Largest coordinate of an estimate, m."""
        return self.half_width + _REACH * self.position_noise

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
    """The configuration of a level, with single parameters overridden.

    Args:
        level: 0 `paper`, 1 `random`, 2 `low detection`, 3 `maneuvers`, 4 `range-bearing`, 5 `wrong detection`,
            6 `wrong clutter`, 7 `wrong births`; from 2 on each differs from `random` in what its name says.
        **axes: Fields of `ClutterConfig`.

    Raises:
        ValueError: A level that does not exist, or a value outside its bounds.
        TypeError: An unknown keyword; the message suggests the nearest known one.
    """
    level = check_level(level, len(_LEVELS))
    check_keywords(axes, AXES)
    settings = _LEVELS[level]
    if axes.get("scenario") == "random" and "scenario" not in settings:
        settings = _RANDOM
    return replace(ClutterConfig(), **{**settings, **axes})


_CHOICES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("scenario", SCENARIOS),
    ("structure", NOISE_STRUCTURES),
    ("sensor", SENSORS),
    ("births", BIRTHS),
    ("told_births", BIRTHS),
)
_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("horizon", 1, 100_000),
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
_WHOLE = frozenset({"horizon", "max_targets", "max_measurements", "max_estimates"})
_OPTIONAL = frozenset({"told_detection_probability", "told_clutter_rate", "max_measurements", "max_estimates"})
