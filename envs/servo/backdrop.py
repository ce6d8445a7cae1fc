"""Static part of a servo picture: layout, floor, axes. Painted once per reach and cached."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import (
    FLOOR,
    FLOOR_GRID,
    INK,
    PAPER,
    SOFT_INK,
    TEAL,
    VERMILION,
    Color,
    Panel,
    fixed_point,
    mix,
)
from servotrack.envs.servo.footprint import GRID_SPACING
from servotrack.estimators.types import Array, FloatArray, Image, Labels

TARGET: Color = VERMILION
DISTRACTOR: Color = (76, 112, 188)
TOOL: Color = TEAL
LENS: Color = (27, 36, 46)
LENS_GRID: Color = (49, 62, 75)
LENS_INK: Color = (148, 160, 170)
GOAL: Color = (242, 240, 232)

WIDTH, HEIGHT = 720, 416
MARGIN = 16
FLOOR_PANEL = Panel(MARGIN, MARGIN, 384, 384)
CAMERA_PANEL = Panel(416, MARGIN, 288, 288)
ERROR_PANEL = Panel(416, 320, 288, 80)
_CORNER_RADIUS = 7
CAMERA_LABEL, LABEL_PLACE = "camera", (14, 20)

# The floor's window in units of the arm's reach. The base is left of and below the center, where targets are rare.
_WINDOW_SIDE, _WINDOW_LEFT, _WINDOW_BOTTOM = 1.5, -0.36, -0.52

ERROR_DECADES = (-4, 0)
"""Powers of ten at the ends of the error plot's axis: 0.1 mm and 1 m."""
ERROR_PLOT = Panel(38, 24, 236, 48)  # inside ERROR_PANEL


def floor_scale(reach: float) -> float:
    """Pixels per meter of the floor panel for an arm of this reach (m)."""
    return FLOOR_PANEL.width / (_WINDOW_SIDE * reach)


def floor_pixels(points: Array, reach: float) -> Array:
    """Map points in the base frame (m) to pixels of the floor panel, shape (..., 2)."""
    scale = floor_scale(reach)
    origin = np.array([-_WINDOW_LEFT * reach * scale, FLOOR_PANEL.height + _WINDOW_BOTTOM * reach * scale])
    return origin + np.asarray(points) * np.array([scale, -scale])


def error_height(error: Array | float) -> Array:
    """Row in the error panel of a tracking error in m, on a logarithmic axis. Values beyond its ends are clipped."""
    low, high = ERROR_DECADES
    decade = np.log10(np.clip(error, 10.0**low, 10.0**high))
    return ERROR_PLOT.top + ERROR_PLOT.height * (high - decade) / (high - low)


class Backdrop(NamedTuple):
    """Static parts of a picture.

    Attributes:
        image: Picture without moving parts, (HEIGHT, WIDTH, 3) uint8.
        lit_floor: Floor panel as drawn inside the camera's footprint.
        rim: Flat pixel indices of the panels' rounded corners, int64.
        rim_opacity: Share of the panel in those pixels; the rest is paper, (k, 1) float32.
    """

    image: Image
    lit_floor: Image
    rim: Labels
    rim_opacity: FloatArray


@lru_cache(maxsize=16)
def backdrop(reach: float, caption: str, spacing: float = GRID_SPACING) -> Backdrop:
    """Backdrop for an arm of this reach (m), with a caption and grid lines `spacing` m apart."""
    image = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:] = PAPER
    FLOOR_PANEL.of(image)[:] = _floor(reach, spacing)
    CAMERA_PANEL.of(image)[:] = LENS
    _error_axes(ERROR_PANEL.of(image))
    put_text(CAMERA_PANEL.of(image), CAMERA_LABEL, *LABEL_PLACE, LENS_INK)
    put_text(FLOOR_PANEL.of(image), caption, 14, FLOOR_PANEL.height - 14, SOFT_INK)
    draw_legend(FLOOR_PANEL.of(image))
    lit = FLOOR_PANEL.of(image).astype(np.float32)
    lit += (np.array(TOOL, dtype=np.float32) - lit) * 0.075
    rim, opacity = _rounded_corners()
    return Backdrop(image, np.rint(lit).astype(np.uint8), rim, opacity)


def draw_legend(panel: Image) -> None:
    """Draw the legend of target and tool into the floor's panel."""
    put_text(panel, "target", 28, 20, SOFT_INK)
    put_text(panel, "tool", 84, 20, SOFT_INK)
    for x, color in ((19, TARGET), (75, TOOL)):
        cv2.circle(panel, (x * 16, 17 * 16), 56, color, -1, cv2.LINE_AA, 4)


def _floor(reach: float, spacing: float) -> Image:
    """Floor with a fine grain, a grid, and the circle of the arm's reach."""
    side = FLOOR_PANEL.width
    rng = np.random.default_rng(0)
    grain = rng.normal(0.0, 0.9, (side, side))
    for cells, strength in ((6, 1.8), (24, 1.2)):
        coarse = rng.normal(0.0, strength, (cells, cells))
        grain += cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    floor = np.rint(np.clip(np.array(FLOOR) + grain[..., None], 0, 255)).astype(np.uint8)
    farthest = int(_WINDOW_SIDE * reach / spacing)
    for k in range(-farthest, farthest + 1):
        column, row = floor_pixels(np.array([k, k]) * spacing, reach)
        color = mix(FLOOR_GRID, INK, 0.10) if k == 0 else FLOOR_GRID
        for ends in (((column, 0), (column, side)), ((0, row), (side, row))):
            cv2.polylines(floor, [fixed_point(np.array(ends))], False, color, 1, cv2.LINE_AA, 4)
    angles = np.radians(np.arange(-90, 271, 1.5))
    circle = floor_pixels(reach * np.stack([np.cos(angles), np.sin(angles)], axis=-1), reach)
    for dash in circle[:-1].reshape(-1, 2, 2):
        cv2.polylines(floor, [fixed_point(dash)], False, mix(FLOOR_GRID, INK, 0.25), 1, cv2.LINE_AA, 4)
    return floor


def _error_axes(panel: Image) -> None:
    """Axis of the tracking error, with the band below 10 mm that counts as success."""
    panel[:] = mix(PAPER, FLOOR, 0.45)
    left, right = ERROR_PLOT.left, ERROR_PLOT.left + ERROR_PLOT.width
    labels = {0: "1 m", -1: "0.1 m", -2: "1 cm", -3: "1 mm", -4: "0.1 mm"}
    success = -2
    top, bottom = (round(float(error_height(10.0**d))) for d in (success, ERROR_DECADES[0]))
    panel[top:bottom, left:right] = mix(PAPER, TOOL, 0.09)
    for decade in range(ERROR_DECADES[0], ERROR_DECADES[1] + 1):
        row = round(float(error_height(10.0**decade)))
        panel[row, left:right] = mix(PAPER, TOOL, 0.45) if decade == success else mix(PAPER, INK, 0.12)
        if decade % 2 == 0:
            put_text(panel, labels[decade], left - 6, row + 3, SOFT_INK, height=6, weight=0.9, align="right")
    put_text(panel, "tracking error", left, 14, SOFT_INK)


def _rounded_corners() -> tuple[Labels, FloatArray]:
    """Pixels at the panels' rounded corners, and the share of the panel in each of them."""
    fine, radius = 8, _CORNER_RADIUS
    quarter = np.zeros((radius * fine, radius * fine), dtype=np.uint8)
    cv2.circle(quarter, (radius * fine, radius * fine), radius * fine, 255, -1)
    corner = cv2.resize(quarter, (radius, radius), interpolation=cv2.INTER_AREA) / 255.0
    opacity = np.ones((HEIGHT, WIDTH), dtype=np.float32)
    for panel in (FLOOR_PANEL, CAMERA_PANEL, ERROR_PANEL):
        part = panel.of(opacity)
        part[:radius, :radius], part[:radius, -radius:] = corner, corner[:, ::-1]
        part[-radius:, :radius], part[-radius:, -radius:] = corner[::-1], corner[::-1, ::-1]
    rim = np.flatnonzero(opacity < 1.0)
    return rim, opacity.ravel()[rim, None]
