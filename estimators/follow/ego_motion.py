"""Where points at rest go in the image while the arm moves its camera.

Every class here is what an estimator of the image Jacobian knows of that, as a function of image points: called with
points in the image of one instant it says where they appear at a later one, if they rest on the plane.
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
        """Where points at rest appear later.

        Args:
            points: Shape (B, K, 2), px.
            joints_before: Joint angles when the points were seen, shape (B, n), rad.
            joints_after: Joint angles later, shape (B, n), rad.

        Returns:
            Shape (B, K, 2), px.
        """


@dataclass(frozen=True)
class StillCamera:
    """The camera does not move, or nobody knows how."""

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """The same points."""
        return points


@dataclass(frozen=True, eq=False)
class JacobianMotion:
    """To first order, by J_theta alone: exact at the point whose Jacobian it is, blind to the turn of the rest.

    Args:
        jacobian: Total image Jacobian. Shape (B, 2, n + 1), px/rad and px/s.
    """

    jacobian: Array

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """As `EgoMotion`."""
        shift = np.einsum("bij,bj->bi", self.jacobian[..., :-1], joints_after - joints_before)
        return points + shift[:, None]


@dataclass(frozen=True, eq=False)
class LiftedMotion:
    """By what a lifted Kalman filter believes of the arm: exact for all points of an image without tilt or distortion.

    A point y at rest has T p = y - goal + b + d, and T p, b turn with the joints (`servotrack.estimators.jacobian.
    lifted`); so y moves by a turn about a center of its own.

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
        """The motion that a state with one batch axis believes in."""
        mean = np.einsum("bm,bms->bs", state.model_weight, state.mean)
        return cls(mean[:, 3], mean[:, 4], goal)

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """As `EgoMotion`."""
        offset = points - self.goal[:, None]
        turn = np.exp(1j * (joints_after - joints_before).sum(axis=1))
        before = np.exp(1j * joints_before[:, 1]) * self.elbow + self.forearm
        after = np.exp(1j * joints_after[:, 1]) * self.elbow + self.forearm
        moved = turn[:, None] * (offset[..., 0] + 1j * offset[..., 1] + before[:, None]) - after[:, None]
        return np.stack([moved.real, moved.imag], axis=-1) + self.goal[:, None]


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """By the camera and the arm themselves, for oracles: exact for all points.

    Args:
        camera: Packed cameras. Shape (B, CAMERA_SIZE).
        links: Shape (B, 2), m.
    """

    camera: Array
    links: Array

    def __call__(self, points: Array, joints_before: Array, joints_after: Array) -> Array:
        """As `EgoMotion`."""
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
        """Cosine and sine of the camera's heading, (B, 1) each, and the tool, (B, 2) m."""
        phi = joints.sum(axis=1)
        cosine, sine = np.cos(phi), np.sin(phi)
        c = cosine * self.camera[:, 5] - sine * self.camera[:, 6]
        s = sine * self.camera[:, 5] + cosine * self.camera[:, 6]
        first, second = self.links.T
        x = first * np.cos(joints[:, 0]) + second * cosine
        y = first * np.sin(joints[:, 0]) + second * sine
        return c[:, None], s[:, None], np.stack([x, y], axis=-1)
