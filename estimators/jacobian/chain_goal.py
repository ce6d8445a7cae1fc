"""Search of the posture in which a rigid chain shows its goal, along images between the present one and the goal's."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.jacobian.chain_kernel import chain_derivatives, chain_features
from servotrack.estimators.types import Array, Mask


class GoalSearch(NamedTuple):
    """Parameters of the search for a goal's posture.

    Attributes:
        waypoints: Number of intermediate images on the way to the goal.
        refinements: Number of iterations at the goal.
        damping: Damping of the steps to intermediate images, expected focal lengths per rad.
        pull: Weight of the motion itself, expected focal lengths per rad; it keeps motions small that do not change the
            image.
    """

    waypoints: int = 12
    refinements: int = 12
    damping: float = 1.0 / 30.0
    pull: float = 1.0 / 1200.0


def chain_goal_rows(
    estimate_rows: tuple[Array, Array, Mask, Array], wanted: Array, used: Mask, bounds: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Find joint motions from present postures to postures with given image points.

    Both turns of the image are tried, the shorter one and the other way round.

    Args:
        estimate_rows: Parameters (B, N), joint angles (B, n), orders (B,) and units of the focal length (B,) of chains.
        wanted: Image points to reach. Shape (B, m), px.
        used: Mask of the features that count. Shape (B, m).
        bounds: Least and largest motions. Shapes (B, n), rad.

    Returns:
        Joint motions, shape (B, n), and root mean squares of what they leave of the errors, shape (B,), px.
    """
    parameters, angles, reverse, focal_unit = estimate_rows
    motions, left = np.zeros_like(angles), np.zeros(len(angles))
    _goal_rows(parameters, angles, reverse, focal_unit, wanted, used, bounds, GoalSearch(), motions, left)
    return motions, left


@njit(cache=True, nogil=True)
def _goal_rows(  # type: ignore[no-untyped-def]
    parameters, angles, reverse, focal_unit, wanted, used, bounds, search, motions, left
):
    """Fill `motions` and `left`, see `chain_goal_rows`."""
    n, m = angles.shape[1], wanted.shape[1]
    motion, goal = np.zeros(n), np.empty(m)
    for row in range(angles.shape[0]):
        chain = (parameters[row], angles[row], reverse[row], focal_unit[row])
        start = np.empty(m)
        chain_features(chain[0], chain[1], chain[2], chain[3], start)
        path = _similarity(start, wanted[row], used[row])
        left[row] = np.inf
        for way in range(2):
            turn = path[4] if way == 0 else path[4] - math.copysign(2.0 * math.pi, path[4])
            motion[:] = 0.0
            error = 0.0
            for at in range(search.waypoints + search.refinements):
                share = min((at + 1.0) / search.waypoints, 1.0)
                _waypoint(start, wanted[row], path, turn, share, goal)
                pull = search.pull * chain[3]
                damping = search.damping * chain[3] if share < 1.0 else pull
                error = _approach(chain, goal, used[row], (bounds[0][row], bounds[1][row]), damping, pull, motion)
            if error < left[row]:
                left[row] = error
                motions[row] = motion


@njit(cache=True, nogil=True)
def _similarity(start, wanted, used):  # type: ignore[no-untyped-def]
    """Return both centers, the logarithm of the scale and the turn of the similarity between two images of points."""
    ax, ay, bx, by, count = 0.0, 0.0, 0.0, 0.0, 0
    for j in range(0, start.shape[0], 2):
        if used[j] and used[j + 1]:
            ax, ay = ax + start[j], ay + start[j + 1]
            bx, by = bx + wanted[j], by + wanted[j + 1]
            count += 1
    if count == 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ax, ay, bx, by = ax / count, ay / count, bx / count, by / count
    along, across, size = 0.0, 0.0, 0.0
    for j in range(0, start.shape[0], 2):
        if used[j] and used[j + 1]:
            x, y, u, v = start[j] - ax, start[j + 1] - ay, wanted[j] - bx, wanted[j + 1] - by
            along += x * u + y * v
            across += x * v - y * u
            size += x * x + y * y
    if size == 0.0 or (along == 0.0 and across == 0.0):
        return ax, ay, bx, by, 0.0, 0.0
    return ax, ay, bx, by, math.atan2(across, along), math.log(math.hypot(along, across) / size)


@njit(cache=True, nogil=True)
def _waypoint(start, wanted, path, turn, share, out):  # type: ignore[no-untyped-def]
    """Write the image at a share of the way: turn and scale about the center, and the other changes in proportion."""
    ax, ay, bx, by, _, log_scale = path
    c, s = math.cos(turn), math.sin(turn)
    scale = math.exp(log_scale)
    part_c, part_s, part_scale = math.cos(share * turn), math.sin(share * turn), math.exp(share * log_scale)
    for j in range(0, start.shape[0], 2):
        x, y, u, v = start[j] - ax, start[j + 1] - ay, wanted[j] - bx, wanted[j + 1] - by
        # The goal, turned back and scaled back.
        u, v = (c * u + s * v) / scale, (c * v - s * u) / scale
        x, y = x + share * (u - x), y + share * (v - y)
        out[j] = ax + share * (bx - ax) + part_scale * (part_c * x - part_s * y)
        out[j + 1] = ay + share * (by - ay) + part_scale * (part_s * x + part_c * y)


@njit(cache=True, nogil=True)
def _approach(chain, goal, used, bounds, damping, pull, motion):  # type: ignore[no-untyped-def]
    """Change a motion by one damped Gauss-Newton step towards an image within bounds; return the error before it."""
    parameters, angles, reverse, focal_unit = chain
    n, m = angles.shape[0], goal.shape[0]
    features, jacobian = np.empty(m), np.empty((m, n))
    chain_derivatives(
        parameters, angles + motion, reverse, focal_unit, features, jacobian, np.zeros((0, len(parameters)))
    )
    gram, slope, step = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    squares, count = 0.0, 0
    for i in range(m):
        if not used[i]:
            continue
        error = goal[i] - features[i]
        squares += error * error
        count += 1
        for a in range(n):
            slope[a] += jacobian[i, a] * error
            for b in range(n):
                gram[a, b] += jacobian[i, a] * jacobian[i, b]
    for a in range(n):
        slope[a] -= pull * pull * motion[a]
        gram[a, a] += damping * damping + pull * pull
    blocked = np.zeros(n, np.bool_)
    for _ in range(n):
        # Joints that are at a bound and would go beyond it stay; the others are solved again.
        _solve_free(gram, slope, blocked, step)
        again = False
        for a in range(n):
            low, high = bounds[0][a], bounds[1][a]
            outward = (motion[a] <= low and step[a] < 0.0) or (motion[a] >= high and step[a] > 0.0)
            if outward and not blocked[a]:
                blocked[a] = True
                again = True
        if not again:
            break
    for a in range(n):
        motion[a] = min(max(motion[a] + step[a], bounds[0][a]), bounds[1][a])
    return math.sqrt(squares / max(count, 1))


@njit(cache=True, nogil=True)
def _solve_free(gram, slope, blocked, step):  # type: ignore[no-untyped-def]
    """Solve gram step = slope with zeros for blocked joints, by elimination without pivots: gram is definite."""
    n = slope.shape[0]
    matrix = gram.copy()
    for a in range(n):
        step[a] = 0.0 if blocked[a] else slope[a]
        for b in range(n):
            if blocked[a] or blocked[b]:
                matrix[a, b] = 1.0 if a == b else 0.0
    for k in range(n):
        for a in range(k + 1, n):
            share = matrix[a, k] / matrix[k, k]
            step[a] -= share * step[k]
            for b in range(k, n):
                matrix[a, b] -= share * matrix[k, b]
    for back in range(n):
        k = n - 1 - back
        for b in range(k + 1, n):
            step[k] -= matrix[k, b] * step[b]
        step[k] /= matrix[k, k]
