"""Film of a servo episode: arm and board from outside, the camera's image with corners and goal, and the error."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import PIL.Image
from mujoco_arm import mujoco  # imported there, after the choice of how to render
from so101_simulation import HEIGHT, PERIOD, WIDTH, Array, Image, SimulatedSO101

from servotrack.baselines.reporting.film import write_film
from servotrack.envs.drawing.glyphs import put_text, text_width
from servotrack.envs.drawing.palette import (
    FLOOR,
    INK,
    IVORY,
    PAPER,
    SOFT_INK,
    TEAL,
    VERMILION,
    Color,
    Panel,
    fixed_point,
    mix,
)

if TYPE_CHECKING:
    from so101_servo import Step

SIZE = 1280, 720
_MARGIN = 16
_RIGHT = 480
_SCENE = Panel(_MARGIN, _MARGIN, SIZE[0] - _RIGHT - 3 * _MARGIN, SIZE[1] - 2 * _MARGIN)
_CAMERA = Panel(_SCENE.width + 2 * _MARGIN, _MARGIN, _RIGHT, _RIGHT * HEIGHT // WIDTH)
_ERROR = Panel(_CAMERA.left, _CAMERA.height + 2 * _MARGIN, _RIGHT, SIZE[1] - _CAMERA.height - 3 * _MARGIN)
_SCALE = 2
_DECADES = (-1, 3)
_TRAIL = 80
_VIEWS = {"hand": (138.0, -24.0, 0.6), "world": (118.0, -24.0, 0.78)}
"""Azimuth and elevation of the viewer, degrees, and distance, m."""
_SWEEP = 14.0
"""Turn of the viewer in a film, degrees."""


def write(frames: Iterable[Image], path: Path) -> None:
    """Write a film of one frame per control period.

    Args:
        frames: RGB images.
        path: Ends in .webm, .mp4 or .avi; .webp makes a small animation of half the size and half the frame rate.
    """
    if path.suffix != ".webp":
        write_film(frames, path, 1.0 / PERIOD)
        return
    half = (SIZE[0] // 2, SIZE[1] // 2)
    kept = [cv2.resize(frame, half, interpolation=cv2.INTER_AREA) for frame in itertools.islice(frames, 0, None, 2)]
    first, *others = [PIL.Image.fromarray(frame) for frame in kept]
    first.save(path, save_all=True, append_images=others, duration=round(2e3 * PERIOD), loop=0, quality=50, method=6)


class Painter:
    """Painter of a film's frames.

    Args:
        robot: Arm, camera and board.
        goal: Wanted places of the corners. Shape (16, 2), px.
        seconds: Duration of the film.
        on_target: Error that is marked in the plot, px.
    """

    def __init__(self, robot: SimulatedSO101, goal: Array, seconds: float, on_target: float) -> None:
        self._robot, self._goal, self._seconds, self._on_target = robot, goal, seconds, on_target
        self._renderer = mujoco.Renderer(robot.model, _SCALE * _SCENE.height, _SCALE * _SCENE.width)
        self._trail: list[Array] = []
        self._errors: list[tuple[float, float]] = []
        places = [robot.data.body(name).xpos for name in ("base", "gripper", "board", "eye")]
        self._middle = 0.5 * (np.min(places, axis=0) + np.max(places, axis=0))

    def paint(self, step: Step) -> Image:
        """Return the picture of a control step, RGB. Shape (720, 1280, 3)."""
        self._trail.append(step.corners)
        self._errors.append((step.reading.frame_time, step.error))
        picture = np.empty((SIZE[1], SIZE[0], 3), np.uint8)
        picture[:] = PAPER
        _SCENE.of(picture)[:] = self._outside(step.reading.time)
        scene = _SCENE.of(picture)
        put_text(scene, "so-101 in mujoco: simulated", 18, 36, INK, height=15, weight=1.8)
        put_text(
            scene, f"eye {'in' if self._robot.camera == 'hand' else 'to'} hand", 18, 62, SOFT_INK, height=13, weight=1.6
        )
        put_text(
            scene, f"{step.reading.time:.1f} s", scene.shape[1] - 18, 36, INK, height=15, weight=1.8, align="right"
        )
        self._draw_camera(_CAMERA.of(picture), step)
        self._draw_error(_ERROR.of(picture), step)
        return picture

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()

    def _outside(self, time: float) -> Image:
        azimuth, elevation, distance = _VIEWS[self._robot.camera]
        viewer = mujoco.MjvCamera()
        viewer.lookat, viewer.distance, viewer.elevation = self._middle, distance, elevation
        viewer.azimuth = azimuth + _SWEEP * (time / self._seconds - 0.5)
        self._renderer.update_scene(self._robot.data, viewer)
        return cv2.resize(self._renderer.render(), (_SCENE.width, _SCENE.height), interpolation=cv2.INTER_AREA)

    def _draw_camera(self, panel: Image, step: Step) -> None:
        ratio = _SCALE * panel.shape[1] / WIDTH
        large = cv2.resize(step.reading.image, None, fx=ratio, fy=ratio, interpolation=cv2.INTER_CUBIC)

        def pixels(corners: Array) -> Array:
            return (corners + 0.5) * ratio

        for k in range(0, 16, 5):  # one corner of each marker, the outermost ones
            trail = pixels(np.array(self._trail[-_TRAIL:])[:, k])
            cv2.polylines(large, [fixed_point(trail)], False, mix(VERMILION, IVORY, 0.45), 3, cv2.LINE_AA, 4)
        for quad in pixels(self._goal).reshape(4, 4, 2):
            cv2.polylines(large, [fixed_point(quad)], True, TEAL, 5, cv2.LINE_AA, 4)
        for place in pixels(self._goal):
            for arm in ((9, 0), (0, 9)):
                tick = np.array([place - arm, place + arm])
                cv2.polylines(large, [fixed_point(tick)], False, TEAL, 3, cv2.LINE_AA, 4)
        for place, seen in zip(pixels(step.corners), step.seen, strict=True):
            at = fixed_point(place).tolist()
            cv2.circle(large, at, 7 * 16, IVORY, 3, cv2.LINE_AA, 4)
            cv2.circle(large, at, 6 * 16, VERMILION, -1 if seen else 2, cv2.LINE_AA, 4)
        cv2.resize(large, (panel.shape[1], panel.shape[0]), dst=panel, interpolation=cv2.INTER_AREA)
        _tag(panel, "camera", INK)
        hidden = int((~step.seen).sum())
        if hidden:
            _tag(panel, f"{hidden} corners not seen", VERMILION, right=True)

    def _draw_error(self, panel: Image, step: Step) -> None:
        panel[:] = mix(PAPER, FLOOR, 0.5)
        left, right, top, bottom = 68, panel.shape[1] - 24, 64, panel.shape[0] - 40
        low, high = _DECADES

        def row(error: Array | float) -> Array:
            return top + (bottom - top) * (high - np.log10(np.clip(error, 10.0**low, 10.0**high))) / (high - low)

        def column(time: Array | float) -> Array:
            return left + (right - left) * np.asarray(time) / self._seconds

        for decade in range(low, high + 1):
            at = round(float(row(10.0**decade)))
            panel[at, left:right] = mix(PAPER, INK, 0.13)
            put_text(panel, f"{10.0**decade:g}", left - 10, at + 5, SOFT_INK, height=11, weight=1.4, align="right")
        for second in range(0, math.floor(self._seconds) + 1, 2):
            put_text(panel, f"{second}", float(column(second)), bottom + 24, SOFT_INK, 11.0, 1.4, align="center")
        at = round(float(row(self._on_target)))
        panel[at, left:right:3] = TEAL
        put_text(panel, "mean corner error px", 18, 34, INK, height=13, weight=1.6)
        if not math.isnan(step.error):
            color: Color = TEAL if step.error < self._on_target else VERMILION
            put_text(panel, f"{step.error:.1f}", panel.shape[1] - 24, 36, color, height=17, weight=2.2, align="right")
        curve = np.array([point for point in self._errors if not math.isnan(point[1]) and point[0] >= 0.0])
        if len(curve) > 1:
            large = cv2.resize(panel, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_NEAREST)
            points = _SCALE * np.stack([column(curve[:, 0]), row(curve[:, 1])], axis=1)
            cv2.polylines(large, [fixed_point(points)], False, VERMILION, 4, cv2.LINE_AA, 4)
            cv2.circle(large, fixed_point(points[-1]).tolist(), 8 * 16, VERMILION, -1, cv2.LINE_AA, 4)
            cv2.resize(large, (panel.shape[1], panel.shape[0]), dst=panel, interpolation=cv2.INTER_AREA)


def _tag(panel: Image, text: str, color: Color, right: bool = False) -> None:
    """Write into an upper corner, on a plate, because the image behind it has any brightness."""
    width = round(text_width(text, 13.0)) + 20
    left = panel.shape[1] - width - 8 if right else 8
    panel[8:40, left : left + width] = mix(IVORY, PAPER, 0.5)
    put_text(panel, text, left + 10, 30, color, height=13, weight=1.6)
