"""Servo laws with everything known: camera, mounting, board and arm (Chaumette and Hutchinson 2006)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np

from servotrack.baselines.agents.memory import remembered
from servotrack.envs.servo3d.episode import PERIOD
from servotrack.estimators.types import Array, FloatArray, Mask

GAIN = 0.15
"""Share of the error that a step removes. Larger values oscillate with late frames and lagging motors."""
DAMPING = 0.01
"""Damping of the inverse, as a share of the largest singular value. Larger values slow weak directions."""
LAWS: Mapping[str, int] = {"current": 1, "desired": 1, "mean": 1, "pose": 4, "joints": 1}
"""Laws by name, with the number of points that each needs: interaction matrix of the present, of the goal, or the mean
of both; pose of the board; joint angles of the goal."""
OBSERVATION_KEYS = (
    "features",
    "goal",
    "visible",
    "true_jacobian",
    "goal_velocity",
    "true_interaction",
    "goal_interaction",
    "twist_jacobian",
    "true_joint_angles",
    "goal_joint_angles",
    "true_optics",
    "true_marks",
)


class ServoMemory(NamedTuple):
    """Memory of a calibrated servo.

    Attributes:
        goal_joints: Joint angles of the goal in the step before. Shape (*batch, n), rad.
    """

    goal_joints: Array


class CalibratedServo:
    """A servo that knows the system's parameters, but not its sensors' noise, delays and occlusions.

    The motion of the goal is known and is fed forward. Points that are not seen are left out; without any, the arm
    rests.

    Args:
        law: A key of `LAWS`.
        max_joint_rate: Limit of the joint rates, rad/s.
        low: Lower joint limits. Shape (n,), rad.
        high: Upper joint limits. Shape (n,), rad.
    """

    def __init__(self, law: str, max_joint_rate: float, low: Array, high: Array) -> None:
        self.law, self.max_joint_rate, self.low, self.high = law, float(max_joint_rate), low, high

    def predict(
        self,
        observation: Mapping[str, Any],
        state: ServoMemory | None = None,
        episode_start: Mask | None = None,
        deterministic: bool = True,
    ) -> tuple[FloatArray, ServoMemory]:
        """Choose joint rates.

        Args:
            observation: Observation with the truth, single or with a leading axis.
            state: Result of the last call; None starts anew.
            episode_start: Rows that start anew. Shape (N,), or a scalar for a single observation.
            deterministic: Ignored: the action is always deterministic.

        Returns:
            The action, shape (*batch, n), in [-1, 1], and the new state.
        """
        seen = {key: np.asarray(observation[key], np.float64) for key in OBSERVATION_KEYS}
        goal_joints = seen["goal_joint_angles"]
        state = remembered(state, episode_start, goal_joints.shape[:-1], lambda: ServoMemory(goal_joints))
        if self.law == "joints":
            drift = (goal_joints - state.goal_joints) / PERIOD
            rates = drift + GAIN / PERIOD * (goal_joints - seen["true_joint_angles"])
        elif self.law == "pose":
            rates = _pose_rates(seen)
        else:
            rates = _image_rates(seen, self.law)
        # The next sample stays within the joint limits.
        angles = seen["true_joint_angles"]
        # Links behind backlash and sag may be a little outside.
        least, most = np.minimum((self.low - angles) / PERIOD, 0.0), np.maximum((self.high - angles) / PERIOD, 0.0)
        action = np.clip(np.clip(rates, least, most) / self.max_joint_rate, -1.0, 1.0)
        return action.astype(np.float32), ServoMemory(goal_joints.copy())


def _image_rates(seen: Mapping[str, Array], law: str) -> Array:
    """Joint rates that bring the visible points to their goals. Shape (*batch, n), rad/s."""
    weights = np.repeat(seen["visible"] > 0.5, 2, axis=-1).astype(np.float64)
    kept = np.any(weights > 0.0, axis=-1, keepdims=True)
    interaction = {
        "current": seen["true_interaction"],
        "desired": seen["goal_interaction"],
        "mean": 0.5 * (seen["true_interaction"] + seen["goal_interaction"]),
    }[law]
    error = GAIN / PERIOD * (seen["goal"] - seen["features"]) + _goal_drift(seen)
    jacobian = weights[..., None] * (interaction @ seen["twist_jacobian"])
    return np.where(kept, _solve(jacobian, weights * error), 0.0)


def _goal_drift(seen: Mapping[str, Array]) -> Array:
    """Velocity of the goal in the image relative to the resting arm's points. Shape (*batch, 2p), px/s."""
    return seen["goal_velocity"] - seen["true_jacobian"][..., -1]


def _pose_rates(seen: Mapping[str, Array]) -> Array:
    """Joint rates that bring the board's pose to that at the goal; image-based below four visible points.

    Shape (*batch, n), rad/s.
    """
    visible = seen["visible"] > 0.5
    rates = np.atleast_2d(_image_rates(seen, "current"))
    jacobian = seen["true_jacobian"][..., :-1]
    drift = np.atleast_2d(_solve(jacobian, _goal_drift(seen)))
    rows = {key: np.atleast_2d(value) for key, value in seen.items() if value.ndim == visible.ndim}
    twists = seen["twist_jacobian"].reshape(-1, *seen["twist_jacobian"].shape[-2:])
    for row in np.flatnonzero(np.atleast_2d(visible).sum(axis=-1) >= LAWS["pose"]):
        chosen = rows["visible"][row] > 0.5
        marks = rows["true_marks"][row].reshape(-1, 3)
        now = _board_pose(marks[chosen], rows["features"][row].reshape(-1, 2)[chosen], rows["true_optics"][row])
        goal = _board_pose(marks, rows["goal"][row].reshape(-1, 2), rows["true_optics"][row])
        if now is None or goal is None:
            continue
        # The camera in its frame at the goal: rotation and position, relative to the board.
        rotation = goal[0] @ now[0].T
        place = goal[1] - rotation @ now[1]
        turn = cv2.Rodrigues(rotation)[0][:, 0]
        twist = -GAIN / PERIOD * np.concatenate([rotation.T @ place, turn])
        # Lengths in distances of the board, so that arms of few joints share the error between place and angle.
        scale = np.array([1.0 / now[1][2]] * 3 + [1.0] * 3)
        rates[row] = _solve(scale[:, None] * twists[row], scale * twist) + drift[row]
    return rates.reshape(seen["goal_joint_angles"].shape)


def _board_pose(marks: Array, image: Array, optics: Array) -> tuple[Array, Array] | None:
    """Rotation and position of the board in the camera's frame by PnP; None if there is no solution."""
    focal, column, line = optics[:3]
    camera = np.array([[focal, 0.0, column], [0.0, focal, line], [0.0, 0.0, 1.0]])
    found, turn, place = cv2.solvePnP(marks, image, camera, None, flags=cv2.SOLVEPNP_IPPE)
    if not found or not np.isfinite(turn).all() or place[2, 0] <= 0.0:
        return None
    return np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(place[:, 0], np.float64)


def _solve(jacobian: Array, error: Array) -> Array:
    """Damped least squares. Shapes (*batch, m, n), (*batch, m) and (*batch, n)."""
    u, sizes, vt = np.linalg.svd(jacobian, full_matrices=False)
    damping = np.maximum(DAMPING * sizes[..., :1], 1e-12)
    inverse = sizes / (sizes**2 + damping**2)
    return np.einsum("...kn,...k,...mk,...m->...n", vt, inverse, u, error)
