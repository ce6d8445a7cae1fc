"""True matrices of the serial-arm world, for calibrated agents: image Jacobians and interaction matrices."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.servo3d.kinematics import (
    LEAST_DEPTH,
    ArmTables,
    axes_now,
    compose,
    inverse,
    moved,
    relative,
    rows_of,
    twist_columns,
)
from servotrack.envs.servo3d.state import ArmState, EpisodeTables, WorldSettings
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


def true_matrices(
    arm: ArmTables, settings: WorldSettings, tables: EpisodeTables, time: Array, state: ArmState
) -> dict[str, Array]:
    """Return the arrays of `Servo3DWorld.privileged`."""
    count, n = state.joints.shape
    p = tables.marks.shape[1]
    features = {
        "true_jacobian": np.zeros((count, 2 * p, n + 1)),
        "goal_velocity": np.zeros((count, 2 * p)),
        "true_interaction": np.zeros((count, 2 * p, 6)),
        "goal_interaction": np.zeros((count, 2 * p, 6)),
        "twist_jacobian": np.zeros((count, 6, n)),
    }
    _matrices(arm, settings, tables, time, state, tuple(features.values()))
    return {
        **features,
        "true_joint_angles": state.joints.copy(),
        "goal_joint_angles": state.goal_joints.copy(),
        "true_optics": tables.optics.copy(),
        "true_marks": tables.marks.reshape(count, -1).copy(),
    }


@njit(cache=True, nogil=True)
def _matrices(arm, settings, tables, time, state, out):  # type: ignore[no-untyped-def]
    jacobian, goal_velocity, interaction, at_goal, twists = out
    count, n = state.joints.shape
    p = tables.marks.shape[1]
    chain, tool, eye, view = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    lines, columns, drift = np.empty((n, 6)), np.empty((n, 6)), np.empty((1, 6))
    for i in range(count):
        if settings.in_hand:
            compose(state.tool[i], tables.mount[i], eye)
        else:
            eye[:] = tables.mount[i]
        axes_now(arm.axes, arm.points, arm.tool, state.joints, i, chain, lines, tool)
        twist_columns(lines, eye[0, 3], eye[1, 3], eye[2, 3], columns)
        # The camera relative to the board: itself in the hand, minus the tool's motion in the world.
        for j in range(n):
            _turned_into(eye, columns, j, 1.0 if settings.in_hand else -1.0, twists[i, :, j])
        if settings.in_hand:
            inverse(eye, view)
        else:
            relative(eye, state.tool[i], view)
        rows = rows_of(view)
        points = state.target if settings.in_hand else state.placed
        for m in range(p):
            x, y, z = moved(rows, points[i, m, 0], points[i, m, 1], points[i, m, 2])
            interaction_rows(tables.optics[i, 0], x, y, z, interaction[i, 2 * m : 2 * m + 2])
            for r in range(2):
                for j in range(n):
                    total = 0.0
                    for k in range(6):
                        total += interaction[i, 2 * m + r, k] * twists[i, k, j]
                    jacobian[i, 2 * m + r, j] = total

        # Motion of the goal: it carries the board in the hand, and moves the goal's image in the world.
        axes_now(arm.axes, arm.points, arm.tool, state.goal_joints, i, chain, lines, tool)
        twist_columns(lines, eye[0, 3], eye[1, 3], eye[2, 3], columns)
        for k in range(6):
            chain[k // 4, k % 4] = 0.0
            for j in range(n):
                _, swing, frequency, phase = tables.motion[i, j]
                chain[k // 4, k % 4] += columns[j, k] * swing * frequency * math.cos(frequency * time[i] + phase)
        for k in range(6):
            columns[0, k] = chain[k // 4, k % 4]
        _turned_into(eye, columns, 0, -1.0, drift[0])
        if settings.in_hand:
            compose(state.goal_tool[i], tables.mount[i], eye)
            relative(eye, state.goal_tool[i], view)
        else:
            relative(eye, state.goal_tool[i], view)
        rows = rows_of(view)
        for m in range(p):
            x, y, z = moved(rows, state.placed[i, m, 0], state.placed[i, m, 1], state.placed[i, m, 2])
            interaction_rows(tables.optics[i, 0], x, y, z, at_goal[i, 2 * m : 2 * m + 2])
            for r in range(2):
                total = 0.0
                for k in range(6):
                    total += (interaction if settings.in_hand else at_goal)[i, 2 * m + r, k] * drift[0, k]
                if settings.in_hand:
                    jacobian[i, 2 * m + r, n] = total
                else:
                    goal_velocity[i, 2 * m + r] = total


@njit(cache=True, nogil=True)
def _turned_into(eye, columns, row, sign, out):  # type: ignore[no-untyped-def]
    """Write a velocity and an angular velocity in the camera's axes. Shapes (3, 4), (n, 6), (6,)."""
    for k in range(3):
        out[k], out[3 + k] = 0.0, 0.0
        for a in range(3):
            out[k] += sign * eye[a, k] * columns[row, a]
            out[3 + k] += sign * eye[a, k] * columns[row, 3 + a]


@njit(cache=True, nogil=True)
def interaction_rows(focal, x, y, z, rows):  # type: ignore[no-untyped-def]
    """Write the interaction matrix of a point (Chaumette and Hutchinson 2006, eq. 11), px/m and px/rad.

    Args:
        focal: Focal length, px.
        x: Coordinate to the right of the point in the camera's frame, m.
        y: Coordinate downward, m.
        z: Coordinate along the optical axis, m. Points behind the camera count as very near.
        rows: Output, for the velocity (m/s) and the angular velocity (rad/s) of the camera. Shape (2, 6).
    """
    depth = max(z, LEAST_DEPTH)
    u, v = x / depth, y / depth
    rows[0, 0], rows[0, 1], rows[0, 2] = -focal / depth, 0.0, focal * u / depth
    rows[0, 3], rows[0, 4], rows[0, 5] = focal * u * v, -focal * (1.0 + u * u), focal * v
    rows[1, 0], rows[1, 1], rows[1, 2] = 0.0, -focal / depth, focal * v / depth
    rows[1, 3], rows[1, 4], rows[1, 5] = focal * (1.0 + v * v), -focal * u * v, -focal * u
