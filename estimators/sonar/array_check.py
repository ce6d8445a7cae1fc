"""Comparison of a record with the array: width of the ridges, and spread of the noise."""

from __future__ import annotations

import numpy as np

from servotrack.estimators.sonar.directions import Directions
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


def ridge_width(
    rows: Array, beam_bearings: Array, averages: float, directions: Directions, least_score: float = 20.0
) -> float | None:
    """Median width at half power of the loudest ridge of each row, as across the array, deg.

    Args:
        rows: Normalized beam powers. Shape (T, beams).
        beam_bearings: Bearings of the beams, deg. Shape (beams,).
        averages: Number M of averages in one beam power.
        directions: Geometry of the bearings.
        least_score: Smallest power of a ridge that is measured, in standard deviations of the noise.

    Returns:
        The width; None if fewer than ten rows have a ridge so loud.
    """
    found = []
    beams = len(beam_bearings)
    for row in rows:
        top = int(row.argmax())
        half = 1.0 + 0.5 * (row[top] - 1.0)
        # Beams beside the ends of a line see both sides of a ridge at once.
        if (row[top] - 1.0) * np.sqrt(averages) < least_score or (
            not directions.planar and abs(np.cos(np.radians(beam_bearings[top]))) > 0.9
        ):
            continue
        ends = []
        for step in (-1, 1):
            at = top
            while directions.circle or 0 <= at + step < beams:
                inner, outer = row[at % beams], row[(at + step) % beams]
                if outer < half or abs(at - top) >= beams:
                    break
                at += step
            if not (directions.circle or 0 <= at + step < beams):
                break
            here, there = beam_bearings[at % beams], beam_bearings[(at + step) % beams]
            share = float((inner - half) / max(inner - outer, 1e-12))
            ends.append(float(here + min(share, 1.0) * directions.difference(there, here)))
        if len(ends) == 2:
            if directions.planar:
                found.append(abs(float(directions.difference(ends[1], ends[0]))))
            else:
                apart = float(directions.apart(ends[0], ends[1]))
                found.append(2.0 * float(np.degrees(np.arcsin(min(0.5 * apart, 1.0)))))
    return float(np.median(found)) if len(found) >= 10 else None


def width_note(smoother: JointSmoother, tolerance: float = 1.4) -> str | None:
    """Return a sentence if the ridges are wider or narrower than any spectrum makes the array's beams, else None."""
    model = smoother.model
    rows = smoother.rows[~(smoother.missing | smoother.lifted)]
    width = ridge_width(rows, model.beam_bearings, model.averages, model.directions)
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
