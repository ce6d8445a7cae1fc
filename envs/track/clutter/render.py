"""Pictures of a clutter scene: scan, ground truth and answer from above, and plots of target number and OSPA."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.drawing.palette import FLOOR, FLOOR_GRID, INK, IVORY, PAPER, SOFT_INK, VERMILION, Color, Panel, mix
from servotrack.envs.drawing.plots import (
    SUBPIXEL_BITS,
    TRAIL_LENGTH,
    draw_axes,
    draw_curve,
    identity_color,
    write_value,
)
from servotrack.estimators.types import Array, Image

WIDTH, HEIGHT = 800, 544

_MARGIN = 16
_SCENE_PANEL = Panel(_MARGIN, _MARGIN, 512, 512)
_NUMBER_PANEL = Panel(544, _MARGIN, 240, 248)
_ERROR_PANEL = Panel(544, 280, 240, 248)
_GRID_LINES = 8
_BANDS = 5
"""Number of pieces of a trail; each has one opacity."""
_ERROR_COLOR: Color = VERMILION


class Trail(NamedTuple):
    """Past positions of one identity, oldest first.

    Attributes:
        label: Identity; it decides the color.
        points: Positions, shape (k, 2), m.
    """

    label: int
    points: Array


@dataclass(frozen=True)
class TrackScene:
    """Content of a picture of a clutter scene.

    Attributes:
        half_width: Half the side of the square that the panel shows, m.
        measurements: Measurements of the scan, shape (z, 2), m.
        truth: True positions, shape (n, 2), m.
        true_trails: Past positions of the true targets that exist now, (k, 2) each, m.
        reported: Trails of the reported identities, current estimate last.
        held: Trails of identities that are held without being reported.
        true_numbers: Number of targets at each scan so far, shape (k,); empty without truth.
        reported_numbers: Number of reported targets at each answered scan, shape (k,).
        errors: OSPA of each answer so far, shape (k,), m.
        cutoff: Largest OSPA, m.
        horizon: Number of scans of an episode.
        sensor_lines: Lines from the sensor to its measurements, shape (z, 2, 2), m; empty for position sensors.
    """

    half_width: float
    measurements: Array
    truth: Array
    true_trails: Sequence[Array]
    reported: Sequence[Trail]
    held: Sequence[Trail]
    true_numbers: Array
    reported_numbers: Array
    errors: Array
    cutoff: float
    horizon: int
    sensor_lines: Array = field(default_factory=lambda: np.empty((0, 2, 2)))


def draw(scene: TrackScene) -> Image:
    """Draw a scene.

    Returns:
        A new RGB image, shape (544, 800, 3).
    """
    image = _backdrop().copy()
    _draw_scene(_SCENE_PANEL.of(image), scene)
    most = max(4.0, *scene.true_numbers.tolist(), *scene.reported_numbers.tolist())
    numbers = _NUMBER_PANEL.of(image)
    draw_curve(numbers, scene.true_numbers, most * 1.1, scene.horizon, mix(FLOOR, INK, 0.3), 4)
    draw_curve(numbers, scene.reported_numbers, most * 1.1, scene.horizon, INK, 1)
    errors = _ERROR_PANEL.of(image)
    draw_curve(errors, scene.errors, scene.cutoff * 1.05, scene.horizon, _ERROR_COLOR, 1)
    if len(scene.reported_numbers):
        of = f" of {scene.true_numbers[-1]:.0f}" if len(scene.true_numbers) else ""
        write_value(numbers, f"{scene.reported_numbers[-1]:.0f}{of}")
    if len(scene.errors):
        write_value(errors, f"{scene.errors[-1]:.1f} m")
    return image


@lru_cache(maxsize=1)
def _backdrop() -> Image:
    image = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:] = PAPER
    for panel in (_SCENE_PANEL, _NUMBER_PANEL, _ERROR_PANEL):
        panel.of(image)[:] = FLOOR
    scene = _SCENE_PANEL.of(image)
    for line in range(1, _GRID_LINES):
        at = round(line * _SCENE_PANEL.width / _GRID_LINES)
        scene[at, :] = FLOOR_GRID
        scene[:, at] = FLOOR_GRID
    draw_axes(_NUMBER_PANEL.of(image), "targets reported")
    draw_axes(_ERROR_PANEL.of(image), "ospa")
    image.setflags(write=False)
    return image


def _draw_scene(panel: Image, scene: TrackScene) -> None:
    for line in _pixels(scene.sensor_lines, scene.half_width):
        cv2.line(panel, line[0].tolist(), line[1].tolist(), mix(FLOOR, SOFT_INK, 0.25), 1, cv2.LINE_AA, SUBPIXEL_BITS)
    for points in scene.true_trails:
        cv2.polylines(
            panel,
            [_pixels(points[-TRAIL_LENGTH:], scene.half_width)],
            False,
            mix(FLOOR, INK, 0.28),
            3,
            cv2.LINE_AA,
            SUBPIXEL_BITS,
        )
    for x, y in _pixels(scene.measurements, scene.half_width).tolist():
        for dx, dy in ((44, 44), (44, -44)):
            cv2.line(panel, (x - dx, y - dy), (x + dx, y + dy), SOFT_INK, 1, cv2.LINE_AA, SUBPIXEL_BITS)
    for center in _pixels(scene.truth, scene.half_width).tolist():
        cv2.circle(panel, center, 8 << SUBPIXEL_BITS, INK, 1, cv2.LINE_AA, SUBPIXEL_BITS)
    for trail in scene.held:
        _trail(panel, trail, scene.half_width, 0.35)
    for trail in scene.reported:
        _trail(panel, trail, scene.half_width, 1.0)
        center = _pixels(trail.points[-1], scene.half_width).tolist()
        cv2.circle(panel, center, 85, IVORY, -1, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.circle(panel, center, 68, identity_color(trail.label), -1, cv2.LINE_AA, SUBPIXEL_BITS)


def _trail(panel: Image, trail: Trail, half_width: float, opacity: float) -> None:
    """Draw a polyline that fades with age, in pieces of one color each."""
    points = _pixels(trail.points[-TRAIL_LENGTH:], half_width)
    color = identity_color(trail.label)
    for band in range(_BANDS):
        newest = len(points) - round(TRAIL_LENGTH * (_BANDS - 1 - band) / _BANDS)
        oldest = max(len(points) - round(TRAIL_LENGTH * (_BANDS - band) / _BANDS) - 1, 0)
        if newest - oldest > 1:
            strength = opacity * (0.2 + 0.8 * (band + 1) / _BANDS)
            cv2.polylines(
                panel, [points[oldest:newest]], False, mix(FLOOR, color, strength), 2, cv2.LINE_AA, SUBPIXEL_BITS
            )


def _pixels(points: Array, half_width: float) -> NDArray[np.int32]:
    """Return fixed-point pixels in the scene's panel of points in m, y upwards. Points far outside are clipped."""
    side = float(_SCENE_PANEL.width)
    scaled = side / 2.0 * (1.0 + np.clip(np.asarray(points) / half_width, -4.0, 4.0) * np.array([1.0, -1.0]))
    return np.rint(scaled * (1 << SUBPIXEL_BITS)).astype(np.int32)
