"""Ego-motion of the camera: motion of the images of points at rest while the arm moves its camera.

Each class here is the knowledge of one estimator of the image Jacobian as a function of image points: from points in
the image of one instant it predicts their positions in a later image, if they are at rest on the plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servotrack.estimators.camera import ground_points, project_points
from servotrack.estimators.jacobian.lifted import LiftedState
from servotrack.estimators.types import Array


class EgoMotion(Protocol):
    """The interface of every camera motion here."""

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """Predict the later image positions of points at rest.

        Args:
            points: Image points. Shape (B, K, 2), px.
            joints_before: Joint angles in the image of the points, shape (B, n), rad.
            joints_after: Joint angles in the later image, shape (B, n), rad.

        Returns:
            Image points in the later image. Shape (B, K, 2), px.
        """


@dataclass(frozen=True)
class StillCamera:
    """No motion of the camera, or unknown motion."""

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """Return the same points."""
        return points


@dataclass(frozen=True, eq=False)
class JacobianMotion:
    """First-order motion by J_theta: exact at the point of the Jacobian; the image's rotation about it is ignored.

    Args:
        jacobian: Total image Jacobian. Shape (B, 2, n + 1), px/rad and px/s.
    """

    jacobian: Array

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """Shift all points by J_theta times the joint motion; arguments as in `EgoMotion`."""
        shift = np.einsum("bij,bj->bi", self.jacobian[..., :-1], joints_after - joints_before)
        return points + shift[:, None]


@dataclass(frozen=True, eq=False)
class LiftedMotion:
    """Motion by the arm estimate of a lifted Kalman filter: exact for all points without tilt or distortion.

    A point y at rest has T p = y - goal + b + d, and T p, b rotate with the joints (`servotrack.estimators.jacobian.
    lifted`); so each point y rotates about its own center.

    Args:
        elbow: B of the filter, u + iv. Shape (B,), px.
        forearm: D of the filter. Shape (B,), px.
        goal: Goal features. Shape (B, 2), px.
    """

    elbow: Array
    forearm: Array
    goal: Array

    @classmethod
    def of(cls, state: LiftedState, goal: Array) -> LiftedMotion:
        """Create the motion from the estimate of a state with one batch axis."""
        mean = np.einsum("bm,bms->bs", state.model_weight, state.mean)
        return cls(mean[:, 3], mean[:, 4], goal)

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """Rotate the points by the joint motion; arguments as in `EgoMotion`."""
        offset = points - self.goal[:, None]
        turn = np.exp(1j * (joints_after - joints_before).sum(axis=1))
        before = np.exp(1j * joints_before[:, 1]) * self.elbow + self.forearm
        after = np.exp(1j * joints_after[:, 1]) * self.elbow + self.forearm
        moved = turn[:, None] * (offset[..., 0] + 1j * offset[..., 1] + before[:, None]) - after[:, None]
        return np.stack([moved.real, moved.imag], axis=-1) + self.goal[:, None]


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Motion by the true camera and arm, for oracles: exact for all points.

    Args:
        camera: Packed cameras. Shape (B, CAMERA_SIZE).
        links: Link lengths. Shape (B, 2), m.
    """

    camera: Array
    links: Array

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """Project the points to the ground and back; arguments as in `EgoMotion`."""
        shape = points.shape[:2]
        camera = np.broadcast_to(self.camera[:, None], (*shape, self.camera.shape[1]))
        links = np.broadcast_to(self.links[:, None], (*shape, 2))
        seen = ground_points(camera, points)
        c, s, tool = self._pose(joints_before)
        world = tool[:, None] + np.stack(
            [c * seen[..., 0] + s * seen[..., 1], s * seen[..., 0] - c * seen[..., 1]], axis=-1
        )
        moved, _ = project_points(camera, links, np.broadcast_to(joints_after[:, None], (*shape, 2)), world)
        return moved

    def _pose(self, joints: Array) -> tuple[Array, Array, Array]:
        """Cosine and sine of the camera's heading, (B, 1) each, and position of the tool, (B, 2) m."""
        phi = joints.sum(axis=1)
        cosine, sine = np.cos(phi), np.sin(phi)
        c = cosine * self.camera[:, 5] - sine * self.camera[:, 6]
        s = sine * self.camera[:, 5] + cosine * self.camera[:, 6]
        first, second = self.links.T
        x = first * np.cos(joints[:, 0]) + second * cosine
        y = first * np.sin(joints[:, 0]) + second * sine
        return c[:, None], s[:, None], np.stack([x, y], axis=-1)
