"""Control law in joint space: straight to the posture that shows the goal, where the estimate can say which it is."""

from __future__ import annotations

from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from servotrack.estimators.jacobian.cautious import Cautious
from servotrack.estimators.jacobian.contract import ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.laws import damped_inverse
from servotrack.estimators.types import Array, Mask


@runtime_checkable
class GoalSearch(Protocol):
    """Estimate that knows the arm well enough to search the posture that shows the goal, as `ChainEstimate`."""

    def motion_to_goal(self, low: Array | None = None, high: Array | None = None) -> tuple[Array, Array]:
        """Joint motion (*batch, n), rad, within bounds, and the error (*batch,) that it leaves, px."""


@dataclass(frozen=True)
class JointSpace:
    """Law that removes a share of the joint motion to the goal in every period.

    A law in the image takes the points to their goal on straight lines, which for a turn of half a circle leads the
    camera away from the target, and others into the joint limits. The straight line in joint space does neither. Where
    the estimate knows no such motion, or none that shows the goal, the law in the image serves.

    Args:
        gain: Share of the motion to make in one period, in (0, 1]. Larger values converge faster and oscillate with
            motors that lag.
        image: Law in the image.
        tolerance: Error, root of the mean square, below which the law in the image serves, and which the motion may
            leave if it is more than `share` of the present one, px. Larger values leave joint space sooner.
        share: Share of the present error that the motion may leave. Larger values trust the search more.
        detour: Largest length of the motion, as a multiple of the step that the linearized image asks for. A longer one
            leads to another posture that shows the same image. Larger values follow longer ways around.
    """

    gain: float = 0.2
    image: Cautious = field(default_factory=Cautious)
    tolerance: float = 5.0
    share: float = 0.25
    detour: float = 3.0

    def __post_init__(self) -> None:
        if not 0.0 < self.gain <= 1.0:
            raise ValueError(f"gain must be in (0, 1] (fraction of the motion made in one period), got {self.gain}")
        for name in ("tolerance", "share", "detour"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")

    @property
    def period(self) -> float:
        """Control period, s."""
        return self.image.period

    def initial(self, measurement: ServoMeasurement) -> Any:
        """Return the state of the law in the image."""
        return self.image.initial(measurement)

    def rate(
        self, state: Any, estimate: ServoEstimate, low: Array | None = None, high: Array | None = None
    ) -> tuple[Any, Array]:
        """Return the new state and the joint rates. Shape (*batch, n), rad/s.

        Args:
            state: State after the last step.
            estimate: Estimate at present, with covariances.
            low: Least motion to the goal's posture: lower limits minus present angles; None: unbounded. Shape
                (*batch, n), rad.
            high: Largest motion to it. Shape (*batch, n), rad.
        """
        state, rate = self.image.rate(state, estimate)
        # Near the goal, which is most of the time, no more than this is computed.
        squares = np.einsum("...i,...i->...", estimate.error, estimate.error) / estimate.error.shape[-1]
        if not (squares > self.tolerance**2).any():
            return state, rate
        if not isinstance(estimate, GoalSearch) or not is_dataclass(estimate):
            return state, rate
        present = np.sqrt(squares)
        motion, left = estimate.motion_to_goal(low, high)
        step = np.einsum("...ij,...j->...i", damped_inverse(estimate.jacobian[..., :-1], 0.01), estimate.error)
        longest = self.detour * np.sqrt(np.sum(step**2, axis=-1))
        direct = np.sqrt(np.sum(motion**2, axis=-1)) <= longest
        # Near the goal, a search answers to every change of the estimate, and the image is as good as straight.
        reached = (present > self.tolerance) & direct & (left <= np.maximum(self.tolerance, self.share * present))
        # What moves by itself, target or goal, is followed as in the image.
        still: Any = replace(estimate, error=np.zeros_like(estimate.error))
        following = self.image.rate(self.image.initial(_goals(estimate.error)), still)[1]
        planned = self.gain / self.period * np.where(reached[..., None], motion, 0.0) + following
        return state, np.where(reached[..., None], planned, rate)

    def within(self, rate: Array, estimate: ServoEstimate, low: Array, high: Array, rows: Mask) -> Array:
        """Joint rates within bounds; see `Cautious.within`."""
        return self.image.within(rate, estimate, low, high, rows)


def _goals(error: Array) -> ServoMeasurement:
    """Measurement of which a law reads only the shape of the goal."""
    empty = np.zeros(error.shape[:-1])
    return ServoMeasurement(error, error, error, empty > 0.0, empty, empty)
