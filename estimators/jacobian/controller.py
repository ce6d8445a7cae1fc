"""Complete servo loop: estimator, control law, exploratory moves and supervisor. It also drives a real robot."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.any_arm import AnyArm
from servotrack.estimators.jacobian.cautious import Cautious
from servotrack.estimators.jacobian.contract import JacobianEstimator, ServoEstimate, ServoMeasurement
from servotrack.estimators.jacobian.excitation import Excitation, Excite, ExploratoryMoves
from servotrack.estimators.jacobian.exploration import Exploration
from servotrack.estimators.jacobian.goal_motion import GoalState, begin_goal, goal_velocity
from servotrack.estimators.jacobian.joint_limits import JointLimits
from servotrack.estimators.jacobian.joint_space import JointSpace
from servotrack.estimators.jacobian.laws import BoundedLaw, ControlLaw, ProportionalIntegral, limiting_factor
from servotrack.estimators.jacobian.progress import ProgressSupervisor
from servotrack.estimators.jacobian.supervisor import Supervisor
from servotrack.estimators.stateful import select_rows
from servotrack.estimators.types import Array


class Pace(NamedTuple):
    """Control periods of the chosen parts where none is given.

    Attributes:
        period: Shortest one, s.
        ratio: Ratio of one to the next.
        least: Number of such steps below which a period counts as the shortest one.
    """

    period: float = 0.05
    ratio: float = 1.1
    least: int = 3


_PACE = Pace()


class ControllerState(NamedTuple):
    """State of a `ServoController`.

    Attributes:
        estimator: State of the estimator.
        law: State of the law.
        excitation: State of the exploratory moves.
        supervisor: State of the supervisor; None without one.
        commanded: Motion commanded at the last step. Shape (*batch, n), rad.
        goal: Goal of the last step, from which its velocity follows; None where it is not followed.
        time: Time of the last step. Shape (*batch,), s.
        period: Running mean of the time between two steps. Shape (*batch,), s.
    """

    estimator: Any
    law: Any
    excitation: Any
    supervisor: Any
    commanded: Array
    goal: GoalState | None
    time: Array
    period: Array


@dataclass(frozen=True)
class ServoController:
    """Servo controller: measurements in, joint rates out.

    The controller makes exploratory moves at the start, then applies the law to the estimate. While the target is out
    of view, it first follows the prediction and then returns to the joint angles at which the target was last seen.
    When the supervisor detects a wrong estimate, the controller resets the estimator's covariance (`forget(state) ->
    state`, if the estimator has it) and explores again.

        controller = ServoController()
        state = controller.initial(measurement)
        while True:
            state, joint_rate = controller.step(state, measurement)

    The default serves arms with any number of joints, with features that are seen one by one. An estimator that gives
    covariances of its rows (`row_covariances`) is used with `JointSpace` on top of `Cautious`, `Exploration` and
    `ProgressSupervisor`, and a goal that moves smoothly is followed with its velocity; others are used with
    `ProportionalIntegral`, `Excitation` and `Supervisor`.

    Args:
        estimator: Estimator of the total image Jacobian. The default takes half a millisecond a step for four image
            points while the arm moves, and half of that at rest; `AdaptiveKalmanJacobian()` is less accurate and
            faster.
        law: Control law, a `BoundedLaw` to heed limits and moving goals; None chooses by the estimator.
        excitation: Exploratory moves, or None to choose by the estimator; `Excitation(steps=0)` makes none.
        supervisor: Detector of a wrong estimate; "auto" chooses by the estimator, None disables it.
        max_joint_rate: Limit of each joint rate, rad/s. The whole vector is scaled, so that its direction stays.
        limits: Joint limits and the limit of acceleration; None: there are none.
        period: Control period of the parts that are chosen, s. None: 50 ms, or the mean time between two steps where
            that is clearly longer: the same share of the error in more time, which motors and images need. Faster loops
            keep the joint rates of 50 ms.
    """

    estimator: JacobianEstimator = field(default_factory=AnyArm)
    law: ControlLaw | None = None
    excitation: ExploratoryMoves | None = None
    supervisor: ProgressSupervisor | Supervisor | Literal["auto"] | None = "auto"
    max_joint_rate: float = 2.0
    limits: JointLimits | None = None
    period: float | None = None

    _chosen: dict[int, tuple[ControlLaw, ExploratoryMoves, bool]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        for name in ("max_joint_rate", "period"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                unit = "rad/s" if name == "max_joint_rate" else "s"
                raise ValueError(f"{name} must be finite and > 0 {unit}, got {value}")
        law, excitation = self._usual(self.period or _PACE.period)
        if self.law is None:
            object.__setattr__(self, "law", law)
        if self.excitation is None:
            object.__setattr__(self, "excitation", excitation)
        if self.supervisor == "auto":
            object.__setattr__(self, "supervisor", ProgressSupervisor() if self._certain else Supervisor())

    def initial(self, measurement: ServoMeasurement) -> ControllerState:
        """State before the first `step`, to which the same measurement must be passed.

        Raises:
            ValueError: As the estimator does for a bad measurement, or joint angles far outside the limits.
        """
        law, excitation, bounded = self._parts(0)
        supervisor = self._watch()
        estimator_state = self.estimator.initial(measurement)
        if self.limits is not None:
            self.limits.check(np.asarray(measurement.joint_angles, np.float64))
        return ControllerState(
            estimator=estimator_state,
            law=law.initial(measurement),
            excitation=excitation.initial(measurement),
            supervisor=None if supervisor is None else supervisor.initial(measurement),
            commanded=np.zeros(np.shape(measurement.joint_angles)),
            goal=begin_goal(*_goal(measurement)) if bounded else None,
            time=np.array(measurement.time, np.float64),
            period=np.full(np.shape(measurement.time), self.period or _PACE.period),
        )

    def step(self, state: ControllerState, measurement: ServoMeasurement) -> tuple[ControllerState, Array]:
        """Update with one measurement and return the joint rates until the next one.

        Returns:
            The new state, and joint rates within all limits. Shape (*batch, n), rad/s.

        Raises:
            ValueError: As the estimator does for a bad measurement.
        """
        estimator_state, estimate = self.estimator.step(state.estimator, measurement)
        time = np.array(measurement.time, np.float64)
        period, slowness = state.period, 0
        if self.period is None:
            means, slowest = _mean_periods(period.reshape(-1), state.time.reshape(-1), time.reshape(-1), _PACE.period)
            period, slowness = means.reshape(time.shape), _slowness(slowest)
        law, excitation, bounded = self._parts(slowness)
        supervisor = self._watch()
        goal = state.goal
        if goal is not None:
            goal, velocity = goal_velocity(goal, *_goal(measurement))
            estimate = _relative(estimate, velocity)
        if self.limits is not None and bounded:
            room = self.limits.room(np.asarray(measurement.joint_angles, np.float64))
            law_state, rate = cast(BoundedLaw, law).rate(state.law, estimate, *room)
        else:
            law_state, rate = law.rate(state.law, estimate)
        watch, active = state.supervisor, excitation.active(state.excitation)
        blocked, restart = np.zeros(rate.shape), np.zeros(rate.shape[:-1], np.bool_)

        if supervisor is not None:
            watch, verdict = supervisor.step(watch, measurement, estimate, state.commanded, active)
            if verdict.lost.any():
                back = (watch.last_seen_joints - np.asarray(measurement.joint_angles)) / law.period
                rate = np.where(verdict.lost[..., None], back, rate)
            restart, blocked = verdict.excite & ~active, verdict.blocked
            if restart.any():
                if hasattr(self.estimator, "forget"):
                    estimator_state = select_rows(restart, self.estimator.forget(estimator_state), estimator_state)
                law_state = select_rows(restart, law.initial(measurement), law_state)
                watch = select_rows(restart, supervisor.renewed(cast(Any, watch), measurement), watch)

        wish = Excite(restart, blocked, self.max_joint_rate)
        excitation_state, exciting = excitation.step(state.excitation, measurement, estimate, wish)
        if exciting.active.any():
            rate = np.where(exciting.active[..., None], exciting.joint_rate, rate)
        # True also for NaN.
        if not (np.abs(rate) <= self.max_joint_rate).all():
            rate = np.where(np.isfinite(rate), rate, 0.0)
            rate = limiting_factor(rate, self.max_joint_rate) * rate
        if self.limits is not None:
            rate = self._limited(rate, state, measurement, estimate, law)
        commanded = rate * law.period
        return ControllerState(estimator_state, law_state, excitation_state, watch, commanded, goal, time, period), rate

    def _limited(
        self,
        rate: Array,
        state: ControllerState,
        measurement: ServoMeasurement,
        estimate: ServoEstimate,
        law: ControlLaw,
    ) -> Array:
        """Joint rates within the limits, as near to the wanted ones as the law sees it."""
        angles = np.asarray(measurement.joint_angles, np.float64)
        low, high = cast(JointLimits, self.limits).bounds(
            angles, state.commanded / law.period, self.max_joint_rate, law.period
        )
        beyond = np.asarray(((rate < low) | (rate > high)).any(axis=-1))
        if beyond.any() and isinstance(law, BoundedLaw):
            rate = law.within(rate, estimate, low, high, beyond)
        return np.clip(rate, low, high)

    @property
    def _certain(self) -> bool:
        return bool(getattr(self.estimator, "row_covariances", False))

    def _parts(self, slowness: int) -> tuple[ControlLaw, ExploratoryMoves, bool]:
        """Law, exploratory moves, and True if the law is a `BoundedLaw`, for a slowness, see `_slowness`.

        Chosen parts change with it, given ones do not.
        """
        if slowness not in self._chosen:
            law, excitation = cast(ControlLaw, self.law), cast(ExploratoryMoves, self.excitation)
            usual, slower = self._usual(self.period or _PACE.period), self._usual(_PACE.period * _PACE.ratio**slowness)
            if slowness > 0:
                law = slower[0] if law == usual[0] else law
                excitation = slower[1] if excitation == usual[1] else excitation
            # A protocol takes longer to check than a law to compute.
            self._chosen[slowness] = (law, excitation, isinstance(law, BoundedLaw))
        return self._chosen[slowness]

    def _usual(self, period: float) -> tuple[ControlLaw, ExploratoryMoves]:
        """Law and exploratory moves that are chosen where none are given."""
        if self._certain:
            return JointSpace(image=Cautious(period=period)), Exploration(period=period)
        return ProportionalIntegral(period=period), Excitation(period=period)

    def _watch(self) -> ProgressSupervisor | Supervisor | None:
        """Supervisor, which `__post_init__` has chosen where it was not given."""
        return cast("ProgressSupervisor | Supervisor | None", self.supervisor)


@njit(cache=True, nogil=True)
def _mean_periods(periods, before, now, shortest):  # type: ignore[no-untyped-def]
    """Return running means of the time between two steps, in which a pause counts little, and the largest of them."""
    means, largest = periods.copy(), shortest
    for row in range(len(now)):
        passed = min(now[row] - before[row], 2.0 * periods[row])
        if passed > 0.0:
            means[row] += 0.2 * (passed - periods[row])
        largest = max(largest, means[row])
    return means, largest


def _slowness(period: float) -> int:
    """Number of steps by which a period is longer than the shortest one, see `Pace`."""
    steps = round(math.log(period / _PACE.period) / math.log(_PACE.ratio))
    return steps if steps >= _PACE.least else 0


def _goal(measurement: ServoMeasurement) -> tuple[Array, Array]:
    """Goal (*batch, m) and present time (*batch,)."""
    return np.asarray(measurement.goal, np.float64), np.asarray(measurement.time, np.float64)


def _relative(estimate: Any, velocity: Array) -> Any:
    """Estimate whose time column is that of the error: the velocity of the goal is subtracted."""
    if not velocity.any():
        return estimate
    jacobian = estimate.jacobian.copy()
    jacobian[..., -1] -= velocity
    given = {"goal_velocity": velocity} if hasattr(estimate, "goal_velocity") else {}
    return replace(estimate, jacobian=jacobian, **given)
