"""Pictures of UncalibServo: the arm from above, the camera's view, and the tracking error so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import FLOOR, INK, IVORY, PAPER, SOFT_INK, Color, fixed_point, mix
from servotrack.envs.servo import backdrop
from servotrack.estimators.types import Array, Image

TRAIL_LENGTH = 126
"""Number of visible samples of a trail: one period of the paper's ellipse."""
ERROR_SPAN = 260
"""Number of samples in the error plot before it scrolls: an episode with its warm-up."""

_BANDS = 7  # bands of constant color in a trail
# Three thin lines side by side (offsets in 1/16 px) look like one 2 px wide, in half of OpenCV's time for that.
_STRANDS = np.array([(-5, -5), (6, -2), (-2, 6)], dtype=np.int32)[:, None]
_SHADOW_OFFSET = np.array([5.0, 7.0])  # px, for light from the upper left
_SHADOW_DEPTH = 34  # gray levels


def _none() -> Array:
    return np.empty((0, 2))


@dataclass(frozen=True)
class ServoScene:
    """Contents of a picture of UncalibServo.

    Attributes:
        links: Link lengths. Shape (2,), m.
        joint_angles: Joint angles of the arm. Shape (2,), rad.
        target: Position of the target in the base frame. Shape (2,), m.
        feature: Newest delivered image point of the target. Shape (2,), px.
        goal: Desired image point. Shape (2,), px.
        camera_size: Width and height of the camera's image, px.
        visible: True if the newest frame shows the target.
        tracking_error: Distance between tool and target in the plane, m.
        time: Time in the episode, negative during the warm-up, s.
        tool_trail: Past tool positions, oldest first. Shape (k, 2), m.
        target_trail: Past target positions. Shape (k, 2), m.
        feature_trail: Past image points. Shape (k, 2), px.
        error_history: Past tracking errors, oldest first. Shape (k,), m.
        footprint: Outline of the floor area in the camera's view, or None. Shape (k, 2), m.
        floor_lines: The floor's grid in the camera's image: polylines of image points, px.
        camera_image: Camera image of any size, RGB uint8, shown in place of the grid, or None.
        distractor: Position of a second marker that is not the target, or None. Shape (2,), m.
        caption: Name of the world, for example `level 3 optics`: lower-case letters and digits.
    """

    links: Array
    joint_angles: Array
    target: Array
    feature: Array
    goal: Array
    camera_size: float
    visible: bool
    tracking_error: float
    time: float
    tool_trail: Array = field(default_factory=_none)
    target_trail: Array = field(default_factory=_none)
    feature_trail: Array = field(default_factory=_none)
    error_history: Array = field(default_factory=lambda: np.empty(0))
    footprint: Array | None = None
    floor_lines: Sequence[Array] = ()
    camera_image: Image | None = None
    distractor: Array | None = None
    caption: str = ""


def draw(scene: ServoScene) -> Image:
    """Draw a scene.

    Returns:
        A new RGB image, shape (416, 720, 3).
    """
    parts = backdrop.backdrop(round(float(np.sum(scene.links)), 6), scene.caption)
    image = parts.image.copy()
    _draw_floor(backdrop.FLOOR_PANEL.of(image), scene, parts.lit_floor)
    _draw_camera(backdrop.CAMERA_PANEL.of(image), scene)
    _draw_error(backdrop.ERROR_PANEL.of(image), scene)
    round_corners(image, parts)
    return image


def round_corners(image: Image, parts: backdrop.Backdrop) -> None:
    """Round the corners of the finished panels."""
    pixels = image.reshape(-1, 3)
    inside = pixels[parts.rim] * parts.rim_opacity
    pixels[parts.rim] = np.rint(inside + np.array(PAPER) * (1.0 - parts.rim_opacity))


def _draw_floor(panel: Image, scene: ServoScene, lit_floor: Image) -> None:
    reach = float(np.sum(scene.links))
    scale = backdrop.floor_scale(reach) * reach
    if scene.footprint is not None:
        light_footprint(panel, backdrop.floor_pixels(scene.footprint, reach), lit_floor)
    trail(panel, backdrop.floor_pixels(scene.target_trail, reach), FLOOR, backdrop.TARGET)
    trail(panel, backdrop.floor_pixels(scene.tool_trail, reach), FLOOR, backdrop.TOOL)

    if scene.distractor is not None:
        _marker(panel, backdrop.floor_pixels(scene.distractor, reach), 0.021 * scale, backdrop.DISTRACTOR)
    draw_arm(panel, scene.links, scene.joint_angles)
    _marker(panel, backdrop.floor_pixels(scene.target, reach), 0.021 * scale, backdrop.TARGET)
    put_text(panel, f"{max(scene.time, 0.0):.1f} s", panel.shape[1] - 14, 20, SOFT_INK, align="right")


def light_footprint(panel: Image, corners: Array, lit_floor: Image) -> None:
    """Light up the floor area in the camera's view, given the corners of its outline in the panel's pixels, (k, 2)."""
    outline = fixed_point(corners)
    mask = np.zeros(panel.shape[:2], dtype=np.uint8)
    cv2.fillPoly(mask, [outline], 255, cv2.LINE_8, 4)
    cv2.copyTo(lit_floor, mask, panel)
    cv2.polylines(panel, [outline], True, mix(FLOOR, backdrop.TOOL, 0.45), 1, cv2.LINE_AA, 4)


def trail(panel: Image, points: Array, floor: Color, color: Color) -> None:
    """Draw a polyline that fades with age, in bands of constant color. Points are oldest first."""
    strands: NDArray[np.int32] = fixed_point(points[-TRAIL_LENGTH:]) + _STRANDS
    length = strands.shape[1]
    cuts = [length - round(TRAIL_LENGTH * k / _BANDS) for k in range(_BANDS, -1, -1)]
    for band, (start, end) in enumerate(pairwise(cuts)):
        first = max(start, 0)
        if end > first:
            strength = 0.12 + 0.88 * ((band + 1) / _BANDS) ** 1.6
            # One point of overlap closes the gap to the next band.
            band_strands = list(strands[:, first : end + 1])
            cv2.polylines(panel, band_strands, False, mix(floor, color, strength), 1, cv2.LINE_AA, 4)


def draw_arm(panel: Image, links: Array, joint_angles: Array) -> None:
    """Draw an arm and its shadow into the floor's panel.

    Args:
        panel: RGB image of the size of the floor's panel, painted in place.
        links: Link lengths, shape (2,), m.
        joint_angles: Joint angles, shape (2,), rad.
    """
    reach = float(np.sum(links))
    # Widths are fractions of the reach, so that arms of all sizes look alike.
    scale = backdrop.floor_scale(reach) * reach
    first, both = joint_angles[0], joint_angles[0] + joint_angles[1]
    elbow = links[0] * np.array([np.cos(first), np.sin(first)])
    tool = elbow + links[1] * np.array([np.cos(both), np.sin(both)])
    base, elbow, tool = backdrop.floor_pixels(np.stack([np.zeros(2), elbow, tool]), reach)
    _shadow(panel, base, elbow, tool, scale)
    _arm(panel, base, elbow, tool, both, scale)


def _shadow(panel: Image, base: Array, elbow: Array, tool: Array, scale: float) -> None:
    """Draw a soft shadow, at half resolution, which gives the same impression."""
    half = np.zeros((panel.shape[0] // 2, panel.shape[1] // 2), dtype=np.uint8)
    points = fixed_point((np.stack([base, elbow, tool]) + _SHADOW_OFFSET) / 2.0)
    cv2.polylines(half, [points], False, _SHADOW_DEPTH, max(2, round(0.038 * scale)), cv2.LINE_8, 4)
    half = cv2.blur(half, (7, 7))
    corners = np.stack([base, elbow, tool])
    low = np.clip((corners.min(axis=0) - 24.0) // 2, 0, None).astype(int)
    high = np.clip((corners.max(axis=0) + 40.0) // 2, 0, [half.shape[1], half.shape[0]]).astype(int)
    part = half[low[1] : high[1], low[0] : high[0]]
    if part.size:
        region = panel[2 * low[1] : 2 * high[1], 2 * low[0] : 2 * high[0]]
        shade = cv2.cvtColor(cv2.resize(part, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR), cv2.COLOR_GRAY2RGB)
        cv2.subtract(region, shade, dst=region)


def _arm(panel: Image, base: Array, elbow: Array, tool: Array, heading: float, scale: float) -> None:
    """Draw base, two tapered links, joints, and the camera at the tool."""
    plate = 0.080 * scale
    disc(panel, base, plate, mix(INK, PAPER, 0.62))
    disc(panel, base, plate - 1.3, mix(FLOOR, PAPER, 0.35))
    _link(panel, base, elbow, 0.042 * scale, 0.033 * scale)
    _link(panel, elbow, tool, 0.033 * scale, 0.022 * scale)
    for joint, radius in ((base, 0.027 * scale), (elbow, 0.0215 * scale)):
        disc(panel, joint, radius, INK)
        disc(panel, joint, 0.5 * radius, IVORY)
    half = 0.036 * scale
    a, b = half * np.cos(heading), -half * np.sin(heading)
    body = fixed_point(tool + np.array([(a - b, b + a), (a + b, b - a), (b - a, -b - a), (-a - b, a - b)]))
    cv2.fillConvexPoly(panel, body, backdrop.TOOL, cv2.LINE_AA, 4)
    cv2.polylines(panel, [body], True, backdrop.TOOL, 2, cv2.LINE_AA, 4)
    disc(panel, tool, 0.031 * scale, IVORY)


def _link(panel: Image, start: Array, end: Array, start_width: float, end_width: float) -> None:
    """Draw a tapered link with an outline and a groove along its center. The next part covers its far end."""
    (x0, y0), (x1, y1) = start.tolist(), end.tolist()
    length = max(np.hypot(x1 - x0, y1 - y0), 1e-9)
    c, s = (x1 - x0) / length, (y1 - y0) / length
    for color, grow in ((INK, 1.3), (IVORY, 0.0)):
        a, b = start_width + grow, end_width + grow
        sides = [(x0 - s * a, y0 + c * a), (x1 - s * b, y1 + c * b), (x1 + s * b, y1 - c * b), (x0 + s * a, y0 - c * a)]
        cv2.fillConvexPoly(panel, fixed_point(np.array(sides)), color, cv2.LINE_AA, 4)
        disc(panel, start, a, color)
    a, b = 2.2 * start_width, 3.0 * end_width
    groove = np.array([(x0 + a * c, y0 + a * s), (x1 - b * c, y1 - b * s)])
    cv2.polylines(panel, [fixed_point(groove)], False, mix(IVORY, INK, 0.20), 2, cv2.LINE_AA, 4)


def _marker(panel: Image, center: Array, radius: float, color: Color) -> None:
    disc(panel, center, radius + 1.5, IVORY)
    disc(panel, center, radius, color)


def _draw_camera(panel: Image, scene: ServoScene) -> None:
    side = panel.shape[0]
    scale = side / scene.camera_size
    if scene.camera_image is not None:
        cv2.resize(scene.camera_image, (side, side), dst=panel, interpolation=cv2.INTER_NEAREST)
        put_text(panel, backdrop.CAMERA_LABEL, *backdrop.LABEL_PLACE, backdrop.LENS_INK)
    else:
        cv2.polylines(panel, _scaled(scene.floor_lines, scale), False, backdrop.LENS_GRID, 1, cv2.LINE_AA, 4)
    feature, goal = scene.feature * scale, scene.goal * scale
    if scene.camera_image is None:
        trail(panel, scene.feature_trail * scale, backdrop.LENS, backdrop.TARGET)
    if scene.visible:
        cv2.polylines(panel, [fixed_point(np.stack([goal, feature]))], False, backdrop.GOAL, 1, cv2.LINE_AA, 4)
    crosshair(panel, goal)
    if scene.camera_image is None:
        # If the newest frame does not show the target, a hollow mark shows its last known position.
        disc(panel, feature, 6.5, backdrop.TARGET)
        if not scene.visible:
            disc(panel, feature, 5.0, backdrop.LENS)
    if not scene.visible:
        put_text(panel, "not seen", side - 14, 20, backdrop.TARGET, align="right")


def _scaled(lines: Sequence[Array], scale: float) -> list[NDArray[np.int32]]:
    """Convert polylines to fixed point, all at once."""
    if not lines:
        return []
    points = fixed_point(np.concatenate(lines) * scale)
    ends = list(accumulate(len(line) for line in lines))
    return [points[start:end] for start, end in pairwise([0, *ends])]


def crosshair(panel: Image, center: Array) -> None:
    """Draw a cross with an open center, so that a feature on the goal stays visible."""
    x, y = center.tolist()
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        tick = np.array([(x + 10 * dx, y + 10 * dy), (x + 17 * dx, y + 17 * dy)])
        cv2.polylines(panel, [fixed_point(tick)], False, backdrop.GOAL, 1, cv2.LINE_AA, 4)
    cv2.circle(panel, fixed_point(center).tolist(), 10 * 16, backdrop.GOAL, 1, cv2.LINE_AA, 4)


def _draw_error(panel: Image, scene: ServoScene) -> None:
    plot = backdrop.ERROR_PLOT
    history = scene.error_history[-ERROR_SPAN:]
    if len(history) > 1:
        columns = plot.left + plot.width * np.arange(len(history)) / (ERROR_SPAN - 1)
        curve = fixed_point(np.stack([columns, backdrop.error_height(history)], axis=-1))
        cv2.polylines(panel, [curve], False, INK, 1, cv2.LINE_AA, 4)
        cv2.circle(panel, curve[-1].tolist(), 45, backdrop.TARGET, -1, cv2.LINE_AA, 4)
    put_text(panel, _length(scene.tracking_error), plot.left + plot.width, 14, INK, align="right")


def _length(meters: float) -> str:
    """Format a distance with two to four digits."""
    millimeters = 1000.0 * meters
    return f"{millimeters:.1f} mm" if millimeters < 100.0 else f"{meters:.2f} m"


def disc(panel: Image, center: Array, radius: float, color: Color) -> None:
    """Draw a filled circle, unless it is far outside the panel."""
    x, y = center.tolist()
    if abs(x) < 4000.0 and abs(y) < 4000.0 and radius > 0.0:
        cv2.circle(panel, (round(16 * x), round(16 * y)), round(16 * radius), color, -1, cv2.LINE_AA, 4)
