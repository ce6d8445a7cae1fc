"""Random draws of one episode of the serial-arm world. All are made before the first step, each from its own stream."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from servotrack.envs.arguments import Range
from servotrack.envs.servo3d.arms import SerialArm
from servotrack.envs.servo3d.kinematics import axes_now, twist_columns
from servotrack.envs.servo3d.layout import LayoutRules, accept_layouts
from servotrack.envs.servo3d.levels import Servo3DConfig
from servotrack.envs.streams import Streams
from servotrack.estimators.elementary import power
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


def draw_episode(config: Servo3DConfig, arm: SerialArm, seed: int) -> Episode:
    """Make all random draws of one episode.

    A layout is drawn again until start and goal keep a margin to the joint limits, every point is in the image at the
    goal, and as many as `in_view` asks for at the start.

    Raises:
        ValueError: No layout was found; the message names the parameters that decide.
    """
    streams = Streams(seed)
    optics = _draw_optics(config, streams)
    marks = board_marks(config.points, config.board * arm.reach)
    mount, board, start, motion = _draw_layout(config, arm, streams, optics, marks)
    count = samples(config)
    noise, dropped = np.zeros((0, 2 * config.points)), np.zeros(0, np.bool_)
    if config.pixel_noise > 0.0:
        noise = config.pixel_noise * streams[Stream.PIXEL_NOISE].standard_normal((count, 2 * config.points))
    if config.dropout > 0.0:
        dropped = streams[Stream.DROPOUT].random(count) < config.dropout
        # The frame of the reset always arrives.
        dropped[: LEAD + 1] = False
    lag = streams[Stream.ACTUATOR].uniform(*config.actuator_lag)
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
        homing=streams[Stream.HOMING].uniform(-config.homing, config.homing, arm.joints),
        lag=float(lag),
        latency=_whole(streams[Stream.TIMING], config.latency),
        encoder_age=_whole(streams[Stream.ENCODER_TIMING], config.encoder_age),
    )


def _whole(rng: np.random.Generator, bounds: Range) -> int:
    return int(rng.integers(int(bounds[0]), int(bounds[1]) + 1))


def _draw_optics(config: Servo3DConfig, streams: Streams) -> Array:
    rng = streams[Stream.OPTICS]
    offset = rng.uniform(-config.principal_offset, config.principal_offset, 2)
    focal = rng.uniform(*config.focal)
    middle = config.width / 2.0 + offset[0], config.height / 2.0 + offset[1]
    return np.array([focal, *middle, float(config.width), float(config.height)])


def _draw_layout(
    config: Servo3DConfig, arm: SerialArm, streams: Streams, optics: Array, marks: Array
) -> tuple[Array, Array, Array, Array]:
    """Return mount, board, start and motion of an `Episode`."""
    tables = arm.tables(STOP_MARGIN)
    least, most = config.in_view or (config.points, config.points)
    rules = LayoutRules(
        config.camera == "hand",
        int(least),
        int(most),
        LEAST_ERROR,
        0.02 * arm.reach,
        config.horizon * PERIOD,
    )
    wanted = _SINGULAR_CHOICES if config.singular else 1
    found: list[tuple[float, Array, Array, Array, Array]] = []
    for _ in range(_MAX_BLOCKS):
        motions = _draw_motions(config, arm, streams)
        mounts, boards = _draw_cameras(config, arm, streams)
        starts, accepted = np.zeros((_BLOCK, arm.joints)), np.zeros(_BLOCK, np.bool_)
        offsets = _draw_offsets(config, streams)
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


def _draw_motions(config: Servo3DConfig, arm: SerialArm, streams: Streams) -> Array:
    """Return a block of motions, see `Episode`. Shape (_BLOCK, n, 4)."""
    shape = (_BLOCK, arm.joints)
    motions = np.zeros((*shape, 4))
    motions[..., 0] = arm.ready + streams[Stream.POSTURE].uniform(-POSTURE, POSTURE, shape)
    if config.motion > 0.0:
        moving = streams[Stream.MOTION]
        motions[..., 1] = config.motion * moving.uniform(0.5, 1.0, shape)
        motions[..., 2] = 2.0 * math.pi / moving.uniform(*config.motion_period, shape)
        motions[..., 3] = moving.uniform(-math.pi, math.pi, shape)
    return motions


def _draw_offsets(config: Servo3DConfig, streams: Streams) -> Array:
    """Return differences of the board's pose in the camera's frame at start and goal, a block. Shape (_BLOCK, 6).

    Columns: offset of the middle along both image axes as a share of the distance, tilts about them (rad), turn about
    the optical axis (rad), and ratio of the distances.
    """
    rng = streams[Stream.START]
    offsets = np.zeros((_BLOCK, 6))
    offsets[:, 0:2] = rng.uniform(-config.shift, config.shift, (_BLOCK, 2))
    offsets[:, 2:4] = rng.uniform(-config.lean, config.lean, (_BLOCK, 2))
    offsets[:, 4] = rng.uniform(*config.turn, _BLOCK) * rng.choice((-1.0, 1.0), _BLOCK)
    offsets[:, 5] = power(rng.uniform(*config.zoom, _BLOCK), rng.choice((-1.0, 1.0), _BLOCK))
    return offsets


def _draw_cameras(config: Servo3DConfig, arm: SerialArm, streams: Streams) -> tuple[Array, Array]:
    """Return a block of mounts and of boards in the camera's frame at the goal. Shapes (_BLOCK, 3, 4).

    With the camera in the world, the mounts are those of the board on the tool.
    """
    fixing, placing = streams[Stream.MOUNTING], streams[Stream.BOARD]
    mounts, boards = np.zeros((_BLOCK, 3, 4)), np.zeros((_BLOCK, 3, 4))
    spin = fixing.uniform(-config.mounting, config.mounting, _BLOCK)
    mounts[:, :, :3] = _rotations(fixing.uniform(-config.mounting_tilt, config.mounting_tilt, (_BLOCK, 2)), spin)
    if config.camera == "world":
        # The board faces the camera: it is seen from in front of the tool.
        mounts[:, :, 1:3] *= -1.0
    mounts[:, :2, 3] = arm.reach * config.mounting_offset * fixing.uniform(-1.0, 1.0, (_BLOCK, 2))
    facing = placing.uniform(-config.mounting, config.mounting, _BLOCK)
    boards[:, :, :3] = _rotations(placing.uniform(-config.board_tilt, config.board_tilt, (_BLOCK, 2)), facing)
    boards[:, 2, 3] = arm.reach * placing.uniform(*config.depth, _BLOCK)
    boards[:, :2, 3] = 0.1 * boards[:, 2:, 3] * placing.uniform(-1.0, 1.0, (_BLOCK, 2))
    return mounts, boards


def _rotations(tilts: Array, spins: Array) -> Array:
    """Rotations about the x, then the y, then the z axis. Shape (_BLOCK, 3, 3)."""
    (cx, cy), (sx, sy), cz, sz = np.cos(tilts).T, np.sin(tilts).T, np.cos(spins), np.sin(spins)
    rotations = np.empty((_BLOCK, 3, 3))
    rotations[:, 0, 0], rotations[:, 0, 1], rotations[:, 0, 2] = cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx
    rotations[:, 1, 0], rotations[:, 1, 1], rotations[:, 1, 2] = sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx
    rotations[:, 2, 0], rotations[:, 2, 1], rotations[:, 2, 2] = -sy, cy * sx, cy * cx
    return rotations


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
