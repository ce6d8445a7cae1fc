"""Pictures of tracking in video: frame with boxes and trails, and plots of number of people and error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from servotrack.envs.drawing.glyphs import put_text, text_width
from servotrack.envs.drawing.palette import (
    FLOOR,
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
from servotrack.envs.drawing.plots import PLOT_INSET, SUBPIXEL_BITS, TITLE_HEIGHT, draw_axes, write_value
from servotrack.envs.track.people.box_paint import BoxTrail, annotate, printable
from servotrack.envs.track.people.place_paint import PlaceMark, paint_places, write_places
from servotrack.estimators.types import Array, Image

_MARGIN = 16
_MAX_WIDTH = 960
"""Maximum width of the frame in the picture, px. Smaller frames are enlarged by whole numbers, larger ones shrunk."""
_PLOT_HEIGHT, _GAP = 112, 12
_MIN_WIDTH = 320  # of the picture without margins, px, so that the plots fit
_TRUTH_COLOR: Color = mix(FLOOR, INK, 0.38)
_ERROR_COLOR: Color = VERMILION
_NUMBER_COLOR: Color = TEAL


def _no_boxes() -> Array:
    return np.empty((0, 4))


@dataclass(frozen=True)
class BoxScene:
    """Content of a picture of tracking in video.

    Attributes:
        frame: RGB, uint8, shape (H, W, 3), or gray, shape (H, W).
        reported: Trails of the reported identities, current estimate last.
        held: Trails of identities that are held without being reported.
        truth: True boxes, shape (n, 4), or points, shape (n, 2), px.
        detections: Detected boxes, shape (n, 4), or points, shape (n, 2), px.
        reported_numbers: Number of reported people in each frame so far, shape (k,).
        true_numbers: True number of people in each frame so far, shape (k,); None if unknown.
        errors: Error of each answer so far, shape (k,); None: no plot.
        error_name: Name of the error metric.
        cutoff: Largest error.
        horizon: Number of frames that the plots span.
        title: Title of the plot of numbers.
        places: Counting zones and lines, px.
        intervals: Interval of the number of people in each frame so far, shape (k, 2); None: not shown.
    """

    frame: Image
    reported: Sequence[BoxTrail] = ()
    held: Sequence[BoxTrail] = ()
    truth: Array = field(default_factory=_no_boxes)
    detections: Array = field(default_factory=_no_boxes)
    reported_numbers: Array = field(default_factory=lambda: np.empty(0))
    true_numbers: Array | None = None
    errors: Array | None = None
    error_name: str = "ospa"
    cutoff: float = 1.0
    horizon: int = 300
    title: str = "people"
    places: Sequence[PlaceMark] = ()
    intervals: Array | None = None


def draw(scene: BoxScene) -> Image:
    """Draw a scene: the frame enlarged, and below it number and error over time.

    Returns:
        New RGB image with even sides, as video encoders require; 800 x 736 px for frames of 384 x 288 px.
    """
    frame = scene.frame if scene.frame.ndim == 3 else cv2.cvtColor(scene.frame, cv2.COLOR_GRAY2RGB)
    height, width = frame.shape[:2]
    scale = max(_MAX_WIDTH // width, 1) if width <= _MAX_WIDTH else _MAX_WIDTH / width
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    resized = cv2.resize(frame, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    large = np.ascontiguousarray(resized, dtype=np.uint8)
    paint_places(large, scene.places, scale)
    annotate(
        large,
        [BoxTrail(trail.label, np.asarray(trail.states) * scale) for trail in scene.reported],
        [BoxTrail(trail.label, np.asarray(trail.states) * scale) for trail in scene.held],
        np.asarray(scene.truth) * scale,
        np.asarray(scene.detections) * scale,
    )
    write_places(large, scene.places, scale)
    inner = max(size[0], _MIN_WIDTH)
    image = np.empty((2 * _MARGIN + size[1] + _GAP + _PLOT_HEIGHT, 2 * _MARGIN + inner, 3), dtype=np.uint8)
    image = image if image.shape[0] % 2 == 0 else np.empty((image.shape[0] + 1, *image.shape[1:]), dtype=np.uint8)
    image = image if image.shape[1] % 2 == 0 else np.empty((image.shape[0], image.shape[1] + 1, 3), dtype=np.uint8)
    _fill(image, PAPER)
    Panel(_MARGIN + (inner - size[0]) // 2, _MARGIN, *size).of(image)[:] = large
    top = _MARGIN + size[1] + _GAP
    share = 1.0 if scene.errors is None else 0.58
    number_width = round((inner - (0 if scene.errors is None else _GAP)) * share)
    _draw_numbers(Panel(_MARGIN, top, number_width, _PLOT_HEIGHT).of(image), scene)
    if scene.errors is not None:
        left = _MARGIN + number_width + _GAP
        _draw_errors(Panel(left, top, inner - number_width - _GAP, _PLOT_HEIGHT).of(image), scene, scene.errors)
    return image


def _fill(image: Image, color: Color) -> None:
    # Whole rows are copied: broadcasting three bytes takes NumPy twenty times as long.
    image[:] = np.tile(np.array(color, dtype=np.uint8), (image.shape[1], 1))


def _draw_numbers(panel: Image, scene: BoxScene) -> None:
    truth = np.empty(0) if scene.true_numbers is None else np.asarray(scene.true_numbers)
    ends = np.empty((0, 2)) if scene.intervals is None else np.asarray(scene.intervals)
    most = max([4.0, *truth.tolist(), *np.asarray(scene.reported_numbers).tolist(), *ends[:, 1].tolist()])
    _axes(panel, printable(scene.title))
    _band(panel, ends, most * 1.1, scene.horizon)
    _curve(panel, truth, most * 1.1, scene.horizon, _TRUTH_COLOR, 4)
    _curve(panel, np.asarray(scene.reported_numbers), most * 1.1, scene.horizon, _NUMBER_COLOR, 1)
    right = panel.shape[1] - PLOT_INSET
    if len(scene.reported_numbers):
        now = f"{scene.reported_numbers[-1]:.0f}"
        text = f"{now} of {truth[-1]:.0f}" if len(truth) else now
        text = f"{text} : {ends[-1, 0]:.0f}-{ends[-1, 1]:.0f}" if len(ends) else text
        put_text(panel, text, right, PLOT_INSET + 8, INK, align="right")
        right -= round(text_width(text, 8.0)) + 18
    if scene.true_numbers is not None:
        right = _legend(panel, "true", right, _TRUTH_COLOR, 4)
    _legend(panel, "reported", right, _NUMBER_COLOR, 2)


def _draw_errors(panel: Image, scene: BoxScene, errors: Array) -> None:
    _axes(panel, printable(scene.error_name))
    _curve(panel, np.asarray(errors), scene.cutoff * 1.05, scene.horizon, _ERROR_COLOR, 1)
    if len(errors):
        digits = 2 if scene.cutoff < 10.0 else 1
        write_value(panel, f"{errors[-1]:.{digits}f}")


def _axes(panel: Image, title: str) -> None:
    _fill(panel, FLOOR)
    draw_axes(panel, title, intervals=3)


def _legend(panel: Image, text: str, right: int, color: Color, thickness: int) -> int:
    """Draw a legend entry, right-aligned at column `right`. Return the right end of the next entry to the left."""
    put_text(panel, text, right, PLOT_INSET + 8, SOFT_INK, align="right")
    left = right - round(text_width(text, 8.0)) - 6
    panel[PLOT_INSET + 4 - thickness // 2 : PLOT_INSET + 4 - thickness // 2 + thickness, left - 14 : left] = color
    return left - 28


def _curve(panel: Image, values: Array, top: float, horizon: int, color: Color, thickness: int) -> None:
    """Draw the last `horizon` values, from 0 to `top`, as a step curve."""
    if len(values):
        points = fixed_point(_steps(panel, values[-horizon:], top, horizon))
        cv2.polylines(panel, [points], False, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS)


def _band(panel: Image, ends: Array, top: float, horizon: int) -> None:
    """Fill between the step curves of the last `horizon` lower and upper ends, shape (k, 2)."""
    if len(ends):
        low, high = (_steps(panel, ends[-horizon:, k], top, horizon) for k in range(2))
        outline = fixed_point(np.concatenate([low, high[::-1]]))
        cv2.fillPoly(panel, [outline], mix(FLOOR, _NUMBER_COLOR, 0.25), cv2.LINE_AA, SUBPIXEL_BITS)


def _steps(panel: Image, values: Array, top: float, horizon: int) -> Array:
    """Corners of a step curve from 0 to `top`. Shape (2 k, 2), px."""
    height, width = panel.shape[0] - 2 * PLOT_INSET - TITLE_HEIGHT, panel.shape[1] - 2 * PLOT_INSET
    x = PLOT_INSET + width * np.arange(len(values) + 1) / horizon
    y = PLOT_INSET + TITLE_HEIGHT + height * (1.0 - np.clip(values / top, 0.0, 1.0))
    return np.stack([np.repeat(x, 2)[1:-1], np.repeat(y, 2)], axis=1)
