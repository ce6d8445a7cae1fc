"""Trackers of bearings by name, created from the environment's `SonarModel`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

from numpy.typing import ArrayLike

from servotrack.envs.track.sonar.array_model import SonarModel
from servotrack.estimators.rfs import SetEstimate
from servotrack.estimators.sonar import HMMBearings
from servotrack.estimators.sonar.bearing_model import fitting_rates
from servotrack.estimators.sonar.nulling import ViterbiNulling
from servotrack.estimators.sonar.peaks import PeakKalmanHungarian, PeakNearestNeighbor, PeakTracker
from servotrack.estimators.sonar.record import BearingTrack
from servotrack.estimators.types import Array, Estimator

SHORTEST_WINDOW = 20
"""Smallest number of rows of a tracker's window."""


class BearingTracker(Estimator[Array, Any, SetEstimate], Protocol):
    """Tracker of bearings: row by row, or over a whole record."""

    def track(self, record: ArrayLike, times: ArrayLike | None = None) -> list[BearingTrack]:
        """Return the tracks of a whole record, shape (rows, beams); `times` are those of its rows, s."""


def _hmm(likelihood: Literal["row", "cell"]) -> Callable[[SonarModel], HMMBearings]:
    def make(scene: SonarModel) -> HMMBearings:
        return HMMBearings(
            likelihood,
            array=scene.array,
            band=scene.band,
            shading=scene.shading,  # type: ignore[arg-type]
            beams=len(scene.beam_bearings),
            snapshots=scene.averages // len(scene.band.frequencies),
            period=scene.period,
            lag=scene.lag,
            window=_window(scene),
        )

    return make


def _viterbi(scene: SonarModel) -> ViterbiNulling:
    return ViterbiNulling(
        beams=len(scene.beam_bearings),
        averages=scene.averages,
        period=scene.period,
        rates=fitting_rates(float(scene.beam_bearings[1] - scene.beam_bearings[0]), scene.period),
        lag=scene.lag,
        window=_window(scene),
    )


def _peaks(tracker: type[PeakTracker]) -> Callable[[SonarModel], PeakTracker]:
    def make(scene: SonarModel) -> PeakTracker:
        return tracker(beams=len(scene.beam_bearings), averages=scene.averages, period=scene.period, lag=scene.lag)

    return make


def _window(scene: SonarModel) -> int:
    """Return the number of rows before and after a row that its estimate uses."""
    return max(SHORTEST_WINDOW, 2 * scene.lag)


TRACKERS: Mapping[str, Callable[[SonarModel], BearingTracker]] = {
    "hmm-row": _hmm("row"),
    "hmm-cell": _hmm("cell"),
    "viterbi": _viterbi,
    "peak-nearest-neighbor": _peaks(PeakNearestNeighbor),
    "peak-kalman-hungarian": _peaks(PeakKalmanHungarian),
}
"""Factory of each observer's tracker."""


def sonar_tracker(name: str, scene: SonarModel) -> BearingTracker:
    """Create a tracker of bearings.

    Args:
        name: One of `TRACKERS`.
        scene: Parameters of the receiver that agents receive.

    Returns:
        The tracker: `track` takes a whole record, `initial` and `step` take it row by row.

    Raises:
        ValueError: An unknown name.
    """
    if name not in TRACKERS:
        raise ValueError(f"no tracker of bearings is called {name!r}; known are {', '.join(TRACKERS)}")
    return TRACKERS[name](scene)
