"""Random draws of one sonar episode: lifetimes, bearings, rates and sounds of the targets."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.sonar.config import BROADBAND_SNR, DRAWN_SNR, LOUD_SNR, TONE_SNR, TRIAL_COUNT, SonarConfig
from servotrack.estimators.types import Array, Mask

PAPER_TONE = 1500.0
"""Frequency of the tonal target of the variants `rates` and `cross30`, Hz."""
BROADBAND = (500.0, 1500.0)
"""Band of broadband targets, Hz."""
TONES = (800.0, 1500.0)
"""Range of the frequencies of random tones, Hz."""

MEETING_DISTANCE = 5.0
"""Bearing difference below which two targets meet, deg."""
LONGEST_MEETING = 20.0
"""Longest time that two targets may stay within `MEETING_DISTANCE`, s: beyond it no tracker could separate them."""
TRIAL_CROSSINGS = 3
"""Minimum number of crossings of a trial."""
_TRIAL_MIN_TARGETS = 4
_TRIAL_LENGTH = 180.0
"""Duration of a whole trial, s."""
_BEARING_RANGE = (20.0, 160.0)
"""Range of first and last bearings of random targets, deg. Beyond it the beams of a line array are broad."""
_LOUD_RATE = 0.2
"""Maximum rate of the interferer of a trial, deg/s."""
_ATTEMPTS = 100
"""Number of draws for one target, and for one trial, before drawing fails."""


class Stream(IntEnum):
    """Child streams of an episode's seed. The numbers must never change; new streams are appended."""

    NUMBER = 0
    LIFE = 1
    MOTION = 2
    SOUND = 3
    JITTER = 4
    RECORD = 5


class PaperTarget(NamedTuple):
    """A target of `rates` and `cross30`: first and last time (s), first bearing (deg), sign of the rate, tone (Hz)."""

    first: float
    last: float
    bearing: float
    direction: float
    tone: float | None


PAPER_TARGETS = (
    PaperTarget(10.0, 48.0, 45.0, 1.0, PAPER_TONE),
    PaperTarget(10.0, 45.0, 105.0, -1.0, None),
)
PAPER_RATES = {"rates": 1.0, "cross30": 1.5}
"""Bearing rates, deg/s: those of Jiang and Zhou 2016, and those with which the tracks cross at their 30 s."""


@dataclass(frozen=True)
class SonarScene:
    """One episode without its noise; K = horizon + lag + 1 records, n = max_targets.

    Attributes:
        bearings: Bearings at the middle of each record, shape (K, n), deg; zeros where a target does not exist.
        rates: Bearing rates, shape (K, n), deg/s.
        exists: Targets that exist, shape (K, n), bool.
        power: Power of each target in each bin, per element, relative to the mean noise of one bin, shape (n, F).
        tonal: True for tonal targets, False for broadband ones, shape (n,), bool.
    """

    bearings: Array
    rates: Array
    exists: Mask
    power: Array
    tonal: Mask


class _Target(NamedTuple):
    first: int
    last: int
    bearings: Array
    rates: Array
    power: Array
    tonal: bool


def draw_scene(config: SonarConfig, seed: int) -> SonarScene:
    """Draw the targets of an episode.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, a non-negative integer.

    Raises:
        ValueError: If no separable set of targets or no trial with enough crossings was found.
    """
    streams = Streams(seed)
    records, n = config.horizon + config.lag + 1, config.max_targets
    bins = len(config.band.frequencies)
    scene = SonarScene(
        np.zeros((records, n)),
        np.zeros((records, n)),
        np.zeros((records, n), np.bool_),
        np.zeros((n, bins)),
        np.zeros(n, np.bool_),
    )
    for column, target in enumerate(_targets(config, streams)):
        life = slice(target.first, min(target.last + 1, records))
        shown = slice(0, max(life.stop - life.start, 0))
        scene.exists[life, column] = True
        scene.bearings[life, column], scene.rates[life, column] = target.bearings[shown], target.rates[shown]
        scene.power[column], scene.tonal[column] = target.power, target.tonal
    return scene


def crossings(bearings: Array, exists: Mask) -> list[tuple[int, int, int]]:
    """Find the records at which two targets have crossed.

    Args:
        bearings: Bearings, shape (K, n), deg.
        exists: Targets that exist, shape (K, n).

    Returns:
        Tuples (first record after the crossing, target, other target), ordered by pairs.
    """
    found = []
    for i in range(bearings.shape[1]):
        for j in range(i + 1, bearings.shape[1]):
            both = np.flatnonzero(exists[:, i] & exists[:, j])
            ahead = bearings[both, i] > bearings[both, j]
            found += [(int(both[k + 1]), i, j) for k in np.flatnonzero(ahead[1:] != ahead[:-1]).tolist()]
    return found


def _targets(config: SonarConfig, streams: Streams) -> list[_Target]:
    if config.variant in PAPER_RATES:
        return _paper_targets(config, streams)
    if config.variant == "trial":
        return _trial_targets(config, streams)
    count = int(streams[Stream.NUMBER].integers(1, config.max_targets + 1))
    drawn = _draw_targets(config, streams, count if config.targets is None else config.targets, 0)
    if drawn is None:
        raise ValueError(
            f"no place was found for {config.targets or count} targets that meet for at most {LONGEST_MEETING:g} s; "
            "lower targets or max_targets, or raise max_rate"
        )
    return drawn


def _paper_targets(config: SonarConfig, streams: Streams) -> list[_Target]:
    end = config.horizon + config.lag
    jitter = streams[Stream.JITTER].uniform(-1.0, 1.0, (len(PAPER_TARGETS), 2))
    targets = []
    for target, (shift, change) in zip(PAPER_TARGETS, jitter.tolist(), strict=True):
        first, last = round(target.first / config.period), min(round(target.last / config.period), end)
        if first > end:
            continue
        rate = target.direction * PAPER_RATES[config.variant] + change * config.rate_jitter
        start = target.bearing + shift * config.bearing_jitter
        bearings, rates = _reflected(
            start + rate * config.period * np.arange(last - first + 1), np.full(last - first + 1, rate)
        )
        power = _power(config, TONE_SNR if target.tone else BROADBAND_SNR, target.tone)
        targets.append(_Target(first, last, bearings, rates, power, target.tone is not None))
    return targets


def _trial_targets(config: SonarConfig, streams: Streams) -> list[_Target]:
    count = int(streams[Stream.NUMBER].integers(_TRIAL_MIN_TARGETS, TRIAL_COUNT + 1))
    for attempt in range(_ATTEMPTS):
        drawn = _draw_targets(config, streams, count, attempt)
        if drawn is not None and _count_crossings(drawn, _span(config)) >= TRIAL_CROSSINGS:
            return drawn
    raise ValueError(f"no scene of {count} targets with {TRIAL_CROSSINGS} crossings was found; raise max_rate")


def _draw_targets(config: SonarConfig, streams: Streams, count: int, attempt: int) -> list[_Target] | None:
    """Return separable targets, or None if no place was found for one of them."""
    targets: list[_Target] = []
    while len(targets) < count:
        for trial in range(_ATTEMPTS):
            new = _draw_target(config, streams, (attempt, len(targets), trial))
            if all(_separable(new, other, config) for other in targets):
                targets.append(new)
                break
        else:
            return None
    return targets


def _draw_target(config: SonarConfig, streams: Streams, key: tuple[int, int, int]) -> _Target:
    loud = config.variant == "trial" and key[1] == 0
    span = _span(config)
    most = span + config.lag
    part, length, place, aim = streams[(Stream.LIFE, *key)].random(4).tolist()  # type: ignore[index]
    shortest = span // 2 if config.variant == "trial" else min(config.shortest_life, span)
    alive = shortest + round(length * (span - shortest))
    first = round(part * (span - alive))
    # A target that exists at the last scored record also exists during the lag.
    last = most if first + alive >= span else first + alive - 1
    if loud:
        first, alive, last = 0, span, most
    low, high = _BEARING_RANGE
    start, end = low + (high - low) * place, low + (high - low) * aim
    fastest = _LOUD_RATE if loud else config.max_rate
    rate = float(np.clip((end - start) / (alive * config.period), -fastest, fastest))
    noise = config.rate_noise * streams[(Stream.MOTION, *key)].standard_normal(most + 1)  # type: ignore[index]
    if loud:
        noise = noise * _LOUD_RATE / max(config.max_rate, _LOUD_RATE)
    rates = rate + np.concatenate([[0.0], np.cumsum(noise)[: last - first]])
    path = start + config.period * np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2.0)])
    bearings, rates = _reflected(path, rates)
    kind, pitch, level = streams[(Stream.SOUND, *key)].random(3).tolist()  # type: ignore[index]
    tone = TONES[0] + pitch * (TONES[1] - TONES[0]) if kind < 0.5 and not loud else None
    snr = LOUD_SNR if loud else DRAWN_SNR[0] + level * (DRAWN_SNR[1] - DRAWN_SNR[0])
    return _Target(first, last, bearings, rates, _power(config, snr, tone), tone is not None)


def _power(config: SonarConfig, snr: float, tone: float | None) -> Array:
    """Return the power in each bin, per element, relative to the mean noise of one bin, shape (F,)."""
    frequencies = config.band.frequencies
    total = config.noise_bins * 10.0 ** ((snr + config.snr_offset) / 10.0)
    if tone is not None:
        own = np.abs(frequencies - tone)
        # Ties go to the lower bin. A tone outside the band is not received.
        return np.where(np.arange(len(own)) == own.argmin(), total, 0.0) * (own.min() <= config.bin_width / 2.0)
    inside = (frequencies >= BROADBAND[0]) & (frequencies < BROADBAND[1])
    return inside * total * config.bin_width / (BROADBAND[1] - BROADBAND[0])


def _reflected(bearings: Array, rates: Array) -> tuple[Array, Array]:
    """Map bearings to 0 to 180 deg by reflection, because a line array cannot distinguish its two sides."""
    turned = bearings % 360.0
    behind = turned > 180.0
    return np.where(behind, 360.0 - turned, turned), np.where(behind, -rates, rates)


def _span(config: SonarConfig) -> int:
    """Return the number of records a scene is drawn for. A shorter trial is the first part of a whole one."""
    return max(config.horizon, round(_TRIAL_LENGTH / config.period)) if config.variant == "trial" else config.horizon


def _overlap(one: _Target, other: _Target, span: int) -> tuple[Array, Array]:
    """Return the bearings of both targets at the records, without the lag, at which both exist."""
    first, last = max(one.first, other.first), min(one.last, other.last, span - 1)
    if first > last:
        return np.zeros(0), np.zeros(0)
    return one.bearings[first - one.first : last + 1 - one.first], other.bearings[
        first - other.first : last + 1 - other.first
    ]


def _separable(one: _Target, other: _Target, config: SonarConfig) -> bool:
    """Return True if two targets meet only briefly, and neither begins or ends close to the other."""
    a, b = _overlap(one, other, _span(config))
    near = np.abs(a - b) < MEETING_DISTANCE
    if len(near) and (near[0] or near[-1]):
        return False
    edges = np.flatnonzero(np.diff(near, prepend=False, append=False))
    return int((edges[1::2] - edges[::2]).max(initial=0)) * config.period <= LONGEST_MEETING


def _count_crossings(targets: list[_Target], span: int) -> int:
    """Return the number of changes in the order of the bearings of two targets."""
    total = 0
    for i, one in enumerate(targets):
        for other in targets[i + 1 :]:
            a, b = _overlap(one, other, span)
            total += int(np.count_nonzero(np.diff(a > b)))
    return total
