"""The trackers of bearings behind the agents' names, made of what a sonar world tells its agents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from servotrack.envs.track.sonar.array_model import SonarModel
from servotrack.estimators.sonar import HMMBearings
from servotrack.estimators.sonar.nulling import ViterbiNulling
from servotrack.estimators.sonar.peaks import PeakKalmanHungarian, PeakNearestNeighbor, PeakTracker

FASTEST = 2.0
"""Bearing rates that trackers are made for, deg/s; grids go at least one step beyond rest."""


SHORTEST_WINDOW = 20
"""Rows."""


def fitting_rates(told: SonarModel) -> tuple[float, ...]:
    """Rates up to `FASTEST` whose steps fit the beams: half a step of the rate moves a target by one beam, deg/s."""
    step = 2.0 * float(told.looks[1] - told.looks[0]) / told.period
    most = max(1, round(FASTEST / step))
    return tuple((step * np.arange(-most, most + 1)).tolist())


def _hmm(likelihood: Any) -> Callable[[SonarModel], HMMBearings]:
    def make(told: SonarModel) -> HMMBearings:
        return HMMBearings(
            likelihood,
            array=told.array,
            band=told.band,
            shading=told.shading,  # type: ignore[arg-type]
            beams=len(told.looks),
            snapshots=told.averages // len(told.band.frequencies),
            period=told.period,
            rates=fitting_rates(told),
            lag=told.lag,
            window=_window(told),
        )

    return make


def _viterbi(told: SonarModel) -> ViterbiNulling:
    return ViterbiNulling(
        beams=len(told.looks),
        averages=told.averages,
        period=told.period,
        rates=fitting_rates(told),
        lag=told.lag,
        window=_window(told),
    )


def _peaks(tracker: type[PeakTracker]) -> Callable[[SonarModel], PeakTracker]:
    def make(told: SonarModel) -> PeakTracker:
        return tracker(beams=len(told.looks), averages=told.averages, period=told.period, lag=told.lag)

    return make


def _window(told: SonarModel) -> int:
    """Rows that an answer looks at, before and after the one that it is for."""
    return max(SHORTEST_WINDOW, 2 * told.lag)


TRACKERS: Mapping[str, Callable[[SonarModel], Any]] = {
    "hmm-row": _hmm("row"),
    "hmm-cell": _hmm("cell"),
    "viterbi": _viterbi,
    "peak-nearest-neighbor": _peaks(PeakNearestNeighbor),
    "peak-kalman-hungarian": _peaks(PeakKalmanHungarian),
}
"""From an observer's name to what makes its tracker."""


def sonar_tracker(name: str, told: SonarModel) -> Any:
    """A tracker of bearings for a world.

    Args:
        name: One of `TRACKERS`.
        told: What agents are told.

    Returns:
        As in `servotrack.estimators.sonar`: `track` takes a whole record, `initial` and `step` one row after the other.

    Raises:
        ValueError: An unknown name.
    """
    if name not in TRACKERS:
        raise ValueError(f"no tracker of bearings is called {name!r}; known are {', '.join(TRACKERS)}")
    return TRACKERS[name](told)
