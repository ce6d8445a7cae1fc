"""Pictures of UncalibServo3D: the arm from two sides, the camera's view, and the errors so far.

The scene is drawn at twice its size and reduced, so that edges are smooth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import (
    FLOOR,
    FLOOR_GRID,
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
from servotrack.estimators.types import Array, Image, Mask

WIDTH, HEIGHT = 960, 540
_MARGIN = 16
_VIEWS = Panel(_MARGIN, _MARGIN, 290, 508), Panel(_MARGIN + 302, _MARGIN, 290, 508)
_CAMERA = Panel(_MARGIN + 604, _MARGIN, 324, 243)
_ERRORS = Panel(_MARGIN + 604, _MARGIN + 255, 324, 253)
_SCALE = 2
_LENS: Color = (27, 36, 46)
_LENS_INK: Color = (148, 160, 170)
_GOAL: Color = (242, 240, 232)
_AZIMUTHS = math.radians(-55.0), math.radians(28.0)
_ELEVATION = math.radians(22.0)
_DISTANCE = 5.0  # of the viewer, in extents
_LIGHT = np.array([-0.45, -0.75])  # direction toward the light in the picture
_ERROR_SPAN = 801  # samples on the error plot's axis
_DECADES = (-1, 3)
_TRAIL = 160


@dataclass(frozen=True)
class ArmScene:
    """Contents of a picture of UncalibServo3D. Positions are in the base frame, m, z up.

    Attributes:
        skeleton: Base, present points of the joints' axes, and tool. Shape (n + 2, 3).
        tool: Pose of the tool. Shape (3, 4).
        goal: Pose of the tool at the goal. Shape (3, 4).
        eye: Pose of the camera. Shape (3, 4).
        marks: Points of the board. Shape (p, 3).
        optics: See `Episode`. Shape (5,), px.
        reach: Reach of the arm, m.
        center: Middle of the views. Shape (3,), m.
        extent: Radius about the middle that the views show, m.
        features: Newest delivered image points. Shape (p, 2), px.
        wanted: Desired image points. Shape (p, 2), px.
        visible: True for points that the newest frame shows. Shape (p,).
        feature_trail: Past image points, oldest first. Shape (k, p, 2), px.
        tip_trail: Past positions of the tool, oldest first. Shape (k, 3).
        errors: Past errors, oldest first: mm and degrees. Shape (k, 2).
        time: Time in the episode, s.
        caption: Name of the arm and of the level.
    """

    skeleton: Array
    tool: Array
    goal: Array
    eye: Array
    marks: Array
    optics: Array
    reach: float
    center: Array
    extent: float
    features: Array
    wanted: Array
    visible: Mask
    feature_trail: Array
    tip_trail: Array
    errors: Array
    time: float
    caption: str = ""


def draw(scene: ArmScene) -> Image:
    """Draw a scene.

    Returns:
        A new RGB image, shape (540, 960, 3).
    """
    image = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    image[:] = PAPER
    for panel, azimuth in zip(_VIEWS, _AZIMUTHS, strict=True):
        large = _wall(panel.width * _SCALE, panel.height * _SCALE).copy()
        _Side(scene, azimuth, large).draw()
        panel.of(image)[:] = cv2.resize(large, (panel.width, panel.height), interpolation=cv2.INTER_AREA)
    put_text(_VIEWS[0].of(image), scene.caption, 14, 22, SOFT_INK)
    put_text(_VIEWS[1].of(image), f"{scene.time:.1f} s", _VIEWS[1].width - 14, 22, SOFT_INK, align="right")
    _draw_camera(_CAMERA.of(image), scene)
    _draw_errors(_ERRORS.of(image), scene)
    return image


@lru_cache(maxsize=2)
def _wall(width: int, height: int) -> Image:
    """Empty view: a wall that brightens upward."""
    rows = np.linspace(0.0, 1.0, height)[:, None, None]
    image = np.rint(np.array(PAPER) * (1.0 - rows) + np.array(FLOOR) * rows).astype(np.uint8).repeat(width, axis=1)
    image.setflags(write=False)
    return image


class _Side:
    """One perspective view of the arm.

    Args:
        scene: Contents of the picture.
        azimuth: Direction of the viewer, rad.
        image: The empty view, painted in place.
    """

    def __init__(self, scene: ArmScene, azimuth: float, image: Image) -> None:
        self._scene, self._azimuth, self._image = scene, azimuth, image
        self._height, self._width = image.shape[:2]

    def draw(self) -> None:
        """Draw floor, shadow, board, camera, goal and arm, the farther ones first."""
        scene = self._scene
        self._floor()
        self._shadow()
        trail, _ = self._pixels(scene.tip_trail[-_TRAIL:])
        if len(trail) > 1:
            cv2.polylines(self._image, [fixed_point(trail)], False, mix(FLOOR, TEAL, 0.55), 3, cv2.LINE_AA, 4)
        self._frame(scene.goal, 0.13, 5, faded=0.45)
        parts = [(self._depth(scene.marks), self._board), (self._depth(scene.eye[:, 3][None]), self._camera)]
        arm = self._depth(scene.skeleton)
        for _, part in sorted((p for p in parts if p[0] > arm), key=lambda p: -p[0]):
            part()
        self._arm()
        for _, part in sorted((p for p in parts if p[0] <= arm), key=lambda p: -p[0]):
            part()
        self._frame(scene.tool, 0.11, 6)

    def _pixels(self, points: Array) -> tuple[Array, Array]:
        """Perspective picture of points in the base frame. Returns pixels (k, 2) and distances in extents (k,)."""
        scene = self._scene
        centered = (np.asarray(points) - scene.center) / scene.extent
        ca, sa, ce, se = math.cos(self._azimuth), math.sin(self._azimuth), math.cos(_ELEVATION), math.sin(_ELEVATION)
        x = -sa * centered[:, 0] + ca * centered[:, 1]
        toward = ca * centered[:, 0] + sa * centered[:, 1]
        depth = _DISTANCE - (ce * toward + se * centered[:, 2])
        y = -se * toward + ce * centered[:, 2]
        middle = np.array([self._width / 2.0, 0.5 * self._height])
        return middle + self._focal * np.stack([x / depth, -y / depth], axis=-1), depth

    @property
    def _focal(self) -> float:
        return 0.47 * self._width * _DISTANCE

    def _depth(self, points: Array) -> float:
        return float(self._pixels(points)[1].mean())

    def _radius(self, share: float, depth: float) -> float:
        """Radius in px of a ball of a share of the reach."""
        return share * self._scene.reach / self._scene.extent * self._focal / depth

    def _floor(self) -> None:
        """Draw the floor's grid, lines a quarter of the reach apart, out to a circle."""
        reach, color = self._scene.reach, mix(FLOOR_GRID, INK, 0.08)
        half = 1.5
        for k in np.arange(-half, half + 0.01, 0.25):
            span = math.sqrt(half * half - k * k)
            for ends in ([[k, -span, 0.0], [k, span, 0.0]], [[-span, k, 0.0], [span, k, 0.0]]):
                pixels, _ = self._pixels(reach * np.linspace(ends[0], ends[1], 2))
                cv2.polylines(self._image, [fixed_point(pixels)], False, color, 2, cv2.LINE_AA, 4)

    def _shadow(self) -> None:
        flat = self._scene.skeleton * np.array([1.0, 1.0, 0.0]) + self._scene.skeleton[:, 2:] * np.array([0.25, 0.2, 0])
        points, _ = self._pixels(flat)
        shade = np.zeros((self._height // 4, self._width // 4), np.uint8)
        cv2.polylines(shade, [fixed_point(points / 4.0)], False, 46, max(3, self._width // 80), cv2.LINE_AA, 4)
        shade = cv2.resize(cv2.blur(shade, (9, 9)), (self._width, self._height), interpolation=cv2.INTER_LINEAR)
        cv2.subtract(self._image, cv2.cvtColor(shade, cv2.COLOR_GRAY2RGB), dst=self._image)

    def _arm(self) -> None:
        points, depths = self._pixels(self._scene.skeleton)
        n = len(points)
        width = np.linspace(0.062, 0.03, n)
        segments = []
        for k in range(n - 1):
            segments.append((0.5 * (depths[k] + depths[k + 1]), k))
        base, base_depth = points[0], float(depths[0])
        self._disc(base, 1.7 * self._radius(0.062, base_depth), mix(INK, PAPER, 0.55), squash=0.45)
        for _, k in sorted(segments, reverse=True):
            a, b = self._radius(width[k], depths[k]), self._radius(width[k + 1], depths[k + 1])
            self._tube(points[k], points[k + 1], a, b)
            self._ball(points[k + 1], 1.18 * b)
            if k > 0:
                self._ball(points[k], 1.18 * a)

    def _tube(self, start: Array, end: Array, first: float, second: float) -> None:
        """Draw a tapered tube, lit from the upper left: strips from dark to light, moved toward the light."""
        if np.hypot(*(end - start)) < 1e-6:
            return
        along = (end - start) / np.hypot(*(end - start))
        side = np.array([-along[1], along[0]])
        side = side if side @ _LIGHT > 0 else -side
        tilt = float(side @ _LIGHT / np.hypot(*_LIGHT))
        for share, shade in ((1.0, 0.62), (0.93, 0.42), (0.74, 0.24), (0.5, 0.10), (0.24, 0.0)):
            move = side * (1.0 - share) * 0.55 * tilt
            a, b = start + move * first, end + move * second
            ring = np.array([a + side * share * first, b + side * share * second])
            back = np.array([b - side * share * second, a - side * share * first])
            cv2.fillConvexPoly(
                self._image, fixed_point(np.vstack([ring, back])), mix(IVORY, INK, shade), cv2.LINE_AA, 4
            )

    def _ball(self, center: Array, radius: float) -> None:
        for share, shade in ((1.0, 0.05), (0.9, 0.16), (0.66, 0.28), (0.4, 0.42), (0.18, 0.6)):
            place = center + _LIGHT * (1.0 - share) * 0.5 * radius
            self._disc(place, share * radius, mix(INK, PAPER, shade))

    def _disc(self, center: Array, radius: float, color: Color, squash: float = 1.0) -> None:
        if np.abs(center).max() < 4000.0 and radius > 0.5:
            at = fixed_point(center).tolist()
            axes = (round(16 * radius), round(16 * radius * squash))
            cv2.ellipse(self._image, at, axes, 0.0, 0.0, 360.0, color, -1, cv2.LINE_AA, 4)

    def _board(self) -> None:
        scene = self._scene
        if len(scene.marks) >= 4:
            middle = scene.marks.mean(axis=0)
            corners = middle + 1.35 * (scene.marks[:4] - middle)
            pixels, _ = self._pixels(corners)
            hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
            cv2.fillConvexPoly(self._image, fixed_point(hull.astype(np.float64)), IVORY, cv2.LINE_AA, 4)
            cv2.polylines(
                self._image, [fixed_point(hull.astype(np.float64))], True, mix(INK, PAPER, 0.5), 3, cv2.LINE_AA, 4
            )
        pixels, depths = self._pixels(scene.marks)
        for place, depth in zip(pixels, depths, strict=True):
            self._disc(place, self._radius(0.017, depth), VERMILION)

    def _camera(self) -> None:
        """Draw the camera as a body with the pyramid of its view."""
        scene = self._scene
        eye, size = scene.eye, 0.16 * scene.reach
        focal, _, _, width, height = scene.optics
        x, y = 0.5 * width / focal * size, 0.5 * height / focal * size
        corners = np.array([(-x, -y, size), (x, -y, size), (x, y, size), (-x, y, size)])
        ends, _ = self._pixels(corners @ eye[:, :3].T + eye[:, 3])
        tip, depth = self._pixels(eye[:, 3][None])
        glass = self._image.copy()
        cv2.fillConvexPoly(glass, fixed_point(ends), mix(TEAL, PAPER, 0.3), cv2.LINE_AA, 4)
        cv2.addWeighted(glass, 0.35, self._image, 0.65, 0.0, dst=self._image)
        for end in ends:
            cv2.polylines(self._image, [fixed_point(np.stack([tip[0], end]))], False, TEAL, 2, cv2.LINE_AA, 4)
        cv2.polylines(self._image, [fixed_point(ends)], True, TEAL, 3, cv2.LINE_AA, 4)
        self._disc(tip[0], self._radius(0.03, float(depth[0])), TEAL)
        self._disc(tip[0], self._radius(0.014, float(depth[0])), IVORY)

    def _frame(self, pose: Array, share: float, thickness: int, faded: float = 0.0) -> None:
        """Draw the axes of a pose: x red, y green, z blue."""
        length = share * self._scene.reach
        ends = np.vstack([pose[:, 3], pose[:, 3] + length * pose[:, 0], pose[:, 3] + length * pose[:, 1]])
        ends = np.vstack([ends, pose[:, 3] + length * pose[:, 2]])
        pixels, _ = self._pixels(ends)
        for end, color in zip(pixels[1:], ((206, 72, 50), (70, 140, 70), (58, 96, 176)), strict=True):
            line = fixed_point(np.stack([pixels[0], end]))
            cv2.polylines(self._image, [line], False, mix(color, FLOOR, faded), thickness, cv2.LINE_AA, 4)


def _draw_camera(panel: Image, scene: ArmScene) -> None:
    large = np.empty((panel.shape[0] * _SCALE, panel.shape[1] * _SCALE, 3), np.uint8)
    large[:] = _LENS
    width, height = scene.optics[3:]
    scale = min(large.shape[1] / width, large.shape[0] / height)
    shift = np.array([large.shape[1] - scale * width, large.shape[0] - scale * height]) / 2.0
    wanted, features = scene.wanted * scale + shift, scene.features * scale + shift
    if len(wanted) >= 4:
        for points, color in ((wanted, mix(_LENS, _GOAL, 0.35)), (features, mix(_LENS, VERMILION, 0.5))):
            hull = cv2.convexHull(points[:4].astype(np.float32))[:, 0]
            cv2.polylines(large, [fixed_point(hull)], True, color, 2, cv2.LINE_AA, 4)
    for k in range(scene.feature_trail.shape[1]):
        line = scene.feature_trail[-_TRAIL:, k] * scale + shift
        if len(line) > 1:
            cv2.polylines(large, [fixed_point(line)], False, mix(_LENS, VERMILION, 0.45), 2, cv2.LINE_AA, 4)
    for goal, feature, seen in zip(wanted, features, scene.visible, strict=True):
        for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            tick = np.array([goal + np.array([dx, dy]) * 8.0, goal + np.array([dx, dy]) * 20.0])
            cv2.polylines(large, [fixed_point(tick)], False, _GOAL, 2, cv2.LINE_AA, 4)
        at = fixed_point(feature).tolist()
        cv2.circle(large, at, 10 * 16, VERMILION, -1 if seen else 3, cv2.LINE_AA, 4)
    cv2.resize(large, (panel.shape[1], panel.shape[0]), dst=panel, interpolation=cv2.INTER_AREA)
    put_text(panel, "camera", 14, 20, _LENS_INK)
    unseen = int((~scene.visible).sum())
    if unseen:
        put_text(panel, f"{unseen} not seen", panel.shape[1] - 14, 20, VERMILION, align="right")


def _draw_errors(panel: Image, scene: ArmScene) -> None:
    panel[:] = mix(PAPER, FLOOR, 0.45)
    left, right, top, bottom = 46, panel.shape[1] - 16, 44, panel.shape[0] - 18
    low, high = _DECADES

    def row(value: Array | float) -> Array:
        decade = np.log10(np.clip(value, 10.0**low, 10.0**high))
        return top + (bottom - top) * (high - decade) / (high - low)

    for decade in range(low, high + 1):
        at = round(float(row(10.0**decade)))
        panel[at, left:right] = mix(PAPER, INK, 0.12)
        put_text(panel, f"{10.0**decade:g}", left - 8, at + 3, SOFT_INK, height=6, weight=0.9, align="right")
    for bound, color in ((2.0, TEAL), (1.0, VERMILION)):
        at = round(float(row(bound)))
        panel[at, left:right:3] = mix(PAPER, color, 0.8)
    if len(scene.errors) > 1:
        shown = scene.errors[-_ERROR_SPAN:]
        columns = left + (right - left) * np.arange(len(shown)) / (_ERROR_SPAN - 1)
        for k, color in ((1, VERMILION), (0, TEAL)):
            curve = fixed_point(np.stack([columns, row(shown[:, k])], axis=-1))
            cv2.polylines(panel, [curve], False, color, 1, cv2.LINE_AA, 4)
            cv2.circle(panel, curve[-1].tolist(), 40, color, -1, cv2.LINE_AA, 4)
    millimeters, degrees = scene.errors[-1] if len(scene.errors) else (0.0, 0.0)
    put_text(panel, f"tip error {millimeters:.1f} mm", 16, 22, TEAL)
    put_text(panel, f"{degrees:.2f} degrees", panel.shape[1] - 16, 22, VERMILION, align="right")
