"""Random draws of one episode. All are made before the first step, each quantity from its own stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.layout import (
    MAX_DRAWS,
    accepted,
    draw_arm,
    draw_layouts,
    never_rejected,
    no_layout,
    ranges_of,
    start_streams,
)
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.noise import draw_noises, noise_ranges_of
from servotrack.envs.servo.records import CONSTANTS, Tables
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD, PERIOD, draw_waypoints
from servotrack.envs.streams import Streams
from servotrack.estimators.types import Array, Mask


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
        knocked_at: Sample from which on the camera is `knocked`; `NEVER` if it is never.
        knocked: Packed camera, turned about its axis by a knock. Shape (CAMERA_SIZE,).
        focal_factor: Focal length over the drawn one at each sample. Shape (K,), or (0,) for a lens that does not zoom.
    """

    streams: Streams
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
    knocked: Array
    focal_factor: Array


def samples(config: ServoConfig) -> int:
    """Length K of an episode's tables."""
    return LEAD + config.warmup + config.horizon + 1


def sample_times(config: ServoConfig) -> Array:
    """Times of the tables' rows, shape (K,), s. Scoring starts at time 0."""
    return (np.arange(samples(config), dtype=np.float64) - LEAD - config.warmup) * PERIOD


Motion = Callable[[Streams, np.void], Array]
"""Function that draws a target's path (K, 4) for an arm and its camera, a record of `CONSTANTS`."""


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
    streams = Streams(seed)
    constants, tables, seeds = np.zeros(1, CONSTANTS), empty_tables(config, 1), np.array([seed])
    if motion is None and config.target != "waypoints":
        if draw_layouts(_FIRST, seeds, ranges_of(config), never_rejected(config), constants, tables.paths) >= 0:
            raise no_layout(config)
    else:
        _draw_moving_layout(config, streams, motion or _waypoints(config), constants, tables.paths)
    draw_noises(_FIRST, seeds, noise_ranges_of(config), constants, tables)
    own = {name: constants[name][0] for name in CONSTANTS.names or ()}
    whole = {name: int(own[name]) for name in ("latency", "encoder_age", "knocked_at")}
    drawn = {name: table[0] for name, table in tables._asdict().items() if name != "paths"}
    return Episode(streams=streams, path=tables.paths[0], **drawn, **{**own, **whole})


def empty_tables(config: ServoConfig, count: int) -> Tables:
    """Return tables of `count` arms for the draws of a configuration, without any effect yet."""
    length = samples(config)
    return Tables(
        paths=np.zeros((count, length, 4)),
        feature_noise=np.zeros((count, length if config.pixel_noise or config.outlier_rate else 0, 2)),
        rate_noise=np.zeros((count, length if any(config.actuation_noise) else 0, 2)),
        encoder_noise=np.zeros((count, length if any(config.encoder_noise) else 0, 2)),
        dropped=np.zeros((count, length if config.dropout or config.occlusion else 0), np.bool_),
        focal_factor=np.ones((count, length if config.zoom else 0)),
    )


_FIRST = np.zeros(1, np.int64)


def _waypoints(config: ServoConfig) -> Motion:
    times = sample_times(config)
    return lambda streams, arm: draw_waypoints(config, streams[Stream.TARGET], arm["links"], times)


def _draw_moving_layout(
    config: ServoConfig, streams: Streams, motion: Motion, constants: NDArray[np.void], paths: Array
) -> None:
    """Draw a layout whose target's path is not drawn in compiled code."""
    ranges, states = ranges_of(config), start_streams(streams.seed)
    for _ in range(MAX_DRAWS):
        draw_arm(ranges, states, constants[0])
        paths[0] = motion(streams, constants[0])
        if accepted(ranges, constants[0], paths[0]):
            return
    raise no_layout(config)
