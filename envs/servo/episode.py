"""Random draws of one episode. All are made before the first step, each quantity from its own stream."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.arguments import Range
from servotrack.envs.servo.layout import (
    MAX_DRAWS,
    accepted,
    draw_arm,
    draw_gains,
    draw_layouts,
    never_rejected,
    no_layout,
    ranges_of,
    start_streams,
)
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.records import CONSTANTS
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD, PERIOD, draw_waypoints
from servotrack.envs.streams import Streams
from servotrack.estimators.types import Array, Mask


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
        encoder_age: Age of the observed joint angles, control periods.
        knocked_at: Sample from which on the camera is turned by `knock`; `NEVER` without one.
        knock: Rotation of the camera about its axis, rad.
        focal_factor: Focal length over the drawn one at each sample. Shape (K,), or (0,) for a lens that does not zoom.
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
    encoder_age: int
    knocked_at: int
    knock: float
    focal_factor: Array


NEVER = np.iinfo(np.int64).max
"""Sample of what does not happen."""


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
    constants, paths = np.zeros(1, CONSTANTS), np.zeros((1, samples(config), 4))
    if motion is None and config.target != "waypoints":
        found = draw_layouts(_FIRST, np.array([seed]), ranges_of(config), never_rejected(config), constants, paths)
        if found >= 0:
            raise no_layout(config)
    else:
        _draw_moving_layout(config, streams, motion or _waypoints(config), constants, paths)
    draw_gains(_FIRST, np.array([seed]), config.actuation_gain, constants)
    noise = draw_noise(config, streams)
    links, camera, goal, gain, *_ = constants[0].item()
    return Episode(
        streams=streams,
        links=np.array(links),
        camera=np.array(camera),
        goal=np.array(goal),
        path=paths[0],
        gain=np.array(gain),
        **noise._asdict(),
    )


_FIRST = np.zeros(1, np.int64)
_NEVER = np.zeros(0, dtype=np.bool_)
_NONE = np.zeros((0, 2))
_CONSTANT = np.zeros(0)


class Noise(NamedTuple):
    """Noise of one episode. Fields: see `Episode`."""

    feature_noise: Array
    dropped: Mask
    latency: int
    rate_noise: Array
    encoder_noise: Array
    noise_levels: Array
    encoder_age: int
    knocked_at: int
    knock: float
    focal_factor: Array


def draw_noise(config: ServoConfig, streams: ServoStreams) -> Noise:
    """Draw the noise of one episode."""
    count = samples(config)
    encoder_noise, encoder_level = _gaussian_block(streams, Stream.ENCODER_NOISE, config.encoder_noise, count)
    rate_noise, rate_level = _gaussian_block(streams, Stream.ACTUATION_NOISE, config.actuation_noise, count)
    knocked_at, knock = NEVER, 0.0
    if config.knock:
        quarter = config.horizon // 4
        knocked_at = LEAD + config.warmup + int(streams[Stream.KNOCK].integers(quarter, 3 * quarter + 1))
        knock = float(streams[Stream.KNOCK].uniform(-config.knock, config.knock))
    return Noise(
        feature_noise=_feature_noise(config, streams, count),
        dropped=_dropped(config, streams, count),
        latency=_whole(streams, Stream.LATENCY, config.latency),
        rate_noise=rate_noise,
        encoder_noise=encoder_noise,
        noise_levels=np.array([encoder_level, rate_level]),
        encoder_age=_whole(streams, Stream.ENCODER_AGE, config.encoder_age),
        knocked_at=knocked_at,
        knock=knock,
        focal_factor=_focal_factor(config, streams, count),
    )


def knocked_camera(camera: Array, knock: float) -> Array:
    """Return a packed camera (CAMERA_SIZE,) that was turned about its axis by `knock`, rad."""
    turned = camera.copy()
    cosine, sine = math.cos(knock), math.sin(knock)
    turned[5:7] = camera[5] * cosine - camera[6] * sine, camera[6] * cosine + camera[5] * sine
    return turned


def _focal_factor(config: ServoConfig, streams: ServoStreams, count: int) -> Array:
    """Draw the focal length over the drawn one at all samples: 1 at the reset, then along a sine of its logarithm."""
    if not config.zoom:
        return _CONSTANT
    size = math.log1p(config.zoom) * (1.0 if streams[Stream.ZOOM].random() < 0.5 else -1.0)
    period = float(streams.uniform(Stream.ZOOM, config.zoom_period))
    since_reset = np.maximum(np.arange(count) - LEAD, 0) * PERIOD
    return np.asarray(np.exp(size * np.sin(2.0 * math.pi / period * since_reset)))


def _whole(streams: ServoStreams, stream: Stream, bounds: Range) -> int:
    """Draw a whole number from a range; a single value uses no stream."""
    low, high = int(bounds[0]), int(bounds[1])
    return low if low == high else int(streams[stream].integers(low, high + 1))


def _dropped(config: ServoConfig, streams: ServoStreams, count: int) -> Mask:
    """Mask of lost frames, one by one or while the target is occluded."""
    if not loses_frames(config):
        return _NEVER
    dropped = np.zeros(count, dtype=np.bool_)
    if config.dropout:
        dropped |= streams[Stream.DROPOUT].random(count) < config.dropout
    rng, times, time = streams[Stream.OCCLUSION], np.arange(count) * PERIOD, 0.0
    while config.occlusion and time < times[-1]:
        begin = time + float(rng.exponential(1.0 / config.occlusion))
        time = begin + float(rng.uniform(*config.occlusion_length))
        dropped |= (times >= begin) & (times < time)
    return dropped


def loses_frames(config: ServoConfig) -> bool:
    """Return True if frames of a world may be lost."""
    return config.dropout > 0.0 or config.occlusion > 0.0


def _waypoints(config: ServoConfig) -> Motion:
    times = sample_times(config)
    return lambda streams, links: draw_waypoints(config, streams[Stream.TARGET], links, times)


def _draw_moving_layout(
    config: ServoConfig, streams: ServoStreams, motion: Motion, constants: NDArray[np.void], paths: Array
) -> None:
    """Draw a layout whose target's path is not drawn in compiled code."""
    ranges, states = ranges_of(config), start_streams(streams.seed)
    for _ in range(MAX_DRAWS):
        draw_arm(ranges, states, constants[0])
        paths[0] = motion(streams, constants["links"][0])
        if accepted(ranges, constants[0], paths[0]):
            return
    raise no_layout(config)


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
