"""A bank of hypotheses: the same estimator under several assumptions, weighted by how well each foresees the frames.

The hypotheses are one more batch axis behind the measurement's own, so that the estimator serves all of them in one
call and knows nothing about it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from servotrack.estimators.jacobian.contract import JacobianEstimator, ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array


class Hypotheses(Protocol):
    """What the members of a bank differ in."""

    @property
    def count(self) -> int:
        """Number K of hypotheses."""

    def measurement(self, measurement: ServoMeasurement) -> ServoMeasurement:
        """The measurement as every hypothesis reads it: batch axes (*batch, K)."""

    def initial(self, estimator: Any, measurement: ServoMeasurement) -> Any:
        """The estimator's state under every hypothesis; `measurement` already has the batch axes (*batch, K)."""


def _repeated(measurement: ServoMeasurement, count: int) -> ServoMeasurement:
    """The same measurement for `count` hypotheses, as a new last batch axis."""
    measurement = checked(measurement)
    axis = measurement.time.ndim
    repeated = [np.repeat(np.expand_dims(value, axis), count, axis) for value in measurement]
    return ServoMeasurement(*repeated)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Latencies:
    """Frames whose stamps tell the arrival may be this old.

    Args:
        ages: Assumed ages of a frame at its stamp, s. The default covers two control periods in steps fine enough for a
            camera whose readout takes a part of a period.
    """

    ages: tuple[float, ...] = (0.0, 0.03, 0.06, 0.09, 0.12)

    def __post_init__(self) -> None:
        if not self.ages or not all(0.0 <= age < np.inf for age in self.ages):
            raise ValueError(f"ages must be finite and >= 0 s, at least one of them, got {self.ages}")

    @property
    def count(self) -> int:
        """Number K of hypotheses."""
        return len(self.ages)

    def measurement(self, measurement: ServoMeasurement) -> ServoMeasurement:
        """The frame was taken earlier than its stamp says."""
        spread = _repeated(measurement, self.count)
        return spread._replace(frame_time=spread.frame_time - np.asarray(self.ages))

    def initial(self, estimator: JacobianEstimator, measurement: ServoMeasurement) -> Any:
        """Any estimator does: the measurement says it all."""
        return estimator.initial(measurement)


@dataclass(frozen=True)
class Mountings:
    """The camera may be turned about its axis by any angle; each hypothesis begins at one of a circle of them.

    Args:
        count: Number K of angles, evenly spaced over the whole turn.
    """

    count: int = 8

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"count must be at least 1, got {self.count}")

    def measurement(self, measurement: ServoMeasurement) -> ServoMeasurement:
        """All hypotheses read the same."""
        return _repeated(measurement, self.count)

    def initial(self, estimator: Any, measurement: ServoMeasurement) -> Any:
        """Needs an estimator whose `initial` takes a mounting angle, as `ParametricKalman` does."""
        angles = np.arange(self.count) * (2.0 * np.pi / self.count)
        return estimator.initial(measurement, mounting=np.broadcast_to(angles, measurement.time.shape))


class BankState(NamedTuple):
    """State of a `HypothesisBank`.

    Attributes:
        members: The estimator's state, batch axes (*batch, K).
        log_weight: Logarithms of the hypotheses' weights, the best 0. Shape (*batch, K).
    """

    members: Any
    log_weight: Array


@dataclass(frozen=True)
class HypothesisBank:
    """Answers with the estimate of the hypothesis that has foreseen the frames best.

    With p_k the density that hypothesis k gives to a frame, log w_k' = forgetting log w_k + log p_k, up to a common
    constant; no weight falls below `floor`, so that a hypothesis can come back.

    Args:
        estimator: Any estimator that the hypotheses serve.
        hypotheses: What its copies differ in.
        forgetting: Memory of the weights, in (0, 1]; 1 for a constant that never changes.
        floor: Least logarithm of a weight relative to the best.
    """

    estimator: Any
    hypotheses: Hypotheses
    forgetting: float = 0.98
    floor: float = -30.0

    def __post_init__(self) -> None:
        if not 0.0 < self.forgetting <= 1.0:
            raise ValueError(f"forgetting must be in (0, 1], got {self.forgetting}")
        if not self.floor < 0.0:
            raise ValueError(f"floor must be negative, the logarithm of a weight below the best, got {self.floor}")

    def initial(self, measurement: ServoMeasurement) -> BankState:
        """All hypotheses equally likely. Raises ValueError as the estimator does."""
        spread = self.hypotheses.measurement(measurement)
        return BankState(self.hypotheses.initial(self.estimator, spread), np.zeros(spread.time.shape))

    def step(self, state: BankState, measurement: ServoMeasurement) -> tuple[BankState, ServoEstimate]:
        """Fold one measurement into every hypothesis. Raises ValueError as the estimator does."""
        members, estimates = self.estimator.step(state.members, self.hypotheses.measurement(measurement))
        log_weight = self.forgetting * state.log_weight + estimates.log_likelihood
        log_weight = np.maximum(log_weight - log_weight.max(axis=-1, keepdims=True), self.floor)
        return BankState(members, log_weight), _chosen(estimates, log_weight.argmax(axis=-1))

    def forget(self, state: BankState) -> BankState:
        """Every hypothesis keeps its mean and trusts it no more; all are equally likely again."""
        members = self.estimator.forget(state.members) if hasattr(self.estimator, "forget") else state.members
        return BankState(members, np.zeros_like(state.log_weight))


def _chosen(estimates: Any, best: NDArray[np.intp]) -> Any:
    """The estimate, a dataclass of arrays (*batch, K, ...), of the hypothesis `best` (*batch,)."""

    def pick(values: Array) -> Array:
        index = best.reshape(*best.shape, *(1,) * (values.ndim - best.ndim))
        return np.take_along_axis(values, index, axis=best.ndim).squeeze(best.ndim)

    return replace(estimates, **{field.name: pick(getattr(estimates, field.name)) for field in fields(estimates)})
