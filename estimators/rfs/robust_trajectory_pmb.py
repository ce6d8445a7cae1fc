"""Smoothed targets of an adaptive filter: `TrajectoryPMB` with the sensor that `RobustPMB` estimates beside it.

Two filters run on the same scans. The guide is a `RobustPMB`, which estimates detection probability, clutter and births
at measurements and follows maneuvers; the smoother uses its estimates at every scan and reports some scans late. Their
tracks are their own, so that the smoother's histories need no motion modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.birth import BirthMixture
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.robust_pmb import RobustPMB, RobustPMBState
from servotrack.estimators.rfs.sensors import Sensor
from servotrack.estimators.rfs.sets import SetEstimate, read_measurements
from servotrack.estimators.rfs.trajectory_pmb import TrajectoryPMB, TrajectoryPMBState
from servotrack.estimators.stateful import add_axis
from servotrack.estimators.types import Array, Labels


class RobustTrajectoryPMBState(NamedTuple):
    """State of a `RobustTrajectoryPMB`.

    Attributes:
        guide: State of the adaptive filter.
        smoother: State of the filter that reports.
    """

    guide: RobustPMBState
    smoother: TrajectoryPMBState

    @property
    def next_label(self) -> Labels:
        """The next new identity of the smoother. Shape (*batch,)."""
        return self.smoother.next_label


def _clutter_at(density: Callable[[Array], Array], intensity: float | Array, z: Array) -> Array:
    """Clutter intensity at measurements (Z, m) of a mean intensity and a relative density. Shape (Z,)."""
    return np.asarray(intensity * density(z), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class RobustTrajectoryPMB:
    """`TrajectoryPMB` whose detection probability, clutter and births at measurements are estimated by `RobustPMB`.

    A step costs those of both filters. The smoother has one motion; targets that maneuver need one with more noise, or
    `maneuver` and `agility`.

    Args:
        guide: The adaptive filter; births, survival and where the estimates start are the smoother's too.
        motion: Motion and measurement model of the smoother; None: the guide's model.
        lag: Smoothing lag L, scans; see `TrajectoryPMB`.
        least_length: Identities that have ended and existed for fewer scans are withheld; see `TrajectoryPMB`.
        maneuver: Probability of a maneuver of the smoother's motion in one period; see `TrajectoryPMB`.
        agility: Factor on its process noise in a maneuver; see `TrajectoryPMB`.

    Raises:
        ValueError: An argument is out of range.
    """

    guide: RobustPMB
    motion: TargetModel | None = None
    lag: int = 5
    least_length: int = 2
    maneuver: float = 0.0
    agility: float = 10.0

    def __post_init__(self) -> None:
        if not isinstance(self.guide, RobustPMB):
            raise ValueError(f"guide must be a RobustPMB, got {type(self.guide).__name__}")
        self.smoother  # noqa: B018 - raises if an argument is out of range

    @property
    def model(self) -> TargetModel:
        """Motion and measurement model of the smoother."""
        return self.guide.model if self.motion is None else self.motion

    @cached_property
    def smoother(self) -> TrajectoryPMB:
        """The filter that reports."""
        guide, clutter = self.guide, self.guide.clutter_intensity
        if guide.clutter_density is not None:
            clutter = partial(_clutter_at, guide.clutter_density, float(np.asarray(clutter)))
        return TrajectoryPMB(
            self.model,
            guide.birth,
            clutter_intensity=clutter,
            survival=guide.survival,
            detection=guide.detection,
            spawn=guide.spawn,
            extraction=guide.extraction,
            threshold=guide.threshold,
            reduction=guide.reduction,
            gate_probability=guide.gate_probability,
            gate_loss=guide.gate_loss,
            undetected=guide.undetected,
            lag=self.lag,
            least_length=self.least_length,
            maneuver=self.maneuver,
            agility=self.agility,
        )

    def initial(self, measurement: ArrayLike, sensor: Sensor | None = None) -> RobustTrajectoryPMBState:
        """State before the first measurement: no targets. Arguments as in `RobustPMB.initial`."""
        return RobustTrajectoryPMBState(
            self.guide.initial(measurement, sensor), self.smoother.initial(measurement, sensor)
        )

    def step(
        self,
        state: RobustTrajectoryPMBState,
        measurement: ArrayLike,
        dt: float | None = None,
        sensor: Sensor | None = None,
        noise: ArrayLike | None = None,
    ) -> tuple[RobustTrajectoryPMBState, SetEstimate]:
        """Predict to the next instant and update with its measurements; arguments and errors as in `RobustPMB.step`.

        Returns:
            The new state, and the estimate for the scan `lag` before this one.
        """
        guide, _ = self.guide.step(state.guide, measurement, dt, sensor, noise)
        now = self.smoother.at(dt, sensor)
        adaptation = self.guide.adaptation
        if adaptation is None:
            smoother, estimate = self.smoother.step_as(now, state.smoother, measurement, noise)
            return RobustTrajectoryPMBState(guide, smoother), estimate
        known = guide.sensor if np.ndim(guide.next_label) else add_axis(guide.sensor)
        if sensor is None:
            intensity = adaptation.clutter_rate(known) / self.guide.volume
            clutter: Array | Callable[[Array], Array] = intensity
            if self.guide.clutter_density is not None:
                _, number, _ = read_measurements(measurement, self.guide._sizes[1])
                clutter = partial(_clutter_at, self.guide.clutter_density, np.repeat(intensity, number))
            now = now.stating(adaptation.detection(known), clutter)

        def adapted(births: BirthMixture) -> BirthMixture:
            return self.guide.adapted_births(births, known)

        smoother, estimate = self.smoother.step_as(now, state.smoother, measurement, noise, adapted)
        return RobustTrajectoryPMBState(guide, smoother), estimate

    def flush(self, state: RobustTrajectoryPMBState) -> list[SetEstimate]:
        """Return the estimates of the last `lag` scans, the oldest first; the state does not change."""
        return self.smoother.flush(state.smoother)
