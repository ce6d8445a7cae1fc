"""Compiled draws of an episode's layout: links, camera, and the path of a target that moves along waves.

A layout is drawn again if the arm cannot follow the target, or the camera does not see both it and the goal at the
start. Each quantity draws from its own stream of the seed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD, PERIOD, START, reachable_place, solvable
from servotrack.envs.streams import draw_share, draw_uniform, start_stream
from servotrack.estimators.camera import pack_into, project, project_ground
from servotrack.estimators.compilation import njit

MAX_DRAWS = 2000
"""Number of layouts that are drawn until one can be solved."""


_LAYOUT_STREAMS = Stream.TARGET + 1
_KINDS = ("paper", "paper_point", "point", "ellipse", "two_sine")
"""Motions along waves; compiled code has their numbers."""
_PAPER, _PAPER_POINT, _POINT, _ELLIPSE, _TWO_SINE = range(len(_KINDS))
_MOST_WAVES = 2


class Ranges(NamedTuple):
    """Ranges that layouts are drawn from, see `ServoConfig`, and what decides if one can be solved.

    Attributes:
        links: Lowest and highest link length, m; `focal`, px, `depth`, m, and `distortion` likewise.
        focal: See `links`.
        depth: See `links`.
        distortion: See `links`.
        mounting: Half of the range of the mounting angle, rad; `offset`, px, `tilt`, rad, and `aspect` likewise.
        offset: See `mounting`.
        tilt: See `mounting`.
        aspect: See `mounting`.
        kind: Number of the target's motion, -1 for one that does not follow waves.
        camera_size: Width and height of the image, px.
        max_joint_rate: Largest joint rate, rad/s.
        warmup: Unscored steps before time 0.
    """

    links: tuple[float, float]
    focal: tuple[float, float]
    depth: tuple[float, float]
    distortion: tuple[float, float]
    mounting: float
    offset: float
    tilt: float
    aspect: float
    kind: int
    camera_size: float
    max_joint_rate: float
    warmup: int


def ranges_of(config: ServoConfig) -> Ranges:
    """Return the ranges that a configuration draws layouts from."""
    return Ranges(
        links=config.links,
        focal=config.focal,
        depth=config.depth,
        distortion=config.distortion,
        mounting=config.mounting,
        offset=config.principal_offset,
        tilt=config.tilt,
        aspect=config.aspect,
        kind=_KINDS.index(config.target) if config.target in _KINDS else -1,
        camera_size=float(config.camera_size),
        max_joint_rate=config.max_joint_rate,
        warmup=config.warmup,
    )


def never_rejected(config: ServoConfig) -> bool:
    """Return True if layout and target are the paper's fixed ones, which are used as they are."""
    ranges = (config.links, config.focal, config.depth, config.distortion)
    offsets = (config.mounting, config.principal_offset, config.tilt, config.aspect)
    return config.target.startswith("paper") and all(low == high for low, high in ranges) and not any(offsets)


@njit(cache=True, nogil=True)
def _within(state, bounds):  # type: ignore[no-untyped-def]
    """Draw uniformly from a range; a single value uses no number of the stream."""
    low, high = bounds
    return low if low == high else draw_uniform(state, low, high)


@njit(cache=True, nogil=True)
def _around(state, half):  # type: ignore[no-untyped-def]
    return _within(state, (-half, half))


@njit(cache=True, nogil=True)
def start_streams(seed):  # type: ignore[no-untyped-def]
    """Start the streams that layouts are drawn from, (streams, 4) uint64."""
    states = np.empty((_LAYOUT_STREAMS, 4), np.uint64)
    for stream in range(_LAYOUT_STREAMS):
        start_stream(seed, stream, states[stream])
    return states


@njit(cache=True, nogil=True)
def draw_arm(ranges, states, constants):  # type: ignore[no-untyped-def]
    """Draw links, camera and goal of an episode into its record of constants."""
    links, size = constants.links, ranges.camera_size
    for j in range(2):
        links[j] = _within(states[Stream.LINKS.value], ranges.links)
    focal, depth = _within(states[Stream.FOCAL.value], ranges.focal), _within(states[Stream.DEPTH.value], ranges.depth)
    mounting, distortion = (
        _around(states[Stream.MOUNTING.value], ranges.mounting),
        _within(states[Stream.DISTORTION.value], ranges.distortion),
    )
    cu = size / 2.0 + _around(states[Stream.PRINCIPAL_POINT.value], ranges.offset)
    cv = size / 2.0 + _around(states[Stream.PRINCIPAL_POINT.value], ranges.offset)
    tilt_x = _around(states[Stream.TILT.value], ranges.tilt)
    tilt_y = _around(states[Stream.TILT.value], ranges.tilt)
    aspect = _around(states[Stream.ASPECT.value], ranges.aspect)
    pack_into(focal, depth, mounting, cu, cv, tilt_x, tilt_y, aspect, distortion, size / 2.0, constants.camera)
    u, v, _ = project_ground(constants.camera, 0.0, 0.0)
    constants.goal[0], constants.goal[1] = u, v


@njit(cache=True, nogil=True)
def accepted(ranges, constants, path):  # type: ignore[no-untyped-def]
    """Return True if the arm can follow a path, and its camera sees the target and the goal at the start."""
    links = constants.links
    return solvable(path[LEAD + ranges.warmup :], links[0], links[1], ranges.max_joint_rate) and starts_in_view(
        constants, ranges.camera_size, path[LEAD, 0], path[LEAD, 1]
    )


@njit(cache=True, nogil=True)
def starts_in_view(constants, size, x, y):  # type: ignore[no-untyped-def]
    """Return True if the camera, at the arm's start, sees a target at (x, y) m and the goal in images of `size` px."""
    u, v, seen = project(constants.camera, constants.links[0], constants.links[1], START[0], START[1], x, y)
    # With a goal outside the image, the agent would have to steer the target out of view.
    gu, gv, before_fold = project_ground(constants.camera, 0.0, 0.0)
    return seen and before_fold and 0 <= u < size and 0 <= v < size and 0 <= gu < size and 0 <= gv < size


@njit(cache=True, nogil=True)
def _draw_waves(kind, state, links, centers, waves):  # type: ignore[no-untyped-def]
    """Draw center and cosines along x and y, lengths as fractions of the reach. Returns the waves per axis.

    Args:
        kind: Number of the motion.
        state: Stream of the target.
        links: Link lengths, (2,) m.
        centers: Output, (2,).
        waves: Output: amplitude, angular rate (rad/s) and phase (rad), (2, _MOST_WAVES, 3).
    """
    if kind == _PAPER:
        centers[:] = 0.5
        waves[0, 0, 0], waves[0, 0, 1], waves[0, 0, 2] = 0.3, 1.0, 0.0
        waves[1, 0, 0], waves[1, 0, 1], waves[1, 0, 2] = 0.2, 1.0, -math.pi / 2
        return 1
    if kind == _PAPER_POINT:
        centers[:] = 0.6
        return 0
    if kind == _POINT:
        share1 = draw_share(state)
        x, y = reachable_place(share1, draw_share(state), links[0], links[1])
        centers[0], centers[1] = x / (links[0] + links[1]), y / (links[0] + links[1])
        return 0
    centers[0] = draw_uniform(state, 0.4, 0.6)
    centers[1] = draw_uniform(state, 0.4, 0.6)
    if kind == _ELLIPSE:
        waves[0, 0, 0] = draw_uniform(state, 0.1, 0.3)
        waves[1, 0, 0] = draw_uniform(state, 0.1, 0.3)
        rate = draw_uniform(state, 0.5, 1.5)
        phase = draw_uniform(state, 0.0, 2.0 * math.pi)
        turn = math.copysign(math.pi / 2, draw_share(state) - 0.5)
        waves[0, 0, 1], waves[0, 0, 2] = rate, phase
        waves[1, 0, 1], waves[1, 0, 2] = rate, phase + turn
        return 1
    for axis in range(2):
        waves[axis, 0, 0] = draw_uniform(state, 0.08, 0.20)
        waves[axis, 0, 1] = draw_uniform(state, 0.4, 1.0)
        waves[axis, 0, 2] = draw_uniform(state, 0.0, 2.0 * math.pi)
        waves[axis, 1, 0] = draw_uniform(state, 0.03, 0.10)
        waves[axis, 1, 1] = draw_uniform(state, 1.0, 2.0)
        waves[axis, 1, 2] = draw_uniform(state, 0.0, 2.0 * math.pi)
    return 2


@njit(cache=True, nogil=True)
def draw_wave_path(ranges, state, links, path):  # type: ignore[no-untyped-def]
    """Draw a target's path along waves, (K, 4) m and m/s. With a warm-up, the target rests before time 0."""
    centers, waves = np.zeros(2), np.zeros((2, _MOST_WAVES, 3))
    count = _draw_waves(ranges.kind, state, links, centers, waves)
    reach = links[0] + links[1]
    for k in range(path.shape[0]):
        time = (float(k) - LEAD - ranges.warmup) * PERIOD
        resting = ranges.warmup > 0 and time < 0.0
        if resting:
            time = 0.0
        for axis in range(2):
            path[k, axis], path[k, 2 + axis] = reach * centers[axis], 0.0
            for wave in range(count):
                amplitude, rate, phase = waves[axis, wave, 0], waves[axis, wave, 1], waves[axis, wave, 2]
                angle = rate * time + phase
                path[k, axis] += reach * amplitude * math.cos(angle)
                if not resting:
                    path[k, 2 + axis] -= reach * amplitude * rate * math.sin(angle)


@njit(cache=True, nogil=True)
def drawn_waves(seed, ranges, fixed, constants, path):  # type: ignore[no-untyped-def]
    """Draw an episode's layout as `draw_layouts` does and return the waves of its target, as fractions of the reach.

    Args:
        seed: Seed of the episode, below 2^63.
        ranges: Ranges, `Ranges`, of a target that moves along waves.
        fixed: Take the first layout, see `never_rejected`.
        constants: Output: constants of the episode, a record `CONSTANTS`.
        path: Output: the target's path, (K, 4) m, m/s.

    Returns:
        Centers, (2,), and amplitude, angular rate (rad/s) and phase (rad) of each wave along each axis, (2, waves, 3).
    """
    states, centers, waves = start_streams(seed), np.zeros(2), np.zeros((2, _MOST_WAVES, 3))
    target, count = states[Stream.TARGET.value], 0
    for _ in range(MAX_DRAWS):
        draw_arm(ranges, states, constants)
        before = target.copy()
        draw_wave_path(ranges, target, constants.links, path)
        if fixed or accepted(ranges, constants, path):
            count = _draw_waves(ranges.kind, before, constants.links, centers, waves)
            break
    return centers, waves[:, :count].copy()


@njit(cache=True, nogil=True)
def draw_layouts(rows, seeds, ranges, fixed, constants, paths):  # type: ignore[no-untyped-def]
    """Draw links, cameras, goals and paths of some rows' episodes.

    Args:
        rows: Indices of the rows, (n,).
        seeds: Seed of each of these rows' episodes, below 2^63, (n,).
        ranges: Ranges, `Ranges`, of a target that moves along waves.
        fixed: Take the first layout, see `never_rejected`.
        constants: Constants of the episodes, (N,) records `CONSTANTS`.
        paths: The targets' paths, (N, K, 4) m, m/s.

    Returns:
        -1, or the first row without a solvable layout among `MAX_DRAWS` draws.
    """
    for n in range(len(rows)):
        row, found = rows[n], False
        if fixed and n > 0:
            same = constants[rows[0]]
            constants[row].links[:], constants[row].camera[:] = same.links, same.camera
            constants[row].goal[:] = same.goal
            paths[row] = paths[rows[0]]
            continue
        states = start_streams(seeds[n])
        for _ in range(MAX_DRAWS):
            draw_arm(ranges, states, constants[row])
            draw_wave_path(ranges, states[Stream.TARGET.value], constants[row].links, paths[row])
            if fixed or accepted(ranges, constants[row], paths[row]):
                found = True
                break
        if not found:
            return row
    return -1


def no_layout(config: ServoConfig) -> ValueError:
    """Error of ranges that contradict each other."""
    return ValueError(
        f"no solvable layout among {MAX_DRAWS} draws: the arm cannot follow a {config.target!r} target with "
        f"links={config.links} at max_joint_rate={config.max_joint_rate}, or the camera (focal={config.focal}, "
        f"depth={config.depth}, tilt={config.tilt}) does not see both it and the goal at the start; change these"
    )
