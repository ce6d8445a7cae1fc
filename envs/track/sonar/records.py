"""Rows of the bearing-time record: beam powers of an episode, a function of (seed, record) whoever listens."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from servotrack.envs.streams import Streams
from servotrack.envs.track.sonar.config import SonarConfig
from servotrack.envs.track.sonar.scene import SonarScene, Stream
from servotrack.estimators.sonar.array import (
    Band,
    LineArray,
    Shading,
    beam_correlation,
    beamform,
    bearings,
    normalize,
    steering,
    tabulate_pattern,
)
from servotrack.estimators.types import Array, ComplexArray

_OFFSETS = 4001
"""Points of a beam pattern's table, from 0 to 2 in the difference of cosines."""


def draw_record(config: SonarConfig, scene: SonarScene, seed: int, record: int) -> Array:
    """One row: normalized beam powers.

    Args:
        config: The world.
        scene: Who is there, as `draw_scene` makes it of the same seed.
        seed: The episode's.
        record: Number of the record, from 0.

    Returns:
        Beam powers over their noise level, shape (beams,).
    """
    return normalize(draw_powers(config, scene, seed, record), config.averages)


def draw_powers(config: SonarConfig, scene: SonarScene, seed: int, record: int) -> Array:
    """Beam powers before they are normalized, over the mean noise of a bin; arguments as in `draw_record`."""
    rng = Streams(seed)[Stream.RECORD, record]
    if config.fidelity == "snapshots":
        snapshots, bearings = draw_snapshots(config, scene, rng, record), config.beam_bearings
        return beamform(config.array, config.band.frequencies, snapshots, bearings, config.shading)  # type: ignore[arg-type]
    return _moment_powers(config, scene, rng, record)


def draw_snapshots(config: SonarConfig, scene: SonarScene, rng: np.random.Generator, record: int) -> ComplexArray:
    """Spectra at the elements during one record: plane waves of tones and bands in ambient noise.

    A tone keeps amplitude and phase, a band's spectrum is complex Gaussian; bearings are those of the record's middle.

    Returns:
        Shape (snapshots, F, elements).
    """
    frequencies, n = config.band.frequencies, scene.power.shape[0]
    shape = config.snapshots, len(frequencies)
    noise = rng.standard_normal((*shape, config.elements, 2)).view(np.complex128)[..., 0]
    snapshots = noise * np.sqrt(config.ambient / 2.0)[:, None]
    # Drawn for all targets, whether they are there or not: one's sound does not depend on another's presence.
    sound = rng.standard_normal((n, *shape, 2)).view(np.complex128)[..., 0]
    phase = rng.uniform(0.0, 2.0 * np.pi, (n,))
    here = np.flatnonzero(scene.exists[record])
    waves = steering(config.array, frequencies, scene.bearings[record, here])
    for row, target in enumerate(here.tolist()):
        amplitude = np.sqrt(scene.power[target])
        steady = np.broadcast_to(np.exp(1j * phase[target]), shape)
        spectrum = amplitude * (steady if scene.tonal[target] else sound[target] / np.sqrt(2.0))
        heard = np.flatnonzero(amplitude)
        snapshots[:, heard] += spectrum[:, heard, None] * waves[heard, row]
    return snapshots


class Moments(NamedTuple):
    """Mean and variance of beam powers, and how much of the variance is the targets' own, common to all beams.

    Attributes:
        mean: Shape (beams,).
        variance: Shape (beams,).
        patterns: What each target adds to the mean, shape (targets, beams).
        common: Relative variance of each target's power in a record, shape (targets,).
    """

    mean: Array
    variance: Array
    patterns: Array
    common: Array


def power_moments(config: SonarConfig, scene: SonarScene, record: int) -> Moments:
    """Moments of the beam powers of one record, exact but for the table of patterns.

    With P_f the mean power in a beam and a bin, the mean is sum P_f / F. Snapshots are independent and Gaussian, so the
    variance is sum P_f^2 / (F^2 K), without the squares of tones, which are steady.
    """
    F, K = len(config.band.frequencies), config.snapshots
    here = np.flatnonzero(scene.exists[record])
    table = _pattern_table(config.array, config.band, config.shading)
    cosines = np.cos(np.radians(config.beam_bearings))
    sources = np.cos(np.radians(scene.bearings[record, here]))
    mean, square, patterns = _sums(table, cosines, sources, scene.power[here], scene.tonal[here], config.ambient)
    power = scene.power[here]
    total = power.sum(axis=1)
    common = np.where(scene.tonal[here], 0.0, (power**2).sum(axis=1) / np.maximum(total, 1e-300) ** 2 / K)
    return Moments(mean / F, square / (F * F * K), patterns / F, common)


def _moment_powers(config: SonarConfig, scene: SonarScene, rng: np.random.Generator, record: int) -> Array:
    """Beam powers with the moments of `power_moments` and Gamma marginals.

    A target's power in the record is drawn once for all beams; the rest is a normal variable, correlated over the beams
    as white noise is, and shaped to Gamma by Wilson's and Hilferty's cube (Proc. Natl. Acad. Sci. 17, 1931).
    """
    root = _correlation_root(config.array, config.band, config.beams, config.shading)
    normal = root @ rng.standard_normal(root.shape[1])
    gain = rng.standard_normal(scene.power.shape[:1])[np.flatnonzero(scene.exists[record])]
    mean, variance, patterns, common = power_moments(config, scene, record)
    shift = ((_gamma(1.0, common, gain) - 1.0)[:, None] * patterns).sum(axis=0)
    own = variance - (common[:, None] * patterns**2).sum(axis=0)
    return np.maximum(_gamma(mean, np.maximum(own, 0.0) / mean**2, normal) + shift, 0.0)


def _gamma(mean: Array | float, relative_variance: Array, normal: Array) -> Array:
    """Gamma variables of a mean and a variance over the square of the mean, out of standard normal ones."""
    ninth = relative_variance / 9.0
    return mean * np.maximum(1.0 - ninth + normal * np.sqrt(ninth), 0.0) ** 3


@lru_cache(maxsize=4)
def _pattern_table(array: LineArray, band: Band, shading: Shading) -> Array:
    """Pattern of a source of unit power in one bin, by the difference of cosines from 0 to 2; shape (offsets, F)."""
    tables = [tabulate_pattern(array, [f], [1.0], shading, _OFFSETS).values for f in band.frequencies.tolist()]
    return np.ascontiguousarray(np.stack(tables, axis=1))


@lru_cache(maxsize=4)
def _correlation_root(array: LineArray, band: Band, beams: int, shading: Shading) -> Array:
    """A matrix C with C C^T the correlation of noise powers of all beams; shape (beams, beams)."""
    values, vectors = np.linalg.eigh(beam_correlation(array, band.frequencies, bearings(beams), shading))
    # The symmetric root: eigenvectors differ from one linear algebra library to the next, this does not.
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


@njit(cache=True, nogil=True)
def _sums(table, beam_bearings, sources, power, tonal, ambient):  # type: ignore[no-untyped-def]
    """Sums over the bins of mean powers, of their variances times K, and each source's part of the means."""
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
