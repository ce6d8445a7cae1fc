"""Servo that follows one person by several hypotheses, with one bank of latencies for servo and ego-motion."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from servotrack.baselines.agents.follow.follow_servo import FollowServo, person_measurement
from servotrack.baselines.agents.memory import remembered
from servotrack.estimators.follow import LiftedMotion, PeopleFromAbove, patch_color
from servotrack.estimators.follow.crowd_follower import CrowdFollower, CrowdState
from servotrack.estimators.jacobian.alignment import AlignmentState
from servotrack.estimators.jacobian.bank import BankState, HypothesisBank
from servotrack.estimators.jacobian.controller import ControllerState, ServoController
from servotrack.estimators.jacobian.laws import ControlLaw
from servotrack.estimators.jacobian.lifted import LiftedEstimate, LiftedKalman
from servotrack.estimators.types import Array, FloatArray, Mask


class CrowdServoState(NamedTuple):
    """State of a `CrowdServo`, B runs.

    Attributes:
        frame_time: Time stamp of the newest frame, -inf before the first. Shape (B,), s.
        frames: State of the alignment of frames with joint angles under every latency. Batch axes (B, K).
        person: State of the followed person and of the crowd.
        servo: State of the controller.
    """

    frame_time: Array
    frames: AlignmentState
    person: CrowdState
    servo: ControllerState

    @property
    def belief(self) -> Array:
        """Estimated position of the person in the newest frame, shape (B, 2), px."""
        return self.person.place


class CrowdServo(FollowServo):
    """Keeps one person centered in the image, by several hypotheses of where the person is.

    Args:
        controller: Servo on the person's features; its estimator is a `HypothesisBank` of `LiftedKalman`.
        crowd: Identifies the person among the detections.
        detector: Detects people if images are observed.
        optics_error: Relative error of the image's predicted motion by distortion, tilt and pixels that are not square.
            Raising it lets the crowd correct the motion more.

    Raises:
        ValueError: The controller's estimator is not a bank.
    """

    def __init__(
        self,
        controller: ServoController,
        crowd: CrowdFollower | None = None,
        detector: PeopleFromAbove | None = None,
        optics_error: float = 0.04,
    ) -> None:
        super().__init__(controller, detector=detector)
        if not isinstance(controller.estimator, HypothesisBank):
            raise ValueError(
                "controller.estimator must be a HypothesisBank of LiftedKalman, got "
                f"{type(controller.estimator).__name__}; one latency is Latencies(ages=(0.0,))"
            )
        self.bank: HypothesisBank[LiftedKalman] = controller.estimator
        self.crowd, self.optics_error = crowd or CrowdFollower(), optics_error

    def predict(  # type: ignore[override]
        self,
        observation: Mapping[str, Any],
        state: CrowdServoState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, CrowdServoState]:
        """Choose joint rates; arguments and errors as in `FollowServo.predict`."""
        seen, single = self._seen(observation)
        detections = self._detections(seen)
        state = remembered(state, episode_start, (len(detections),), lambda: self._initial(seen, detections))
        stamp = seen["frame_time"][:, 0]
        fresh = stamp > state.frame_time
        best, rows = state.servo.estimator.log_weight.argmax(axis=-1), np.arange(len(stamp))
        spread = self.bank.hypotheses.measurement(person_measurement(seen, seen["goal"], fresh))
        frames, increment = self._alignment.step(state.frames, spread)
        after = frames.frame_joints[rows, best]
        first = ~state.frames.seen[rows, best]
        before = np.where(first[:, None], after, state.frames.frame_joints[rows, best])
        elapsed = np.where(increment.fresh[rows, best], increment.time[rows, best], self.follower.period)
        arm = _Arm.of(state.servo.estimator, best, seen["goal"])
        variance = arm.variance(before, after) + self._variance(seen, state, frames, after, before, arm)
        person, sighting = self.crowd.step(
            state.person, detections, fresh, elapsed, arm.motion, before, after, variance
        )
        servo, rate = self.controller.step(state.servo, person_measurement(seen, sighting.features, sighting.visible))
        aimed = ~sighting.visible & (servo.supervisor.unseen > 1)
        if aimed.any():
            rate = np.where(aimed[:, None], self._toward(seen, person, servo, frames, increment), rate)
            rate = np.clip(rate, -self.controller.max_joint_rate, self.controller.max_joint_rate)
            servo = servo._replace(commanded=rate * self.follower.period)
        action = (rate / self.controller.max_joint_rate).astype(np.float32)
        stamp = np.where(fresh, stamp, state.frame_time)
        return (action[0] if single else action), CrowdServoState(stamp, frames, person, servo)

    def _initial(self, seen: Mapping[str, Any], detections: Array) -> CrowdServoState:  # type: ignore[override]
        box = seen["target_box"]
        place, width = box[:, :2] + 0.5 * box[:, 2:], np.sqrt(np.maximum(box[:, 2] * box[:, 3], 1.0))
        person = self.crowd.initial(detections, place, width, patch_color(seen["target_patch"]))
        measurement = person_measurement(seen, place, np.zeros(len(place), np.bool_))
        return CrowdServoState(
            np.full(len(place), -np.inf),
            self._alignment.initial(self.bank.hypotheses.measurement(measurement)),
            person,
            self.controller.initial(measurement),
        )

    def _variance(
        self,
        seen: Mapping[str, Any],
        state: CrowdServoState,
        frames: AlignmentState,
        after: Array,
        before: Array,
        arm: _Arm,
    ) -> Array:
        """Variance of the image's motion along each axis by unknown latency and optics, shape (B,), px^2."""
        bank = state.servo.estimator
        weight = np.exp(bank.log_weight)
        weight /= weight.sum(axis=-1, keepdims=True)
        middle = seen["goal"][:, None]
        best = arm.motion(middle, before, after)[:, 0] - seen["goal"]
        variance = (self.optics_error * np.hypot(*best.T)) ** 2
        for k in range(weight.shape[1]):
            index = np.full(len(weight), k)
            moved = _Arm.of(bank, index, seen["goal"]).motion(
                middle, state.frames.frame_joints[:, k], frames.frame_joints[:, k]
            )
            off = moved[:, 0] - seen["goal"] - best
            variance += 0.5 * weight[:, k] * (off**2).sum(axis=1)
        return variance

    def _toward(
        self,
        seen: Mapping[str, Any],
        person: CrowdState,
        servo: ControllerState,
        frames: AlignmentState,
        increment: Any,
    ) -> Array:
        """Joint rates toward the believed position of a person without a detection."""
        bank = servo.estimator
        rows, best = np.arange(len(person.place)), bank.log_weight.argmax(axis=-1)
        arm = _Arm.of(bank, best, seen["goal"])
        then = frames.frame_joints[rows, best]
        now = then + increment.pending_joints[rows, best]
        age = increment.pending_time[rows, best][:, None]
        place = arm.motion(person.place[:, None], then, now)[:, 0]
        ahead = arm.motion((person.place + 0.05 * person.memory.motion)[:, None], then, now)[:, 0]
        velocity = (ahead - place) / 0.05
        error = place + age * velocity - seen["goal"]
        elbow, forearm = np.exp(1j * now[:, 1]) * arm.motion.elbow, arm.motion.forearm
        target = error[:, 0] + 1j * error[:, 1] + elbow + forearm
        reach = np.abs(arm.motion.elbow) + np.abs(arm.motion.forearm)
        target = target * np.minimum(1.0, 0.98 * reach / np.maximum(np.abs(target), 1e-9))
        nothing = np.zeros(len(rows))
        speed = velocity[:, 0] + 1j * velocity[:, 1]
        still = np.zeros(len(rows), np.complex128)
        estimate = LiftedEstimate(target.astype(np.complex128), speed, still, elbow, forearm + still, nothing, nothing)
        law = cast(ControlLaw, self.controller.law)
        return law.rate(law.initial(person_measurement(seen, place, nothing > 0.0)), estimate)[1]


class _Arm(NamedTuple):
    """Estimate of arm and camera by the most probable hypothesis of a bank.

    Attributes:
        motion: Motion of points at rest.
        covariance: Covariance of elbow and forearm. Shape (B, 2, 2), px^2.
    """

    motion: LiftedMotion
    covariance: Array

    @classmethod
    def of(cls, bank: BankState, best: Array, goal: Array) -> _Arm:
        """Return the estimate of hypothesis `best`, shape (B,), of each run."""
        members, rows = bank.members, np.arange(len(best))
        weight = members.model_weight[rows, best]
        mean = np.einsum("bm,bms->bs", weight, members.mean[rows, best])
        covariance = np.einsum("bm,bmst->bst", weight, members.covariance[rows, best])
        return cls(LiftedMotion(mean[:, 3], mean[:, 4], goal), covariance[:, 3:5, 3:5])

    def variance(self, before: Array, after: Array) -> Array:
        """Variance of the predicted motion of the image along each axis. Shape (B,), px^2."""
        turn = np.exp(1j * (after - before).sum(axis=1))
        slope = np.stack([turn * np.exp(1j * before[:, 1]) - np.exp(1j * after[:, 1]), turn - 1.0], axis=-1)
        return 0.5 * np.einsum("bi,bij,bj->b", slope, self.covariance, slope.conj()).real
