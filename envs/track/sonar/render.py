"""Pictures of a sonar scene: waterfall with tracks in identity colors, and plots of target number and OSPA."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import FLOOR, INK, IVORY, PAPER, SOFT_INK, VERMILION, Color, Panel, mix
from servotrack.envs.drawing.plots import SUBPIXEL_BITS, draw_axes, draw_curve, identity_color, write_value
from servotrack.estimators.metrics import Track
from servotrack.estimators.types import Array, Image

WIDTH, HEIGHT = 800, 544
MAX_RECORDS = 480
"""Maximum number of records in a waterfall; older records are not shown."""
WATERFALL = Panel(52, 16, 476, 492)
"""Panel of the waterfall in the picture, px."""

_NUMBER_PANEL = Panel(544, 16, 240, 248)
_ERROR_PANEL = Panel(544, 280, 240, 248)
_ERROR_COLOR: Color = VERMILION
_BEARING_MARKS = (0, 30, 60, 90, 120, 150, 180)
_SOFT_DEVIATIONS = 2.5
"""Standard deviations of noise up to which the logarithmic gray scale is nearly linear and pale."""
_BLACK_DEVIATIONS = (15.0, 1000.0)
"""Bounds of the standard deviations that are drawn black; between them, the largest value shown is black."""
_PALETTE: tuple[Color, ...] = ((247, 245, 240), (205, 214, 218), (140, 163, 176), (77, 104, 128), (27, 40, 61))
"""Colors from noise to the largest power."""


@dataclass(frozen=True)
class Waterfall:
    """Content of a picture of a sonar scene.

    Attributes:
        records: Beam powers relative to their noise level, oldest first, shape (k, beams); at most `MAX_RECORDS`.
        first: Number of the oldest record.
        averages: Number of averages M of a beam power.
        period: Time between records, s.
        horizon: Number of records that the picture spans.
        tracks: Reported tracks with their identities; steps are record numbers, states are bearings in deg.
        truth: True tracks.
        true_numbers: Number of targets at each answered record, shape (k,).
        reported_numbers: Number of reported targets at each answered record, shape (k,).
        errors: OSPA of each answer so far, shape (k,), deg.
        cutoff: Largest OSPA, deg.
        scored: Number of scored answers of an episode.
    """

    records: Array
    first: int
    averages: int
    period: float
    horizon: int
    tracks: Sequence[tuple[int, Track]]
    truth: Sequence[Track]
    true_numbers: Array
    reported_numbers: Array
    errors: Array
    cutoff: float
    scored: int


def draw(scene: Waterfall) -> Image:
    """Draw a scene: bearing from left to right, time downwards.

    Returns:
        A new RGB image, shape (544, 800, 3).
    """
    image = _backdrop().copy()
    panel = WATERFALL.of(image)
    span = max(min(scene.horizon, MAX_RECORDS), 1)
    height = round(panel.shape[0] * len(scene.records) / span)
    if height > 0:
        panel[:height] = paint_powers(scene.records, scene.averages, (panel.shape[1], height))
    _time_marks(image, scene, span)
    for label, track in scene.tracks:
        for piece in _pieces(track, scene.first):
            draw_track(panel, _pixels(piece, scene.first, span), label)
    for track in scene.truth:
        for piece in _pieces(track, scene.first):
            _dotted(panel, _pixels(piece, scene.first, span))
    numbers, errors = _NUMBER_PANEL.of(image), _ERROR_PANEL.of(image)
    most = 1.1 * max([4.0, *scene.true_numbers.tolist(), *scene.reported_numbers.tolist()])
    draw_curve(numbers, scene.true_numbers, most, scene.scored, mix(FLOOR, INK, 0.3), 4)
    draw_curve(numbers, scene.reported_numbers, most, scene.scored, INK, 1)
    draw_curve(errors, scene.errors, 1.05 * scene.cutoff, scene.scored, _ERROR_COLOR, 1)
    if len(scene.errors):
        write_value(numbers, f"{scene.reported_numbers[-1]:.0f} of {scene.true_numbers[-1]:.0f}")
        write_value(errors, f"{scene.errors[-1]:.2f} deg")
    return image


def paint_powers(records: Array, averages: int, size: tuple[int, int]) -> Image:
    """Paint a bearing-time record on a logarithmic scale: noise is pale, large powers are dark.

    Args:
        records: Beam powers relative to their noise level, shape (k, beams).
        averages: Number of averages M of a beam power; the standard deviation of noise is 1 / sqrt(M).
        size: Width and height of the image, px.

    Returns:
        RGB image, shape (height, width, 3), uint8.
    """
    deviations = (np.asarray(records) - 1.0) * np.sqrt(averages)
    loudest = float(np.clip(deviations.max(initial=0.0), *_BLACK_DEVIATIONS))
    shade = np.log(np.maximum(deviations, 0.0) / _SOFT_DEVIATIONS + 1.0) / np.log(loudest / _SOFT_DEVIATIONS + 1.0)
    tone = np.rint(255.0 * np.clip(shade, 0.0, 1.0)).astype(np.uint8)
    wide = cv2.resize(tone, (size[0], len(tone)), interpolation=cv2.INTER_AREA)
    rows = np.minimum((np.arange(size[1]) + 0.5) * len(tone) / size[1], len(tone) - 1).astype(np.int64)
    return _colors()[wide.reshape(len(tone), size[0])[rows]]


def draw_track(panel: Image, points: NDArray[np.int32], label: int) -> None:
    """Draw a track in the color of its identity, with a pale rim that is visible on any background.

    Args:
        panel: Part of the picture, changed in place.
        points: Pixel coordinates with 4 fractional bits, shape (k, 2).
        label: Identity.
    """
    cv2.polylines(panel, [points], False, IVORY, 4, cv2.LINE_AA, SUBPIXEL_BITS)
    cv2.polylines(panel, [points], False, identity_color(label), 2, cv2.LINE_AA, SUBPIXEL_BITS)


def _dotted(panel: Image, points: NDArray[np.int32]) -> None:
    """Draw a true track: a pale dot with a dark rim about every 24 px."""
    apart = np.hypot(*np.diff(points, axis=0, prepend=points[:1]).T) / (1 << SUBPIXEL_BITS)
    along = np.cumsum(apart)
    chosen = np.flatnonzero(np.diff(np.floor(along / 24.0), prepend=-1.0) > 0)
    for x, y in points[chosen].tolist():
        cv2.circle(panel, (x, y), 34, INK, -1, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.circle(panel, (x, y), 18, IVORY, -1, cv2.LINE_AA, SUBPIXEL_BITS)


def _pieces(track: Track, first: int) -> list[Track]:
    """Split a track into its visible parts without gaps."""
    shown = track.steps >= first
    steps, states = track.steps[shown], track.states[shown]
    cuts = np.flatnonzero(np.diff(steps) > 1) + 1
    return [Track(s, b) for s, b in zip(np.split(steps, cuts), np.split(states, cuts), strict=True) if len(s)]


def _pixels(track: Track, first: int, span: int) -> NDArray[np.int32]:
    """Return fixed-point pixels in the waterfall, at the middle of each record. A single record is a short stroke."""
    steps, bearings = track.steps.astype(np.float64), np.clip(track.states[:, 0], -20.0, 200.0)
    if len(steps) == 1:
        steps, bearings = steps[0] + np.array([-0.4, 0.4]), np.repeat(bearings, 2)
    x = (WATERFALL.width - 1) * bearings / 180.0
    y = WATERFALL.height * (steps - first + 0.5) / span
    return np.rint(np.stack([x, y], axis=1) * (1 << SUBPIXEL_BITS)).astype(np.int32)


def _time_marks(image: Image, scene: Waterfall, span: int) -> None:
    step = next(s for s in (10, 20, 30, 60, 120, 300, 600, 1800, 3600, 10**9) if span * scene.period <= 9 * s)
    begin = scene.first * scene.period
    for mark in range(0, int(begin + span * scene.period) + 1, step):
        y = WATERFALL.top + WATERFALL.height * (mark - begin) / (span * scene.period)
        if WATERFALL.top - 1 <= y <= WATERFALL.top + WATERFALL.height + 1:
            row = min(round(y), WATERFALL.top + WATERFALL.height - 1)
            image[row, WATERFALL.left - 5 : WATERFALL.left] = SOFT_INK
            text = f"{mark}" if mark else "0 s"
            put_text(image, text, WATERFALL.left - 9, min(y + 4.0, HEIGHT - 30), SOFT_INK, align="right")


@lru_cache(maxsize=1)
def _colors() -> Image:
    """Return the palette in 256 steps, shape (256, 3)."""
    at = np.linspace(0.0, len(_PALETTE) - 1.0, 256)
    shades = np.array(_PALETTE, dtype=np.float64)
    channels = [np.interp(at, np.arange(len(_PALETTE)), shades[:, channel]) for channel in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


@lru_cache(maxsize=1)
def _backdrop() -> Image:
    image = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
    image[:] = PAPER
    for panel in (WATERFALL, _NUMBER_PANEL, _ERROR_PANEL):
        panel.of(image)[:] = FLOOR
    bottom = WATERFALL.top + WATERFALL.height
    for bearing in _BEARING_MARKS:
        x = WATERFALL.left + round((WATERFALL.width - 1) * bearing / 180.0)
        image[bottom : bottom + 5, x] = SOFT_INK
        put_text(image, f"{bearing}" if bearing else "0 deg", x, bottom + 18, SOFT_INK, align="center")
    draw_axes(_NUMBER_PANEL.of(image), "targets reported")
    draw_axes(_ERROR_PANEL.of(image), "ospa")
    image.setflags(write=False)
    return image
