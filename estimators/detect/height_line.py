"""Line of people's heights over the rows of their feet."""

from __future__ import annotations

from servotrack.estimators.compilation import njit


@njit(cache=True, nogil=True)
def height_line(n, sy, sh, syy, syh, rows, steepest):  # type: ignore[no-untyped-def]
    """Fit the heights h over the rows y of the feet by least squares.

    Weak regularization toward the same height in all rows serves people who all stand in one row.

    Args:
        n: Sum of the weights.
        sy: Weighted sum of y, px.
        sh: Weighted sum of h, px.
        syy: Weighted sum of y * y, px^2.
        syh: Weighted sum of y * h, px^2.
        rows: Height of the image, px.
        steepest: Upper limit of the slope; the lower one is 0.

    Returns:
        Height at row 0, px, and its growth per row.
    """
    spread = syy - sy * sy / n + n * (0.02 * rows) ** 2
    slope = min(max((syh - sy * sh / n) / spread, 0.0), steepest)
    return (sh - slope * sy) / n, slope
