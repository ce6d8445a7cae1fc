"""Random draws of one episode of the serial-arm world. All are made before the first step, each from its own stream."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from servotrack.envs.arguments import Range
from servotrack.envs.servo3d.arms import SerialArm
from servotrack.envs.servo3d.draws import (
    LayoutRanges,
    draw_cameras,
    draw_constants,
    draw_motions,
    draw_offsets,
    start_streams,
)
from servotrack.envs.servo3d.kinematics import ArmTables, axes_now, twist_columns
from servotrack.envs.servo3d.layout import LayoutRules, accept_layouts
from servotrack.envs.servo3d.levels import Servo3DConfig
from servotrack.envs.streams import Streams
from servotrack.estimators.types import Array, Mask

PERIOD = 0.05
"""Control and camera period, s."""
LEAD = 6
"""Number of samples before the reset in an episode's tables, for frames taken before the reset."""
POSTURE = 0.4
"""Largest difference of each joint's angle at the goal from the arm's ready posture, rad."""
STOP_MARGIN = 0.05
"""Distance of start and goal from the joint limits, rad."""
LEAST_ERROR = 15.0
"""Smallest mean distance between the points at start and goal, px."""
_SINGULAR_CHOICES = 3  # accepted layouts of which the most singular one is taken
_BLOCK = 64  # layouts drawn together
_MAX_BLOCKS = 1000


class Stream(IntEnum):
    """Stream numbers of an episode's seed. A new stream does not change the others; the numbers must never change."""

    OPTICS = 0
    MOUNTING = 1
    BOARD = 2
    POSTURE = 3
    MOTION = 4
    PIXEL_NOISE = 5
    DROPOUT = 6
    HIDING = 7
    HOMING = 8
    ACTUATOR = 9
    TIMING = 10
    START = 11
    ENCODER_TIMING = 12


_CONSTANTS = np.array([Stream.OPTICS, Stream.ACTUATOR, Stream.HOMING, Stream.TIMING, Stream.ENCODER_TIMING])
_LAYOUT = np.array([Stream.POSTURE, Stream.MOTION, Stream.MOUNTING, Stream.BOARD, Stream.START])


@dataclass(frozen=True)
class Episode:
    """Hidden constants and tables of one episode: K = LEAD + horizon + 1 samples, the reset at index LEAD.

    Attributes:
        optics: Focal length, column and row of the principal point, width and height of the image. Shape (5,), px.
        mount: Pose of the camera in the tool's frame (`hand`) or in the base (`world`). Shape (3, 4), m.
        board: Pose of the board: in the camera's frame at the goal (`hand`) or in the tool's frame (`world`).
            Shape (3, 4), m.
        marks: Points of the board in its frame. Shape (p, 3), m.
        start: Joint angles at the reset. Shape (n,), rad.
        motion: Center (rad), amplitude (rad), angular frequency (rad/s) and phase (rad) of each joint's goal angle.
            Shape (n, 4).
        feature_noise: Noise of each frame's features. Shape (K, 2p), px, or (0, 2p) without noise.
        dropped: Mask of lost frames. Shape (K,), or (0,) if none are lost.
        hidden: Mask of occluded points. Shape (K, p), or (0, p) if none are.
        homing: Constant error of the joint angles. Shape (n,), rad.
        lag: Time constant of the joint rates, s.
        latency: Age of frames at arrival, control periods.
        encoder_age: Age of joint angles at arrival, control periods.
    """

    optics: Array
    mount: Array
    board: Array
    marks: Array
    start: Array
    motion: Array
    feature_noise: Array
    dropped: Mask
    hidden: Mask
    homing: Array
    lag: float
    latency: int
    encoder_age: int


class LayoutParts(NamedTuple):
    """Arm with a margin to its limits, conditions and ranges of layouts."""

    tables: ArmTables
    rules: LayoutRules
    ranges: LayoutRanges


def samples(config: Servo3DConfig) -> int:
    """Length K of an episode's tables."""
    return LEAD + config.horizon + 1


def board_marks(points: int, side: float) -> Array:
    """Return the points of a board: its middle, its four corners, or a regular grid. Shape (points, 3), m."""
    return _board_marks(points, side).copy()


@functools.lru_cache(maxsize=64)
def _board_marks(points: int, side: float) -> Array:
    """All episodes of a world have the same board."""
    if points == 1:
        return np.zeros((1, 3))
    columns = math.ceil(math.sqrt(points))
    rows = math.ceil(points / columns)
    grid = [
        (x, y, 0.0)
        for y in np.linspace(-side / 2.0, side / 2.0, rows)
        for x in np.linspace(-side / 2.0, side / 2.0, columns)
    ]
    # The corners come first, so that a grid with a few points missing still spans the board.
    grid.sort(key=lambda mark: -max(abs(mark[0]), abs(mark[1])) - min(abs(mark[0]), abs(mark[1])))
    return np.array(grid[:points])


def draw_episode(config: Servo3DConfig, arm: SerialArm, seed: int, parts: LayoutParts | None = None) -> Episode:
    """Make all random draws of one episode.

    A layout is drawn again until start and goal keep a margin to the joint limits, every point is in the image at the
    goal, and as many as `in_view` asks for at the start.

    Args:
        config: Parameters.
        arm: Arm.
        seed: Seed of the episode, below 2^64.
        parts: See `layout_parts`; None: they are computed.

    Raises:
        ValueError: No layout was found; the message names the parameters that decide.
    """
    streams = Streams(seed)
    lens, lag, homing, latency, encoder_age = draw_constants(
        np.uint64(seed),
        _CONSTANTS,
        float(config.principal_offset),
        config.focal,
        config.actuator_lag,
        float(config.homing),
        _whole(config.latency),
        _whole(config.encoder_age),
        arm.joints,
    )
    middle = config.width / 2.0 + lens[0], config.height / 2.0 + lens[1]
    optics = np.array([lens[2], *middle, float(config.width), float(config.height)])
    marks = board_marks(config.points, config.board * arm.reach)
    mount, board, start, motion = _draw_layout(config, arm, seed, parts or layout_parts(config, arm), optics, marks)
    count = samples(config)
    noise, dropped = np.zeros((0, 2 * config.points)), np.zeros(0, np.bool_)
    if config.pixel_noise > 0.0:
        noise = streams[Stream.PIXEL_NOISE].standard_normal((count, 2 * config.points))
        noise *= config.pixel_noise
    if config.dropout > 0.0:
        dropped = streams[Stream.DROPOUT].random(count) < config.dropout
        # The frame of the reset always arrives.
        dropped[: LEAD + 1] = False
    return Episode(
        optics=optics,
        mount=mount,
        board=board,
        marks=marks,
        start=start,
        motion=motion,
        feature_noise=noise,
        dropped=dropped,
        hidden=_draw_hiding(config, streams, count),
        homing=homing,
        lag=lag,
        latency=latency,
        encoder_age=encoder_age,
    )


def _whole(bounds: Range) -> tuple[int, int]:
    return int(bounds[0]), int(bounds[1])


def _draw_layout(
    config: Servo3DConfig, arm: SerialArm, seed: int, parts: LayoutParts, optics: Array, marks: Array
) -> tuple[Array, Array, Array, Array]:
    """Return mount, board, start and motion of an `Episode`."""
    tables, rules, ranges = parts
    states = start_streams(np.uint64(seed), _LAYOUT)
    motions, offsets = np.empty((_BLOCK, arm.joints, 4)), np.empty((_BLOCK, 6))
    mounts, boards = np.empty((_BLOCK, 3, 4)), np.empty((_BLOCK, 3, 4))
    starts, accepted = np.empty((_BLOCK, arm.joints)), np.empty(_BLOCK, np.bool_)
    wanted = _SINGULAR_CHOICES if config.singular else 1
    found: list[tuple[float, Array, Array, Array, Array]] = []
    for _ in range(_MAX_BLOCKS):
        draw_motions(states[:2], ranges, arm.ready, motions)
        draw_cameras(states[2:4], ranges, mounts, boards)
        draw_offsets(states[4], ranges, offsets)
        starts[:], accepted[:] = 0.0, False
        left = wanted - len(found)
        accept_layouts(tables, rules, optics[None], marks, mounts, boards, offsets, motions, starts, accepted, left)
        for k in np.flatnonzero(accepted):
            singular = _least_singular_value(arm, starts[k]) if config.singular else 0.0
            found.append((singular, mounts[k].copy(), boards[k].copy(), starts[k].copy(), motions[k].copy()))
        if len(found) == wanted:
            break
    if not found:
        raise ValueError(
            f"no layout among {_MAX_BLOCKS * _BLOCK} draws shows the board at start and goal within the joint limits: "
            f"shift={config.shift:g}, lean={config.lean:g}, turn={config.turn}, zoom={config.zoom}, "
            f"depth={config.depth}, board={config.board:g}, in_view={config.in_view}, "
            f"motion={config.motion:g}; change these"
        )
    _, mount, board, start, motion = min(found, key=lambda choice: choice[0])
    return mount, board, start, motion


def layout_parts(config: Servo3DConfig, arm: SerialArm) -> LayoutParts:
    """Return what all layouts of a world have in common."""
    least, most = config.in_view or (config.points, config.points)
    rules = LayoutRules(
        config.camera == "hand",
        int(least),
        int(most),
        LEAST_ERROR,
        0.02 * arm.reach,
        config.horizon * PERIOD,
    )
    ranges = LayoutRanges(
        in_hand=config.camera == "hand",
        posture=POSTURE,
        motion=float(config.motion),
        motion_period=config.motion_period,
        mounting=float(config.mounting),
        mounting_tilt=float(config.mounting_tilt),
        offset=arm.reach * config.mounting_offset,
        board_tilt=float(config.board_tilt),
        reach=arm.reach,
        depth=config.depth,
        shift=float(config.shift),
        lean=float(config.lean),
        turn=config.turn,
        zoom=config.zoom,
    )
    return LayoutParts(arm.tables(STOP_MARGIN), rules, ranges)


def _least_singular_value(arm: SerialArm, angles: Array) -> float:
    """Smallest singular value of the arm's geometric Jacobian at the tool, lengths in reaches."""
    lines, columns, pose = np.zeros((len(angles), 6)), np.zeros((len(angles), 6)), np.zeros((3, 4))
    axes_now(arm.axes, arm.points, arm.tool, angles[None], 0, np.zeros((3, 4)), lines, pose)
    twist_columns(lines, *pose[:, 3], columns)
    columns[:, :3] /= arm.reach
    return float(np.linalg.svd(columns, compute_uv=False)[-1])


def _draw_hiding(config: Servo3DConfig, streams: Streams, count: int) -> Mask:
    """Draw occlusions of single points; at least two points are visible at any time."""
    if config.hiding == 0.0 or config.points < 3:
        return np.zeros((0, config.points), np.bool_)
    rng = streams[Stream.HIDING]
    hidden = np.zeros((count, config.points), np.bool_)
    mean = config.hiding / PERIOD
    at = LEAD + 1 + int(rng.exponential(mean))
    while at < count:
        point, length = int(rng.integers(config.points)), math.ceil(rng.uniform(*config.hiding_time) / PERIOD)
        proposed = hidden[at : at + length].copy()
        proposed[:, point] = True
        if (config.points - proposed.sum(axis=1)).min() >= 2:
            hidden[at : at + length] = proposed
        at += 1 + int(rng.exponential(mean))
    return hidden
