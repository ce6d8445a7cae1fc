"""Servos that follow one person: detections, identity and image Jacobian, each estimated or told by an oracle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np

from servotrack.baselines.agents.memory import remembered
from servotrack.baselines.agents.servo.jacobian_servo import servo_measurement
from servotrack.estimators.follow import (
    CameraMotion,
    FollowState,
    JacobianMotion,
    LiftedMotion,
    PeopleFromAbove,
    PersonFollower,
    Sighting,
    StillCamera,
    patch_color,
)
from servotrack.estimators.follow.ego_motion import EgoMotion
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState
from servotrack.estimators.jacobian.controller import ControllerState, ServoController
from servotrack.estimators.jacobian.kf import KalmanState
from servotrack.estimators.jacobian.lifted import LiftedState
from servotrack.estimators.types import Array, FloatArray, Mask

Identity = Literal["tracked", "nearest", "oracle"]
Detection = Literal["observed", "oracle"]

KEYS = ("joint_angles", "goal", "frame_time", "time", "target_patch", "target_box")
_ORACLE_REACH = 40.0  # how far from the right person a detection may lie that is taken for theirs, px
_NEAREST_REACH = 80.0  # the same from the last detection, for who follows the nearest one, px


class FollowServoState(NamedTuple):
    """State of a `FollowServo`, B runs.

    Attributes:
        frame_time: Stamp of the newest frame, -inf before the first. Shape (B,), s.
        frames: Pairs frames with the joint angles at their instants.
        person: Who is followed; of the set filter where identity is tracked.
        servo: State of the controller.
    """

    frame_time: Array
    frames: AlignmentState
    person: FollowState
    servo: ControllerState

    @property
    def belief(self) -> Array:
        """Where the person is believed to be in the newest frame, shape (B, 2), px."""
        return self.person.place


class FollowServo:
    """Keeps one person centered.

    Args:
        controller: Servo on the features of whom it follows.
        follower: Decides who that is.
        identity: "tracked" by the follower, "nearest" detection to the last one, or told by an "oracle".
        detection: "observed", or those of an "oracle" (nobody missed or merged, no clutter, no noise).
        told_camera: Whether the camera's own motion is told, instead of what the controller's estimator believes.
        detector: Finds people where images are observed.
    """

    def __init__(
        self,
        controller: ServoController,
        follower: PersonFollower | None = None,
        identity: Identity = "tracked",
        detection: Detection = "observed",
        told_camera: bool = False,
        detector: PeopleFromAbove | None = None,
    ) -> None:
        self.controller = controller
        self.follower = follower or PersonFollower()
        self.identity, self.detection, self.told_camera = identity, detection, told_camera
        self.detector = detector or PeopleFromAbove()
        self._alignment = Alignment()

    def initial(self, observation: Mapping[str, Any]) -> FollowServoState:
        """State before the first observation, which has a leading axis and is to be given to `predict` again.

        Raises:
            ValueError: A key is missing.
        """
        seen, _ = self._seen(observation)
        return self._initial(seen, self._detections(seen))

    def goal(self, observation: Mapping[str, Any]) -> Array:
        """Where the person is wanted, in the pixels of `FollowServoState.belief`. Shape (*batch, 2), px."""
        goal = np.asarray(observation["goal"], np.float64)
        if "image" in observation:
            goal = goal * (self.detector.reference_size / np.shape(observation["image"])[-2])
        return goal

    def predict(
        self,
        observation: Mapping[str, Any],
        state: FollowServoState | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, FollowServoState]:
        """Choose joint rates.

        Args:
            observation: As `PedestrianServo-v0` gives it, single or with a leading axis.
            state: What the last call returned; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: These agents always are.

        Returns:
            Shape (*batch, n), in [-1, 1]; and the new state.

        Raises:
            ValueError: A key is missing or a measurement is bad.
        """
        seen, single = self._seen(observation)
        detections = self._detections(seen)
        state = remembered(state, episode_start, (len(detections),), lambda: self._initial(seen, detections))
        stamp = seen["frame_time"][:, 0]
        fresh = stamp > state.frame_time
        frames, increment = self._alignment.step(state.frames, _measurement(seen, seen["goal"], fresh))
        joints = state.frames.frame_joints, frames.frame_joints
        # Until there have been two frames nothing has moved.
        first = ~state.frames.seen
        before = np.where(first[:, None], joints[1], joints[0])
        elapsed = np.where(increment.fresh, increment.time, self.follower.period)
        person, sighting = self._look(seen, state, detections, fresh, elapsed, before, joints[1])
        measurement = _measurement(seen, sighting.features, sighting.visible)
        servo, rate = self.controller.step(state.servo, measurement)
        action = (rate / self.controller.max_joint_rate).astype(np.float32)
        stamp = np.where(fresh, stamp, state.frame_time)
        return (action[0] if single else action), FollowServoState(stamp, frames, person, servo)

    def _seen(self, observation: Mapping[str, Any]) -> tuple[dict[str, Any], bool]:
        """The observation with a leading axis, in the camera's pixels, and whether it came without that axis."""
        missing = [key for key in KEYS if not isinstance(observation, Mapping) or key not in observation]
        if not missing and not {"detections", "image"}.intersection(observation):
            missing = ["detections (or image)"]
        if missing:
            raise ValueError(
                f"observation must have {', '.join(KEYS)} and detections or image; {', '.join(missing)} missing"
            )
        single = np.ndim(observation["joint_angles"]) == 1
        seen = {key: np.asarray(value)[None] if single else np.asarray(value) for key, value in observation.items()}
        seen["goal"] = self.goal(seen)
        if "image" in seen:
            seen["target_box"] = seen["target_box"] * (self.detector.reference_size / seen["image"].shape[-2])
        return seen, single

    def _detections(self, seen: Mapping[str, Array]) -> Array:
        if self.detection == "oracle":
            people = seen["true_people"]
            return np.where(people[..., :1] > 0.5, people, 0.0)
        if "detections" in seen:
            return seen["detections"]
        return self.detector.detect(seen["image"], np.maximum(seen["target_box"][:, 2:].mean(axis=1), 1.0))

    def _initial(self, seen: Mapping[str, Any], detections: Array) -> FollowServoState:
        box = seen["target_box"]
        place = box[:, :2] + 0.5 * box[:, 2:]
        person = self.follower.initial(detections, place, patch_color(seen["target_patch"]))
        nothing = np.zeros(len(place), np.bool_)
        measurement = _measurement(seen, place, nothing)
        return FollowServoState(
            np.full(len(place), -np.inf),
            self._alignment.initial(measurement),
            person,
            self.controller.initial(measurement),
        )

    def _look(
        self,
        seen: Mapping[str, Any],
        state: FollowServoState,
        detections: Array,
        fresh: Mask,
        elapsed: Array,
        before: Array,
        after: Array,
    ) -> tuple[FollowState, Sighting]:
        """Where the person is, by whatever decides about identity here."""
        person = state.person
        if self.identity == "tracked":
            ego = self._ego_motion(seen, state)
            return self.follower.step(person, detections, fresh, elapsed, ego, before, after)
        told = self.identity == "oracle"
        wanted = seen["true_people"][:, 0, 1:3] if told else person.place
        reach = _ORACLE_REACH if told else _NEAREST_REACH
        distance = np.hypot(*(detections[:, :, 1:3] - wanted[:, None]).transpose(2, 0, 1))
        distance = np.where(detections[:, :, 0] > 0.5, distance, np.inf)
        nearest = distance.argmin(axis=1)
        rows = np.arange(len(nearest))
        visible = fresh & (distance[rows, nearest] < reach)
        if told:
            visible &= seen["true_people"][:, 0, 0] > 0.5
        features = np.where(visible[:, None], detections[rows, nearest, 1:3], person.place)
        return person._replace(place=features), Sighting(features, visible)

    def _ego_motion(self, seen: Mapping[str, Any], state: FollowServoState) -> EgoMotion:
        if self.told_camera:
            return CameraMotion(seen["true_camera"], seen["true_links"])
        belief = state.servo.estimator
        if isinstance(belief, LiftedState):
            return LiftedMotion.of(belief, seen["goal"])
        return JacobianMotion(belief.jacobian) if isinstance(belief, KalmanState) else StillCamera()


def _measurement(seen: Mapping[str, Any], features: Array, visible: Mask) -> Any:
    """A servo's measurement of these features in the newest frame."""
    return servo_measurement({**seen, "features": features, "visible": visible[:, None]})
