"""Background of each row over bearing: rows that a broad transient lifts, in whole or in part, and missing rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from servotrack.estimators.sonar.rules import BackgroundRules
from servotrack.estimators.types import Array, Mask


class PreparedRows(NamedTuple):
    """Rows with the mean power of their noise.

    Attributes:
        rows: Normalized beam powers; ones where a row is missing. Shape (T, beams).
        background: Mean power without targets; ones except in rows that a transient lifts. Shape (T, beams).
        missing: True for rows without data. Shape (T,).
        lifted: True for rows that a transient lifts. Shape (T,).
    """

    rows: Array
    background: Array
    missing: Mask
    lifted: Mask


def prepare_rows(rows: Array, beam_width: float, rules: BackgroundRules) -> PreparedRows:
    """Find missing rows and rows that a transient lifts, and estimate the background of the latter.

    The ratio of a row to the median of its neighbors in time shows no targets, since these move slowly; its running
    median over bearing is the background. The median keeps the edges of a lift that covers some bearings only. A row
    whose background is flat keeps its values to the bit.

    Args:
        rows: Normalized beam powers; rows of NaN are missing. Shape (T, beams).
        beam_width: Width of a beam, in beams.
        rules: Windows and thresholds.
    """
    missing = np.isnan(rows[:, 0]) if rows.size else np.zeros(len(rows), np.bool_)
    filled = np.where(missing[:, None], 1.0, rows) if missing.any() else rows
    background, lifted = np.ones_like(filled), np.zeros(len(filled), np.bool_)
    present = np.flatnonzero(~missing)
    if len(present) >= rules.min_rows:
        block = max(1, round(beam_width))
        usable = filled.shape[1] // block * block
        coarse = np.median(filled[present, :usable].reshape(len(present), -1, block), axis=2)
        for at in np.flatnonzero(_is_odd(coarse, rules)):
            row = present[at]
            if not lifted.any():
                filled = filled.copy()
            around = np.r_[present[max(0, at - rules.rows) : at], present[at + 1 : at + 1 + rules.rows]]
            usual = np.median(rows[around], axis=0)
            own = _median_over_bearing(rows[row][None] / usual, rules.beam_widths * block)[0]
            # The unit is the noise of the bearings that are not lifted.
            unit = float(np.quantile(own, rules.unlifted))
            filled[row] /= unit
            background[row] = np.maximum(own / unit, rules.unlifted)
            lifted[row] = True
    return PreparedRows(filled, background, missing, lifted)


def _is_odd(coarse: Array, rules: BackgroundRules) -> Mask:
    """Mask of the rows whose background deviates, in the same direction, from the rows before and from those after.

    A loud target that appears or disappears changes the rows on one side only. At the ends there is one side, which
    must differ by twice the logarithm.
    """
    count = len(coarse)
    before, after = (np.zeros((count, coarse.shape[1])) for _ in range(2))
    for k in range(count):
        for deviation, side in (
            (before, coarse[max(0, k - rules.rows) : k]),
            (after, coarse[k + 1 : k + 1 + rules.rows]),
        ):
            if len(side) >= rules.side_rows:
                deviation[k] = np.log(coarse[k] / np.maximum(np.median(side, axis=0), 1e-9) + 1e-9)
    before, after = (_median_over_bearing(side, rules.breadth) for side in (before, after))
    ends = np.zeros(count, np.bool_)
    ends[: rules.side_rows] = ends[max(0, count - rules.side_rows) :] = True
    both = np.where(before * after > 0.0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    either = 0.5 * np.maximum(np.abs(before), np.abs(after))
    return np.asarray(np.where(ends[:, None], either, both).max(axis=1) > np.log1p(rules.tolerance))


def _median_over_bearing(rows: Array, width: int) -> Array:
    """Running median over about `width` neighboring values, with the values at the ends repeated. Shape of rows."""
    reach = min(width // 2, rows.shape[1] - 1)
    padded = np.pad(rows, ((0, 0), (reach, reach)), mode="symmetric")
    return np.asarray(np.median(sliding_window_view(padded, 2 * reach + 1, axis=1), axis=-1))
