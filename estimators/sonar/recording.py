"""From hydrophone signals to a bearing-time record: snapshots, equalized spectra, beam powers, notes on the data."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servotrack.estimators.sonar.array import Band
from servotrack.estimators.sonar.beamforming import Beamformer, beam_powers
from servotrack.estimators.sonar.elements import AnyArray, ElementArray, aliasing_note
from servotrack.estimators.sonar.tracker import HMMBearings
from servotrack.estimators.types import Array, ComplexArray, Mask
from servotrack.estimators.validation import as_array


class BearingRecord(NamedTuple):
    """Bearing-time record of a recording.

    Attributes:
        powers: Beam powers, relative to the usual noise of a bin; NaN in rows without data. Shape (T, beams).
        times: Middle of each row, from the start of the recording, s. Shape (T,).
        tracker: Tracker whose array, band, beams, period and statistics are those of the record.
        notes: Sentences on what may spoil the record: aliasing, clipped channels, missing samples.
    """

    powers: Array
    times: Array
    tracker: HMMBearings
    notes: tuple[str, ...]


def bearing_record(
    samples: ArrayLike,
    rate: float,
    array: AnyArray,
    band: tuple[float, float],
    *,
    beams: int | Sequence[float] | None = None,
    period: float | None = None,
    beamformer: Beamformer = "conventional",
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> BearingRecord:
    """Beamform a recording of hydrophones, row by row.

    A row averages Hann windows that overlap by half. A window lasts at least eight times as long as sound takes along
    the array, so that each bin sees plane waves; a row at least 1 s and ten windows. Channels are scaled to equal
    levels, and each bin is divided by the running median of the levels over frequency, so that noise of any spectrum
    is white, and tones stay. A row with a sample that is NaN is missing.

    Args:
        samples: Signals of the elements, any unit; integers too, and memory maps. Shape (samples, N).
        rate: Sampling frequency, Hz.
        array: Line array or elements at given places, in the order of the channels.
        band: Lowest and highest frequency, Hz.
        beams: Number of beams or their angles, deg; None: an eighth of a beam's width apart.
        period: Duration of a row, s; None: see above. Longer rows show weaker targets that move slowly.
        beamformer: `conventional` or `mvdr`.
        progress: Called with the number of finished rows and of all rows.
        **settings: Fields of the tracker that differ from `HMMBearings.fitted`.

    Raises:
        ValueError: Samples of another shape, a channel without signal, a band beyond half the sampling frequency, or a
            recording shorter than a row.
    """
    x = as_array("samples", samples)
    if x.ndim != 2 or x.dtype.kind not in "fiu":
        raise ValueError(f"samples must be real numbers of shape (samples, channels), got {x.dtype} of shape {x.shape}")
    if x.shape[1] != array.elements:
        swapped = "; transpose them" if x.shape[0] == array.elements else ""
        raise ValueError(
            f"samples must have one channel for each of the array's {array.elements} elements, got {x.shape[1]} "
            f"channels{swapped}"
        )
    if not 0.0 < rate < np.inf:
        raise ValueError(f"rate must be positive, got {rate!r}")
    low, high = band
    if not 0.0 < low <= high < 0.5 * rate:
        raise ValueError(
            f"band must satisfy 0 < low <= high < {0.5 * rate:g} Hz, half the sampling frequency, got {low:g} "
            f"to {high:g}"
        )
    window = _window(array, rate)
    hop = window // 2
    length = round(max(1.0, 10.0 * window / rate) * rate) if period is None else round(period * rate)
    if length < 2 * window:
        raise ValueError(
            f"period must be at least {2.0 * window / rate:.3g} s, two windows of {window / rate:.3g} s, got {period!r}"
        )
    rows = len(x) // length
    if rows == 0:
        raise ValueError(f"samples must last at least one row of {length / rate:g} s, got {len(x) / rate:g} s")
    bins = np.arange(math.ceil(low * window / rate), math.floor(high * window / rate) + 1)
    if not len(bins):
        raise ValueError(f"band must hold a frequency bin of {rate / window:.3g} Hz, got {low:g} to {high:g} Hz")
    step = rate / window
    receiver = Band(float(bins[0] * step), float(bins[-1] * step + 0.01 * step), step)
    gains, notes = _gains(x, length)
    taper = np.hanning(window + 1)[:-1]
    count = (length - window) // hop + 1
    # Overlap by half leaves 9/11 of the averages (Welch 1967); a Hann window spreads a bin over its neighbors.
    averages = max(1.0, count * len(bins) * 9.0 / 11.0 / (1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0) * (len(bins) > 1)))
    tracker = HMMBearings.fitted(
        array,
        receiver,
        beams,
        period=length / rate,
        snapshots=count,
        beamformer=beamformer,
        **{"noise_averages": averages, **settings},
    )

    def spectra(row: int) -> ComplexArray:
        part = np.asarray(x[row * length : (row + 1) * length], np.float64) * gains
        windows = np.lib.stride_tricks.sliding_window_view(part, window, axis=0)[::hop] * taper
        return np.fft.rfft(windows, axis=-1)[..., bins].transpose(0, 2, 1)

    level = _spectral_level([spectra(row) for row in np.unique(np.linspace(0, rows - 1, 20).astype(int)).tolist()])
    powers = np.full((rows, len(tracker.beam_bearings)), np.nan)
    for row in range(rows):
        snapshots = spectra(row)
        if np.isfinite(snapshots).all():
            white = snapshots / level[:, None]
            powers[row] = beam_powers(array, receiver.frequencies, white, tracker.beam_bearings, beamformer)
        if progress is not None:
            progress(row + 1, rows)
    missing = int(np.isnan(powers[:, 0]).sum())
    if missing == rows:
        raise ValueError("samples must be finite in some row, got NaN in every one; repair or cut the recording")
    if missing:
        notes.append(f"{missing} of {rows} rows hold samples that are not finite and count as missing")
    silent = ~(np.median(np.nan_to_num(powers, nan=1.0), axis=1) > 0.0)
    if silent.any():
        powers[silent] = np.nan
        notes.append(f"{int(silent.sum())} of {rows} rows are silent and count as missing")
    aliasing = aliasing_note(array, receiver)
    if aliasing is not None:
        notes.insert(0, aliasing)
    return BearingRecord(powers, (np.arange(rows, dtype=np.float64) + 0.5) * length / rate, tracker, tuple(notes))


def _window(array: AnyArray, rate: float) -> int:
    """Length of a window, samples, a power of two: eight travel times along the array, at least 64 samples."""
    if isinstance(array, ElementArray):
        places = np.array(array.positions)
        extent = float(np.linalg.norm(np.ptp(places, axis=0)))
    else:
        extent = array.spacing * (array.elements - 1)
    return int(2 ** math.ceil(math.log2(max(64.0, 8.0 * extent / array.sound_speed * rate))))


def _gains(samples: NDArray[Any], length: int, parts: int = 20) -> tuple[Array, list[str]]:
    """Factors that bring the channels to the same level, from some stretches of the recording, and notes. Shape (N,).

    Raises:
        ValueError: A channel is NaN, or has no signal.
    """
    starts = np.unique(np.linspace(0, max(len(samples) - length, 0), parts).astype(int)).tolist()
    levels, clipped = [], []
    for start in starts:
        part = np.asarray(samples[start : start + length], np.float64)
        finite = np.isfinite(part)
        safe = np.where(finite, part, 0.0)
        number = np.maximum(finite.sum(axis=0), 1)
        mean = safe.sum(axis=0) / number
        level = np.sqrt((np.where(finite, safe - mean, 0.0) ** 2).sum(axis=0) / number)
        levels.append(np.where(finite.any(axis=0), level, np.nan))
        clipped.append(_clipped(safe))
    level = np.full(samples.shape[1], np.nan)
    seen = ~np.isnan(np.array(levels)).all(axis=0)
    level[seen] = np.nanmedian(np.array(levels)[:, seen], axis=0)
    _refuse(np.isnan(level), "holds only NaN")
    usual = float(np.median(level))
    # 60 dB below the others is a dead hydrophone; below one step of the converter nothing is heard at all.
    _refuse((level <= 1e-3 * usual) | (level <= 0.0), "is silent")
    notes = []
    share = np.max(clipped, axis=0)
    if (share > 0.001).any():
        worst = int(share.argmax())
        names = ", ".join(str(channel) for channel in np.flatnonzero(share > 0.001)[:8].tolist())
        notes.append(
            f"channel {names} is clipped, channel {worst} in {100.0 * share[worst]:.2g} % of its samples at worst: "
            "loud targets may show at false bearings"
        )
    return usual / level, notes


def _refuse(bad: Mask, what: str) -> None:
    if bad.any():
        some = np.flatnonzero(bad).tolist()
        raise ValueError(
            f"samples must have a signal in every channel, but channel {', '.join(map(str, some[:8]))} {what}; leave "
            "it out of samples and positions"
        )


def _clipped(part: Array) -> Array:
    """Share of the samples of each channel that repeat its largest or smallest value. Shape (N,)."""
    if len(part) < 2:
        return np.zeros(part.shape[1])
    extreme = (part == part.max(axis=0)) | (part == part.min(axis=0))
    return np.asarray((extreme[1:] & extreme[:-1]).mean(axis=0))


def _spectral_level(some: Sequence[ComplexArray], reach: int = 12) -> Array:
    """Noise amplitude of each bin: running median over frequency of the median over rows and elements. Shape (F,)."""
    power = np.array([(np.abs(spectra) ** 2).mean(axis=0) for spectra in some])
    power = power[np.isfinite(power).all(axis=(1, 2))]
    if not len(power):
        return np.ones(some[0].shape[1])
    level = np.median(power, axis=(0, 2))
    padded = np.pad(level, min(reach, len(level) - 1), mode="reflect") if len(level) > 1 else level
    width = len(padded) - len(level) + 1
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(padded, width), axis=-1)
    return np.sqrt(np.maximum(smooth, 1e-30 * max(float(smooth.max()), 1e-300)))
