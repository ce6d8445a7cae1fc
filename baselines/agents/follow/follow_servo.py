"""Servos that follow one person: detections, identity and image Jacobian, each estimated or from an oracle."""

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
ORACLE_GATE = 40.0
"""Largest distance of a detection from the true position that is taken for the person, px."""
NEAREST_GATE = 80.0
"""Largest distance of a detection from the last one, with `identity` "nearest", px."""


class FollowServoState(NamedTuple):
    """State of a `FollowServo`, B runs.

    Attributes:
        frame_time: Time stamp of the newest frame, -inf before the first. Shape (B,), s.
        frames: State of the alignment of frames with joint angles.
        person: State of the followed person, and of the set filter with tracked identity.
        servo: State of the controller.
    """

    frame_time: Array
    frames: AlignmentState
    person: FollowState
    servo: ControllerState

    @property
    def belief(self) -> Array:
        """Estimated position of the person in the newest frame, shape (B, 2), px."""
        return self.person.place


class FollowServo:
    """Keeps one person centered in the image.

    Args:
        controller: Servo on the person's features.
        follower: Identifies the person among the detections.
        identity: "tracked" by the follower, "nearest" detection to the last one, or from an "oracle".
        detection: "observed", or from an "oracle" (no missed or merged people, no clutter, no noise).
        true_camera: True uses the camera's true motion, False that of the controller's estimator.
        detector: Detects people if images are observed.
    """

    def __init__(
        self,
        controller: ServoController,
        follower: PersonFollower | None = None,
        identity: Identity = "tracked",
        detection: Detection = "observed",
        true_camera: bool = False,
        detector: PeopleFromAbove | None = None,
    ) -> None:
        self.controller = controller
        self.follower = follower or PersonFollower()
        self.identity, self.detection, self.true_camera = identity, detection, true_camera
        self.detector = detector or PeopleFromAbove()
        self._alignment = Alignment()

    def initial(self, observation: Mapping[str, Any]) -> FollowServoState:
        """Return the state before the first observation, which has a leading axis and is passed to `predict` again.

        Raises:
            ValueError: A missing key.
        """
        seen, _ = self._seen(observation)
        return self._initial(seen, self._detections(seen))

    def goal(self, observation: Mapping[str, Any]) -> Array:
        """Return the goal in the pixels of `FollowServoState.belief`. Shape (*batch, 2), px."""
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
            observation: Observation of `PedestrianServo-v0`, single or with a leading axis.
            state: Result of the last call; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the action is always deterministic.

        Returns:
            The action, shape (*batch, n), in [-1, 1], and the new state.

        Raises:
            ValueError: A missing key or an invalid measurement.
        """
        seen, single = self._seen(observation)
        detections = self._detections(seen)
        state = remembered(state, episode_start, (len(detections),), lambda: self._initial(seen, detections))
        stamp = seen["frame_time"][:, 0]
        fresh = stamp > state.frame_time
        frames, increment = self._alignment.step(state.frames, person_measurement(seen, seen["goal"], fresh))
        joints = state.frames.frame_joints, frames.frame_joints
        # Before the second frame there is no motion.
        first = ~state.frames.seen
        before = np.where(first[:, None], joints[1], joints[0])
        elapsed = np.where(increment.fresh, increment.time, self.follower.period)
        person, sighting = self._look(seen, state, detections, fresh, elapsed, before, joints[1])
        measurement = person_measurement(seen, sighting.features, sighting.visible)
        servo, rate = self.controller.step(state.servo, measurement)
        action = (rate / self.controller.max_joint_rate).astype(np.float32)
        stamp = np.where(fresh, stamp, state.frame_time)
        return (action[0] if single else action), FollowServoState(stamp, frames, person, servo)

    def _seen(self, observation: Mapping[str, Any]) -> tuple[dict[str, Any], bool]:
        """Return the observation with a leading axis in the camera's pixels, and True if it came without that axis."""
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
        measurement = person_measurement(seen, place, nothing)
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
        """Return the person's new state and position, by the agent's `identity`."""
        person = state.person
        if self.identity == "tracked":
            ego = self._ego_motion(seen, state)
            return self.follower.step(person, detections, fresh, elapsed, ego, before, after)
        oracle = self.identity == "oracle"
        wanted = seen["true_people"][:, 0, 1:3] if oracle else person.place
        reach = ORACLE_GATE if oracle else NEAREST_GATE
        distance = np.hypot(*(detections[:, :, 1:3] - wanted[:, None]).transpose(2, 0, 1))
        distance = np.where(detections[:, :, 0] > 0.5, distance, np.inf)
        nearest = distance.argmin(axis=1)
        rows = np.arange(len(nearest))
        visible = fresh & (distance[rows, nearest] < reach)
        if oracle:
            visible &= seen["true_people"][:, 0, 0] > 0.5
        features = np.where(visible[:, None], detections[rows, nearest, 1:3], person.place)
        return person._replace(place=features), Sighting(features, visible)

    def _ego_motion(self, seen: Mapping[str, Any], state: FollowServoState) -> EgoMotion:
        if self.true_camera:
            return CameraMotion(seen["true_camera"], seen["true_links"])
        belief = state.servo.estimator
        if isinstance(belief, LiftedState):
            return LiftedMotion.of(belief, seen["goal"])
        return JacobianMotion(belief.jacobian) if isinstance(belief, KalmanState) else StillCamera()


def person_measurement(seen: Mapping[str, Any], features: Array, visible: Mask) -> Any:
    """Return a servo's measurement with these features in the newest frame."""
    return servo_measurement({**seen, "features": features, "visible": visible[:, None]})
