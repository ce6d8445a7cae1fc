"""Base class of the Gaussian set filters: parameters, the step from measurements to an estimate, and checks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from servotrack.estimators.rfs.birth import Birth, BirthMixture, MeasurementBirth, Spawn, pack_spawns
from servotrack.estimators.rfs.extraction import RULES, Rule
from servotrack.estimators.rfs.mixed_births import Births
from servotrack.estimators.rfs.mixture import Mixture
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import (
    Extraction,
    Scan,
    SetEstimate,
    check_runs,
    estimate_from_extraction,
    read_measurements,
)
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, Labels

Probability = float | Callable[[Array], Array]
"""A constant in [0, 1], or a function of states (k, n) that returns (k,)."""


class SetFilterState(Protocol):
    """State of a Gaussian set filter, a NamedTuple of arrays."""

    @property
    def births(self) -> BirthMixture:
        """Births of the next step if they depend on the measurements, else empty."""

    @property
    def next_label(self) -> Labels:
        """The next new identity. Shape (*batch,)."""


StateT = TypeVar("StateT", bound=SetFilterState)


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

    Raises:
        ValueError: An argument is out of range.
    """

    model: TargetModel
    birth: Birth | MeasurementBirth | Births
    _: KW_ONLY
    clutter_intensity: float | Callable[[Array], Array]
    survival: Probability = 0.99
    detection: Probability = 0.98
    spawn: tuple[Spawn, ...] = ()
    extraction: Rule = "threshold"
    threshold: float = 0.5
    reduction: Reduction = field(default_factory=Reduction)
    gate_probability: float | None = None
    gate_loss: float = 0.01

    def __post_init__(self) -> None:
        n = self.model.packed.observation.shape[1]
        sites = self.birth.sites if isinstance(self.birth, Births) else self.birth
        if isinstance(sites, Birth) and sites.means.shape[1] != n:
            raise ValueError(f"birth means must have {n} entries as the model's state, got {sites.means.shape[1]}")
        pack_spawns(self.spawn, n)
        for name, value in (("survival", self.survival), ("detection", self.detection), ("threshold", self.threshold)):
            if not callable(value) and not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {value!r}")
        kappa = self.clutter_intensity
        if not callable(kappa) and not (np.isfinite(kappa) and kappa >= 0.0):
            raise ValueError(f"clutter_intensity must be finite and >= 0, got {kappa!r}")
        if self.extraction not in RULES:
            raise ValueError(f"extraction must be one of {', '.join(RULES)}, got {self.extraction!r}")
        gate = self.gate_probability
        if gate is not None and not 0.0 < gate <= 1.0:
            raise ValueError(f"gate_probability must be in (0, 1], got {gate!r}")
        if gate is not None and not callable(self.detection) and 1.0 - gate > 0.1 * (1.0 - self.detection):
            raise ValueError(
                f"gate_probability {gate!r} loses targets permanently at p_D = {self.detection!r}: "
                "1 - gate_probability must be at most 0.1 * (1 - p_D); use None or >= "
                f"{1.0 - 0.1 * (1.0 - self.detection):.6g}"
            )
        if not 0.0 <= self.gate_loss <= 0.1:
            raise ValueError(f"gate_loss must be in [0, 0.1], got {self.gate_loss!r}")

    def initial(self, measurement: ArrayLike) -> StateT:
        """State before the first measurement: no targets. Only the measurement's batch axis is read."""
        z, _, single = read_measurements(measurement, self._sizes[1])
        state = self._empty(z.shape[0])
        return first_row(state) if single else state

    def step(self, state: StateT, measurement: ArrayLike) -> tuple[StateT, SetEstimate]:
        """Predict to the next instant and update with its measurements.

        Args:
            state: Result of `initial` or of the last `step`.
            measurement: Shape (Z, m) for one run, Z may be 0; (B, n_max, 1 + m) with existence in column 0 for a batch.

        Returns:
            The new state and the estimate, n the state's size and m the measurement's.

        Raises:
            ValueError: Measurements have a wrong shape or are not finite, or a covariance is not positive definite.
        """
        z, number, single = read_measurements(measurement, self._sizes[1])
        check_runs(state.next_label, z.shape[0], single)
        if single:
            state = add_axis(state)
        births = self._static_births if isinstance(self.birth, Birth) else state.births
        scan = Scan(z, number, self._clutter(z, number))
        new, extraction, unexplained = self._advance(state, births, scan)
        if not isinstance(self.birth, Birth):
            new = new._replace(births=self.birth.next(self.model, z, unexplained))  # type: ignore[attr-defined]
        return (first_row(new) if single else new), estimate_from_extraction(extraction, single)

    @abstractmethod
    def _empty(self, batch: int) -> StateT:
        """State of `batch` runs without targets."""

    @abstractmethod
    def _advance(self, state: StateT, births: BirthMixture, scan: Scan) -> tuple[StateT, Extraction, Array]:
        """Advance all runs by one step: new state, extraction, probability of each measurement to be clutter (B, Z)."""

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
    def _static_births(self) -> BirthMixture:
        if not isinstance(self.birth, Birth):
            raise TypeError("birth must be a Birth: only births at known places are the same at every step")
        return BirthMixture(self.birth.weights[None], self.birth.means[None], self.birth.covariances[None])

    def _no_births(self, batch: int) -> BirthMixture:
        """Births of an initial state: weights of 0, or empty arrays if births are the same at every step."""
        n = self._sizes[0]
        if not isinstance(self.birth, Birth):
            return self.birth.empty(batch, n)
        return BirthMixture(np.zeros((batch, 0)), np.zeros((batch, 0, n)), np.zeros((batch, 0, n, n)))

    def _clutter(self, z: Array, number: Labels) -> Array:
        """Clutter intensity at each measurement, 0 in unused rows. Shape (B, Z)."""
        if not callable(self.clutter_intensity):
            return np.full(z.shape[:2], float(self.clutter_intensity))
        used = np.arange(z.shape[1]) < number[:, None]
        kappa = np.zeros(z.shape[:2])
        kappa[used] = checked_values("clutter_intensity", self.clutter_intensity(z[used]), int(used.sum()), np.inf)
        return kappa

    def _evaluate(self, name: str, probability: Probability | Array, mixture: Mixture) -> Array:
        """Evaluate p_S or p_D at each component's mean: a function, a constant or one per run. Shape (B, K)."""
        if not callable(probability):
            values = np.empty(mixture.weight.shape)
            values.T[:] = probability
            return values
        used = np.arange(mixture.weight.shape[1]) < mixture.number[:, None]
        values = np.zeros(mixture.weight.shape)
        states = mixture.mean[used][:, : self._sizes[0]]
        values[used] = checked_values(name, probability(states), len(states), 1.0)
        return values


def checked_values(name: str, values: ArrayLike, number: int, top: float) -> Array:
    """Check that a caller's function returned `number` finite values from 0 to `top`; raise ValueError otherwise."""
    array = np.asarray(values, dtype=np.float64)
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
