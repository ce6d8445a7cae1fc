"""Compiled test of drawn layouts: start and goal within the joint limits, and the board in view."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.envs.servo3d.kinematics import (
    approach_pose,
    compose,
    divide,
    image_point,
    moved,
    optics_of,
    relative,
    rows_of,
    tool_pose,
)
from servotrack.estimators.compilation import njit

EDGE = 0.06
"""Margin of the goal's points to the image's edge, as a share of the image."""
SHORTFALL = 0.1
"""Largest difference between drawn and reached start, which arms of few joints cannot reach exactly: of the turn about
the optical axis, rad, and of the distance, as a share of it. Shift and tilt are as near as the arm comes."""
_PERIODS = 24  # instants in the shortest period of a moving goal at which it is tested


class LayoutRules(NamedTuple):
    """Conditions of a layout.

    Attributes:
        in_hand: True if the camera is on the tool.
        least_in_view: Least number of points in the image at the start.
        most_in_view: Largest number of points in the image at the start.
        least_error: Smallest mean distance between the points at start and goal, px.
        least_height: Smallest height of the tool above the base's plane, m.
        duration: Length of an episode, s.
    """

    in_hand: bool
    least_in_view: int
    most_in_view: int
    least_error: float
    least_height: float
    duration: float


@njit(cache=True, nogil=True)
def accept_layouts(  # type: ignore[no-untyped-def]
    arm, rules, optics, marks, mounts, boards, offsets, motions, starts, accepted, wanted
):
    """Test a block of layouts until as many are accepted as are wanted.

    With the camera in the world, accepted rows of `mounts` and `boards` change: from the board on the tool and the
    board in the camera's frame to the camera in the base and the board on the tool.

    Args:
        arm: An `ArmTables`, limits with a margin.
        rules: A `LayoutRules`.
        optics: See `Episode`. Shape (1, 5).
        marks: See `Episode`. Shape (p, 3).
        mounts: Mounts. Shape (B, 3, 4).
        boards: Boards in the camera's frame at the goal. Shape (B, 3, 4).
        offsets: Differences of the board's pose between start and goal, see `_draw_offsets`. Shape (B, 6).
        motions: Motions of the goals. Shape (B, n, 4).
        starts: Output: joint angles of the starts. Shape (B, n), rad.
        accepted: Output. Shape (B,).
        wanted: Number of layouts to accept.
    """
    n, p = starts.shape[1], marks.shape[0]
    chain, tool, eye, board = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    goal, at_goal, image = np.empty((1, n)), np.empty((p, 2)), np.empty((p, 2))
    start_tool, found, along = np.empty((3, 4)), 0, 0.0
    for i in range(3):
        along += arm.axes[n - 1, i] * arm.tool[i, 2]
    sense = 1.0 if along >= 0.0 else -1.0
    for k in range(len(starts)):
        if found == wanted:
            return
        start, motion = starts[k], motions[k]
        inside = True
        for j in range(n):
            inside = inside and arm.low[j] <= motion[j, 0] - motion[j, 1] and motion[j, 0] + motion[j, 1] <= arm.high[j]
            goal[0, j] = motion[j, 0]
        if not inside:
            continue
        # The place of the board (hand) or of the camera (world) follows from the middle of the goal's motion.
        tool_pose(arm.axes, arm.points, arm.tool, goal, 0, chain, tool)
        if tool[2, 3] < rules.least_height:
            continue
        mount, seen = mounts[k].copy(), boards[k].copy()
        if not rules.in_hand:
            compose(tool, mount, board)
            divide(board, seen, eye)
            mount, seen = eye.copy(), mounts[k].copy()
        if not _goal_in_view(arm, rules, optics, marks, mount, seen, motion, 0.0):
            continue
        _goal_angles(motion, 0.0, goal)
        tool_pose(arm.axes, arm.points, arm.tool, goal, 0, chain, tool)
        _start_pose(rules.in_hand, mount, seen, offsets[k], tool, start_tool)
        for j in range(n):
            start[j] = goal[0, j]
        # Seen along the optical axis, the last joint turns the board best: against the tool's own turn, both with the
        # camera in the hand and with the board on a tool that faces the camera.
        start[n - 1] -= sense * offsets[k, 4]
        if not arm.low[n - 1] <= start[n - 1] <= arm.high[n - 1]:
            start[n - 1] += 2.0 * sense * offsets[k, 4]
            offsets[k, 4] = -offsets[k, 4]
            _start_pose(rules.in_hand, mount, seen, offsets[k], tool, start_tool)
        approach_pose(arm, start_tool, starts, k)
        for j in range(n):
            inside = inside and arm.low[j] <= start[j] <= arm.high[j]
        if not inside:
            continue
        tool_pose(arm.axes, arm.points, arm.tool, starts, k, chain, start_tool)
        if start_tool[2, 3] < rules.least_height:
            continue
        turn, ratio = _difference(rules.in_hand, mount, seen, start_tool, tool)
        if not (
            math.cos(turn - offsets[k, 4]) >= math.cos(SHORTFALL) and abs(ratio / offsets[k, 5] - 1.0) <= SHORTFALL
        ):
            continue
        _images(rules.in_hand, optics, marks, mount, seen, tool, tool, at_goal)
        count, depth = _images(rules.in_hand, optics, marks, mount, seen, start_tool, tool, image)
        if not rules.least_in_view <= count <= rules.most_in_view or depth <= 0.0:
            continue
        error = 0.0
        for i in range(p):
            error += math.hypot(image[i, 0] - at_goal[i, 0], image[i, 1] - at_goal[i, 1]) / p
        if error < rules.least_error:
            continue
        if not _goal_in_view(arm, rules, optics, marks, mount, seen, motion, rules.duration):
            continue
        mounts[k], boards[k] = mount, seen
        accepted[k] = True
        found += 1


@njit(cache=True, nogil=True)
def _start_pose(in_hand, mount, seen, offset, tool, out):  # type: ignore[no-untyped-def]
    """Set `out` to the tool's pose at the start, from its pose at the goal and the drawn offset."""
    eye, board, later, product = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    at_goal, tilt = np.empty((3, 4)), np.empty((3, 3))
    if in_hand:
        compose(tool, mount, eye)
        at_goal[:] = seen
        compose(eye, seen, board)
    else:
        eye[:] = mount
        compose(tool, seen, board)
        relative(eye, board, at_goal)
    c, s = math.cos(offset[4]), math.sin(offset[4])
    depth = at_goal[2, 3] * offset[5]
    _tilt(offset[2], offset[3], tilt)
    for j in range(3):
        a = tilt[0, 0] * at_goal[0, j] + tilt[0, 1] * at_goal[1, j] + tilt[0, 2] * at_goal[2, j]
        b = tilt[1, 0] * at_goal[0, j] + tilt[1, 1] * at_goal[1, j] + tilt[1, 2] * at_goal[2, j]
        later[0, j], later[1, j] = c * a - s * b, s * a + c * b
        later[2, j] = tilt[2, 0] * at_goal[0, j] + tilt[2, 1] * at_goal[1, j] + tilt[2, 2] * at_goal[2, j]
    later[0, 3] = at_goal[0, 3] * offset[5] + offset[0] * depth
    later[1, 3] = at_goal[1, 3] * offset[5] + offset[1] * depth
    later[2, 3] = depth
    if in_hand:
        # The board stays: eye = board later^-1, tool = eye mount^-1.
        divide(board, later, product)
        divide(product, mount, out)
    else:
        compose(eye, later, product)
        divide(product, seen, out)


@njit(cache=True, nogil=True)
def _tilt(x, y, out):  # type: ignore[no-untyped-def]
    """Set `out` to the rotation about x, then y. Shape (3, 3)."""
    cx, sx, cy, sy = math.cos(x), math.sin(x), math.cos(y), math.sin(y)
    out[0, 0], out[0, 1], out[0, 2] = cy, sy * sx, sy * cx
    out[1, 0], out[1, 1], out[1, 2] = 0.0, cx, -sx
    out[2, 0], out[2, 1], out[2, 2] = -sy, cy * sx, cy * cx


@njit(cache=True, nogil=True)
def _board_seen(in_hand, mount, seen, tool, goal, out):  # type: ignore[no-untyped-def]
    """Set `out` to the board's pose in the camera's frame, at poses of the tool and of the goal."""
    eye, board = np.empty((3, 4)), np.empty((3, 4))
    if in_hand:
        compose(goal, mount, eye)
        compose(eye, seen, board)
        compose(tool, mount, eye)
        relative(eye, board, out)
    else:
        compose(tool, seen, board)
        relative(mount, board, out)


@njit(cache=True, nogil=True)
def _difference(in_hand, mount, seen, start, goal):  # type: ignore[no-untyped-def]
    """Return the board's turn about the optical axis (rad) and the ratio of its distances between start and goal."""
    now, wanted, turned = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    _board_seen(in_hand, mount, seen, start, goal, now)
    _board_seen(in_hand, mount, seen, goal, goal, wanted)
    divide(now, wanted, turned)
    return math.atan2(turned[1, 0] - turned[0, 1], turned[0, 0] + turned[1, 1]), now[2, 3] / wanted[2, 3]


@njit(cache=True, nogil=True)
def _images(in_hand, optics, marks, mount, seen, tool, goal, image):  # type: ignore[no-untyped-def]
    """Write the image points at poses of tool and goal; return the number in the image and the least depth, m."""
    view = np.empty((3, 4))
    _board_seen(in_hand, mount, seen, tool, goal, view)
    rows, lens = rows_of(view), optics_of(optics, 0)
    count, depth = 0, np.inf
    for i in range(marks.shape[0]):
        x, y, z = moved(rows, marks[i, 0], marks[i, 1], marks[i, 2])
        image[i, 0], image[i, 1], visible = image_point(lens, x, y, z)
        depth = min(depth, z)
        if visible:
            count += 1
    return count, depth


@njit(cache=True, nogil=True)
def _goal_in_view(arm, rules, optics, marks, mount, seen, motion, duration):  # type: ignore[no-untyped-def]
    """Return True if all points keep a margin to the image's edge while the goal moves for a duration, s."""
    fastest = 0.0
    for j in range(len(motion)):
        if motion[j, 1] > 0.0:
            fastest = max(fastest, motion[j, 2])
    chain, tool, goal = np.empty((3, 4)), np.empty((3, 4)), np.empty((1, len(motion)))
    image = np.empty((marks.shape[0], 2))
    # With the camera in the hand, the goal's image does not depend on the goal's joint angles.
    instants = 1 if rules.in_hand else 1 + math.ceil(fastest / (2.0 * math.pi) * _PERIODS * duration)
    for instant in range(instants):
        _goal_angles(motion, duration * instant / max(instants - 1, 1), goal)
        tool_pose(arm.axes, arm.points, arm.tool, goal, 0, chain, tool)
        _, depth = _images(rules.in_hand, optics, marks, mount, seen, tool, tool, image)
        if depth <= 0.0:
            return False
        for i in range(marks.shape[0]):
            for axis in range(2):
                size = optics[0, 3 + axis]
                if not EDGE * size <= image[i, axis] <= (1.0 - EDGE) * size:
                    return False
    return True


@njit(cache=True, nogil=True)
def _goal_angles(motion, time, out):  # type: ignore[no-untyped-def]
    """Write the goal's joint angles at a time. Shapes (n, 4) and (1, n)."""
    for j in range(len(motion)):
        out[0, j] = motion[j, 0] + motion[j, 1] * math.sin(motion[j, 2] * time + motion[j, 3])
