"""Bearing rates of ridges that are faster than a grid of rates: straight lines through the peaks of some rows."""

from __future__ import annotations

import numpy as np
from scipy.signal import find_peaks

from servotrack.estimators.compilation import njit
from servotrack.estimators.sonar.rules import FastRules
from servotrack.estimators.types import Array, Mask


def fastest_rate(
    rows: Array, background: Array, averages: float, spacing: float, period: float, known: float, rules: FastRules
) -> float:
    """Largest absolute bearing rate of a ridge that moves faster than `known`, deg/s; `known` if there is none.

    The Hough transform of the peaks: a line counts the rows in which it meets a peak. A line at a fast rate stands for
    a ridge if it meets peaks in nearly all of its rows, and any line about its middle at a rate within the known ones
    meets clearly fewer. Levels do not matter, so that neither a loud target nor its sidelobes hide a faster one.

    Args:
        rows: Normalized beam powers at equally spaced bearings. Shape (T, beams).
        background: Mean power without targets. Shape (T, beams).
        averages: Number M of averages in one beam power.
        spacing: Distance of neighboring beams, deg.
        period: Time between rows, s.
        known: Largest rate that is already followed, deg/s.
        rules: Length of a line and its thresholds.
    """
    length = 2 * rules.half_rows + 1
    if len(rows) < length:
        return known
    shown = np.zeros(rows.shape, np.bool_)
    for k in range(len(rows)):
        score = (rows[k] / background[k] - 1.0) * np.sqrt(averages)
        at, _ = find_peaks(score, height=rules.height, prominence=rules.height)
        shown[k, at] = True
    if not shown.any():
        return known
    near = _dilated(shown, max(1, round(rules.tolerance / spacing)))
    # A line must stay inside the beams for all of its rows.
    limit = (rows.shape[1] - 1) / (length - 1)
    shifts = np.arange(1, int(limit) + 1)
    slow = shifts[shifts * spacing <= known * period + 1e-9]
    fast = shifts[len(slow) :]
    if not len(fast):
        return known
    best = _fastest(shown, near, slow, fast, rules.half_rows, rules.min_hits, rules.min_gain)
    return known if best == 0 else float(best * spacing / period)


def _dilated(shown: Mask, reach: int) -> Mask:
    out = shown.copy()
    for shift in range(1, reach + 1):
        out[:, shift:] |= shown[:, :-shift]
        out[:, :-shift] |= shown[:, shift:]
    return out


@njit(cache=True, nogil=True)
def _hits(near, row, beam, shift, half):  # type: ignore[no-untyped-def]
    """Number of rows within `half` of a row in which the line through a beam meets a peak."""
    count, beams = 0, near.shape[1]
    for j in range(-half, half + 1):
        at = beam + shift * j
        if 0 <= at < beams and near[row + j, at]:
            count += 1
    return count


@njit(cache=True, nogil=True)
def _fastest(shown, near, slow, fast, half, min_hits, min_gain):  # type: ignore[no-untyped-def]
    """Largest shift per row, in beams, of a line that is a fast ridge; 0 if there is none."""
    best = 0
    for row in range(half, shown.shape[0] - half):
        for beam in range(shown.shape[1]):
            if not shown[row, beam]:
                continue
            slowest = _hits(near, row, beam, 0, half)
            for shift in slow:
                slowest = max(slowest, _hits(near, row, beam, shift, half), _hits(near, row, beam, -shift, half))
            most, at = 0, 0
            for shift in fast:
                hits = max(_hits(near, row, beam, shift, half), _hits(near, row, beam, -shift, half))
                if hits > most:
                    most, at = hits, shift
            if most >= min_hits and most >= slowest + min_gain and at > best:
                best = at
    return best
