"""What fate deals an episode of the sonar world: who is where, when, how fast, and how it sounds."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.sonar.config import BROADBAND_SNR, DRAWN_SNR, LOUD_SNR, TONE_SNR, TRIAL_COUNT, SonarConfig
from servotrack.estimators.types import Array, Mask

PAPER_TONE = 1500.0
"""Hz."""
BROADBAND = (500.0, 1500.0)
"""Hz."""
TONES = (800.0, 1500.0)
"""Tones of drawn targets lie between, Hz."""

CLOSE = 5.0
"""Targets nearer to each other meet, deg."""
LONGEST_MEETING = 20.0
"""s; whoever keeps longer beside another one could not be told apart by anybody."""
TRIAL_CROSSINGS = 3
"""A trial has at least as many crossings."""
_TRIAL_LEAST = 4
_TRIAL_LENGTH = 180.0
"""s."""
_INSIDE = (20.0, 160.0)
"""Drawn targets begin and end between, deg; beyond, the beams of a line array are broad."""
_LOUD_RATE = 0.2
"""Largest rate of the trial's interferer, deg/s."""
_ATTEMPTS = 100


class Stream(IntEnum):
    """Child streams of an episode's seed. Appending one shifts no other; the numbers must never change."""

    NUMBER = 0
    LIFE = 1
    MOTION = 2
    SOUND = 3
    JITTER = 4
    RECORD = 5


class PaperTarget(NamedTuple):
    """A target of the paper's simulation: first and last instant (s), first bearing (deg), and the sign of its rate."""

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
"""Bearing rates, deg/s: the paper's, and those with which the tracks cross when the paper says, after 30 s."""


@dataclass(frozen=True)
class SonarScene:
    """One episode without its noise; K = horizon + lag + 1 records, n = max_targets.

    Attributes:
        bearings: In the middle of each record, shape (K, n), deg; zeros where a target does not exist.
        rates: Shape (K, n), deg/s.
        exists: Shape (K, n), bool.
        power: Of each target in each bin, per element, over the mean noise of one bin. Shape (n, F).
        tonal: Whether a target is one steady tone. Shape (n,), bool.
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
    """Draw who is there.

    Args:
        config: The world.
        seed: Non-negative integer.

    Raises:
        ValueError: So many targets that no place for one of them was found.
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
    """Where bearings of two targets change their order.

    Args:
        bearings: Shape (K, n), deg.
        exists: Shape (K, n).

    Returns:
        (record after which they have crossed, target, other target), in the order of the pairs.
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
    count = int(streams[Stream.NUMBER].integers(_TRIAL_LEAST, TRIAL_COUNT + 1))
    for attempt in range(_ATTEMPTS):
        drawn = _draw_targets(config, streams, count, attempt)
        if drawn is not None and _met(drawn, _span(config)) >= TRIAL_CROSSINGS:
            return drawn
    raise ValueError(f"no scene of {count} targets with {TRIAL_CROSSINGS} crossings was found; raise max_rate")


def _draw_targets(config: SonarConfig, streams: Streams, count: int, attempt: int) -> list[_Target] | None:
    """Targets that can be told apart, or None where there was no room for one of them."""
    targets: list[_Target] = []
    while len(targets) < count:
        for trial in range(_ATTEMPTS):
            new = _draw_target(config, streams, (attempt, len(targets), trial))
            if all(_can_be_told_apart(new, other, config) for other in targets):
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
    # Whoever is there at the end of what is scored is there beyond it, too.
    last = most if first + alive >= span else first + alive - 1
    if loud:
        first, alive, last = 0, span, most
    low, high = _INSIDE
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
    """Power in each bin of the band, per element, over the mean noise of one bin; shape (F,)."""
    frequencies = config.band.frequencies
    total = config.noise_bins * 10.0 ** ((snr + config.snr_offset) / 10.0)
    if tone is not None:
        own = np.abs(frequencies - tone)
        # Ties go to the lower bin; a tone outside the band is not received.
        return np.where(np.arange(len(own)) == own.argmin(), total, 0.0) * (own.min() <= config.bin_width / 2.0)
    inside = (frequencies >= BROADBAND[0]) & (frequencies < BROADBAND[1])
    return inside * total * config.bin_width / (BROADBAND[1] - BROADBAND[0])


def _reflected(bearings: Array, rates: Array) -> tuple[Array, Array]:
    """Bearings from 0 to 180: a line array cannot tell its sides apart, so that who crosses its axis turns back."""
    turned = bearings % 360.0
    behind = turned > 180.0
    return np.where(behind, 360.0 - turned, turned), np.where(behind, -rates, rates)


def _span(config: SonarConfig) -> int:
    """Records that a scene is drawn for: those that are scored; a shorter trial is the first part of a whole one."""
    return max(config.horizon, round(_TRIAL_LENGTH / config.period)) if config.variant == "trial" else config.horizon


def _overlap(one: _Target, other: _Target, span: int) -> tuple[Array, Array]:
    """Bearings of both while both are there, so far as the lag does not matter."""
    first, last = max(one.first, other.first), min(one.last, other.last, span - 1)
    if first > last:
        return np.zeros(0), np.zeros(0)
    return one.bearings[first - one.first : last + 1 - one.first], other.bearings[
        first - other.first : last + 1 - other.first
    ]


def _can_be_told_apart(one: _Target, other: _Target, config: SonarConfig) -> bool:
    """Whether two targets meet for a short time only, and neither begins or ends where the other one is."""
    a, b = _overlap(one, other, _span(config))
    near = np.abs(a - b) < CLOSE
    if len(near) and (near[0] or near[-1]):
        return False
    edges = np.flatnonzero(np.diff(near, prepend=False, append=False))
    return int((edges[1::2] - edges[::2]).max(initial=0)) * config.period <= LONGEST_MEETING


def _met(targets: list[_Target], span: int) -> int:
    """How often the order of two targets' bearings changes."""
    total = 0
    for i, one in enumerate(targets):
        for other in targets[i + 1 :]:
            a, b = _overlap(one, other, span)
            total += int(np.count_nonzero(np.diff(a > b)))
    return total
