"""Published scenarios of points in clutter: their parameters, targets and births, each with its source.

What the configuration can say is in `settings`, and can be overridden like the parameters of a level.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple


class FixedTarget(NamedTuple):
    """A target with a given life.

    Attributes:
        first: First scan, counted from 1.
        last: Last scan; None: that of the episode.
        state: Initial state (x, vx, y, vy), m and m/s.
        acceleration: Constant acceleration along x and y, m/s^2, of which no filter knows.
    """

    first: int
    last: int | None
    state: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    acceleration: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Scenario:
    """A published scenario.

    Attributes:
        source: Publication of its parameters.
        differences: Known differences from it; empty for none.
        settings: Fields of `ClutterConfig` that differ from their defaults.
        targets: Targets with given lives, in order of their first scans; empty if births and deaths are drawn.
        wanders: True if the motion of the targets has process noise.
        middle: Variance of every entry of the targets' states at the middle scan, from which paths are drawn forward
            and backward in time; None if paths begin at the states of `targets`. Small values bring targets close.
        birth_places: Means of the positions of new targets in the scene model, m.
        birth_weight: Expected number of new targets per scan at each of them, in the scene model.
        clutter_half_width: Half the side of the square with clutter, m; None: the region's.
        spawn: Expected number of targets that split off a target per scan, and standard deviations of their position
            (m) and velocity (m/s) from its own, in the scene model; None for none.
        least_existence: Existence below which filters may drop a track; see `SceneModel`.
    """

    source: str
    differences: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    targets: tuple[FixedTarget, ...] = ()
    wanders: bool = True
    middle: float | None = None
    birth_places: tuple[tuple[float, float], ...] = ()
    birth_weight: float = 0.0
    clutter_half_width: float | None = None
    spawn: tuple[float, float, float] | None = None
    least_existence: float = 1e-3


_ANYWHERE = 1e-5
"""Least existence where targets may appear anywhere: the first detection of one gives about 1e-4."""

PAPER_TARGETS = (
    FixedTarget(1, 70, (0.0, 0.0, 0.0, -10.0)),
    FixedTarget(1, 70, (400.0, -10.0, -600.0, 5.0)),
    FixedTarget(1, None, (-800.0, 20.0, -200.0, -5.0)),
    FixedTarget(20, None, (400.0, -7.0, -600.0, -4.0)),
    FixedTarget(20, None, (400.0, -2.5, -600.0, 10.0)),
    FixedTarget(20, None, (0.0, 7.5, 0.0, -5.0)),
    FixedTarget(40, None, (-800.0, 12.0, -200.0, 7.0)),
    FixedTarget(40, None, (-200.0, 15.0, 800.0, -10.0)),
    FixedTarget(60, None, (-800.0, 3.0, -200.0, 15.0)),
    FixedTarget(60, None, (-200.0, -3.0, 800.0, -15.0)),
    FixedTarget(80, None, (0.0, -20.0, 0.0, -15.0)),
    FixedTarget(80, None, (-200.0, 15.0, 800.0, -5.0)),
)

_DEMO_STARTS = (
    (1, 70, 0.0, 0.0, 0.0, -10.0),
    (1, None, 400.0, -10.0, -600.0, 5.0),
    (1, 70, -800.0, 20.0, -200.0, -5.0),
    *((one.first, one.last, *one.state) for one in PAPER_TARGETS[3:]),
)
# The demo moves a target before its first scan.
_DEMO_TARGETS = tuple(FixedTarget(first, last, (x + vx, vx, y + vy, vy)) for first, last, x, vx, y, vy in _DEMO_STARTS)

_VO_MA_TARGETS = (
    FixedTarget(1, None, (250.0, 2.5, 250.0, -12.0)),
    FixedTarget(1, None, (-250.0, 12.0, -250.0, -2.5)),
    FixedTarget(66, None, (410.5, 0.5, -529.4, -11.5), (-1.0, 0.25)),
)
"""Paths in the vector graphics of figure 1, to .2 m. The third target splits off the first one and turns away."""

_VO_MA_SETTINGS = {
    "half_width": 1000.0,
    "structure": "HMM",
    "acceleration_noise": 5.0,
    "position_noise": 10.0,
    "detection_probability": 0.98,
    "clutter_rate": 50.0,
    "survival_probability": 0.99,
    "birth_spread": 10.0,
    "birth_speed": 5.0,
}
_VO_MA = "Vo and Ma, IEEE Transactions on Signal Processing 54(11), 2006"
_CONTINUOUS = "process noise of continuous time, T^3/3 instead of T^4/4"

SCENARIOS: Mapping[str, Scenario] = {
    "paper": Scenario(
        "Zhang, Han, Lian and Zeng, Acta Automatica Sinica 43(12), 2017, section 3.2: births and deaths at given scans",
        targets=PAPER_TARGETS,
        birth_places=((0.0, 0.0), (400.0, -600.0), (-800.0, -200.0), (-200.0, 800.0)),
        birth_weight=0.03,
    ),
    "random": Scenario("births and deaths drawn in every episode"),
    "vo-ma-2006": Scenario(
        f"{_VO_MA}, example 1: two targets that cross at scan 53, and a third that splits off at scan 66",
        _CONTINUOUS,
        {**_VO_MA_SETTINGS, "max_targets": 3},
        targets=_VO_MA_TARGETS,
        wanders=False,
        birth_places=((250.0, 250.0), (-250.0, -250.0)),
        birth_weight=0.1,
        spawn=(0.05, 10.0, 20.0),
    ),
    "vo-ma-2006-pair": Scenario(
        f"{_VO_MA}, example 2: the two targets of example 1 that cross",
        _CONTINUOUS,
        {**_VO_MA_SETTINGS, "max_targets": 2},
        targets=_VO_MA_TARGETS[:2],
        wanders=False,
        birth_places=((250.0, 250.0), (-250.0, -250.0)),
        birth_weight=0.1,
    ),
    "vo-demo": Scenario(
        "demonstration of the Gaussian mixture filters in the Matlab code that B.-T. Vo published with them "
        "(phd/gms): twelve targets of four places",
        _CONTINUOUS,
        {
            "half_width": 1000.0,
            "structure": "HMM",
            "acceleration_noise": 5.0,
            "position_noise": 10.0,
            "detection_probability": 0.98,
            "clutter_rate": 60.0,
            "survival_probability": 0.99,
            "birth_spread": 10.0,
            "birth_speed": 10.0,
            "max_targets": 12,
        },
        targets=_DEMO_TARGETS,
        wanders=False,
        birth_places=((0.0, 0.0), (400.0, -600.0), (-800.0, -200.0), (-200.0, 800.0)),
        birth_weight=0.03,
    ),
    "williams-2015": Scenario(
        "Williams, IEEE Transactions on Aerospace and Electronic Systems 51(3), 2015 (arXiv:1203.2995, its simulation "
        "code): six targets that meet at one point in the middle of 201 scans",
        "filters do not know of the intensity of 10 undetected targets before the first scan",
        {
            "half_width": 400.0,
            "horizon": 201,
            "structure": "HMM",
            "acceleration_noise": 0.1,
            "position_noise": 1.0,
            "detection_probability": 0.5,
            "clutter_rate": 10.0,
            "survival_probability": 0.999,
            "birth_spread": 100.0,
            "birth_speed": 1.0,
            "max_targets": 6,
            "cutoff": 20.0,
        },
        targets=(FixedTarget(1, None),) * 6,
        middle=1e-6,
        birth_places=((0.0, 0.0),),
        birth_weight=0.05,
        clutter_half_width=100.0,
        least_existence=_ANYWHERE,
    ),
    "garcia-fernandez-2018": Scenario(
        "Garcia-Fernandez, Williams, Granstrom and Svensson, IEEE Transactions on Aerospace and Electronic Systems "
        "54(4), 2018 (their code, ScenarioWilliams15): four targets that come together in the middle of 81 scans, "
        "where one of them dies",
        "filters do not know of the intensity of 3 undetected targets before the first scan; paths are drawn anew in "
        "every episode instead of once",
        {
            "half_width": 150.0,
            "horizon": 81,
            "structure": "HMM",
            "acceleration_noise": 0.1,
            "position_noise": 1.0,
            "detection_probability": 0.9,
            "clutter_rate": 10.0,
            "survival_probability": 0.99,
            "birth_spread": 150.0,
            "birth_speed": 1.0,
            "max_targets": 4,
            "cutoff": 10.0,
        },
        targets=(FixedTarget(1, 40), *(FixedTarget(1, None),) * 3),
        middle=0.1,
        birth_places=((-50.0, -50.0),),
        birth_weight=0.005,
        least_existence=_ANYWHERE,
    ),
    "pinto-2021": Scenario(
        "Pinto, Hess, Ljungbergh, Xia, Svensson and Wymeersch, FUSION 2021 (arXiv:2104.00734; their code, MT3, task 2)",
        "episodes may begin without targets, targets may also appear in the last two scans, and at most 40 appear",
        {
            "half_width": 10.0,
            "horizon": 20,
            "period": 0.1,
            "structure": "HMM",
            "acceleration_noise": math.sqrt(0.9),
            "position_noise": 0.3,
            "detection_probability": 0.8,
            "clutter_rate": 30.0,
            "survival_probability": 0.95,
            "max_targets": 40,
            "initial_targets": 6.0,
            "birth_rate": 0.4,
            "births": "anywhere",
            "birth_speed": math.sqrt(3.0),
            "cutoff": 2.0,
        },
    ),
}
"""Scenarios by the value of `scenario`."""
