"""Pictures of PedestrianServo: the arm over the crowd from above, the camera's view, and the distance so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.drawing.glyphs import put_text
from servotrack.envs.drawing.palette import FLOOR, INK, PAPER, SOFT_INK, Color, fixed_point, mix
from servotrack.envs.follow.outfits import Outfits
from servotrack.envs.follow.painting import CrowdTables, paint_panel
from servotrack.envs.servo import backdrop
from servotrack.envs.servo.exposure import Rays, trace_rays
from servotrack.envs.servo.imaging import no_rays
from servotrack.envs.servo.render import crosshair, draw_arm, light_footprint, round_corners, trail
from servotrack.estimators.camera import pack_camera
from servotrack.estimators.types import Array, Image, Mask

BELIEF: Color = (86, 222, 208)
DETECTED: Color = (250, 216, 120)

_GRID_SPACING = 1.0  # m
_PANEL_CAMERA_HEIGHT = 1e5  # height of the camera that draws the floor's panel, m: its rays are nearly parallel
_COVER_OPACITY = 0.55  # of umbrellas and lampshades in the floor's panel
_SHADOW_STRENGTH = 0.28  # darkness of shadows in the floor's panel, 0 to 1
_ARM_OPACITY = 0.8
_RING_RADIUS = 0.42  # of the ring around the person to follow, m
_SHORTEST_DISTANCE, _LONGEST_DISTANCE = 0.01, 4.0  # ends of the plot's distance axis, m
_MARKS = (("wrong person", backdrop.DISTRACTOR, 104, 1), ("lost", backdrop.TARGET, 184, 4))
"""Marks below the plot: name, color, column of the name in the legend, and distance below the plot, px."""


def _none() -> Array:
    return np.empty((0, 2))


@dataclass(frozen=True)
class FollowScene:
    """Contents of a picture of PedestrianServo.

    Attributes:
        links: Link lengths. Shape (2,), m.
        joint_angles: Joint angles of the arm. Shape (2,), rad.
        people: Positions of all people, the person to follow first. Shape (P, 2), m.
        walk: Heading, phase and stride of all people. Shape (P, 3).
        outfits: Appearance of all people, umbrellas and lampshades.
        goal: Desired image point. Shape (2,), px.
        camera_size: Width and height of the camera's image, px.
        camera_image: Camera image of any size, RGB uint8.
        visible: True if the newest frame shows the person.
        distance: Distance between tool and person, m.
        time: Time in the episode, s.
        tool_trail: Past tool positions, oldest first. Shape (k, 2), m.
        person_trail: Past positions of the person. Shape (k, 2), m.
        image_trail: The person's recent path in the newest image. Shape (k, 2), px.
        distances: Distances so far, oldest first. Shape (k,), m.
        wrong: Samples at which the tool was at another person. Shape (k,), bool.
        lost: Samples at which the person was lost. Shape (k,), bool.
        span: Number of samples of a full plot.
        footprint: Outline of the floor area in the camera's view. Shape (k, 2), m.
        detections: Existence, u, v, width, height (px), red, green, blue of each detection, or None. Shape (M, 8).
        belief: An agent's estimate of the person's position in the image, or None. Shape (2,), px.
        caption: Name of the world: lower-case letters and digits.
    """

    links: Array
    joint_angles: Array
    people: Array
    walk: Array
    outfits: Outfits
    goal: Array
    camera_size: float
    camera_image: Image
    visible: bool
    distance: float
    time: float
    footprint: Array
    tool_trail: Array = field(default_factory=_none)
    person_trail: Array = field(default_factory=_none)
    image_trail: Array = field(default_factory=_none)
    distances: Array = field(default_factory=lambda: np.empty(0))
    wrong: Mask = field(default_factory=lambda: np.empty(0, np.bool_))
    lost: Mask = field(default_factory=lambda: np.empty(0, np.bool_))
    span: int = 401
    detections: Array | None = None
    belief: Array | None = None
    caption: str = ""


def draw(scene: FollowScene) -> Image:
    """Draw a scene.

    Returns:
        A new RGB image, shape (416, 720, 3).
    """
    parts = backdrop.backdrop(round(float(np.sum(scene.links)), 6), scene.caption, _GRID_SPACING)
    image = parts.image.copy()
    _draw_floor(backdrop.FLOOR_PANEL.of(image), scene, parts.lit_floor)
    _draw_camera(backdrop.CAMERA_PANEL.of(image), scene)
    backdrop.ERROR_PANEL.of(image)[:] = _distance_axes()
    _draw_distance(backdrop.ERROR_PANEL.of(image), scene)
    round_corners(image, parts)
    return image


def _draw_floor(panel: Image, scene: FollowScene, lit_floor: Image) -> None:
    reach = float(np.sum(scene.links))
    light_footprint(panel, backdrop.floor_pixels(scene.footprint, reach), lit_floor)
    trail(panel, backdrop.floor_pixels(scene.person_trail, reach), FLOOR, backdrop.TARGET)
    trail(panel, backdrop.floor_pixels(scene.tool_trail, reach), FLOOR, backdrop.TOOL)
    camera, view, rays = _panel_camera(round(reach, 6))
    crowd = np.ascontiguousarray(panel)
    outfits = scene.outfits
    paint_panel(
        crowd, camera, view, rays.ground[0], rays.spread[0], _SHADOW_STRENGTH, _COVER_OPACITY, scene.people,
        CrowdTables(scene.walk, outfits.people, outfits.umbrella, outfits.umbrella_color, outfits.lamps),
    )  # fmt: skip
    panel[:] = crowd
    # The arm is translucent, because a tool on target would hide the person.
    draw_arm(crowd, scene.links, scene.joint_angles)
    cv2.addWeighted(crowd, _ARM_OPACITY, panel, 1.0 - _ARM_OPACITY, 0.0, dst=panel)
    backdrop.draw_legend(panel)
    _ring(
        panel,
        backdrop.floor_pixels(scene.people[0], reach),
        _RING_RADIUS * backdrop.floor_scale(reach),
        backdrop.TARGET,
    )
    put_text(panel, f"{max(scene.time, 0.0):.1f} s", panel.shape[1] - 14, 20, SOFT_INK, align="right")


@lru_cache(maxsize=16)
def _panel_camera(reach: float) -> tuple[Array, Array, Rays]:
    """Camera far above the floor that draws the floor's panel: packed, its view, and its rays."""
    side = backdrop.FLOOR_PANEL.width
    camera = pack_camera(
        focal=_PANEL_CAMERA_HEIGHT * backdrop.floor_scale(reach),
        depth=_PANEL_CAMERA_HEIGHT,
        # OpenCV measures from the center of the first pixel, the camera from its corner.
        center=backdrop.floor_pixels(np.zeros(2), reach) + 0.5,
        half_width=0.5 * side,
    )
    rays = no_rays(1, side)
    trace_rays(camera, 1.0, *(table[0] for table in rays))
    return camera, np.array([[1.0, 0.0, 0.0, 0.0]]), rays


def _draw_camera(panel: Image, scene: FollowScene) -> None:
    side = panel.shape[0]
    scale = side / scene.camera_size
    cv2.resize(scene.camera_image, (side, side), dst=panel, interpolation=cv2.INTER_NEAREST)
    trail(panel, scene.image_trail * scale, mix(FLOOR, backdrop.LENS, 0.5), backdrop.TARGET)
    if scene.detections is not None:
        _draw_detections(panel, scene.detections, scale)
    crosshair(panel, scene.goal * scale)
    if scene.belief is not None:
        _ring(panel, scene.belief * scale, 13.0, BELIEF)
    put_text(panel, backdrop.CAMERA_LABEL, *backdrop.LABEL_PLACE, backdrop.GOAL)
    if not scene.visible:
        put_text(panel, "not seen", side - 14, 20, backdrop.TARGET, align="right")


def _draw_detections(panel: Image, detections: Array, scale: float) -> None:
    found = detections[detections[:, 0] > 0.5]
    half = 0.5 * found[:, 3:5]
    low, high = found[:, 1:3] - half, found[:, 1:3] + half
    corners = np.stack(
        [low, np.stack([high[:, 0], low[:, 1]], axis=-1), high, np.stack([low[:, 0], high[:, 1]], -1)], 1
    )
    boxes: Sequence[NDArray[np.int32]] = list(fixed_point(corners * scale))
    cv2.polylines(panel, boxes, True, DETECTED, 1, cv2.LINE_AA, 4)


def _ring(panel: Image, center: Array, radius: float, color: Color) -> None:
    x, y = fixed_point(center).tolist()
    cv2.circle(panel, (x, y), round(16 * radius), color, 1, cv2.LINE_AA, 4)
    cv2.circle(panel, (x, y), round(16 * radius) + 11, color, 1, cv2.LINE_AA, 4)


def _distance_height(distance: Array | float) -> Array:
    """Row in the lower panel of a distance in m, on a logarithmic axis. Values beyond its ends are clipped."""
    span = np.log(_LONGEST_DISTANCE / _SHORTEST_DISTANCE)
    return (
        backdrop.ERROR_PLOT.top
        + backdrop.ERROR_PLOT.height
        * np.log(_LONGEST_DISTANCE / np.clip(distance, _SHORTEST_DISTANCE, _LONGEST_DISTANCE))
        / span
    )


@lru_cache(maxsize=1)
def _distance_axes() -> Image:
    """Static part of the lower panel, with bands for on target (up to 10 cm) and followed (up to 0.5 m)."""
    panel = np.empty((backdrop.ERROR_PANEL.height, backdrop.ERROR_PANEL.width, 3), np.uint8)
    panel[:] = mix(PAPER, FLOOR, 0.45)
    left, right = backdrop.ERROR_PLOT.left, backdrop.ERROR_PLOT.left + backdrop.ERROR_PLOT.width
    bottom = backdrop.ERROR_PLOT.top + backdrop.ERROR_PLOT.height
    for distance, label, strength in ((0.5, "0.5 m", 0.06), (0.1, "10 cm", 0.10)):
        row = round(float(_distance_height(distance)))
        panel[row:bottom, left:right] = mix(PAPER, backdrop.TOOL, strength)
        panel[row, left:right] = mix(PAPER, backdrop.TOOL, 0.45)
        put_text(panel, label, left - 6, row + 3, SOFT_INK, height=6, weight=0.9, align="right")
    for distance in (_SHORTEST_DISTANCE, _LONGEST_DISTANCE):
        panel[round(float(_distance_height(distance))), left:right] = mix(PAPER, INK, 0.12)
    put_text(panel, "distance", left, 14, SOFT_INK)
    for name, color, column, _ in _MARKS:
        panel[9:13, column : column + 4] = color
        put_text(panel, name, column + 9, 14, SOFT_INK, height=6, weight=0.9)
    return panel


def _draw_distance(panel: Image, scene: FollowScene) -> None:
    plot = backdrop.ERROR_PLOT
    columns = plot.left + plot.width * np.arange(len(scene.distances)) / max(scene.span - 1, 1)
    for (_, color, _, below), at in zip(_MARKS, (scene.wrong, scene.lost), strict=True):
        row = plot.top + plot.height + below
        for column in np.unique(np.rint(columns[at])).astype(int).tolist():
            panel[row : row + 3, column : column + 2] = color
    if len(columns) > 1:
        curve = fixed_point(np.stack([columns, _distance_height(scene.distances)], axis=-1))
        cv2.polylines(panel, [curve], False, INK, 1, cv2.LINE_AA, 4)
        cv2.circle(panel, curve[-1].tolist(), 45, backdrop.TARGET, -1, cv2.LINE_AA, 4)
    put_text(panel, f"{scene.distance:.2f} m", plot.left + plot.width, 14, INK, align="right")
