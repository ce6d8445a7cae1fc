"""Parameters of the sonar environment, and the levels that set them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np

from servotrack.envs.arguments import check_fields, check_keywords, check_level
from servotrack.estimators.elementary import sum_in_order
from servotrack.estimators.sonar.array import Band, LineArray, Shading, bearings
from servotrack.estimators.types import Array

VARIANTS = ("rates", "cross30", "random", "trial")
"""Scenes: two versions of the simulation of Jiang and Zhou 2016, random scenes, and a substitute for its sea trial."""
FIDELITIES = ("snapshots", "gamma")
SHADINGS = get_args(Shading)

PAPER_COUNT = 2
"""Number of targets of the simulation of Jiang and Zhou 2016."""
TRIAL_COUNT = 6
"""Maximum number of targets of the sea trial, including its interferer."""
TONE_SNR, BROADBAND_SNR = -15.0, -10.0
"""SNR of the two targets of the simulation in one element, relative to its noise up to `SAMPLED_BAND`, dB."""
DRAWN_SNR = (-26.0, -14.0)
"""Range of the SNR of random targets in one element, dB."""
LOUD_SNR = -5.0
"""SNR of the interferer of the sea trial in one element, dB."""
SAMPLED_BAND = 6000.0
"""Upper limit of the band in which SNRs are defined, Hz: half the sampling frequency of 12 kHz."""


@dataclass(frozen=True)
class SonarConfig:
    """Parameters of a sonar environment.

    Attributes:
        variant: Kind of scene: `rates` (simulation of Jiang and Zhou 2016 with its bearing rates; the tracks cross
            after 40 s), `cross30` (the same, crossing after 30 s), `random` (random targets), `trial` (substitute for
            its sea trial: 4 to 6 targets, one of them loud, at least 3 crossings).
        horizon: Number of scored records of an episode.
        lag: Delay of answers, records: the answer to record k is for record k - lag. Larger values give smoothers more
            data.
        snr_offset: Offset added to the SNR of every target, dB. Negative values make the task harder.
        fidelity: `gamma` (beam powers are drawn from their mean, variance and correlation; fast) or `snapshots`
            (spectra at the elements are drawn and beamformed).
        elements: Number of elements of the uniform line array.
        spacing: Distance between elements, m.
        sound_speed: Speed of sound, m/s.
        band_low: Lowest received frequency, Hz.
        band_high: Highest received frequency, Hz.
        bin_width: Width of a frequency bin, Hz. The duration of a snapshot is its inverse.
        snapshots: Number of snapshots averaged in a record. More snapshots lower the noise and lengthen the period.
        beams: Number of beams, with bearings from 0 to 180 deg.
        shading: `conventional` or `chebyshev` (sidelobes at -30 dB).
        ambient_slope: Decrease of the ambient noise with frequency, dB per octave.
        max_targets: Maximum number of targets in an episode.
        targets: Number of targets (`random`); None: uniform from 1 to `max_targets`.
        shortest_life: Minimum lifetime of a target, records (`random`).
        max_rate: Maximum bearing rate of a new target, deg/s (`random`, `trial`).
        rate_noise: Standard deviation of the change of a rate per record, deg/s (`random`, `trial`).
        bearing_jitter: Maximum deviation of initial bearings from those of the simulation, deg (`rates`, `cross30`).
        rate_jitter: Maximum deviation of bearing rates from those of the simulation, deg/s (`rates`, `cross30`).
        max_estimates: Rows of an action; None: 2 max_targets + 8.
        cutoff: Cut-off c of the reward and of OSPA, GOSPA and OSPA(2), deg.
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
        """Check every field. A ValueError names the argument, its value and the valid values."""
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
        if self.fidelity == "snapshots" and size > _MAX_TABLE_BYTES:
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
        """Line array of the receiver."""
        return LineArray(self.elements, self.spacing, self.sound_speed)

    @cached_property
    def band(self) -> Band:
        """Frequency bins that a beam power sums over."""
        return Band(self.band_low, self.band_high, self.bin_width)

    @cached_property
    def beam_bearings(self) -> Array:
        """Bearings of the beams, shape (beams,), deg."""
        return bearings(self.beams)

    @cached_property
    def ambient(self) -> Array:
        """Noise power of one element in each bin of the band, shape (F,); the mean is 1."""
        octaves = [math.log2(ratio) for ratio in (self.band.frequencies / self.band_low).tolist()]
        # NumPy's own power and logarithm differ in the last bit between versions and processors.
        power = np.array([10.0 ** (-self.ambient_slope / 10.0 * octave) for octave in octaves])
        return power / (sum_in_order(power) / len(power))

    @property
    def averages(self) -> int:
        """Number of averages in one beam power: bins times snapshots."""
        return len(self.band.frequencies) * self.snapshots

    @property
    def noise_bins(self) -> float:
        """Number of bins up to `SAMPLED_BAND`: the ratio of the noise power of an element to that of one bin."""
        return SAMPLED_BAND / self.bin_width

    @property
    def max_power(self) -> float:
        """Upper bound of beam powers, relative to the noise level: twice the power of the loudest scene in one beam."""
        loudest = [TONE_SNR, BROADBAND_SNR]
        if self.variant not in ("rates", "cross30"):
            loudest = [DRAWN_SNR[1]] * self.max_targets
        if self.variant == "trial":
            loudest[0] = LOUD_SNR
        elements = sum_in_order([10.0 ** ((snr + self.snr_offset) / 10.0) for snr in loudest])
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
    """Return the configuration of a level, with some parameters overridden.

    Args:
        level: 0 `rates`, 1 `cross30`, 2 `random`, 3 `trial`, 4 `faint` (`cross30` with -20 dB), 5 `noise` (no targets).
        **axes: Fields of `SonarConfig` with the values to use. Another `variant` than that of the level replaces the
            values of the level by the defaults of that variant.

    Raises:
        ValueError: If the level does not exist or a value is outside its bounds.
        TypeError: If a keyword is unknown; the message suggests the nearest known one.
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
_MAX_TABLE_BYTES = 2**31
"""Maximum size of the beamformer's table, bytes."""
