"""Hypothesis bank: one estimator under several assumptions, weighted by their predictive likelihood.

The hypotheses are one more batch axis behind the measurement's own, so that one call of the estimator updates all of
them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.jacobian.contract import JacobianEstimator, ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array
from servotrack.estimators.validation import as_mask, as_numbers


class MountedEstimator(JacobianEstimator, Protocol):
    """`JacobianEstimator` whose initial state can be made for given mounting angles, as `ParametricKalman`."""

    def initial(self, measurement: ServoMeasurement, /, mounting: ArrayLike | None = None) -> Any:
        """Return the state before the first frame.

        Args:
            measurement: First measurement.
            mounting: Expected mounting angle of the camera; None: the estimator's own. Shape (*batch,), rad.
        """


Member = TypeVar("Member", bound=JacobianEstimator)
Member_contra = TypeVar("Member_contra", bound=JacobianEstimator, contravariant=True)


class Hypotheses(Protocol[Member_contra]):
    """Assumptions in which the K members of a bank differ."""

    @property
    def count(self) -> int:
        """Number K of hypotheses."""

    def measurement(self, measurement: ServoMeasurement) -> ServoMeasurement:
        """Return the measurement under every hypothesis, with batch axes (*batch, K)."""

    def initial(self, estimator: Member_contra, measurement: ServoMeasurement) -> Any:
        """Return the estimator's state under every hypothesis.

        Args:
            estimator: Estimator of the bank.
            measurement: Result of `measurement`, with batch axes (*batch, K).
        """


def _repeated(measurement: ServoMeasurement, count: int) -> ServoMeasurement:
    """Repeat a measurement for `count` hypotheses along a new last batch axis."""
    single = as_mask("visible", measurement.visible).ndim > as_numbers("time", measurement.time).ndim
    measurement = checked(measurement, each_feature=single)
    axis = measurement.time.ndim
    repeated = [None if value is None else np.repeat(np.expand_dims(value, axis), count, axis) for value in measurement]
    return ServoMeasurement(*repeated)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Latencies:
    """Hypotheses about the unknown latencies of a camera and of encoders whose readings are stamped on arrival.

    Args:
        ages: Assumed ages of a frame at its stamp, s. The default covers two control periods, in steps fine enough for
            a camera whose readout takes part of a period.
        encoder_ages: Assumed ages of the encoder readings at their stamps, s. Every pair of ages is a hypothesis. Where
            both are late by the same time, nothing but the age of the answer differs.
    """

    ages: tuple[float, ...] = (0.0, 0.03, 0.06, 0.09, 0.12)
    encoder_ages: tuple[float, ...] = (0.0,)

    def __post_init__(self) -> None:
        for name in ("ages", "encoder_ages"):
            values = getattr(self, name)
            if not values or not all(0.0 <= age < np.inf for age in values):
                raise ValueError(f"{name} must have at least one value, all finite and >= 0 s, got {values}")

    @property
    def count(self) -> int:
        """Number K of hypotheses."""
        return len(self.ages) * len(self.encoder_ages)

    def measurement(self, measurement: ServoMeasurement) -> ServoMeasurement:
        """Return the measurement with `frame_time` and `joint_time` moved back by each pair of assumed ages."""
        spread = _repeated(measurement, self.count)
        frames, encoders = np.repeat(self.ages, len(self.encoder_ages)), np.tile(self.encoder_ages, len(self.ages))
        spread = spread._replace(frame_time=spread.frame_time - frames)
        if self.encoder_ages == (0.0,):
            return spread
        read_at = spread.time if spread.joint_time is None else spread.joint_time
        return spread._replace(joint_time=read_at - encoders)

    def initial(self, estimator: JacobianEstimator, measurement: ServoMeasurement) -> Any:
        """Return the state of any estimator; the ages are already part of the measurement."""
        return estimator.initial(measurement)


@dataclass(frozen=True)
class Mountings:
    """Hypotheses about the unknown mounting angle of the camera: each starts at one of K angles on a circle.

    Args:
        count: Number K of angles, evenly spaced over 2 pi. Computing time grows in proportion.
    """

    count: int = 8

    def __post_init__(self) -> None:
        if self.count < 1:
            raise ValueError(f"count must be at least 1, got {self.count}")

    def measurement(self, measurement: ServoMeasurement) -> ServoMeasurement:
        """Return the same measurement for every hypothesis."""
        return _repeated(measurement, self.count)

    def initial(self, estimator: MountedEstimator, measurement: ServoMeasurement) -> Any:
        """Return the state of an estimator whose `initial` accepts a mounting angle, such as `ParametricKalman`."""
        angles = np.arange(self.count) * (2.0 * np.pi / self.count)
        return estimator.initial(measurement, mounting=np.broadcast_to(angles, measurement.time.shape))


class BankState(NamedTuple):
    """State of a `HypothesisBank`.

    Attributes:
        members: State of the estimator, with batch axes (*batch, K).
        log_weight: Logarithms of the hypotheses' weights; the largest is 0. Shape (*batch, K).
    """

    members: Any
    log_weight: Array


@dataclass(frozen=True)
class HypothesisBank(Generic[Member]):
    """Estimator that returns the estimate of the hypothesis with the highest predictive likelihood.

    With p_k the density of a frame under hypothesis k, log w_k' = forgetting log w_k + log p_k, up to a common
    constant. No weight falls below `floor`, so that a hypothesis can recover.

    Args:
        estimator: Estimator of which every hypothesis has a copy.
        hypotheses: Assumptions in which the copies differ.
        forgetting: Memory of the weights per frame, in (0, 1]. Smaller values switch hypotheses sooner; 1 suits a
            constant that never changes.
        floor: Smallest logarithm of a weight relative to the best, negative. Values nearer to 0 let a hypothesis
            recover sooner.
    """

    estimator: Member
    hypotheses: Hypotheses[Member]
    forgetting: float = 0.98
    floor: float = -30.0

    def __post_init__(self) -> None:
        check_memory(self.forgetting, self.floor)

    @property
    def row_covariances(self) -> bool:
        """True if the estimator gives covariances of its rows."""
        return bool(getattr(self.estimator, "row_covariances", False))

    def initial(self, measurement: ServoMeasurement) -> BankState:
        """Return the state with equally likely hypotheses. Raises ValueError as the estimator does."""
        spread = self.hypotheses.measurement(measurement)
        return BankState(self.hypotheses.initial(self.estimator, spread), np.zeros(spread.time.shape))

    def step(self, state: BankState, measurement: ServoMeasurement) -> tuple[BankState, ServoEstimate]:
        """Update every hypothesis with one measurement. Raises ValueError as the estimator does."""
        members, estimates = self.estimator.step(state.members, self.hypotheses.measurement(measurement))
        log_weight = _weighted(state.log_weight, estimates.log_likelihood, self.forgetting, self.floor)
        return BankState(members, log_weight), _chosen(estimates, log_weight.argmax(axis=-1))

    def forget(self, state: BankState) -> BankState:
        """Reset the covariance of every hypothesis and make all hypotheses equally likely; the means stay."""
        members = self.estimator.forget(state.members) if hasattr(self.estimator, "forget") else state.members
        return BankState(members, np.zeros_like(state.log_weight))


class EstimatorBankState(NamedTuple):
    """State of an `EstimatorBank`.

    Attributes:
        members: State of each estimator; of a `ChainBank` one state, with batch axes (*batch, K).
        log_weight: Logarithms of the estimators' weights; the largest is 0. Shape (*batch, K).
    """

    members: Any
    log_weight: Array


@dataclass(frozen=True)
class EstimatorBank:
    """Estimator that returns the estimate of the one of K estimators with the highest predictive likelihood.

    A frame counts with its mean log likelihood per feature. `HypothesisBank` is faster where the members differ only in
    what they assume of the measurement.

    Args:
        members: Estimators with the same kind of estimate, for example with gears of different play.
        forgetting: Memory of the weights per frame, in (0, 1]. Smaller values switch sooner.
        floor: Smallest logarithm of a weight relative to the best, negative. Values nearer to 0 let a member recover
            sooner.
    """

    members: tuple[JacobianEstimator, ...]
    forgetting: float = 0.98
    floor: float = -30.0

    def __post_init__(self) -> None:
        if not self.members:
            raise ValueError("members must have at least one estimator, got ()")
        check_memory(self.forgetting, self.floor)

    @property
    def row_covariances(self) -> bool:
        """True if all members give covariances of their rows."""
        return all(getattr(member, "row_covariances", False) for member in self.members)

    def initial(self, measurement: ServoMeasurement) -> EstimatorBankState:
        """Return the state with equally likely members. Raises ValueError as the members do."""
        states = tuple(member.initial(measurement) for member in self.members)
        return EstimatorBankState(states, np.zeros((*np.shape(measurement.time), len(states))))

    def step(self, state: EstimatorBankState, measurement: ServoMeasurement) -> tuple[EstimatorBankState, Any]:
        """Update every member with one measurement. Raises ValueError as the members do."""
        results = [member.step(before, measurement) for member, before in zip(self.members, state.members, strict=True)]
        estimates = [estimate for _, estimate in results]
        # The errors of a frame have few causes, the joints, however many features show them.
        features = estimates[0].error.shape[-1]
        log_likelihood = np.stack([estimate.log_likelihood for estimate in estimates], axis=-1) / features
        log_weight = _weighted(state.log_weight, log_likelihood, self.forgetting, self.floor)
        stacked = _stacked(estimates, log_likelihood.ndim - 1)
        return EstimatorBankState(tuple(s for s, _ in results), log_weight), _chosen(
            stacked, log_weight.argmax(axis=-1)
        )

    def forget(self, state: EstimatorBankState) -> EstimatorBankState:
        """Let every member forget that can; the weights stay."""
        return EstimatorBankState(
            tuple(
                member.forget(before) if hasattr(member, "forget") else before
                for member, before in zip(self.members, state.members, strict=True)
            ),
            state.log_weight,
        )


def check_memory(forgetting: float, floor: float) -> None:
    """Raise ValueError for a bad memory or floor of a bank's weights."""
    if not 0.0 < forgetting <= 1.0:
        raise ValueError(f"forgetting must be in (0, 1], got {forgetting}")
    if not floor < 0.0:
        raise ValueError(f"floor must be negative (logarithm of a weight relative to the best), got {floor}")


def _weighted(log_weight: Array, log_likelihood: Array, forgetting: float, floor: float) -> Array:
    """Logarithms of the weights after a frame. Shapes (*batch, K)."""
    updated = forgetting * log_weight + log_likelihood
    return np.maximum(updated - updated.max(axis=-1, keepdims=True), floor)


def _stacked(estimates: list[Any], axis: int) -> Any:
    """Stack the arrays of estimates of one kind along a new axis; what is None in one is None."""

    def stack(name: str) -> Array | None:
        values = [getattr(estimate, name) for estimate in estimates]
        return None if any(value is None for value in values) else np.stack(values, axis=axis)

    return replace(estimates[0], **{field.name: stack(field.name) for field in fields(estimates[0])})


def _chosen(estimates: Any, best: NDArray[np.intp]) -> Any:
    """Pick the estimate of one hypothesis per batch row.

    Args:
        estimates: Dataclass of arrays (*batch, K, ...).
        best: Index of the hypothesis. Shape (*batch,).
    """

    def pick(values: Array | None) -> Array | None:
        if values is None:
            return None
        index = best.reshape(*best.shape, *(1,) * (values.ndim - best.ndim))
        return np.take_along_axis(values, index, axis=best.ndim).squeeze(best.ndim)

    return replace(estimates, **{field.name: pick(getattr(estimates, field.name)) for field in fields(estimates)})
