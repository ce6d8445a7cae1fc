"""Plots beside the pictures of tracking environments: axes, curves, newest values, and one color per identity."""

from __future__ import annotations

import colorsys
from functools import lru_cache

import cv2
import numpy as np

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import FLOOR_GRID, INK, SOFT_INK, Color
from servotrack.estimators.types import Array, Image

TRAIL_LENGTH = 40
"""Number of newest positions of an identity that its trail shows."""
PLOT_INSET = 14
"""Distance from a plot's panel border to its axes, px."""
TITLE_HEIGHT = 26
"""Height of a plot's title line, px."""
SUBPIXEL_BITS = 4
"""Fractional bits of the fixed-point coordinates that OpenCV's drawing functions get."""

_GOLDEN_RATIO = 0.6180339887498949


@lru_cache(maxsize=512)
def identity_color(label: int) -> Color:
    """Return the color of an identity. Consecutive labels get hues that differ by the golden ratio."""
    hue = (0.03 + label * _GOLDEN_RATIO) % 1.0
    value = 0.62 if label % 2 else 0.78
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.85, value)
    return (round(255 * red), round(255 * green), round(255 * blue))


def draw_axes(panel: Image, title: str, intervals: int = 4) -> None:
    """Draw a plot's title and its horizontal grid lines.

    Args:
        panel: Part of the picture, shape (h, w, 3), changed in place.
        title: Title, at the upper left.
        intervals: Number of intervals between the grid lines.
    """
    for line in range(intervals + 1):
        at = PLOT_INSET + TITLE_HEIGHT + round(line * (panel.shape[0] - 2 * PLOT_INSET - TITLE_HEIGHT) / intervals)
        panel[at, PLOT_INSET : panel.shape[1] - PLOT_INSET] = FLOOR_GRID
    put_text(panel, title, PLOT_INSET, PLOT_INSET + 8, SOFT_INK)


def draw_curve(panel: Image, values: Array, top: float, horizon: int, color: Color, thickness: int) -> None:
    """Draw a step curve below a plot's title.

    Args:
        panel: Part of the picture, shape (h, w, 3), changed in place.
        values: Values from 0 to `top`, one per step, shape (k,). Larger ones are drawn at `top`.
        top: Value at the upper end of the axis.
        horizon: Number of steps at the right end of the axis.
        color: Color of the line.
        thickness: Thickness of the line, px.
    """
    if len(values) == 0:
        return
    height, width = panel.shape[0] - 2 * PLOT_INSET - TITLE_HEIGHT, panel.shape[1] - 2 * PLOT_INSET
    x = PLOT_INSET + width * np.arange(len(values) + 1) / horizon
    y = PLOT_INSET + TITLE_HEIGHT + height * (1.0 - np.minimum(values / top, 1.0))
    corners = np.stack([np.repeat(x, 2)[1:-1], np.repeat(y, 2)], axis=1)
    fixed = np.rint(corners * (1 << SUBPIXEL_BITS)).astype(np.int32)
    cv2.polylines(panel, [fixed], False, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def write_value(panel: Image, text: str) -> None:
    """Write the newest value of a plot, right-aligned in the title line."""
    put_text(panel, text, panel.shape[1] - PLOT_INSET, PLOT_INSET + 8, INK, align="right")
