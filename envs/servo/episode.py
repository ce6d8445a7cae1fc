"""Random draws of one episode. All are made before the first step, each quantity from its own stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np

from servotrack.envs.arguments import Range
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.targets import PERIOD, START, draw_path, solvable
from servotrack.envs.streams import Streams
from servotrack.estimators.camera import pack_camera, project_ground, project_points
from servotrack.estimators.types import Array, Mask

LEAD = 6
"""Number of samples before the reset in an episode's tables, for frames taken before the reset."""
_MAX_DRAWS = 2000  # of a layout, until one is solvable
_PAPER_TARGETS = ("paper", "paper_point")


class Stream(IntEnum):
    """Stream numbers of an episode's seed. A new stream does not change the others; the numbers must never change."""

    LINKS = 0
    FOCAL = 1
    DEPTH = 2
    MOUNTING = 3
    PRINCIPAL_POINT = 4
    DISTORTION = 5
    TILT = 6
    ASPECT = 7
    TARGET = 8
    PIXEL_NOISE = 9
    OUTLIER = 10
    OUTLIER_OFFSET = 11
    DROPOUT = 12
    LATENCY = 13
    ACTUATION_NOISE = 14
    ACTUATION_GAIN = 15
    ENCODER_NOISE = 16
    DISTRACTOR = 17
    IMAGE_NOISE = 18
    FLOOR = 19


class ServoStreams(Streams):
    """The random streams of one servo episode."""

    def uniform(self, stream: Stream, bounds: Range, size: int | None = None) -> float | Array:
        """Draw uniformly from a range; a single value uses no stream. Returns a float, or shape (size,)."""
        low, high = bounds
        if low == high:
            return float(low) if size is None else np.full(size, float(low))
        return self[stream].uniform(low, high, size)


@dataclass(frozen=True)
class Episode:
    """Hidden constants and tables of one episode: K = LEAD + warmup + horizon + 1 samples, the reset at index LEAD.

    Attributes:
        streams: Random streams of the episode; image sensors draw from them too.
        links: Link lengths. Shape (2,), m.
        camera: Packed camera. Shape (CAMERA_SIZE,).
        goal: Goal features: image of the point under the tool. Shape (2,), px.
        path: Target positions and velocities. Shape (K, 4), m and m/s.
        feature_noise: Noise and outliers added to each frame's features. Shape (K, 2), px, or (0, 2) without noise.
        dropped: Mask of lost frames. Shape (K,), or (0,) if none are lost.
        latency: Age of frames at arrival, control periods.
        gain: Factor on each joint's rate. Shape (2,).
        rate_noise: Noise on the joint rates. Shape (K, 2), rad/s, or (0, 2) without noise.
        encoder_noise: Noise on the observed joint angles. Shape (K, 2), rad, or (0, 2) without noise.
        noise_levels: Standard deviations of encoder noise (rad) and rate noise (rad/s) in this episode. Shape (2,).
    """

    streams: ServoStreams
    links: Array
    camera: Array
    goal: Array
    path: Array
    feature_noise: Array
    dropped: Mask
    latency: int
    gain: Array
    rate_noise: Array
    encoder_noise: Array
    noise_levels: Array


def samples(config: ServoConfig) -> int:
    """Length K of an episode's tables."""
    return LEAD + config.warmup + config.horizon + 1


def sample_times(config: ServoConfig) -> Array:
    """Times of the tables' rows, shape (K,), s. Scoring starts at time 0."""
    return (np.arange(samples(config), dtype=np.float64) - LEAD - config.warmup) * PERIOD


Motion = Callable[["ServoStreams", Array], Array]
"""Function that draws a target's path (K, 4) for an arm with these links."""


def draw_episode(config: ServoConfig, seed: int, motion: Motion | None = None) -> Episode:
    """Make all random draws of one episode.

    A layout is drawn again if it cannot be solved (see `solvable`), if the target starts out of view, or if the goal
    lies outside the image.

    Args:
        config: Parameters of the world.
        seed: Seed of the episode, a non-negative integer.
        motion: Draws the target's path instead of `config.target`.

    Raises:
        ValueError: No solvable layout was found in many draws: the ranges contradict each other.
    """
    streams = ServoStreams(seed)
    links, camera, path = _draw_layout(config, streams, motion)
    count = samples(config)
    u, v, _ = project_ground(camera, 0.0, 0.0)
    encoder_noise, encoder_level = _gaussian_block(streams, Stream.ENCODER_NOISE, config.encoder_noise, count)
    rate_noise, rate_level = _gaussian_block(streams, Stream.ACTUATION_NOISE, config.actuation_noise, count)
    low, high = config.latency
    return Episode(
        streams=streams,
        links=links,
        camera=camera,
        goal=np.array([u, v]),
        path=path,
        feature_noise=_feature_noise(config, streams, count),
        dropped=streams[Stream.DROPOUT].random(count) < config.dropout if config.dropout else _NEVER,
        latency=int(low) if low == high else int(streams[Stream.LATENCY].integers(int(low), int(high) + 1)),
        gain=1.0
        + np.asarray(streams.uniform(Stream.ACTUATION_GAIN, (-config.actuation_gain, config.actuation_gain), 2)),
        rate_noise=rate_noise,
        encoder_noise=encoder_noise,
        noise_levels=np.array([encoder_level, rate_level]),
    )


_NEVER = np.zeros(0, dtype=np.bool_)
_NONE = np.zeros((0, 2))


def _draw_layout(config: ServoConfig, streams: ServoStreams, motion: Motion | None) -> tuple[Array, Array, Array]:
    if _is_fixed(config):
        return _fixed_layout(config)
    times = sample_times(config)
    for _ in range(_MAX_DRAWS):
        links = np.asarray(streams.uniform(Stream.LINKS, config.links, 2))
        camera = _draw_camera(config, streams)
        if motion is not None:
            path = motion(streams, links)
        else:
            rng = None if config.target in _PAPER_TARGETS else streams[Stream.TARGET]
            path = draw_path(config, rng, links, times)
        if not solvable(path[LEAD + config.warmup :], links[0], links[1], config.max_joint_rate):
            continue
        start, seen = project_points(camera, links, START, path[LEAD, :2])
        u, v, before_fold = project_ground(camera, 0.0, 0.0)
        # With a goal outside the image, the agent would have to steer the target out of view.
        if seen and before_fold and _in_image(config, *start) and _in_image(config, u, v):
            return links, camera, path
    raise ValueError(
        f"no solvable layout among {_MAX_DRAWS} draws: the arm cannot follow a {config.target!r} target with "
        f"links={config.links} at max_joint_rate={config.max_joint_rate}, or the camera (focal={config.focal}, "
        f"depth={config.depth}, tilt={config.tilt}) does not see both it and the goal at the start; change these"
    )


def _in_image(config: ServoConfig, u: float, v: float) -> bool:
    return bool(0.0 <= u < config.camera_size and 0.0 <= v < config.camera_size)


def _is_fixed(config: ServoConfig) -> bool:
    """Return True if layout and target are the paper's fixed ones, which are never rejected."""
    ranges = (config.links, config.focal, config.depth, config.distortion)
    offsets = (config.mounting, config.principal_offset, config.tilt, config.aspect)
    return config.target in _PAPER_TARGETS and all(low == high for low, high in ranges) and not any(offsets)


@lru_cache(maxsize=32)
def _fixed_layout(config: ServoConfig) -> tuple[Array, Array, Array]:
    links = np.full(2, config.links[0])
    camera = _draw_camera(config, ServoStreams(0))
    path = draw_path(config, None, links, sample_times(config))
    for table in (links, camera, path):
        table.setflags(write=False)
    return links, camera, path


def _draw_camera(config: ServoConfig, streams: ServoStreams) -> Array:
    middle = config.camera_size / 2.0

    def around(stream: Stream, half: float, size: int | None = None) -> float | Array:
        return streams.uniform(stream, (-half, half), size)

    return pack_camera(
        focal=streams.uniform(Stream.FOCAL, config.focal),
        depth=streams.uniform(Stream.DEPTH, config.depth),
        mounting=around(Stream.MOUNTING, config.mounting),
        center=middle + np.asarray(around(Stream.PRINCIPAL_POINT, config.principal_offset, 2)),
        tilt=around(Stream.TILT, config.tilt, 2),
        aspect=around(Stream.ASPECT, config.aspect),
        distortion=streams.uniform(Stream.DISTORTION, config.distortion),
        half_width=middle,
    )


def _gaussian_block(streams: ServoStreams, stream: Stream, level: Range, count: int) -> tuple[Array, float]:
    """Draw a noise level for the episode. Returns white noise of both joints, (count, 2), and the level."""
    if level == (0.0, 0.0):
        return _NONE, 0.0
    sigma = float(streams.uniform(stream, level))
    return sigma * streams[stream].standard_normal((count, 2)), sigma


def _feature_noise(config: ServoConfig, streams: ServoStreams, count: int) -> Array:
    noise = _NONE
    if config.pixel_noise > 0:
        rng, sigma = streams[Stream.PIXEL_NOISE], config.pixel_noise
        if config.noise_kind == "uniform":
            noise = rng.uniform(-np.sqrt(3.0) * sigma, np.sqrt(3.0) * sigma, (count, 2))
        elif config.noise_kind == "laplace":
            noise = rng.laplace(0.0, sigma / np.sqrt(2.0), (count, 2))
        else:
            noise = sigma * rng.standard_normal((count, 2))
    if config.outlier_rate > 0:
        hit = streams[Stream.OUTLIER].random((count, 1)) < config.outlier_rate
        offset = config.outlier_size * streams[Stream.OUTLIER_OFFSET].standard_normal((count, 2))
        noise = np.where(hit, offset, 0.0) + (noise if len(noise) else 0.0)
    return noise
