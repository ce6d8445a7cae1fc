"""Compiled sensors and score of the serial-arm world: image points, encoder readings, errors."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.servo3d.episode import LEAD, PERIOD
from servotrack.envs.servo3d.kinematics import (
    angle_between,
    compose,
    image_point,
    inverse,
    moved,
    optics_of,
    relative,
    rows_of,
    take,
    tool_pose,
)
from servotrack.envs.servo3d.state import ANGLE_BOUND, DISTANCE_BOUND, LARGEST_ERROR, LOST_SAMPLES, RING
from servotrack.estimators.compilation import njit

_LOG_LARGEST = math.log1p(LARGEST_ERROR)


@njit(cache=True, nogil=True)
def begin(rows, arm, settings, tables, state, sample):  # type: ignore[no-untyped-def]
    """Place the boards of new episodes, and fill the histories with the samples before the reset.

    Args:
        rows: Mask of the rows. Shape (N,).
        arm: An `ArmTables`.
        settings: A `WorldSettings`.
        tables: An `EpisodeTables`.
        state: An `ArmState`; changed.
        sample: A `Sample`; `goal` and `time` change.
    """
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        lens, board, mount = optics_of(tables.optics, i), rows_of(tables.board[i]), rows_of(tables.mount[i])
        for m in range(tables.marks.shape[1]):
            x, y, z = moved(board, tables.marks[i, m, 0], tables.marks[i, m, 1], tables.marks[i, m, 2])
            if settings.in_hand:
                # The goal's image does not depend on the goal's joint angles: the board is there in the camera's frame.
                sample.goal[i, 2 * m], sample.goal[i, 2 * m + 1], _ = image_point(lens, x, y, z)
                x, y, z = moved(mount, x, y, z)
            state.placed[i, m, 0], state.placed[i, m, 1], state.placed[i, m, 2] = x, y, z
        state.motor_history[:, i] = state.motors[i]
    in_view, steps = np.empty(rows.shape[0], np.bool_), np.zeros(rows.shape[0], np.int64)
    for past in range(RING):
        for i in range(rows.shape[0]):
            if rows[i]:
                steps[i] = past - RING + 1
                sample.time[i] = steps[i] * PERIOD
        _place_goals(rows, arm, settings, tables, state, sample)
        _look(rows, arm, settings, tables, steps, state, in_view)


@njit(cache=True, nogil=True)
def sense(rows, arm, settings, tables, steps, state, sample):  # type: ignore[no-untyped-def]
    """Compute the newest sample of every chosen row: truth, score and sensor readings.

    Args:
        rows: Mask of the rows. Shape (N,).
        arm: An `ArmTables`.
        settings: A `WorldSettings`.
        tables: An `EpisodeTables`.
        steps: Steps since the reset. Shape (N,).
        state: An `ArmState`; changed.
        sample: A `Sample`; changed.
    """
    in_view = np.empty(rows.shape[0], np.bool_)
    for i in range(rows.shape[0]):
        if rows[i]:
            sample.time[i] = steps[i] * PERIOD
    if settings.moving:
        _place_goals(rows, arm, settings, tables, state, sample)
    _look(rows, arm, settings, tables, steps, state, in_view)
    _score(rows, settings, tables, steps, in_view, state, sample)
    _read_encoders(rows, settings, tables, steps, state, sample)
    _deliver_frames(rows, settings, tables, steps, state, sample)


# The functions below unpack their tuples before the loop over rows: inside, each access would count references.


@njit(cache=True, nogil=True)
def _place_goals(rows, arm, settings, tables, state, sample):  # type: ignore[no-untyped-def]
    """Compute the goals at `sample.time`: joint angles, pose, the board's place (hand) or the goal's image (world)."""
    in_hand, axes, points, at_zero = settings.in_hand, arm.axes, arm.points, arm.tool
    motion, mounts, optics, times = tables.motion, tables.mount, tables.optics, sample.time
    joints, tools, placed, target, image = state.goal_joints, state.goal_tool, state.placed, state.target, sample.goal
    chain, tool, view, mount = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        for j in range(motion.shape[1]):
            swing = math.sin(motion[i, j, 2] * times[i] + motion[i, j, 3])
            joints[i, j] = motion[i, j, 0] + motion[i, j, 1] * swing
        tool_pose(axes, points, at_zero, joints, i, chain, tool)
        for a in range(3):
            for b in range(4):
                tools[i, a, b] = tool[a, b]
        if not in_hand:
            take(mounts, i, mount)
            relative(mount, tool, view)
        change, lens = rows_of(tool if in_hand else view), optics_of(optics, i)
        for m in range(placed.shape[1]):
            x, y, z = moved(change, placed[i, m, 0], placed[i, m, 1], placed[i, m, 2])
            if in_hand:
                target[i, m, 0], target[i, m, 1], target[i, m, 2] = x, y, z
            else:
                image[i, 2 * m], image[i, 2 * m + 1], _ = image_point(lens, x, y, z)


@njit(cache=True, nogil=True)
def _look(rows, arm, settings, tables, steps, state, in_view):  # type: ignore[no-untyped-def]
    """Compute tool poses and true image points at the present joint angles; set `in_view` where there are any."""
    in_hand, axes, points, at_zero = settings.in_hand, arm.axes, arm.points, arm.tool
    mounts, optics, joints, tools, depths = tables.mount, tables.optics, state.joints, state.tool, state.depth
    images, in_image = state.images, state.in_image
    # In the hand the board rests in the base, in the world on the tool.
    board = state.target if in_hand else state.placed
    chain, tool, eye = np.empty((3, 4)), np.empty((3, 4)), np.empty((3, 4))
    view, mount = np.empty((3, 4)), np.empty((3, 4))
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        tool_pose(axes, points, at_zero, joints, i, chain, tool)
        for a in range(3):
            for b in range(4):
                tools[i, a, b] = tool[a, b]
        take(mounts, i, mount)
        if in_hand:
            compose(tool, mount, eye)
            inverse(eye, view)
        else:
            relative(mount, tool, view)
        change, lens = rows_of(view), optics_of(optics, i)
        slot, some, depth = (steps[i] + LEAD) % RING, False, 0.0
        for m in range(board.shape[1]):
            x, y, z = moved(change, board[i, m, 0], board[i, m, 1], board[i, m, 2])
            u, v, seen = image_point(lens, x, y, z)
            images[slot, i, 2 * m], images[slot, i, 2 * m + 1] = u, v
            in_image[slot, i, m] = seen
            some = some or seen
            depth += z
        depths[i] = depth / board.shape[1]
        in_view[i] = some


@njit(cache=True, nogil=True)
def _score(rows, settings, tables, steps, in_view, state, sample):  # type: ignore[no-untyped-def]
    """Compute errors, rewards and ends."""
    images, goals, tools, goal_tools, depths = state.images, sample.goal, state.tool, state.goal_tool, state.depth
    tip_errors, tip_angles, errors, feature_errors = (
        sample.tip_error,
        sample.tip_angle,
        sample.error,
        sample.feature_error,
    )
    out_of_view, rewards, terminated, truncated = (
        sample.out_of_view,
        sample.reward,
        sample.terminated,
        sample.truncated,
    )
    optics, p, horizon = tables.optics, images.shape[2] // 2, settings.horizon
    tool, goal = np.empty((3, 4)), np.empty((3, 4))
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        slot, feature_error = (steps[i] + LEAD) % RING, 0.0
        for m in range(p):
            du, dv = images[slot, i, 2 * m] - goals[i, 2 * m], images[slot, i, 2 * m + 1] - goals[i, 2 * m + 1]
            feature_error += math.sqrt(du * du + dv * dv) / p
        feature_errors[i] = feature_error
        if p == 1:
            # One point leaves the pose open: its own distance from the goal's line of sight counts.
            tip_error, tip_angle = feature_error * abs(depths[i]) / optics[i, 0], 0.0
        else:
            take(tools, i, tool)
            take(goal_tools, i, goal)
            dx, dy, dz = tool[0, 3] - goal[0, 3], tool[1, 3] - goal[1, 3], tool[2, 3] - goal[2, 3]
            tip_error, tip_angle = math.sqrt(dx * dx + dy * dy + dz * dz), angle_between(tool, goal)
        distance, angle = tip_error / DISTANCE_BOUND, tip_angle / ANGLE_BOUND
        error = math.sqrt(distance * distance + angle * angle)
        tip_errors[i], tip_angles[i], errors[i] = tip_error, tip_angle, error
        out_of_view[i] = 0 if in_view[i] else out_of_view[i] + 1
        lost = out_of_view[i] >= LOST_SAMPLES
        terminated[i], truncated[i] = lost, steps[i] >= horizon
        running = steps[i] > 0 and not lost
        rewards[i] = max(1.0 - math.log1p(error) / _LOG_LARGEST, 0.0) if running else 0.0


@njit(cache=True, nogil=True)
def _read_encoders(rows, settings, tables, steps, state, sample):  # type: ignore[no-untyped-def]
    """Read the joint angles: aged, with their homing errors, in whole steps."""
    motors, history, readings, stamps = state.motors, state.motor_history, sample.joint_angles, sample.joint_time
    homing, ages, counts, stamped = tables.homing, tables.encoder_age, settings.encoder_steps, settings.stamped
    width = 2.0 * math.pi / counts if counts > 0 else 0.0
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        now, read = (steps[i] + LEAD) % RING, (steps[i] + LEAD - ages[i]) % RING
        for j in range(motors.shape[1]):
            history[now, i, j] = motors[i, j]
        for j in range(motors.shape[1]):
            angle = history[read, i, j] + homing[i, j]
            readings[i, j] = math.floor(angle / width + 0.5) * width if counts > 0 else angle
        stamps[i] = (steps[i] - ages[i] if stamped else steps[i]) * PERIOD


@njit(cache=True, nogil=True)
def _deliver_frames(rows, settings, tables, steps, state, sample):  # type: ignore[no-untyped-def]
    """Deliver the frames that arrive now; points that they do not show keep their last image."""
    images, in_image, optics, latency = state.images, state.in_image, tables.optics, tables.latency
    noise, dropped, hidden = tables.feature_noise, tables.dropped, tables.hidden
    noisy, losing, hiding = noise.shape[1] > 0, dropped.shape[1] > 0, hidden.shape[1] > 0
    features, visible, stamps, stamped = sample.features, sample.visible, sample.frame_time, settings.stamped
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        frame = steps[i] + LEAD - latency[i]
        slot = frame % RING
        arrives = not (losing and dropped[i, frame])
        for m in range(visible.shape[1]):
            shown = arrives and in_image[slot, i, m] and not (hiding and hidden[i, frame, m])
            visible[i, m] = 1.0 if shown else 0.0
            if not shown:
                continue
            u, v = images[slot, i, 2 * m], images[slot, i, 2 * m + 1]
            if noisy:
                u += noise[i, frame, 2 * m]
                v += noise[i, frame, 2 * m + 1]
            features[i, 2 * m] = min(max(u, 0.0), optics[i, 3])
            features[i, 2 * m + 1] = min(max(v, 0.0), optics[i, 4])
        if arrives:
            # The stamp is that of the newest frame, even if it shows no point.
            stamps[i] = (steps[i] - latency[i] if stamped else steps[i]) * PERIOD
