"""Compiled random draws of an episode: the same numbers as NumPy's generators draw, from the same streams."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.envs.streams import draw_index, draw_uniform, start_stream
from servotrack.estimators.compilation import njit


class LayoutRanges(NamedTuple):
    """Ranges of layouts, see `Servo3DConfig`; `offset` is a length in m, `reach` that of the arm, m."""

    in_hand: bool
    posture: float
    motion: float
    motion_period: tuple[float, float]
    mounting: float
    mounting_tilt: float
    offset: float
    board_tilt: float
    reach: float
    depth: tuple[float, float]
    shift: float
    lean: float
    turn: tuple[float, float]
    zoom: tuple[float, float]


@njit(cache=True, nogil=True)
def start_streams(seed, streams):  # type: ignore[no-untyped-def]
    """Start streams of an episode for compiled draws. Returns their states, shape (streams, 6), see `draw_index`."""
    states = np.zeros((len(streams), 6), np.uint64)
    for k in range(len(streams)):
        start_stream(seed, streams[k], states[k])
    return states


@njit(cache=True, nogil=True)
def draw_constants(seed, streams, offset, focal, lag, homing, latency, age, joints):  # type: ignore[no-untyped-def]
    """Draw what does not depend on the layout.

    Args:
        seed: Seed of the episode.
        streams: Numbers of the streams of optics, actuator, homing, latency and age of the encoders.
        offset: Largest offset of the principal point, px.
        focal: Range of the focal length, px.
        lag: Range of the time constant of the joint rates, s.
        homing: Largest error of a joint angle, rad.
        latency: Range of the frames' age, control periods.
        age: Range of the joint angles' age, control periods.
        joints: Number of joints n.

    Returns:
        Column and row of the principal point from the middle of the image and focal length, shape (3,), px; time
        constant, s; errors of the joint angles, shape (n,), rad; both ages.
    """
    states = start_streams(seed, streams)
    lens, errors = np.empty(3), np.empty(joints)
    for k in range(2):
        lens[k] = draw_uniform(states[0], -offset, offset)
    lens[2] = draw_uniform(states[0], focal[0], focal[1])
    constant = draw_uniform(states[1], lag[0], lag[1])
    for j in range(joints):
        errors[j] = draw_uniform(states[2], -homing, homing)
    frames = latency[0] + draw_index(states[3], latency[1] + 1 - latency[0])
    return lens, constant, errors, frames, age[0] + draw_index(states[4], age[1] + 1 - age[0])


@njit(cache=True, nogil=True)
def draw_motions(states, ranges, ready, motions):  # type: ignore[no-untyped-def]
    """Draw a block of motions, see `Episode`.

    Args:
        states: Streams of posture and motion.
        ranges: A `LayoutRanges`.
        ready: Ready posture of the arm. Shape (n,), rad.
        motions: Output. Shape (B, n, 4).
    """
    block, n, _ = motions.shape
    motions[:] = 0.0
    for k in range(block):
        for j in range(n):
            motions[k, j, 0] = ready[j] + draw_uniform(states[0], -ranges.posture, ranges.posture)
    if not ranges.motion > 0.0:
        return
    for k in range(block):
        for j in range(n):
            motions[k, j, 1] = ranges.motion * draw_uniform(states[1], 0.5, 1.0)
    for k in range(block):
        for j in range(n):
            period = draw_uniform(states[1], ranges.motion_period[0], ranges.motion_period[1])
            motions[k, j, 2] = 2.0 * math.pi / period
    for k in range(block):
        for j in range(n):
            motions[k, j, 3] = draw_uniform(states[1], -math.pi, math.pi)


@njit(cache=True, nogil=True)
def draw_cameras(states, ranges, mounts, boards):  # type: ignore[no-untyped-def]
    """Draw a block of mounts and of boards in the camera's frame at the goal.

    With the camera in the world, the mounts are those of the board on the tool.

    Args:
        states: Streams of mounting and board.
        ranges: A `LayoutRanges`.
        mounts: Output. Shape (B, 3, 4).
        boards: Output. Shape (B, 3, 4).
    """
    block = len(mounts)
    _draw_rotations(states[0], ranges.mounting, ranges.mounting_tilt, mounts)
    if not ranges.in_hand:
        # The board faces the camera: it is seen from in front of the tool.
        mounts[:, :, 1:3] *= -1.0
    for k in range(block):
        for i in range(2):
            mounts[k, i, 3] = ranges.offset * draw_uniform(states[0], -1.0, 1.0)
        mounts[k, 2, 3] = 0.0
    _draw_rotations(states[1], ranges.mounting, ranges.board_tilt, boards)
    for k in range(block):
        boards[k, 2, 3] = ranges.reach * draw_uniform(states[1], ranges.depth[0], ranges.depth[1])
    for k in range(block):
        for i in range(2):
            boards[k, i, 3] = 0.1 * boards[k, 2, 3] * draw_uniform(states[1], -1.0, 1.0)


@njit(cache=True, nogil=True)
def _draw_rotations(state, spin, tilt, poses):  # type: ignore[no-untyped-def]
    """Draw rotations about the x, then the y, then the z axis, of which `tilt` and `spin` are the largest angles."""
    block = len(poses)
    spins = np.empty(block)
    for k in range(block):
        spins[k] = draw_uniform(state, -spin, spin)
    for k in range(block):
        x = draw_uniform(state, -tilt, tilt)
        y = draw_uniform(state, -tilt, tilt)
        cx, sx, cy, sy = math.cos(x), math.sin(x), math.cos(y), math.sin(y)
        cz, sz = math.cos(spins[k]), math.sin(spins[k])
        pose = poses[k]
        pose[0, 0], pose[0, 1], pose[0, 2] = cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx
        pose[1, 0], pose[1, 1], pose[1, 2] = sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx
        pose[2, 0], pose[2, 1], pose[2, 2] = -sy, cy * sx, cy * cx


@njit(cache=True, nogil=True)
def draw_offsets(state, ranges, offsets):  # type: ignore[no-untyped-def]
    """Draw differences of the board's pose in the camera's frame at start and goal, a block.

    Args:
        state: Stream of the start.
        ranges: A `LayoutRanges`.
        offsets: Output: offset of the middle along both image axes as a share of the distance, tilts about them (rad),
            turn about the optical axis (rad), and ratio of the distances. Shape (B, 6).
    """
    block = len(offsets)
    for k in range(block):
        for i in range(2):
            offsets[k, i] = draw_uniform(state, -ranges.shift, ranges.shift)
    for k in range(block):
        for i in range(2, 4):
            offsets[k, i] = draw_uniform(state, -ranges.lean, ranges.lean)
    for k in range(block):
        offsets[k, 4] = draw_uniform(state, ranges.turn[0], ranges.turn[1])
    for k in range(block):
        offsets[k, 4] *= _draw_sign(state)
    for k in range(block):
        offsets[k, 5] = draw_uniform(state, ranges.zoom[0], ranges.zoom[1])
    for k in range(block):
        offsets[k, 5] = math.pow(offsets[k, 5], _draw_sign(state))


@njit(cache=True, nogil=True)
def _draw_sign(state):  # type: ignore[no-untyped-def]
    """Draw -1 or 1: `Generator.choice((-1.0, 1.0))`."""
    return 1.0 if draw_index(state, 2) == 1 else -1.0
