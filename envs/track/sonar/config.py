"""Every parameter of the sonar world, and the levels that set them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np

from servotrack.envs.arguments import check_fields, check_keywords, check_level
from servotrack.estimators.sonar.array import Band, LineArray, Shading, bearings
from servotrack.estimators.types import Array

VARIANTS = ("rates", "cross30", "random", "trial")
"""Scenes: two readings of the paper's simulation, scenes drawn anew, and a stand-in for its sea trial."""
FIDELITIES = ("snapshots", "gamma")
SHADINGS = get_args(Shading)

PAPER_COUNT = 2
"""Targets of the paper's simulation."""
TRIAL_COUNT = 6
"""Most targets of the sea trial, its interferer among them."""
TONE_SNR, BROADBAND_SNR = -15.0, -10.0
"""Of the paper's two targets in one element, over all its noise up to `SAMPLED_BAND`, dB."""
DRAWN_SNR = (-26.0, -14.0)
"""Of targets that are drawn, likewise, dB."""
LOUD_SNR = -5.0
"""Of the trial's interferer, dB."""
SAMPLED_BAND = 6000.0
"""SNRs are of an element's whole power, up to half the sampling frequency of 12 kHz, Hz."""


@dataclass(frozen=True)
class SonarConfig:
    """All that defines a sonar world.

    Attributes:
        variant: `rates` (the paper's simulation with its bearing rates, tracks cross after 40 s), `cross30` (with its
            crossing after 30 s), `random` (targets drawn anew), `trial` (a stand-in for the paper's sea trial: 4 to 6
            targets, one of them loud, at least 3 crossings).
        horizon: Records of an episode that are scored.
        lag: Records by which answers are late: the answer to record k is for record k - lag.
        snr_offset: Added to the signal-to-noise ratio of every target, dB.
        fidelity: `gamma` (beam powers drawn with the mean, variance and correlation that snapshots would give) or
            `snapshots` (spectra at the elements, beamformed).
        elements: Of the uniform line array.
        spacing: Between elements, m.
        sound_speed: m/s.
        band_low: First frequency that is received, Hz.
        band_high: Last one, Hz.
        bin_width: Of a frequency bin, Hz; a snapshot lasts its inverse.
        snapshots: Averaged in a record.
        beams: Look directions from 0 to 180 deg.
        shading: `conventional` or `chebyshev` (sidelobes 30 dB down).
        ambient_slope: By how much the ambient noise falls with frequency, dB per octave.
        max_targets: Most targets of an episode.
        targets: Their number (`random`); None: uniform from 1 to `max_targets`.
        shortest_life: Records for which a target is at least there (`random`).
        max_rate: Largest bearing rate of a new target, deg/s (`random`, `trial`).
        rate_noise: Standard deviation of a rate's change from record to record, deg/s (`random`, `trial`).
        bearing_jitter: First bearings of the paper's targets are drawn within this of the paper's, deg.
        rate_jitter: Their rates likewise, deg/s.
        max_estimates: Rows of an action; None: 2 max_targets + 8.
        cutoff: The c of reward and scores, deg.
    """

    variant: str = "rates"
    horizon: int = 60
    lag: int = 5
    snr_offset: float = 0.0
    fidelity: str = "gamma"
    elements: int = 48
    spacing: float = 0.5
    sound_speed: float = 1500.0
    band_low: float = 500.0
    band_high: float = 1600.0
    bin_width: float = 10.0
    snapshots: int = 10
    beams: int = 721
    shading: str = "conventional"
    ambient_slope: float = 0.0
    max_targets: int = 6
    targets: int | None = None
    shortest_life: int = 30
    max_rate: float = 1.5
    rate_noise: float = 0.0
    bearing_jitter: float = 0.5
    rate_jitter: float = 0.05
    max_estimates: int | None = None
    cutoff: float = 5.0

    def __post_init__(self) -> None:
        """Check every field; raises ValueError that names the argument, the value and what would be right."""
        for name, options in (("variant", VARIANTS), ("fidelity", FIDELITIES), ("shading", SHADINGS)):
            if getattr(self, name) not in options:
                raise ValueError(f"{name} must be one of {', '.join(options)}, got {getattr(self, name)!r}")
        check_fields(self, _BOUNDS, _WHOLE, frozenset({"targets", "max_estimates"}))
        if self.band_low > self.band_high:
            raise ValueError(f"band_low must not exceed band_high, got {self.band_low:g} above {self.band_high:g}")
        if self.targets is not None and self.targets > self.max_targets:
            raise ValueError(
                f"targets must not exceed max_targets = {self.max_targets}, got {self.targets}; raise max_targets"
            )
        size = len(self.band.frequencies) * (2 * self.elements - 1) * self.beams * 8
        if self.fidelity == "snapshots" and size > _MOST_BYTES:
            raise ValueError(
                f"fidelity 'snapshots' would need {size / 2**30:.1f} GiB for {len(self.band.frequencies)} bins, "
                f"{self.elements} elements and {self.beams} beams; lower one of them, or choose fidelity='gamma'"
            )
        needed = {"rates": PAPER_COUNT, "cross30": PAPER_COUNT, "trial": TRIAL_COUNT}.get(self.variant, 0)
        if self.max_targets < needed:
            raise ValueError(
                f"max_targets must be at least {needed} in variant {self.variant!r}, got {self.max_targets}; choose "
                "variant='random'"
            )

    @property
    def period(self) -> float:
        """Time between records, s."""
        return self.snapshots / self.bin_width

    @cached_property
    def array(self) -> LineArray:
        """The receiver."""
        return LineArray(self.elements, self.spacing, self.sound_speed)

    @cached_property
    def band(self) -> Band:
        """The frequencies that it sums over."""
        return Band(self.band_low, self.band_high, self.bin_width)

    @cached_property
    def beam_bearings(self) -> Array:
        """Look directions, shape (beams,), deg."""
        return bearings(self.beams)

    @cached_property
    def ambient(self) -> Array:
        """Noise power of one element in each bin of the band, mean 1. Shape (F,)."""
        frequencies = self.band.frequencies
        power = 10.0 ** (-self.ambient_slope / 10.0 * np.log2(frequencies / frequencies[0]))
        return power / power.mean()

    @property
    def averages(self) -> int:
        """Bins times snapshots, the averages in one beam power."""
        return len(self.band.frequencies) * self.snapshots

    @property
    def noise_bins(self) -> float:
        """Bins up to `SAMPLED_BAND`: the noise power of an element, in powers of one bin."""
        return SAMPLED_BAND / self.bin_width

    @property
    def most_power(self) -> float:
        """What a beam power, over its noise level, is cut at: twice what the loudest scene has in one beam."""
        loudest = [TONE_SNR, BROADBAND_SNR]
        if self.variant not in ("rates", "cross30"):
            loudest = [DRAWN_SNR[1]] * self.max_targets
        if self.variant == "trial":
            loudest[0] = LOUD_SNR
        elements = sum(10.0 ** ((snr + self.snr_offset) / 10.0) for snr in loudest)
        return 2.0 + 2.0 * self.elements * self.noise_bins * elements / len(self.band.frequencies)

    @property
    def estimate_rows(self) -> int:
        """Rows of an action."""
        return 2 * self.max_targets + 8 if self.max_estimates is None else self.max_estimates


_RANDOM = {"horizon": 120, "rate_noise": 0.02}
_TRIAL = {"horizon": 180, "max_rate": 1.0, "rate_noise": 0.02, "ambient_slope": 5.0}
_VARIANTS: dict[str, dict[str, Any]] = {"rates": {}, "cross30": {}, "random": _RANDOM, "trial": _TRIAL}
_LEVELS: tuple[dict[str, Any], ...] = (
    {"variant": "rates"},
    {"variant": "cross30"},
    {"variant": "random"},
    {"variant": "trial"},
    {"variant": "cross30", "snr_offset": -20.0},
    {"variant": "random", "targets": 0},
)

LEVEL_NAMES = ("rates", "cross30", "random", "trial", "faint", "noise")
AXES = tuple(f.name for f in fields(SonarConfig))


def sonar_config(level: int = 0, **axes: Any) -> SonarConfig:
    """The configuration of a level, with single parameters overridden.

    Args:
        level: 0 `rates`, 1 `cross30`, 2 `random`, 3 `trial`, 4 `faint` (`cross30`, 20 dB below), 5 `noise` (nothing).
        **axes: Fields of `SonarConfig`; with another `variant` than the level's, that variant's values stand for the
            level's.

    Raises:
        ValueError: A level that does not exist, or a value outside its bounds.
        TypeError: An unknown keyword; the message suggests the nearest known one.
    """
    settings = _LEVELS[check_level(level, len(_LEVELS))]
    check_keywords(axes, AXES)
    variant = axes.get("variant", settings["variant"])
    if variant != settings["variant"]:
        settings = {}
    return replace(SonarConfig(), **{**_VARIANTS.get(variant, {}), **settings, "variant": variant, **axes})


_BOUNDS: tuple[tuple[str, float, float], ...] = (
    ("horizon", 1, 100_000),
    ("lag", 0, 1000),
    ("snr_offset", -60.0, 40.0),
    ("elements", 2, 256),
    ("spacing", 1e-3, 100.0),
    ("sound_speed", 100.0, 10_000.0),
    ("band_low", 1.0, SAMPLED_BAND),
    ("band_high", 1.0, SAMPLED_BAND),
    ("bin_width", 1.0, 1000.0),
    ("snapshots", 1, 1000),
    ("beams", 19, 3601),
    ("ambient_slope", -20.0, 20.0),
    ("max_targets", 1, 20),
    ("targets", 0, 20),
    ("shortest_life", 1, 100_000),
    ("max_rate", 0.0, 10.0),
    ("rate_noise", 0.0, 10.0),
    ("bearing_jitter", 0.0, 20.0),
    ("rate_jitter", 0.0, 1.0),
    ("max_estimates", 1, 1000),
    ("cutoff", 1e-3, 180.0),
)
_WHOLE = frozenset(
    {"horizon", "lag", "elements", "snapshots", "beams", "max_targets", "targets", "shortest_life", "max_estimates"}
)
_MOST_BYTES = 2**31
"""Of the beamformer's table."""
