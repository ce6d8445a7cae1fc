"""Compiled draws of an episode's noise: the same numbers as NumPy's generators draw, from the same streams."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.envs.servo.levels import NOISE_KINDS, ServoConfig
from servotrack.envs.servo.streams import Stream
from servotrack.envs.servo.targets import LEAD, PERIOD
from servotrack.envs.streams import (
    draw_exponential,
    draw_index,
    draw_laplace,
    draw_normal,
    draw_share,
    draw_uniform,
    start_stream,
)
from servotrack.estimators.compilation import njit

NEVER = np.iinfo(np.int64).max
"""Sample of what does not happen."""
_UNIFORM, _LAPLACE = NOISE_KINDS.index("uniform"), NOISE_KINDS.index("laplace")


class NoiseRanges(NamedTuple):
    """Ranges and levels that noise is drawn from, see `ServoConfig`.

    Attributes:
        kind: Index of the kind of pixel noise in `NOISE_KINDS`.
        pixel_noise: Standard deviation, px.
        outlier_rate: Probability of an outlier in a frame.
        outlier_size: Standard deviation of an outlier, px.
        dropout: Probability that a frame is lost.
        occlusion: Number of occlusions per second.
        occlusion_length: Shortest and longest duration of an occlusion, s.
        encoder_noise: Range of the standard deviation of encoders, rad.
        actuation_noise: Range of the standard deviation of joint rates, rad/s.
        actuation_gain: Half of the range of the factors on joint rates.
        latency: Lowest and highest age of frames, samples.
        encoder_age: Lowest and highest age of joint angles, samples.
        knock: Largest turn of a knocked camera, rad.
        knocks: First and last sample at which the camera may be knocked.
        zoom: Largest relative change of the focal length.
        zoom_period: Shortest and longest time in which the lens zooms in, out and back, s.
    """

    kind: int
    pixel_noise: float
    outlier_rate: float
    outlier_size: float
    dropout: float
    occlusion: float
    occlusion_length: tuple[float, float]
    encoder_noise: tuple[float, float]
    actuation_noise: tuple[float, float]
    actuation_gain: float
    latency: tuple[int, int]
    encoder_age: tuple[int, int]
    knock: float
    knocks: tuple[int, int]
    zoom: float
    zoom_period: tuple[float, float]


def noise_ranges_of(config: ServoConfig) -> NoiseRanges:
    """Return the ranges that a configuration draws noise from."""
    quarter, scored = config.horizon // 4, LEAD + config.warmup
    return NoiseRanges(
        kind=NOISE_KINDS.index(config.noise_kind),
        pixel_noise=config.pixel_noise,
        outlier_rate=config.outlier_rate,
        outlier_size=config.outlier_size,
        dropout=config.dropout,
        occlusion=config.occlusion,
        occlusion_length=config.occlusion_length,
        encoder_noise=config.encoder_noise,
        actuation_noise=config.actuation_noise,
        actuation_gain=config.actuation_gain,
        latency=(int(config.latency[0]), int(config.latency[1])),
        encoder_age=(int(config.encoder_age[0]), int(config.encoder_age[1])),
        knock=config.knock,
        knocks=(scored + quarter, scored + 3 * quarter),
        zoom=config.zoom,
        zoom_period=config.zoom_period,
    )


@njit(cache=True, nogil=True)
def draw_noises(rows, seeds, ranges, constants, tables):  # type: ignore[no-untyped-def]
    """Draw gains and noise of some rows' episodes, whose cameras are drawn.

    Args:
        rows: Indices of the rows, (n,).
        seeds: Seed of each of these rows' episodes, below 2^63, (n,).
        ranges: Ranges, `NoiseRanges`.
        constants: Constants of the episodes, (N,) records `CONSTANTS`.
        tables: Draws of the episodes, `Tables`.
    """
    state = np.empty(6, np.uint64)
    for n in range(len(rows)):
        row, seed = rows[n], seeds[n]
        own = constants[row]
        _start(seed, Stream.ACTUATION_GAIN.value, state)
        for j in range(2):
            half = ranges.actuation_gain
            own.gain[j] = 1.0 + draw_uniform(state, -half, half) if half > 0.0 else 1.0
        _start(seed, Stream.ENCODER_NOISE.value, state)
        own.noise_levels[0] = _draw_white(state, ranges.encoder_noise, tables.encoder_noise[row])
        _start(seed, Stream.ACTUATION_NOISE.value, state)
        own.noise_levels[1] = _draw_white(state, ranges.actuation_noise, tables.rate_noise[row])
        _draw_feature_noise(seed, ranges, state, tables.feature_noise[row])
        _draw_losses(seed, ranges, state, tables.dropped[row])
        _start(seed, Stream.LATENCY.value, state)
        own.latency = _draw_whole(state, ranges.latency)
        _start(seed, Stream.ENCODER_AGE.value, state)
        own.encoder_age = _draw_whole(state, ranges.encoder_age)
        _draw_knock(seed, ranges, state, own)
        _draw_zoom(seed, ranges, state, tables.focal_factor[row])


@njit(cache=True, nogil=True)
def _start(seed, stream, state):  # type: ignore[no-untyped-def]
    """Start a stream for numbers of any kind, see `draw_index`."""
    start_stream(seed, stream, state)
    state[4], state[5] = 0, 0


@njit(cache=True, nogil=True)
def _draw_whole(state, bounds):  # type: ignore[no-untyped-def]
    """Draw a whole number from a range."""
    return bounds[0] + draw_index(state, bounds[1] + 1 - bounds[0])


@njit(cache=True, nogil=True)
def _draw_white(state, level, table):  # type: ignore[no-untyped-def]
    """Draw a level and white noise of both joints, (K, 2). Returns the level; with an empty table 0."""
    if table.shape[0] == 0:
        return 0.0
    low, high = level
    sigma = low if low == high else draw_uniform(state, low, high)
    for k in range(table.shape[0]):
        for j in range(2):
            table[k, j] = sigma * draw_normal(state)
    return sigma


@njit(cache=True, nogil=True)
def _draw_feature_noise(seed, ranges, state, table):  # type: ignore[no-untyped-def]
    """Draw noise and outliers of the features, (K, 2) px."""
    count, sigma = table.shape[0], ranges.pixel_noise
    if count == 0:
        return
    table[:] = 0.0
    if sigma > 0.0:
        _start(seed, Stream.PIXEL_NOISE.value, state)
        half, scale = math.sqrt(3.0) * sigma, sigma / math.sqrt(2.0)
        for k in range(count):
            for j in range(2):
                if ranges.kind == _UNIFORM:
                    table[k, j] = draw_uniform(state, -half, half)
                elif ranges.kind == _LAPLACE:
                    table[k, j] = draw_laplace(state, scale)
                else:
                    table[k, j] = sigma * draw_normal(state)
    if ranges.outlier_rate > 0.0:
        offsets = np.empty(6, np.uint64)
        _start(seed, Stream.OUTLIER.value, state)
        _start(seed, Stream.OUTLIER_OFFSET.value, offsets)
        for k in range(count):
            hit = draw_share(state) < ranges.outlier_rate
            for j in range(2):
                offset = ranges.outlier_size * draw_normal(offsets)
                if hit:
                    table[k, j] += offset


@njit(cache=True, nogil=True)
def _draw_losses(seed, ranges, state, dropped):  # type: ignore[no-untyped-def]
    """Draw the mask of lost frames, (K,): one by one, or while the target is occluded."""
    count = dropped.shape[0]
    if count == 0:
        return
    dropped[:] = False
    if ranges.dropout > 0.0:
        _start(seed, Stream.DROPOUT.value, state)
        for k in range(count):
            dropped[k] = draw_share(state) < ranges.dropout
    if ranges.occlusion > 0.0:
        _start(seed, Stream.OCCLUSION.value, state)
        time, low, high = 0.0, ranges.occlusion_length[0], ranges.occlusion_length[1]
        while time < (count - 1) * PERIOD:
            begin = time + 1.0 / ranges.occlusion * draw_exponential(state)
            time = begin + draw_uniform(state, low, high)
            for k in range(count):
                if begin <= k * PERIOD < time:
                    dropped[k] = True


@njit(cache=True, nogil=True)
def _draw_knock(seed, ranges, state, constants):  # type: ignore[no-untyped-def]
    """Draw the sample of a knock and the camera after it, turned about its axis."""
    camera, knocked = constants.camera, constants.knocked
    constants.knocked_at = NEVER
    for k in range(len(camera)):
        knocked[k] = camera[k]
    if ranges.knock > 0.0:
        _start(seed, Stream.KNOCK.value, state)
        constants.knocked_at = _draw_whole(state, ranges.knocks)
        turn = draw_uniform(state, -ranges.knock, ranges.knock)
        cosine, sine = math.cos(turn), math.sin(turn)
        knocked[5], knocked[6] = camera[5] * cosine - camera[6] * sine, camera[6] * cosine + camera[5] * sine


@njit(cache=True, nogil=True)
def _draw_zoom(seed, ranges, state, focal_factor):  # type: ignore[no-untyped-def]
    """Draw the focal length over the drawn one, (K,): 1 until the reset, then along a sine of its logarithm."""
    if focal_factor.shape[0] == 0:
        return
    _start(seed, Stream.ZOOM.value, state)
    size = math.log1p(ranges.zoom) if draw_share(state) < 0.5 else -math.log1p(ranges.zoom)
    rate = 2.0 * math.pi / draw_uniform(state, ranges.zoom_period[0], ranges.zoom_period[1])
    for k in range(focal_factor.shape[0]):
        focal_factor[k] = math.exp(size * math.sin(rate * (max(k - LEAD, 0) * PERIOD)))
