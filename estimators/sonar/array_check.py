"""Comparison of a record with the array: width of the ridges, and spread of the noise."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.sonar.joint_smoothing import JointSmoother
from servotrack.estimators.types import Array


def measured_averages(rows: Array, quiet: float = 0.4, least_rows: int = 10) -> float | None:
    """Number of independent averages in a beam power, 1 over the relative variance of its noise.

    Targets and levels change little from row to row, so that the second differences of three rows are mostly noise; of
    the beams, those that change least hold none of a moving target.

    Args:
        rows: Beam powers; rows of NaN are missing. Shape (T, beams).
        quiet: Quantile of the spread over the beams.
        least_rows: Number of differences from which the spread is measured.

    Returns:
        The number; None for too few neighboring rows, or rows without spread.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        change = np.abs(rows[2:] - 2.0 * rows[1:-1] + rows[:-2]) / (rows[2:] + rows[1:-1] + rows[:-2])
    change = change[~np.isnan(change).any(axis=1)]
    if len(change) < least_rows:
        return None
    # Three rows of mean m: the difference has 6 times the variance of one, the sum a mean of 3 m.
    deviation = float(np.quantile(np.median(change, axis=0), quiet)) / 0.6745 * 3.0 / np.sqrt(6.0)
    return 1.0 / deviation**2 if deviation > 0.0 else None


def ridge_width(smoother: JointSmoother, least_score: float = 20.0, least_rows: int = 10) -> float | None:
    """Median width at half power of the ridges that are clear of others, as across the array, deg.

    Args:
        smoother: Chains of a record.
        least_score: Smallest power of a ridge, in standard deviations of the noise.
        least_rows: Number of rows from which a ridge is measured.

    Returns:
        The width; None if no ridge is loud enough for long enough.
    """
    model = smoother.model
    nominal = model.patterns.width
    edges = np.linspace(0.0, 4.0 * nominal, 81)
    found = []
    for chain in smoother.chains:
        rows = smoother._alone(chain)
        rows &= chain.power * np.sqrt(model.averages) > least_score
        # Beams beside the ends of a line see both sides of a ridge at once.
        rows &= np.abs(np.cos(np.radians(chain.bearings))) < 0.9 if not model.directions.planar else True
        if rows.sum() < least_rows:
            continue
        bearings = chain.bearings[rows, None]
        if model.directions.planar:
            away = np.abs(model.directions.difference(model.beam_bearings, bearings))
        else:
            cosines = np.cos(np.radians(model.beam_bearings)) - np.cos(np.radians(bearings))
            away = np.degrees(2.0 * np.arcsin(np.minimum(0.5 * np.abs(cosines), 1.0)))
        shape = (smoother.rows - smoother.explained([chain]))[rows] / chain.power[rows, None]
        at = np.digitize(away, edges) - 1
        profile = np.array([np.median(shape[at == i]) if (at == i).any() else np.nan for i in range(len(edges) - 1)])
        known = np.flatnonzero(~np.isnan(profile))
        if len(known) < 3:
            continue
        smooth = np.interp(np.arange(len(profile)), known, profile[known])
        below = np.flatnonzero(smooth < 0.5 * smooth[:2].max())
        if len(below) and below[0] > 0:
            found.append(2.0 * 0.5 * float(edges[below[0]] + edges[below[0] + 1]))
        else:
            found.append(2.0 * float(edges[-1]) if not len(below) else float(edges[1]))
    return float(np.median(found)) if found else None


def width_note(smoother: JointSmoother, tolerance: float = 1.4) -> str | None:
    """Return a sentence if the ridges are wider or narrower than any spectrum makes the array's beams, else None."""
    width = ridge_width(smoother)
    low, high = smoother.model.patterns.widths
    if smoother.model.beamformer == "mvdr":
        # The louder a target is, the narrower is its ridge.
        low = 0.0
    # A position of the grid more or less is no misfit.
    step = float(np.median(np.diff(smoother.model.beam_bearings)))
    if width is None or (low / tolerance - step <= width <= high * tolerance + step):
        return None
    return (
        f"ridges in the record are about {width:.3g} deg wide at half power, the array's beams {low:.3g} to {high:.3g} "
        "deg: array, sound speed, band or beams do not fit the record, and tracks may be wrong"
    )
