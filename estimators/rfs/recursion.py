"""What all Gaussian set filters share: their parameters, one step from arrays to arrays, and the checks around it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from servotrack.estimators.rfs.birth import Birth, BirthMixture, MeasurementBirth, Spawn, pack_spawns
from servotrack.estimators.rfs.extraction import RULES, Rule
from servotrack.estimators.rfs.mixture import Mixture
from servotrack.estimators.rfs.models import TargetModel
from servotrack.estimators.rfs.reduction import Reduction
from servotrack.estimators.rfs.sets import (
    Extraction,
    SetEstimate,
    check_runs,
    estimate_from_extraction,
    read_measurements,
)
from servotrack.estimators.stateful import add_axis, first_row
from servotrack.estimators.types import Array, Labels

Probability = float | Callable[[Array], Array]
"""A constant in [0, 1], or a function of states (k, n) that returns (k,)."""

GATE_SHARE = 0.01
"""Share of the missed detections that the default gate may add to them."""


@dataclass(frozen=True, eq=False)
class GaussianSetFilter(ABC):
    """Base of the Gaussian-mixture filters over random finite sets.

    Args:
        model: Motion and measurement of one target.
        birth: Where targets appear: `Birth` at known places, `MeasurementBirth` where measurements are unexplained.
        clutter_intensity: Expected false measurements per unit of measurement space, kappa; a number, or a function of
            measurements (Z, m) that returns (Z,). Clutter uniform over a volume V has kappa = rate / V.
        survival: p_S, a number or a function of the states (k, n) that returns (k,).
        detection: p_D, likewise; a function is evaluated at the components' means.
        spawn: How targets split, any number of terms.
        extraction: "threshold", "sum" or "map".
        threshold: Weight or existence above which the threshold rule reports.
        reduction: How far mixtures are reduced.
        gate_probability: Probability that a target's measurement lies in its gate; None ties the gate to p_D such that
            it adds one hundredth to the missed detections (no gate where p_D is 1 or a function).

    Raises:
        ValueError: Naming the argument that is out of range.
    """

    model: TargetModel
    birth: Birth | MeasurementBirth
    _: KW_ONLY
    clutter_intensity: float | Callable[[Array], Array]
    survival: Probability = 0.99
    detection: Probability = 0.98
    spawn: tuple[Spawn, ...] = ()
    extraction: Rule = "threshold"
    threshold: float = 0.5
    reduction: Reduction = field(default_factory=Reduction)
    gate_probability: float | None = None

    def __post_init__(self) -> None:
        n = self.model.packed.observation.shape[1]
        if isinstance(self.birth, Birth) and self.birth.means.shape[1] != n:
            raise ValueError(f"birth means must have {n} entries as the model's state, got {self.birth.means.shape[1]}")
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
                f"gate_probability {gate!r} loses targets for good at p_D = {self.detection!r}: what it cuts off must "
                f"be at most a tenth of what is missed anyway; use None or >= {1.0 - 0.1 * (1.0 - self.detection):.6g}"
            )

    def initial(self, measurement: ArrayLike) -> Any:
        """State before the first measurement: no targets. The measurement gives the batch axis only."""
        z, _, single = read_measurements(measurement, self._sizes[1])
        state = self._empty(z.shape[0])
        return first_row(state) if single else state

    def step(self, state: Any, measurement: ArrayLike) -> tuple[Any, SetEstimate]:
        """Predict to the next instant and fold its measurements in.

        Args:
            state: As returned by `initial` or `step`.
            measurement: Shape (Z, m) for one run, Z may be 0; (B, n_max, 1 + m) with existence in column 0 for a batch.

        Returns:
            The new state and the estimate, n the state's size and m the measurement's.

        Raises:
            ValueError: For measurements of a wrong shape or not finite, and where a covariance lost its definiteness.
        """
        z, number, single = read_measurements(measurement, self._sizes[1])
        if single:
            state = add_axis(state)
        check_runs(state.next_label.shape[0], z.shape[0])
        births = self._static_births if isinstance(self.birth, Birth) else state.births
        new, extraction, unexplained = self._advance(state, births, z, number, self._clutter(z, number))
        if isinstance(self.birth, MeasurementBirth):
            new = new._replace(births=self.birth.next(self.model, z, unexplained))
        return (first_row(new) if single else new), estimate_from_extraction(extraction, single)

    @abstractmethod
    def _empty(self, batch: int) -> Any:
        """State of `batch` runs without targets."""

    @abstractmethod
    def _advance(
        self, state: Any, births: BirthMixture, z: Array, number: Labels, clutter: Array
    ) -> tuple[Any, Extraction, Array]:
        """One step over all runs: the new state, what is extracted, each measurement's chance to be clutter (B, Z)."""

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
            outside = 0.0 if callable(self.detection) else GATE_SHARE * (1.0 - self.detection)
        else:
            outside = 1.0 - self.gate_probability
        return float(chdtri(m, outside)) if outside > 0.0 else np.inf

    @cached_property
    def _spawns(self) -> tuple[Array, Array, Array, Array]:
        return pack_spawns(self.spawn, self._sizes[0])

    @cached_property
    def _static_births(self) -> BirthMixture:
        if not isinstance(self.birth, Birth):
            raise TypeError("only births at known places are the same at every step")
        return BirthMixture(self.birth.weights[None], self.birth.means[None], self.birth.covariances[None])

    def _no_births(self, batch: int) -> BirthMixture:
        """Births a state starts with: none, and no room for any where they are the same at every step."""
        n = self._sizes[0]
        if isinstance(self.birth, MeasurementBirth):
            return self.birth.empty(batch, n)
        return BirthMixture(np.zeros((batch, 0)), np.zeros((batch, 0, n)), np.zeros((batch, 0, n, n)))

    def _clutter(self, z: Array, number: Labels) -> Array:
        """Kappa at each measurement, 0 in unused rows. Shape (B, Z)."""
        if not callable(self.clutter_intensity):
            return np.full(z.shape[:2], float(self.clutter_intensity))
        used = np.arange(z.shape[1]) < number[:, None]
        kappa = np.zeros(z.shape[:2])
        kappa[used] = checked_values("clutter_intensity", self.clutter_intensity(z[used]), int(used.sum()), np.inf)
        return kappa

    def _evaluate(self, name: str, probability: Probability | Array, mixture: Mixture) -> Array:
        """p_S or p_D at each component's mean, from a function, a constant or one constant per run. Shape (B, K)."""
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
    """What a caller's function returned: `number` finite values from 0 to `top`, or a ValueError that names it."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (number,):
        raise ValueError(f"{name} must return shape ({number},), got {array.shape}")
    if not np.all(np.isfinite(array) & (array >= 0.0) & (array <= top)):
        raise ValueError(f"{name} must return finite values from 0 to {top}, got {array.min()} to {array.max()}")
    return array


def check_sound(sound: bool) -> None:
    """Raise where a predicted measurement's covariance was not positive definite."""
    if not sound:
        raise ValueError(
            "a predicted measurement covariance is not positive definite; check the condition of the model's "
            "process_noise, measurement_noise and the birth covariances"
        )
