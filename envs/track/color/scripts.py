"""Random motion of one color tracking episode: head, camera, light, distractors and occluders."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.color.config import ColorConfig
from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import exponential, hyperbolic_tangent
from servotrack.estimators.types import Array


class Stream(IntEnum):
    """Random streams of an episode. The numbers must never change; new streams are appended."""

    PATH = 0
    POSE = 1
    ZOOM = 2
    PAN = 3
    LIGHT = 4
    TINT = 5
    OCCLUSION = 6
    OCCLUDER = 7
    DISTRACTOR_PATH = 8
    FIGURE = 9
    DISTRACTOR = 10
    BACKDROP = 11
    NOISE = 12
    NOISE_SHIFT = 13
    SPIN = 14
    GROWTH = 15


class Motion(NamedTuple):
    """Motion of one figure over all F frames.

    Attributes:
        centers: Center of the head in the frame, shape (F, 2), px.
        heights: Height of the head in the frame, shape (F,), px.
        rolls: Roll of the head, shape (F,), rad.
        yaws: Turn of the head to the side, -1 to 1, shape (F,).
        turns: Rotation of the whole figure about its head, shape (F,), rad.
    """

    centers: Array
    heights: Array
    rolls: Array
    yaws: Array
    turns: Array


class Script(NamedTuple):
    """Motion of everything in an episode of F frames.

    Attributes:
        target: Head to be tracked.
        distractors: People behind the target.
        occluders: Objects that pass in front of the target; most of the time they are outside the frame.
        zooms: Zoom factors of the camera, shape (F,).
        pans: Point of the scene at the center of the frame, relative to the center of the scene, shape (F, 2), px of
            the scene.
        gains: Gains of the light on red, green and blue, shape (F, 3).
    """

    target: Motion
    distractors: tuple[Motion, ...]
    occluders: tuple[Motion, ...]
    zooms: Array
    pans: Array
    gains: Array


SCENE_ROOM = 1.12
"""Size of the painted scene relative to the view at the widest zoom."""
_HALF_WIDTH, _HALF_HEIGHT = 0.62, 0.72
"""Half width and half height of a head with its hair, head heights. They must stay inside the frame."""
_GROWTH_TIME, _SPIN_TIME = 0.4, 1.0
"""Time constants of the head's growth and of its angular velocity, s."""
_OCCLUDER_SIZE = 2.3
"""Width of an occluder, head widths."""
_HEAD_WIDTH = 0.8
"""Width of a head, head heights."""


def draw_script(config: ColorConfig, streams: Streams) -> Script:
    """Draw the motion of an episode. Every quantity has its own random stream."""
    frames = config.horizon + 1
    slow = 1.6 * config.frame_rate
    zooms = _draw_factors(streams[Stream.ZOOM], frames, slow, config.zoom)
    pan = np.stack([wander(streams[Stream.PAN, axis], frames, slow) for axis in (0, 1)], axis=1)
    pans = config.pan * np.array([1.0, 0.5]) * np.clip(pan, -2.0, 2.0)
    heights = config.head_height * zooms
    if config.growth > 1.0:
        heights = heights * _draw_factors(
            streams[Stream.GROWTH], frames, _GROWTH_TIME * config.frame_rate, config.growth
        )
    target = _draw_target(config, streams, heights)
    return Script(
        target,
        tuple(_draw_distractor(config, streams, target, member) for member in range(config.distractors)),
        tuple(_draw_occluder(config, streams, target, member) for member in range(config.occlusions)),
        zooms,
        pans,
        _draw_light(config, streams, frames),
    )


def _draw_factors(rng: np.random.Generator, frames: int, period: float, most: float) -> Array:
    """Draw factors between 1 / most and most that wander with a time constant (frames) and start at 1."""
    factors = exponential(math.log(most) * np.clip(wander(rng, frames, period), -1.6, 1.6) / 1.6)
    return np.clip(factors / factors[0], 1.0 / most, most) if most > 1.0 else factors


def wander(rng: np.random.Generator, frames: int, period: float, columns: int = 1) -> Array:
    """Return a smooth, stationary random process of unit variance: white noise after two first-order low-pass filters.

    Args:
        rng: Random generator. The first frames do not depend on the number of frames.
        frames: Number of frames.
        period: Time constant, frames. Larger values give slower motion.
        columns: Number of independent processes.

    Returns:
        Samples, shape (frames,) for one column, otherwise (frames, columns).
    """
    keep = math.exp(-1.0 / max(period / 2.0, 1e-9))
    warm_up = int(8 * period)
    white = rng.standard_normal((warm_up + frames, columns))
    # Variance of white noise after two filters x <- keep x + (1 - keep) u.
    gain = 1.0 - keep
    variance = gain**4 * (1.0 + keep**2) / (1.0 - keep**2) ** 3
    found = _filtered_twice(white, keep)[warm_up:] / math.sqrt(variance)
    return found[:, 0] if columns == 1 else found


@njit(cache=True, nogil=True)
def _filtered_twice(white, keep):  # type: ignore[no-untyped-def]
    found = np.empty_like(white)
    for column in range(white.shape[1]):
        first = second = 0.0
        for k in range(len(white)):
            first = keep * first + (1.0 - keep) * white[k, column]
            second = keep * second + (1.0 - keep) * first
            found[k, column] = second
    return found


def _draw_target(config: ColorConfig, streams: Streams, heights: Array) -> Motion:
    rolls, yaws = _draw_pose(config, streams, Stream.POSE, len(heights))
    turns = np.zeros(len(heights))
    if config.spin > 0.0:
        rate = wander(streams[Stream.SPIN], len(heights), _SPIN_TIME * config.frame_rate)
        turns = config.spin / config.frame_rate * (np.cumsum(rate) - rate[0])
    return Motion(_draw_path(config, streams[Stream.PATH], heights), heights, rolls, yaws, turns)


def _draw_pose(config: ColorConfig, streams: Streams, stream: Stream, frames: int) -> tuple[Array, Array]:
    pose = wander(streams[stream], frames, 0.7 * config.frame_rate, 2)
    return config.tilt * pose[:, 0], config.turning * hyperbolic_tangent(pose[:, 1])


def _draw_path(config: ColorConfig, rng: np.random.Generator, heights: Array) -> Array:
    """Return a path whose velocity changes at random times and is reflected at the border of the frame."""
    size = np.array([config.width, config.height], dtype=np.float64)
    draws = rng.random((len(heights), 4))
    half = np.array([_HALF_HEIGHT if config.spin > 0.0 else _HALF_WIDTH, _HALF_HEIGHT])
    center = size / 2.0 + 0.35 * (draws[0, :2] - 0.5) * size
    chance = config.restlessness / config.frame_rate
    velocity = np.zeros(2)
    wanted = _velocity(config, draws[0, 2:])
    path = np.empty((len(heights), 2))
    for k, height in enumerate(heights):
        margin = np.minimum(half * height + 2.0, size / 2.0)
        path[k] = center = np.clip(center, margin, size - margin)
        if draws[k, 0] < chance:
            wanted = _velocity(config, draws[k, 2:])
        velocity = velocity + 0.35 * (wanted - velocity)
        after = center + velocity
        back = (after < margin) | (after > size - margin)
        wanted, velocity = np.where(back, -wanted, wanted), np.where(back, -0.5 * velocity, velocity)
        center = center + velocity
    return path


def _velocity(config: ColorConfig, uniform: Array) -> Array:
    """Return a velocity with uniform direction and 0.3 to 1 of the maximum speed, px per frame."""
    angle = 2.0 * np.pi * uniform[0]
    return config.speed * (0.3 + 0.7 * uniform[1]) * np.array([np.cos(angle), 0.7 * np.sin(angle)])


def _draw_distractor(config: ColorConfig, streams: Streams, target: Motion, member: int) -> Motion:
    """Return the motion of a person who stays about a head width away and sometimes passes behind the target."""
    rng = streams[Stream.DISTRACTOR_PATH, member]
    frames = len(target.heights)
    phase, side, size = rng.random(3)
    sway = wander(rng, frames, 1.2 * config.frame_rate, 4)
    turns = np.arange(frames) / (5.5 * config.frame_rate)
    across = 2.1 * np.sin(2.0 * np.pi * (turns + phase)) + 0.25 * sway[:, 0] + 0.9 * member * np.sign(side - 0.5)
    down = 0.1 + 0.12 * sway[:, 1]
    offset = np.stack([across, down], axis=1) * target.heights[:, None] * np.array([_HEAD_WIDTH, 1.0])
    heights = target.heights * (0.9 + 0.15 * size)
    yaws = config.turning * hyperbolic_tangent(sway[:, 3])
    return Motion(target.centers + offset, heights, config.tilt * sway[:, 2], yaws, np.zeros(frames))


def _draw_occluder(config: ColorConfig, streams: Streams, target: Motion, member: int) -> Motion:
    """Return the straight motion of an object that occludes the head once, for about `occlusion_frames`."""
    rng = streams[Stream.OCCLUSION, member]
    when, side, shift = rng.random(3)
    frames = len(target.heights)
    share = (member + 0.35 + 0.5 * when) / config.occlusions
    meeting = min(frames - 1, round(share * (frames - 1)))
    height = float(target.heights[meeting])
    width = _OCCLUDER_SIZE * _HEAD_WIDTH * height
    hidden = width - _HEAD_WIDTH * height
    speed = hidden / max(config.occlusion_frames, 1e-3)
    speed = min(speed, 0.5 * width) * (1.0 if side < 0.5 else -1.0)
    time = np.arange(frames) - meeting
    x = target.centers[meeting, 0] + speed * time
    y = np.full(frames, target.centers[meeting, 1] + 0.1 * (shift - 0.5) * height)
    still = np.zeros(frames)
    return Motion(np.stack([x, y], axis=1), np.full(frames, height), still, still, still)


def _draw_light(config: ColorConfig, streams: Streams, frames: int) -> Array:
    level = hyperbolic_tangent(wander(streams[Stream.LIGHT], frames, 1.2 * config.frame_rate))
    tint = hyperbolic_tangent(wander(streams[Stream.TINT], frames, 2.0 * config.frame_rate))
    # The first frame has neutral light: gains of 1.
    level, tint = level - level[0], tint - tint[0]
    most = math.log(config.light_change)
    bright = np.clip(most * level, -most, most)
    warm = 0.5 * math.log(config.light_tint) * tint
    return exponential(bright[:, None] + warm[:, None] * np.array([1.0, 0.0, -1.0]))
