"""Bearing-time records of a small array for the tests of trackers."""

import numpy as np

from servotrack.estimators.sonar import Band, LineArray, beam_correlation, bearings, tabulate_pattern

ARRAY, BAND = LineArray(elements=24), Band(500.0, 1500.0, 50.0)
BEAMS, SNAPSHOTS = 361, 20
RATES = (-2.0, -1.0, 0.0, 1.0, 2.0)
SETTINGS = {
    "array": ARRAY,
    "band": BAND,
    "beams": BEAMS,
    "snapshots": SNAPSHOTS,
    "rates": RATES,
    "acceleration": 0.5,
    "max_targets": 6,
}
AVERAGES = len(BAND.frequencies) * SNAPSHOTS


def noise(rows, seed):
    """Normalized beam powers of noise, neighbors correlated as the array has it."""
    rng = np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(beam_correlation(ARRAY, BAND.frequencies, bearings(BEAMS)))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return 1.0 + rng.normal(size=(rows, BEAMS)) @ root.T / np.sqrt(AVERAGES)


def record(rows, targets, seed=0):
    """Noise and targets: (first, last, bearing at row 0, rate, power in standard deviations of noise, tone in Hz)."""
    looks = bearings(BEAMS)
    mean = np.zeros((rows, BEAMS))
    for first, last, bearing, rate, strength, tone in targets:
        f = BAND.frequencies
        spectrum = np.ones(len(f)) if tone is None else (np.abs(f - tone) == np.abs(f - tone).min()).astype(float)
        table = tabulate_pattern(ARRAY, f, spectrum)
        k = np.arange(first, min(last + 1, rows))
        mean[k] += strength / np.sqrt(AVERAGES) * table.at(looks, bearing + rate * k) / table.values[0]
    return np.maximum(noise(rows, seed) * (1.0 + mean), 0.0)


CROSSING = [(8, 40, 50.0, 1.0, 150.0, None), (8, 36, 100.0, -1.0, 60.0, 1500.0)]
