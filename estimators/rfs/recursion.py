"""Base class of the Gaussian set filters: parameters, the step from measurements to an estimate, and checks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from servotrack.estimators.elementary import power
from servotrack.estimators.rfs.birth import Birth, BirthMixture, MeasurementBirth, joined_births
from servotrack.estimators.rfs.extraction import RULES, Rule
from servotrack.estimators.rfs.mixed_births import Births, join_births
from servotrack.estimators.rfs.mixture import Mixture
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.scan_noise import no_excess, read_noise
from servotrack.estimators.rfs.sensors import Intensity, Probability, SensedModel, Sensor, checked_interval, model_at
from servotrack.estimators.rfs.sets import (
    Extraction,
    Scan,
    SetEstimate,
    check_runs,
    estimate_from_extraction,
    read_measurements,
)
from servotrack.estimators.rfs.spawn import Spawn, pack_spawns
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, Labels
from servotrack.estimators.validation import LARGEST_NUMBER, SMALLEST_NUMBER, as_numbers, check_count, checked_number

if TYPE_CHECKING:
    from typing_extensions import Self


class SetFilterState(Protocol):
    """State of a Gaussian set filter, a NamedTuple of arrays."""

    @property
    def births(self) -> BirthMixture:
        """Births at the last measurements if they depend on them, else empty."""

    @property
    def next_label(self) -> Labels:
        """The next new identity. Shape (*batch,)."""


StateT = TypeVar("StateT", bound=SetFilterState)
TupleT = TypeVar("TupleT", bound=tuple[Any, ...])


@dataclass(frozen=True, eq=False)
class GaussianSetFilter(ABC, Generic[StateT]):
    """Base of the Gaussian-mixture filters over random finite sets.

    Args:
        model: Motion and measurement model of one target.
        birth: Birth model: `Birth` at known places, `MeasurementBirth` at unexplained measurements, `Births` for both.
        clutter_intensity: Expected false measurements per unit of measurement space, kappa; a number, or a function of
            measurements (Z, m) that returns (Z,). Clutter uniform over a volume V has kappa = rate / V. Raising it
            starts fewer tracks.
        survival: Survival probability p_S, a number or a function of the states (k, n) that returns (k,). Raising it
            keeps missed targets longer.
        detection: Detection probability p_D, a number or a function, which is evaluated at the components' means.
            Raising it ends missed targets sooner.
        spawn: Terms by which targets split, any number.
        extraction: "threshold", "sum" or "map".
        threshold: Weight or existence above which the threshold rule reports. Raising it reports fewer targets.
        reduction: Pruning, merging and capping of the mixtures.
        gate_probability: Probability that a target's measurement lies in its gate. None derives the gate from p_D and
            `gate_loss` (no gate if p_D is 1 or a function).
        gate_loss: Increase of the missed detections by the default gate, as a share of 1 - p_D, from 0 (no gate) to
            0.1. Raising it makes the gate smaller and the filter faster.
        variants: Number of intervals and sensors whose matrices are kept for the next scan of their kind. Raising it
            takes memory, and saves time where many intervals alternate.

    Raises:
        ValueError: An argument is out of range.
    """

    model: TargetModel
    birth: Birth | MeasurementBirth | Births
    _: KW_ONLY
    clutter_intensity: Intensity
    survival: Probability = 0.99
    detection: Probability = 0.98
    spawn: tuple[Spawn, ...] = ()
    extraction: Rule = "threshold"
    threshold: float = 0.5
    reduction: Reduction = field(default_factory=Reduction)
    gate_probability: float | None = None
    gate_loss: float = 0.01
    variants: int = 64

    def __post_init__(self) -> None:
        n = self.model.packed.observation.shape[1]
        sites = self.birth.sites if isinstance(self.birth, Births) else self.birth
        if isinstance(sites, Birth) and sites.means.shape[1] != n:
            raise ValueError(f"birth means must have {n} entries as the model's state, got {sites.means.shape[1]}")
        pack_spawns(self.spawn, n)
        for name, value in (("survival", self.survival), ("detection", self.detection), ("threshold", self.threshold)):
            if not callable(value):
                checked_number(name, value, 0.0, 1.0, "in [0, 1]")
        if not callable(self.clutter_intensity):
            checked_number("clutter_intensity", self.clutter_intensity, 0.0, LARGEST_NUMBER, "finite and >= 0")
        if not isinstance(self.reduction, Reduction):
            raise ValueError(f"reduction must be a Reduction, got {type(self.reduction).__name__}")
        if self.extraction not in RULES:
            raise ValueError(f"extraction must be one of {', '.join(RULES)}, got {self.extraction!r}")
        gate = self.gate_probability
        if gate is not None:
            checked_number("gate_probability", gate, SMALLEST_NUMBER, 1.0, "in (0, 1]")
        if gate is not None and not callable(self.detection) and 1.0 - gate > 0.1 * (1.0 - self.detection):
            raise ValueError(
                f"gate_probability {gate!r} loses targets permanently at p_D = {self.detection!r}: "
                "1 - gate_probability must be at most 0.1 * (1 - p_D); use None or >= "
                f"{1.0 - 0.1 * (1.0 - self.detection):.6g}"
            )
        checked_number("gate_loss", self.gate_loss, 0.0, 0.1, "in [0, 0.1]")
        check_count("variants", self.variants, 1)

    def initial(self, measurement: ArrayLike, sensor: Sensor | None = None) -> StateT:
        """State before the first measurement: no targets. Only the measurement's batch axis is read.

        Args:
            measurement: The first scan, in the form of `step`.
            sensor: Sensor of that scan; None: the measurement of the filter's model.
        """
        z, _, single = read_measurements(measurement, self._sizes[1] if sensor is None else sensor.size)
        state = self._empty(z.shape[0])
        return first_row(state) if single else state

    def step(
        self,
        state: StateT,
        measurement: ArrayLike,
        dt: float | None = None,
        sensor: Sensor | None = None,
        noise: ArrayLike | None = None,
    ) -> tuple[StateT, SetEstimate]:
        """Predict to the next instant and update with its measurements.

        Args:
            state: Result of `initial` or of the last `step`.
            measurement: Shape (Z, m) for one run, Z may be 0; (B, n_max, 1 + m) with existence in column 0 for a batch.
            dt: Time since the last step, s. None: the model's period. Survival and expected births, which are for one
                period, follow. 0: another scan of the same instant, before which nothing moves, appears or vanishes.
            sensor: Sensor of this scan; None: the measurement of the filter's model.
            noise: Covariance of each measurement's noise, where they differ; None: that of the sensor. Shape (Z, m, m),
                for a batch (B, n_max, m, m).

        Returns:
            The new state and the estimate, n the state's size and m the measurement's.

        Raises:
            ValueError: Measurements or noise have a wrong shape or are not finite, dt is negative, the model has no
                motion for dt, or a covariance is not positive definite.
        """
        return self.step_as(self.at(dt, sensor), state, measurement, noise)

    def step_as(
        self,
        now: Self,
        state: StateT,
        measurement: ArrayLike,
        noise: ArrayLike | None = None,
        adapted: Callable[[BirthMixture], BirthMixture] | None = None,
    ) -> tuple[StateT, SetEstimate]:
        """Step with the parameters of a variant of this filter.

        Args:
            now: Result of `at`, also with probabilities by `stating`.
            state: Result of `initial` or of the last step.
            measurement: One scan, in the form of `step`.
            noise: Covariance of each measurement's noise, in the form of `step`; None: that of the sensor.
            adapted: Function from the coming births to those that are used; None: as they are.

        Returns:
            The new state and the estimate.

        Raises:
            ValueError: Measurements or noise have a wrong shape or are not finite, or a covariance is not positive
                definite.
        """
        z, number, single = read_measurements(measurement, now._sizes[1])
        check_runs(state.next_label, z.shape[0], single)
        if single:
            state = add_axis(state)
        state = resized(state, sum(now._sizes))  # type: ignore[type-var]
        share = now.model.period / self.model.period
        births = now._coming_births(state) if adapted is None else adapted(now._coming_births(state))
        packed = now.model.packed
        excess = no_excess(z.shape[0], z.shape[2]) if noise is None else read_noise(noise, measurement, packed)
        scan = Scan(z, number, now._clutter(z, number), excess)
        new, extraction, unexplained = now._advance(state, births, scan)
        if self._anywhere is not None:
            born = self._anywhere.born(now.model, z, unexplained, share if share > 0.0 else 1.0, excess)
            if share == 0.0:
                born = state.births if born is None else joined_births(state.births, born)
            elif born is None:
                born = self._anywhere.empty(z.shape[0], now.model)
            new = new._replace(births=born)  # type: ignore[attr-defined]
        return (first_row(new) if single else new), estimate_from_extraction(extraction, single)

    def at(self, dt: float | None = None, sensor: Sensor | None = None) -> Self:
        """The same filter for another interval and another sensor.

        Args:
            dt: Interval before a scan, s; None: the model's period.
            sensor: Sensor of the scan; None: the measurement of the filter's model.

        Returns:
            A filter whose model, survival, expected births at sites, detection and clutter are those of the step.

        Raises:
            ValueError: dt is negative or not finite, or the model cannot serve it or the sensor.
        """
        if sensor is not None:
            return self._sensing(sensor).at(dt)
        if dt is None or (type(dt) is float and dt == self.model.period):
            return self
        interval = checked_interval(dt)
        return self._variant(interval, lambda: self._over(interval))

    def stating(self, detection: Array, clutter_intensity: Array | Callable[[Array], Array]) -> Self:
        """The same filter with a detection probability and a clutter intensity for each run, for `step_as`.

        Args:
            detection: Shape (B,), in [0, 1].
            clutter_intensity: Shape (B,), >= 0; or a function of the measurements of all runs, in their order.
        """
        made = object.__new__(type(self))
        made.__dict__.update(self.__dict__)
        # The gate follows from the stated probability.
        made.__dict__.update(_gate=self._gate, detection=detection, clutter_intensity=clutter_intensity, _variants={})
        return made

    def _sensing(self, sensor: Sensor) -> Self:
        """The same filter with another sensor."""
        return self._variant(sensor, lambda: replace(self, **self._sensor_changes(sensor)))

    def _variant(self, key: Any, make: Callable[[], Self]) -> Self:
        """A filter made earlier for an interval or a sensor, or a new one."""
        known: dict[Any, Self] = self.__dict__.setdefault("_variants", {})
        variant = known.get(key)
        if variant is None:
            # A sensor that moves is a new one at every scan; without a limit they would fill the memory.
            if len(known) >= self.variants:
                known.pop(next(iter(known)))
            variant = known[key] = make()
        return variant

    def _over(self, dt: float) -> Self:
        """The same filter for another interval."""
        made = object.__new__(type(self))
        # `replace` would check all arguments again, which takes longer than a scan with a few targets.
        own = self.__dict__
        made.__dict__.update({name: own[name] for name in self._names}, **self._interval_changes(dt))
        # What does not depend on the interval is computed once.
        made.__dict__.update(_names=self._names, _sizes=self._sizes, _gate=self._gate, _anywhere=self._anywhere)
        if not self.spawn:
            made.__dict__["_spawns"] = self._spawns
        return made

    def _sensor_changes(self, sensor: Sensor) -> dict[str, Any]:
        """Arguments of the filter with another sensor that differ."""
        changes: dict[str, Any] = {"model": model_at(self.model, None, sensor)}
        for name in ("detection", "clutter_intensity"):
            if getattr(sensor, name) is not None:
                changes[name] = getattr(sensor, name)
        return changes

    def _interval_changes(self, dt: float) -> dict[str, Any]:
        """Arguments of the filter for another interval that differ."""
        model, share = self.model.at(dt), dt / self.model.period
        changes: dict[str, Any] = {"model": model, "survival": _to_the(self.survival, share)}
        if self._sites is not None and share > 0.0:
            sites = replace(self._sites, weights=np.minimum(share * self._sites.weights, 1.0))
            changes["birth"] = sites if self._anywhere is None else Births(sites, self._anywhere)
        if self.spawn:
            shared = (replace(one, weight=min(share * one.weight, 1.0)) for one in self.spawn)
            changes["spawn"] = tuple(shared) if share > 0.0 else ()
        return changes

    def _coming_births(self, state: StateT) -> BirthMixture:
        """Births of the coming step; none if it is at the instant of the last one."""
        batch = len(state.next_label)
        if self.model.period == 0.0:
            n = self._sizes[0]
            return BirthMixture(np.zeros((batch, 0)), np.zeros((batch, 0, n)), np.zeros((batch, 0, n, n)))
        if self._anywhere is None:
            return self._static_births
        coming = self._anywhere.predicted(self.model, state.births)
        return coming if self._sites is None else join_births(self._static_births, coming)

    @abstractmethod
    def _empty(self, batch: int) -> StateT:
        """State of `batch` runs without targets."""

    @abstractmethod
    def _advance(self, state: StateT, births: BirthMixture, scan: Scan) -> tuple[StateT, Extraction, Array]:
        """Advance all runs by one step: new state, extraction, probability of each measurement to be clutter (B, Z)."""

    @cached_property
    def _names(self) -> tuple[str, ...]:
        """Names of the arguments."""
        return tuple(one.name for one in fields(self))

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        """State size n and measurement size m."""
        m, n = self.model.packed.observation.shape
        return n, m

    @cached_property
    def _gate(self) -> float:
        """Largest squared Mahalanobis distance between a measurement and its prediction."""
        m = self._sizes[1]
        if self.gate_probability is None:
            outside = 0.0 if callable(self.detection) else self.gate_loss * (1.0 - self.detection)
        else:
            outside = 1.0 - self.gate_probability
        return float(chdtri(m, outside)) if outside > 0.0 else np.inf

    @cached_property
    def _spawns(self) -> tuple[Array, Array, Array, Array]:
        return pack_spawns(self.spawn, self._sizes[0])

    @cached_property
    def _sites(self) -> Birth | None:
        """Births at known places, if there are any."""
        if isinstance(self.birth, Births):
            return self.birth.sites
        return self.birth if isinstance(self.birth, Birth) else None

    @cached_property
    def _anywhere(self) -> MeasurementBirth | None:
        """Births at measurements, if there are any."""
        if isinstance(self.birth, Births):
            return self.birth.anywhere
        return self.birth if isinstance(self.birth, MeasurementBirth) else None

    @cached_property
    def _static_births(self) -> BirthMixture:
        sites = self._sites
        if sites is None:
            raise TypeError("birth must have sites: only births at known places are the same at every step")
        return BirthMixture(sites.weights[None], sites.means[None], sites.covariances[None])

    def _no_births(self, batch: int) -> BirthMixture:
        """Births of an initial state: weights of 0, or empty arrays if births are the same at every step."""
        n = self._sizes[0]
        if self._anywhere is not None:
            return self._anywhere.empty(batch, self.model)
        return BirthMixture(np.zeros((batch, 0)), np.zeros((batch, 0, n)), np.zeros((batch, 0, n, n)))

    def _attach(self, mixture: Mixture) -> None:
        """Fill the predicted measurements of a mixture that the kernels cannot compute."""
        if isinstance(self.model, SensedModel):
            self.model.attach(mixture)

    def _clutter(self, z: Array, number: Labels) -> Array:
        """Clutter intensity at each measurement, 0 in unused rows. Shape (B, Z)."""
        if not callable(self.clutter_intensity):
            return _filled(z.shape[:2], self.clutter_intensity)
        used = np.arange(z.shape[1]) < number[:, None]
        kappa = np.zeros(z.shape[:2])
        kappa[used] = checked_values("clutter_intensity", self.clutter_intensity(z[used]), int(used.sum()), np.inf)
        return kappa

    def _evaluate(self, name: str, probability: Probability | Array, mixture: Mixture) -> Array:
        """Evaluate p_S or p_D at each component's mean: a function, a constant or one per run. Shape (B, K)."""
        if not callable(probability):
            return _filled(mixture.weight.shape, probability)
        used = np.arange(mixture.weight.shape[1]) < mixture.number[:, None]
        values = np.zeros(mixture.weight.shape)
        states = mixture.mean[used][:, : self._sizes[0]]
        values[used] = checked_values(name, probability(states), len(states), 1.0)
        return values


def _filled(shape: tuple[int, ...], value: float | Array) -> Array:
    """Array (B, K) of a number, or of one number per run, shape (B,)."""
    values = np.empty(shape)
    if isinstance(value, float):
        values.fill(value)
    else:
        values.T[:] = value
    return values


def resized(state: TupleT, width: int) -> TupleT:
    """A state whose components have `width` entries, for a sensor whose measurements have another size.

    Only hidden Markov models have other sensors, and there the entries of the last measurement are not used.
    """
    if all(field.mean.shape[-1] == width for field in state if type(field) is Mixture):
        return state

    def fit(field: Any) -> Any:
        if not isinstance(field, Mixture) or field.mean.shape[-1] == width:
            return field
        kept = min(width, field.mean.shape[-1])
        mean = np.zeros((*field.mean.shape[:-1], width))
        covariance = np.zeros((*mean.shape, width))
        mean[..., :kept] = field.mean[..., :kept]
        covariance[..., :kept, :kept] = field.covariance[..., :kept, :kept]
        return field._replace(mean=mean, covariance=covariance)

    return type(state)(*(fit(field) for field in state))


def _to_the(probability: Probability, share: float) -> Probability:
    """The probability of surviving a share of a period."""
    if share == 1.0:
        return probability
    return _Power(probability, share) if callable(probability) else float(probability) ** share


@dataclass(frozen=True)
class _Power:
    """A probability that depends on the state, to a power; unlike a lambda it can be pickled."""

    probability: Callable[[Array], Array]
    share: float

    def __call__(self, states: Array) -> Array:
        values = as_numbers("what the function survival returns", self.probability(states))
        return power(values, np.full(values.shape, self.share))


def checked_values(name: str, values: ArrayLike, number: int, top: float) -> Array:
    """Check that a caller's function returned `number` finite values from 0 to `top`; raise ValueError otherwise."""
    array = as_numbers(f"what the function {name} returns", values)
    if array.shape != (number,):
        raise ValueError(f"{name} must return shape ({number},), got {array.shape}")
    if not np.all(np.isfinite(array) & (array >= 0.0) & (array <= top)):
        raise ValueError(f"{name} must return finite values from 0 to {top}, got {array.min()} to {array.max()}")
    return array


def check_positive_definite(positive_definite: bool) -> None:
    """Raise ValueError if a kernel found a predicted measurement covariance that is not positive definite."""
    if not positive_definite:
        raise ValueError(
            "a predicted measurement covariance is not positive definite; check the condition of the model's "
            "process_noise, measurement_noise and the birth covariances"
        )
