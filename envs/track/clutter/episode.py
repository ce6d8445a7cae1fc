"""Random draws of one clutter episode: targets, detections and clutter, all drawn before the first scan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.clutter.config import ClutterConfig
from servotrack.envs.track.counts import poisson_quantile
from servotrack.estimators.compilation import njit
from servotrack.estimators.elementary import direction
from servotrack.estimators.types import Array, Labels, Mask

_MAX_DRAWS = 4096
"""Number of paths drawn for one target with a given lifetime before `draw_episode` fails."""


class Stream(IntEnum):
    """Child streams of an episode's seed. The numbers must never change; new streams are appended."""

    MOTION = 0
    MANEUVER = 1
    BIRTH = 2
    LIFETIME = 3
    DETECTION = 4
    SENSOR_NOISE = 5
    CLUTTER_COUNT = 6
    CLUTTER = 7
    SHUFFLE = 8
    AFTER = 9


@dataclass(frozen=True)
class ClutterEpisode:
    """One episode; K = horizon + 1 + lag scans, n = max_targets, M = rows of an observation.

    The first `horizon` scans are scored. The same seed gives the same first horizon + 1 scans with any lag.

    Attributes:
        states: True states, shape (K, n, 4), m and m/s; zeros where a target does not exist.
        exists: Targets that exist, shape (K, n), bool.
        measurements: Scans, shape (K, M, 3): existence and two coordinates.
        source: Index of the target that caused each measurement, shape (K, M): -1 for clutter, -2 for an unused row.
    """

    states: Array
    exists: Mask
    measurements: Array
    source: Labels


def draw_episode(config: ClutterConfig, seed: int) -> ClutterEpisode:
    """Draw all random quantities of an episode.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, a non-negative integer.

    Raises:
        ValueError: If no path of a target with a given lifetime stays inside the region.
    """
    streams = Streams(seed)
    scans, n = config.horizon + 1, config.max_targets
    first, last, starts = _births(config, streams)
    states, exists, positions = np.zeros((scans, n, 4)), np.zeros((scans, n), np.bool_), np.zeros((scans, n, 2))
    root = np.asarray(np.linalg.cholesky(config.motion.packed.noise), np.float64)
    if not config.published.wanders:
        root[:4] = 0.0
    for target in range(len(first)):
        life = slice(first[target], last[target] + 1)
        if config.published.middle is None:
            path = _draw_path(config, streams, target, starts[target], root, life)
        else:
            path = _path_through_middle(config, streams, target, root)[life]
        if not config.draws_lives and any(config.published.targets[target].acceleration):
            _accelerate(path, config.published.targets[target].acceleration, config.period)
        life = slice(life.start, life.start + len(path))
        exists[life, target] = True
        states[life, target], positions[life, target] = path[:, :4], path[:, 4:]
    if config.lag:
        states, exists, positions = _continued(config, streams, root, states, exists, positions)
    if config.sensor == "range-bearing":
        positions = _range_bearing(config, streams, states)
    measurements, source = _scan(config, streams, exists, positions)
    return ClutterEpisode(states, exists, measurements, source)


def _continued(
    config: ClutterConfig, streams: Streams, root: Array, states: Array, exists: Mask, positions: Array
) -> tuple[Array, Mask, Array]:
    """Append `lag` scans, which are never scored: targets go on, and none is born."""
    extra, n = config.lag, config.max_targets
    rng = streams[Stream.AFTER]
    noise = rng.standard_normal((n, extra + 1, 6))
    survives = rng.random((n, extra)) < (config.survival_probability if config.draws_lives else 1.0)
    lifetime = np.where(survives.all(axis=1), extra, survives.argmin(axis=1))
    more = [np.concatenate([a, np.zeros((extra, *a.shape[1:]), a.dtype)]) for a in (states, exists, positions)]
    now = len(states) - 1
    for target in np.flatnonzero(exists[now]).tolist():
        start, path = states[now, target], np.empty((1 + int(lifetime[target]), 6))
        # The pair of state and measured position is continued: under a pairwise model both influence the next step.
        noise[target, 0, 4:] = (positions[now, target] - start[[0, 2]]) / config.position_noise
        turns = np.full(len(path), _turn_rates(config, streams, target)[now])
        length = _simulate(
            config.motion.packed.transition,
            root,
            config.position_noise,
            start,
            noise[target],
            turns,
            config.half_width,
            path,
        )
        life = slice(now + 1, now + max(length, 1))
        more[0][life, target], more[1][life, target], more[2][life, target] = (
            path[1:length, :4],
            True,
            path[1:length, 4:],
        )
    return more[0], more[1], more[2]


def _births(config: ClutterConfig, streams: Streams) -> tuple[Labels, Labels, Array]:
    """First and last scan (counted from 0) of each target, and its first state."""
    scans = config.horizon + 1
    if not config.draws_lives:
        scale = config.half_width / 2000.0 if config.scenario == "paper" else 1.0
        present = [target for target in config.published.targets if target.first <= scans]
        first = np.array([target.first - 1 for target in present], dtype=np.int64)
        last = np.array([min(target.last or scans, scans) - 1 for target in present], dtype=np.int64)
        starts = np.array([target.state for target in present])
        starts[:, [0, 2]] *= scale
        return first, last, starts
    rng = streams[Stream.BIRTH]
    counts = rng.poisson(np.concatenate([[config.initial_targets], np.full(scans - 1, config.birth_rate)]))
    first = np.repeat(np.arange(scans), counts)[: config.max_targets]
    # Places are drawn for max_targets, so that the place of a target does not depend on the number of targets.
    anywhere = rng.uniform(-config.half_width, config.half_width, (config.max_targets, 2))
    site = rng.integers(0, len(config.sites), config.max_targets)
    about = config.birth_spread * rng.standard_normal((config.max_targets, 2))
    velocity = config.birth_speed * rng.standard_normal((config.max_targets, 2))
    position = anywhere if config.births == "anywhere" else config.sites[site] + about
    starts = np.stack([position[:, 0], velocity[:, 0], position[:, 1], velocity[:, 1]], axis=1)
    survives = streams[Stream.LIFETIME].random((config.max_targets, scans)) < config.survival_probability
    lifetime = np.where(survives.all(axis=1), scans, survives.argmin(axis=1) + 1)
    count = len(first)
    return first, np.minimum(first + lifetime[:count], scans) - 1, starts[:count]


def _draw_path(config: ClutterConfig, streams: Streams, target: int, start: Array, root: Array, life: slice) -> Array:
    """Return state and measured position of a target at every scan of its life, shape (scans alive, 6).

    In scenarios with given lifetimes the first path that stays inside the region is used. In others the target
    disappears when it leaves the region.
    """
    steps, total = life.stop - life.start, config.horizon + 1
    transition, rng = config.motion.packed.transition, streams[Stream.MOTION, target]
    turns, path = _turn_rates(config, streams, target)[life], np.empty((steps, 6))
    for _ in range(_MAX_DRAWS):
        noise = rng.standard_normal((steps, 6))
        length = _simulate(transition, root, config.position_noise, start, noise, turns, config.half_width, path)
        if length == steps or config.draws_lives:
            return path[:length]
        # Each path takes the noise of a whole episode, so that a change of the lifetime changes no other draw.
        rng.standard_normal((total - steps, 6))
    raise ValueError(
        f"no path of {steps} scans among {_MAX_DRAWS} stays inside half_width={config.half_width:g} m with "
        f"acceleration_noise={config.acceleration_noise:g}; widen half_width, or lower acceleration_noise or horizon"
    )


def _accelerate(path: Array, acceleration: tuple[float, float], period: float) -> None:
    """Add the effect of a constant acceleration, m/s^2, to a path of (state, measured position), in place."""
    time = period * np.arange(len(path))
    for axis, push in enumerate(acceleration):
        for column, moved in ((2 * axis, 0.5 * time**2), (2 * axis + 1, time), (4 + axis, 0.5 * time**2)):
            path[:, column] += push * moved


def turn_angles(config: ClutterConfig, seed: int) -> Array:
    """Angle by which the velocity of each target turns before each scan of an episode. Shape (K, n), rad."""
    streams = Streams(seed)
    turns = np.stack([_turn_rates(config, streams, target) for target in range(config.max_targets)], axis=1)
    return np.concatenate([turns, np.repeat(turns[-1:], config.lag, axis=0)])


def _path_through_middle(config: ClutterConfig, streams: Streams, target: int, root: Array) -> Array:
    """Return state and measured position of a target at every scan, shape (K, 6), drawn from the middle scan on.

    The state at the middle of the horizon is drawn first, then the path forward, and backward with the inverse motion
    and the same noise (Williams 2015, section V).
    """
    scans, middle = config.horizon + 1, (config.horizon - 1) // 2
    forward = config.motion.packed.transition[:4, :4]
    backward = np.asarray(np.linalg.inv(forward), np.float64)
    noise = streams[Stream.MOTION, target].standard_normal((scans + 1, 6))
    pushes = np.einsum("rj,kj->kr", root[:4, :4], noise[:, :4])
    path = np.empty((scans, 6))
    path[middle, :4] = math.sqrt(config.published.middle or 0.0) * noise[-1, :4]
    for k in range(middle + 1, scans):
        path[k, :4] = np.einsum("rj,j->r", forward, path[k - 1, :4]) + pushes[k]
    for k in range(middle - 1, -1, -1):
        path[k, :4] = np.einsum("rj,j->r", backward, path[k + 1, :4] + pushes[k])
    path[:, 4:] = path[:, [0, 2]] + config.position_noise * noise[:scans, 4:]
    return path


def _turn_rates(config: ClutterConfig, streams: Streams, target: int) -> Array:
    """Angle by which a target's velocity turns before each scan, shape (K,), rad."""
    scans = config.horizon + 1
    if config.maneuver_rate == 0.0 or config.max_turn_rate == 0.0:
        return np.zeros(scans)
    rng = streams[Stream.MANEUVER, target]
    new = rng.random(scans) < config.maneuver_rate
    rates = rng.uniform(-config.max_turn_rate, config.max_turn_rate, scans)
    latest = np.maximum.accumulate(np.where(new, np.arange(scans), -1))
    return np.where(latest >= 0, rates[latest], 0.0) * config.period


@njit(cache=True, nogil=True)
def _simulate(transition, root, spread, start, noise, turns, half_width, path):  # type: ignore[no-untyped-def]
    """Fill a path of (state, measured position) until it leaves the region. Return its length.

    The velocity of a turning target is rotated before every step. Position, measurement error and noise are not.
    """
    steps, size = path.shape
    for r in range(4):
        path[0, r] = start[r]
    for r in range(2):
        path[0, 4 + r] = start[2 * r] + spread * noise[0, 4 + r]
    before = np.empty(size)
    for length in range(steps):
        if not (abs(path[length, 0]) <= half_width and abs(path[length, 2]) <= half_width):
            return length
        if length + 1 == steps:
            break
        for r in range(size):
            before[r] = path[length, r]
        turn = turns[length + 1]
        if turn != 0.0:
            c, s = np.cos(turn), np.sin(turn)
            before[1] = c * path[length, 1] - s * path[length, 3]
            before[3] = s * path[length, 1] + c * path[length, 3]
        for r in range(size):
            value = 0.0
            for j in range(size):
                value += transition[r, j] * before[j]
            for j in range(r + 1):
                value += root[r, j] * noise[length + 1, j]
            path[length + 1, r] = value
    return steps


def _range_bearing(config: ClutterConfig, streams: Streams, states: Array) -> Array:
    """Noisy range and bearing of every target, shape (K, n, 2)."""
    x, y = config.sensor_position
    dx, dy = states[..., 0] - x, states[..., 2] - y
    noise = streams[Stream.SENSOR_NOISE].standard_normal((*dx.shape, 2))
    exact = np.stack([np.hypot(dx, dy), direction(dy, dx)], axis=-1)
    return exact + noise * np.array([config.range_noise, config.bearing_noise])


def _scan(config: ClutterConfig, streams: Streams, exists: Mask, values: Array) -> tuple[Array, Labels]:
    """Return the shuffled detections and clutter of all scans: measurements (K, M, 3) and sources (K, M)."""
    scans, n = exists.shape
    rows = config.measurement_rows
    most = poisson_quantile(config.clutter_rate)
    detected = exists & (streams[Stream.DETECTION].random((scans, n)) < config.detection_probability)
    counts = np.minimum(streams[Stream.CLUTTER_COUNT].poisson(config.clutter_rate, scans), most)
    seen_low, seen_high = config.seen
    clutter = seen_low + (seen_high - seen_low) * streams[Stream.CLUTTER].random((scans, most, 2))
    order = streams[Stream.SHUFFLE].random((scans, n + most))
    low, high = config.measurement_bounds
    measurements, source = np.zeros((scans, rows, 3)), np.full((scans, rows), -2, dtype=np.int64)
    _fill_scans(detected, values, counts, clutter, order, np.array([low, high]), measurements, source)
    return measurements, source


@njit(cache=True, nogil=True)
def _fill_scans(detected, values, counts, clutter, order, bounds, measurements, source):  # type: ignore[no-untyped-def]
    """Write the detections and the clutter of all scans in the order of random numbers."""
    scans, n = detected.shape
    ranked = np.empty(n + clutter.shape[1], np.int64)
    origin = np.empty_like(ranked)
    for scan in range(scans):
        targets = 0
        for target in range(n):
            if detected[scan, target]:
                origin[targets] = target
                targets += 1
        # If the rows do not suffice, only clutter is dropped.
        members = targets + min(counts[scan], measurements.shape[1] - targets)
        for member in range(members):
            row = member
            while row > 0 and order[scan, ranked[row - 1]] > order[scan, member]:
                ranked[row] = ranked[row - 1]
                row -= 1
            ranked[row] = member
        for row in range(members):
            member = ranked[row]
            real = member < targets
            source[scan, row] = origin[member] if real else -1
            measurements[scan, row, 0] = 1.0
            for axis in range(2):
                value = values[scan, origin[member], axis] if real else clutter[scan, member - targets, axis]
                measurements[scan, row, 1 + axis] = min(max(value, bounds[0, axis]), bounds[1, axis])
