"""A GM-PHD filter whose parameters are inputs of every step, with constant parameters or estimates by counting."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.rfs.birth import Birth, BirthMixture, MeasurementBirth
from servotrack.estimators.rfs.mixed_births import join_births
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.phd import GMPHD, PHDState
from servotrack.estimators.rfs.scan_noise import no_excess
from servotrack.estimators.rfs.sets import Scan, SetEstimate, check_runs, estimate_from_extraction, read_measurements
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers


class Steering(NamedTuple):
    """Parameters of one step, for each run of a batch.

    Attributes:
        detection: Detection probability p_D, in [0, 1]. Shape (*batch,).
        clutter: Factor on the filter's clutter intensity, > 0. Shape (*batch,).
        births: Expected number of births at unexplained measurements, in addition to those at known places, >= 0. Shape
            (*batch,).
    """

    detection: Array
    clutter: Array
    births: Array


class Account(NamedTuple):
    """Expected counts of one step, from which the parameters can be estimated.

    Attributes:
        predicted: Expected number of targets before the scan. Shape (*batch,).
        explained: Expected number of measurements of targets. Shape (*batch,).
        unexplained: Expected number of other measurements. Shape (*batch,).
        number: Expected number of targets after the scan. Shape (*batch,).
    """

    predicted: Array
    explained: Array
    unexplained: Array
    number: Array


class SteeredState(NamedTuple):
    """State of a `SteeredPHD`.

    Attributes:
        phd: State of the filter.
        anywhere: Births at the last unexplained measurements, for an expected number of one.
        account: Expected counts of the last step.
    """

    phd: PHDState
    anywhere: BirthMixture
    account: Account


@dataclass(frozen=True)
class SteeredPHD:
    """A GM-PHD filter whose detection probability, clutter and births are inputs of every step.

    Args:
        filter: The filter: model, births at known places, and clutter intensity, which steering multiplies.
        anywhere: Birth model at unexplained measurements; `expected` must be 1, steering gives the number.

    Raises:
        ValueError: `anywhere.expected` is not 1.
    """

    filter: GMPHD
    anywhere: MeasurementBirth = field(default_factory=lambda: MeasurementBirth(expected=1.0, largest=1.0))

    def __post_init__(self) -> None:
        if self.anywhere.expected != 1.0:
            raise ValueError(
                f"anywhere.expected must be 1, got {self.anywhere.expected!r}; steering gives the number of births"
            )

    def initial(self, measurement: ArrayLike) -> SteeredState:
        """State before the first scan, of which only the batch axis is read."""
        z, _, single = read_measurements(measurement, self.filter._sizes[1])
        none = np.zeros(len(z))
        state = SteeredState(
            self.filter._empty(len(z)),
            self.anywhere.empty(len(z), self.filter.model),
            Account(none, none, none, none),
        )
        return first_row(state) if single else state

    def step(self, state: SteeredState, measurement: ArrayLike, steering: Steering) -> tuple[SteeredState, SetEstimate]:
        """Predict to the next instant and update with its measurements, with the given parameters.

        Args:
            state: Result of `initial` or of the last `step`.
            measurement: Measurements in the form of `GMPHD.step`.
            steering: Parameters of each run.

        Returns:
            The new state and the estimate.

        Raises:
            ValueError: An error of `GMPHD.step`, or steering has another shape or is out of range.
        """
        phd = self.filter
        z, number, single = read_measurements(measurement, phd._sizes[1])
        check_runs(state.phd.next_label, len(z), single)
        steering = _checked_steering(steering, () if single else (len(z),))
        if single:
            state = add_axis(state)
        births = self._births(state.anywhere, steering.births)
        clutter = phd._clutter(z, number) * steering.clutter[:, None]
        survival = phd._evaluate("survival", phd.survival, state.phd.intensity)
        predicted = (survival * state.phd.intensity.weight).sum(axis=1) + births.weight.sum(axis=1)
        scan = Scan(z, number, clutter, no_excess(len(z), z.shape[2]))
        new, extraction, unexplained = phd._advance_detecting(state.phd, births, scan, steering.detection)
        used = np.arange(z.shape[1]) < number[:, None]
        left = np.where(used, unexplained, 0.0)
        account = Account(predicted, number - left.sum(axis=1), left.sum(axis=1), new.intensity.weight.sum(axis=1))
        born = self.anywhere.born(phd.model, z, left)
        following = SteeredState(new, self.anywhere.empty(len(z), phd.model) if born is None else born, account)
        return (first_row(following) if single else following), estimate_from_extraction(extraction, single)

    def at(self, dt: float) -> SteeredPHD:
        """The same filter for an interval of `dt` seconds; steering is still given per step."""
        return replace(self, filter=self.filter.at(dt))

    def _births(self, anywhere: BirthMixture, expected: Array) -> BirthMixture:
        """Births at known places and at unexplained measurements."""
        moved = self.anywhere.predicted(self.filter.model, anywhere)
        shared = moved._replace(weight=np.minimum(moved.weight * expected[:, None], 1.0))
        if not isinstance(self.filter.birth, Birth):
            return shared
        return join_births(self.filter._static_births, shared)


def _checked_steering(steering: Steering, batch: tuple[int, ...]) -> Steering:
    """Return the parameters of every run, shape (runs,); raise ValueError for wrong shapes and values."""
    ranges = {"detection": (0.0, 1.0), "clutter": (1e-12, LIMITS.scores), "births": (0.0, LIMITS.scores)}
    checked = []
    for name, (low, high) in ranges.items():
        values = as_numbers(f"steering {name}", getattr(steering, name))
        # One run has a number, or an array of one number.
        if values.shape != batch and not (batch == () and values.shape == (1,)):
            raise ValueError(f"steering {name} must have shape {batch}, one number per run, got {values.shape}")
        if not np.all((values >= low) & (values <= high)):
            raise ValueError(f"steering {name} must be finite and in [{low:g}, {high:g}], got {values.tolist()}")
        checked.append(values.reshape(-1))
    return Steering(*checked)


@dataclass(frozen=True)
class SteadyPHD:
    """A steered GM-PHD filter with constant parameters: those of its filter, and births at unexplained measurements.

    Args:
        steered: The filter.
        births: Expected number of births per scan at unexplained measurements. Raising it finds targets anywhere sooner
            and reports more clutter.

    Raises:
        ValueError: `births` is out of range, or the detection probability is a function of the state.
    """

    steered: SteeredPHD
    births: float = 1e-3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.births) and self.births >= 0.0):
            raise ValueError(f"births must be finite and >= 0, got {self.births!r}")
        constant_detection(self.steered)

    @property
    def model(self) -> TargetModel:
        """Motion and measurement model of one target."""
        return self.steered.filter.model

    def initial(self, measurement: ArrayLike) -> SteeredState:
        """State before the first scan, of which only the batch axis is read."""
        return self.steered.initial(measurement)

    def step(
        self, state: SteeredState, measurement: ArrayLike, dt: float | None = None
    ) -> tuple[SteeredState, SetEstimate]:
        """Predict and update; arguments, results and errors as in `GMPHD.step`."""
        if dt is not None and dt != self.model.period:
            return replace(self, steered=self.steered.at(dt), births=self.births * dt / self.model.period).step(
                state, measurement
            )
        one = np.ones_like(state.account.number)
        return self.steered.step(
            state, measurement, Steering(constant_detection(self.steered) * one, one, self.births * one)
        )


def constant_detection(steered: SteeredPHD) -> float:
    """Return the detection probability of the filter's own parameters.

    Raises:
        ValueError: The detection probability is a function of the state.
    """
    detection = steered.filter.detection
    if callable(detection):
        raise ValueError("detection must be a number in a steered filter, got a function of the state")
    return float(detection)


class CountingState(NamedTuple):
    """State of a `CountingPHD`.

    Attributes:
        steered: State of the filter.
        predicted, explained, unexplained, scans: Exponentially weighted sums of the counts. Shape (*batch,).
    """

    steered: SteeredState
    predicted: Array
    explained: Array
    unexplained: Array
    scans: Array


@dataclass(frozen=True)
class CountingPHD:
    """A steered GM-PHD filter that estimates its detection probability and clutter rate by counting.

    The detection probability is the share of expected targets with a measurement, the clutter rate the mean number of
    measurements that no target explains. Both start from the given values, which count like `trust` observed scans.

    Args:
        steered: The filter.
        clutter_rate: Assumed mean number of false measurements per scan.
        births: Expected number of births per scan at unexplained measurements.
        memory: Number of scans after which the weight of a count has fallen to 1/e. Raising it makes the estimates
            steadier and slower.
        trust: Number of scans that the given values count for. Raising it keeps the estimates near them for longer.
        detection_limits: Lower and upper limit of the estimated detection probability.
        least_clutter: Lower limit of the estimated clutter rate, as a share of `clutter_rate`.

    Raises:
        ValueError: An argument is out of range.
    """

    steered: SteeredPHD
    clutter_rate: float
    births: float = 0.1
    memory: float = 30.0
    trust: float = 2.0
    detection_limits: tuple[float, float] = (0.05, 0.999)
    least_clutter: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("clutter_rate", "births", "memory", "trust", "least_clutter"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be finite and > 0, got {value!r}")
        low, high = self.detection_limits
        if not 0.0 <= low <= high <= 1.0:
            raise ValueError(f"detection_limits must be ascending in [0, 1], got {self.detection_limits!r}")
        constant_detection(self.steered)

    @property
    def model(self) -> TargetModel:
        """Motion and measurement model of one target."""
        return self.steered.filter.model

    def initial(self, measurement: ArrayLike) -> CountingState:
        """State before the first scan, of which only the batch axis is read."""
        steered = self.steered.initial(measurement)
        none = np.zeros_like(steered.account.number)
        return CountingState(steered, none, none, none, none)

    def step(
        self, state: CountingState, measurement: ArrayLike, dt: float | None = None
    ) -> tuple[CountingState, SetEstimate]:
        """Predict and update; arguments, results and errors as in `GMPHD.step`. Counts are of scans."""
        if dt is not None and dt != self.model.period:
            return replace(self, steered=self.steered.at(dt), births=self.births * dt / self.model.period).step(
                state, measurement
            )
        detection = (self.trust * constant_detection(self.steered) + state.explained) / (self.trust + state.predicted)
        clutter = (self.trust * self.clutter_rate + state.unexplained) / (self.trust + state.scans)
        steering = Steering(
            np.clip(detection, *self.detection_limits),
            np.maximum(clutter / self.clutter_rate, self.least_clutter),
            np.full_like(detection, self.births),
        )
        steered, estimate = self.steered.step(state.steered, measurement, steering)
        account, kept = steered.account, np.exp(-1.0 / self.memory)
        return CountingState(
            steered,
            kept * state.predicted + account.predicted,
            kept * state.explained + account.explained,
            kept * state.unexplained + account.unexplained,
            kept * state.scans + 1.0,
        ), estimate
