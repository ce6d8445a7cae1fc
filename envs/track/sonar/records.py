"""Rows of the bearing-time record: beam powers as a function of configuration, seed and record number."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from servotrack.envs.streams import Streams
from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.envs.track.sonar.scene import SonarScene, Stream
from servotrack.estimators.compilation import njit
from servotrack.estimators.sonar.array import (
    Band,
    LineArray,
    Shading,
    beam_correlation,
    beamform,
    bearings,
    cosines,
    normalize,
    steering,
    tabulate_pattern,
    unit_phasors,
)
from servotrack.estimators.symmetric import mirrored_function, weighted_rows
from servotrack.estimators.types import Array, ComplexArray

_OFFSETS = 4001
"""Number of points in the table of a beam pattern, from 0 to 2 in the difference of cosines."""


def draw_record(config: SonarConfig, scene: SonarScene, seed: int, record: int) -> Array:
    """Draw one row of the bearing-time record.

    Args:
        config: Parameters of the environment.
        scene: Targets, drawn by `draw_scene` with the same seed.
        seed: Seed of the episode.
        record: Number of the record, from 0.

    Returns:
        Beam powers relative to their noise level, shape (beams,).
    """
    return normalize(draw_powers(config, scene, seed, record), config.averages)


def draw_powers(config: SonarConfig, scene: SonarScene, seed: int, record: int) -> Array:
    """Draw beam powers before normalization, relative to the mean noise of a bin. Arguments: see `draw_record`."""
    rng = Streams(seed)[Stream.RECORD, record]
    if config.fidelity == "snapshots":
        snapshots, bearings = draw_snapshots(config, scene, rng, record), config.beam_bearings
        return beamform(config.array, config.band.frequencies, snapshots, bearings, config.shading)  # type: ignore[arg-type]
    return _moment_powers(config, scene, rng, record)


def draw_snapshots(config: SonarConfig, scene: SonarScene, rng: np.random.Generator, record: int) -> ComplexArray:
    """Draw the spectra at the elements during one record: plane waves of the targets in ambient noise.

    A tone has constant amplitude and phase; the spectrum of a broadband target is complex Gaussian. The bearings are
    those at the middle of the record.

    Returns:
        Complex spectra, shape (snapshots, F, elements).
    """
    frequencies, n = config.band.frequencies, scene.power.shape[0]
    shape = config.snapshots, len(frequencies)
    noise = rng.standard_normal((*shape, config.elements, 2)).view(np.complex128)[..., 0]
    snapshots = noise * np.sqrt(config.ambient / 2.0)[:, None]
    # Drawn for all targets, existing or not, so that the sound of one does not depend on the presence of another.
    sound = rng.standard_normal((n, *shape, 2)).view(np.complex128)[..., 0]
    phase = rng.uniform(0.0, 2.0 * np.pi, (n,))
    here = np.flatnonzero(scene.exists[record])
    waves = steering(config.array, frequencies, scene.bearings[record, here])
    for row, target in enumerate(here.tolist()):
        amplitude = np.sqrt(scene.power[target])
        steady = np.broadcast_to(unit_phasors(phase[target]), shape)
        spectrum = amplitude * (steady if scene.tonal[target] else sound[target] / np.sqrt(2.0))
        heard = np.flatnonzero(amplitude)
        snapshots[:, heard] += spectrum[:, heard, None] * waves[heard, row]
    return snapshots


class Moments(NamedTuple):
    """Mean and variance of beam powers, and the part of the variance that is common to all beams.

    Attributes:
        mean: Means, shape (beams,).
        variance: Variances, shape (beams,).
        patterns: Contribution of each target to the mean, shape (targets, beams).
        common: Relative variance of the power of each target in a record, shape (targets,).
    """

    mean: Array
    variance: Array
    patterns: Array
    common: Array


def power_moments(config: SonarConfig, scene: SonarScene, record: int) -> Moments:
    """Return the moments of the beam powers of one record, exact up to the interpolation of the pattern table.

    With P_f the mean power in a beam and a bin, the mean is sum P_f / F. Snapshots are independent and Gaussian, so the
    variance is sum P_f^2 / (F^2 K), without the squares of tones, whose power is constant.
    """
    F, K = len(config.band.frequencies), config.snapshots
    here = np.flatnonzero(scene.exists[record])
    table = _pattern_table(config.array, config.band, config.shading)
    beams, sources = cosines(config.beam_bearings), cosines(scene.bearings[record, here])
    mean, square, patterns = _sums(table, beams, sources, scene.power[here], scene.tonal[here], config.ambient)
    power = scene.power[here]
    # The order of `sum` depends on the processor.
    total, squares = np.cumsum(power, axis=1)[:, -1], np.cumsum(power**2, axis=1)[:, -1]
    common = np.where(scene.tonal[here], 0.0, squares / np.maximum(total, 1e-300) ** 2 / K)
    return Moments(mean / F, square / (F * F * K), patterns / F, common)


def _moment_powers(config: SonarConfig, scene: SonarScene, rng: np.random.Generator, record: int) -> Array:
    """Draw beam powers with the moments of `power_moments` and gamma marginals.

    The power of a target in the record is drawn once for all beams. The rest is a normal variable with the correlation
    of white noise over the beams, converted to a gamma variable by the cube of Wilson and Hilferty (Proc. Natl. Acad.
    Sci. 17, 1931).
    """
    root = _correlation_root(config.array, config.band, config.beams, config.shading)
    # The root is symmetric: its rows are its columns.
    normal = weighted_rows(rng.standard_normal(len(root)), root)
    gain = rng.standard_normal(scene.power.shape[:1])[np.flatnonzero(scene.exists[record])]
    mean, variance, patterns, common = power_moments(config, scene, record)
    shift = ((_gamma(1.0, common, gain) - 1.0)[:, None] * patterns).sum(axis=0)
    own = variance - (common[:, None] * patterns**2).sum(axis=0)
    return np.maximum(_gamma(mean, np.maximum(own, 0.0) / mean**2, normal) + shift, 0.0)


def _gamma(mean: Array | float, relative_variance: Array, normal: Array) -> Array:
    """Convert standard normal variables to gamma variables with a given mean and relative variance."""
    ninth = relative_variance / 9.0
    cube_root = np.maximum(1.0 - ninth + normal * np.sqrt(ninth), 0.0)
    return mean * (cube_root * cube_root * cube_root)


@lru_cache(maxsize=4)
def _pattern_table(array: LineArray, band: Band, shading: Shading) -> Array:
    """Return beam patterns of a unit source in each bin over the difference of cosines, 0 to 2; shape (offsets, F)."""
    tables = [tabulate_pattern(array, [f], [1.0], shading, _OFFSETS).values for f in band.frequencies.tolist()]
    return np.ascontiguousarray(np.stack(tables, axis=1))


@lru_cache(maxsize=4)
def _correlation_root(array: LineArray, band: Band, beams: int, shading: Shading) -> Array:
    """Return the symmetric C, shape (beams, beams), with C C^T the correlation of the noise powers of all beams."""
    correlation = beam_correlation(array, band.frequencies, bearings(beams), shading)
    return mirrored_function(correlation, lambda values: np.sqrt(np.maximum(values, 0.0)))


@njit(cache=True, nogil=True)
def _sums(table, beam_bearings, sources, power, tonal, ambient):  # type: ignore[no-untyped-def]
    """Return sums over the bins: mean powers, their variances times K, and the contribution of each source."""
    points, bins = table.shape
    beams, count = len(beam_bearings), len(sources)
    mean, square, patterns = np.zeros(beams), np.zeros(beams), np.zeros((count, beams))
    here = np.empty(bins)
    for beam in range(beams):
        steady = 0.0
        here[:] = ambient
        for i in range(count):
            position = abs(beam_bearings[beam] - sources[i]) * (points - 1) / 2.0
            below = min(int(position), points - 2)
            part = position - below
            total = 0.0
            for f in range(bins):
                if power[i, f] == 0.0:
                    continue
                value = power[i, f] * ((1.0 - part) * table[below, f] + part * table[below + 1, f])
                total += value
                here[f] += value
                if tonal[i]:
                    steady += value * value
            patterns[i, beam] = total
        first, second = 0.0, 0.0
        for f in range(bins):
            first += here[f]
            second += here[f] * here[f]
        mean[beam], square[beam] = first, second - steady
    return mean, square, patterns
