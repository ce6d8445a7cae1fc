"""Compiled kernels that paint a crowd on a canvas for any camera above: shadows, people, umbrellas, lampshades.

A canvas is a float32 RGB image whose pixels see known points of the plane. Objects are numbered: people first, then
one umbrella per person (radius 0 without one), then lampshades.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.envs.follow.covers import (
    COVER_SHADOW,
    PENUMBRA,
    SHADOW_LENGTH,
    SHADOW_RADIUS,
    cover_shadow,
    lamp_at,
    person_shadow,
    umbrella_at,
)
from servotrack.envs.follow.figures import HALF_WIDTH, POSE_NUMBERS, REACH, SUN, person_at, pose
from servotrack.estimators.camera import project_ground
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array

WIDEST_PIXEL = 0.35
"""Largest width of the plane that a pixel may see and still show people, m. In wider pixels they would be invisible."""

_CORNERS = 8  # corners of the polygon that replaces a circle
_ONE_SAMPLE_WIDTH, _FOUR_SAMPLES_WIDTH = (
    0.09,
    0.17,
)  # widest pixel with one sample (edges are soft), and with 2 x 2 samples; others 3 x 3, m
_PERSON, _UMBRELLA, _LAMP = range(3)


class CrowdTables(NamedTuple):
    """Gait and appearance of a crowd of P people under L lampshades. Tables of N crowds have a leading axis of N.

    Attributes:
        walk: Heading (rad), phase of the gait (rad) and amplitude of the gait, (P, 3); (K, P, 3) for K samples.
        outfits: Appearance vectors, (P, OUTFIT_NUMBERS).
        umbrella: Radii of the umbrellas, (P,) m; 0 for people without one.
        umbrella_color: Colors of the umbrellas, (P, 3), gray levels.
        lamps: Positions and radii of the lampshades, (L, 3) m.
    """

    walk: Array
    outfits: Array
    umbrella: Array
    umbrella_color: Array
    lamps: Array


@njit(cache=True, nogil=True, error_model="numpy")
def _box(camera, step, height, width, views, places, k, radius, ahead, box):  # type: ignore[no-untyped-def]
    """Fill `box` with the rows and columns (first, last + 1) of a circle during the readout; empty if out of view."""
    box[:] = 0
    if radius <= 0.0:
        return
    top, bottom, left, right = np.inf, -np.inf, np.inf, -np.inf
    last = views.shape[0] - 1
    for at in range(0, last + 1, max(last, 1)):
        c, s = views[at, 0], views[at, 1]
        x, y = places[at, k, 0] - ahead * SUN[0] - views[at, 2], places[at, k, 1] - ahead * SUN[1] - views[at, 3]
        for corner in range(_CORNERS + 1):
            # The polygon encloses the circle. The last point is its center, for circles without a corner in view.
            r = radius / math.cos(math.pi / _CORNERS) if corner < _CORNERS else 0.0
            angle = 2.0 * math.pi * corner / _CORNERS
            wx, wy = x + r * math.cos(angle), y + r * math.sin(angle)
            u, v, seen = project_ground(camera, c * wx + s * wy, s * wx - c * wy)
            if seen:
                top, bottom, left, right = min(top, v), max(bottom, v), min(left, u), max(right, u)
    if right < 0.0 or bottom < 0.0 or left > width * step or top > height * step:
        return
    box[0], box[1] = max(int(top / step) - 1, 0), min(int(bottom / step) + 2, height)
    box[2], box[3] = max(int(left / step) - 1, 0), min(int(right / step) + 2, width)


@njit(cache=True, nogil=True, error_model="numpy")
def find_boxes(  # type: ignore[no-untyped-def]
    camera, step, height, width, views, places, poses, umbrella, lamps, boxes
):
    """Fill the table of bounding boxes in the image: of each object's shadow (row 0) and of the object (row 1).

    Args:
        camera: Packed camera.
        step: Camera pixels per image pixel.
        height: Height of the image, px.
        width: Width of the image, px.
        views: Cos and sin of the camera's heading and the point below it, per image row or for all rows. (R, 4).
        places: Positions of all objects at those instants, (R, 2 P + L, 2) m.
        poses: Poses of all people, (P, POSE_NUMBERS).
        umbrella: Radii of the umbrellas, (P,) m.
        lamps: Positions and radii of the lampshades, (L, 3) m.
        boxes: Output: rows and columns (first, last + 1), (2, 2 P + L, 4).
    """
    people = len(umbrella)
    for k in range(boxes.shape[1]):
        if k < people:
            radius, shadow, ahead = poses[k, REACH], 0.5 * SHADOW_LENGTH + SHADOW_RADIUS, 0.5 * SHADOW_LENGTH
        else:
            radius = umbrella[k - people] if k < 2 * people else lamps[k - 2 * people, 2]
            shadow, ahead = radius + 2.0 * PENUMBRA if radius > 0.0 else 0.0, COVER_SHADOW
        _box(camera, step, height, width, views, places, k, shadow, ahead, boxes[0, k])
        _box(camera, step, height, width, views, places, k, radius, 0.0, boxes[1, k])


@njit(cache=True, nogil=True, error_model="numpy")
def paint_shadows(shade, ground, spread, strength, views, places, umbrella, lamps, boxes):  # type: ignore[no-untyped-def]
    """Darken `shade`, the share of light that reaches each pixel's point. Overlapping shadows do not add up."""
    people = len(umbrella)
    for k in range(boxes.shape[1]):
        top, bottom, left, right = boxes[0, k]
        for i in range(top, bottom):
            view, place = views[i % len(views)], places[i % len(views), k]
            c, s = view[0], view[1]
            wx, wy = place[0] - view[2], place[1] - view[3]
            gx, gy = c * wx + s * wy, s * wx - c * wy
            # Directions away from the light and across it, in the camera's frame.
            ax, ay = -(c * SUN[0] + s * SUN[1]), -(s * SUN[0] - c * SUN[1])
            bx, by = s * SUN[0] - c * SUN[1], -c * SUN[0] - s * SUN[1]
            for j in range(left, right):
                width = spread[i, j]
                if width > WIDEST_PIXEL:
                    continue
                dx, dy = ground[i, j, 0] - gx, ground[i, j, 1] - gy
                along, across = ax * dx + ay * dy, bx * dx + by * dy
                if k < people:
                    dark = person_shadow(along, across, width)
                else:
                    radius = umbrella[k - people] if k < 2 * people else lamps[k - 2 * people, 2]
                    along -= COVER_SHADOW
                    dark = cover_shadow(math.sqrt(along * along + across * across), radius, width)
                shade[i, j] = min(shade[i, j], np.float32(1.0 - strength * dark))


@njit(cache=True, nogil=True, error_model="numpy")
def paint_crowd(canvas, ground, spread, opacity, views, places, crowd, poses, boxes):  # type: ignore[no-untyped-def]
    """Paint people on the canvas, then umbrellas and lampshades with this opacity.

    Args:
        canvas: RGB image, painted in place, (H, W, 3) float32.
        ground: Point of the plane that each pixel sees, in the camera's frame, (H, W, 2) m.
        spread: Distance on the plane between neighboring pixels, (H, W) m.
        opacity: Opacity of umbrellas and lampshades, 0 to 1.
        views: Cos and sin of the camera's heading and the point below it, per image row or for all rows. (R, 4).
        places: Positions of all objects at those instants, (R, 2 P + L, 2) m.
        crowd: Gait and appearance at this instant, `CrowdTables`.
        poses: Poses of all people, (P, POSE_NUMBERS).
        boxes: Bounding boxes in the image, as `find_boxes` fills them, (2, 2 P + L, 4).
    """
    people, headings = len(crowd.umbrella), crowd.walk[:, 0]
    outfits, umbrella, umbrella_color, lamps = crowd.outfits, crowd.umbrella, crowd.umbrella_color, crowd.lamps
    for k in range(boxes.shape[1]):
        if boxes[1, k, 0] >= boxes[1, k, 1]:
            continue
        if k < people:
            _paint(
                canvas, ground, spread, 1.0, views, places[:, k], boxes[1, k], _PERSON, headings[k], poses[k, REACH],
                outfits[k], poses[k],
            )  # fmt: skip
        elif k < 2 * people:
            who = k - people
            _paint(
                canvas, ground, spread, opacity, views, places[:, k], boxes[1, k], _UMBRELLA, headings[who],
                umbrella[who], umbrella_color[who], poses[who],
            )  # fmt: skip
        else:
            lamp = lamps[k - 2 * people]
            _paint(canvas, ground, spread, opacity, views, places[:, k], boxes[1, k], _LAMP, 0.0, lamp[2], lamp, lamp)


@njit(cache=True, nogil=True, error_model="numpy")
def _paint(  # type: ignore[no-untyped-def]
    canvas, ground, spread, opacity, views, places, box, kind, heading, reach, look, pose
):
    """Paint one object on the canvas."""
    rows, columns = spread.shape
    seen, total = np.empty(4), np.empty(4)
    ch, sh = math.cos(heading), math.sin(heading)
    light_x, light_y = ch * SUN[0] + sh * SUN[1], ch * SUN[1] - sh * SUN[0]
    for i in range(box[0], box[1]):
        at = i % len(views)
        c, s = views[at, 0], views[at, 1]
        wx, wy = places[at, 0] - views[at, 2], places[at, 1] - views[at, 3]
        gx, gy = c * wx + s * wy, s * wx - c * wy
        # From the camera's frame to the object's own axes, which the camera sees mirrored from above.
        xx, xy = c * ch + s * sh, s * ch - c * sh
        yx, yy = xy, -xx
        for j in range(box[2], box[3]):
            width = spread[i, j]
            if width > WIDEST_PIXEL:
                continue
            dx, dy = ground[i, j, 0] - gx, ground[i, j, 1] - gy
            near = reach + 0.71 * width
            if dx * dx + dy * dy > near * near:
                continue
            x, y = xx * dx + xy * dy, yx * dx + yy * dy
            if kind == _PERSON and abs(y) > HALF_WIDTH + 0.71 * width:
                continue
            n = 1 if width <= _ONE_SAMPLE_WIDTH else 2 if width <= _FOUR_SAMPLES_WIDTH else 3
            total[:] = 0.0
            for sample in range(n * n):
                u, v = x, y
                if n > 1:
                    a, b = min(max(i, 1), rows - 2), min(max(j, 1), columns - 2)
                    right, down = (sample % n + 0.5) / n - 0.5, (sample // n + 0.5) / n - 0.5
                    dx = 0.5 * right * (ground[i, b + 1, 0] - ground[i, b - 1, 0])
                    dy = 0.5 * right * (ground[i, b + 1, 1] - ground[i, b - 1, 1])
                    dx += 0.5 * down * (ground[a + 1, j, 0] - ground[a - 1, j, 0])
                    dy += 0.5 * down * (ground[a + 1, j, 1] - ground[a - 1, j, 1])
                    u, v = x + xx * dx + xy * dy, y + yx * dx + yy * dy
                # Objects paint from the top down, each part under the parts before it: every sample starts empty.
                seen[:] = 0.0
                if kind == _PERSON:
                    person_at(look, pose, u, v, width / n, seen)
                elif kind == _UMBRELLA:
                    umbrella_at(look, reach, light_x, light_y, u, v, width / n, seen)
                else:
                    lamp_at(reach, u, v, width / n, seen)
                for channel in range(4):
                    total[channel] += seen[channel]
            if total[3] == 0.0:
                continue
            share = opacity / (n * n)
            left_over = 1.0 - share * total[3]
            for channel in range(3):
                canvas[i, j, channel] = left_over * canvas[i, j, channel] + share * total[channel]


@njit(cache=True, nogil=True, error_model="numpy")
def paint_panel(panel, camera, view, ground, spread, strength, opacity, people, crowd):  # type: ignore[no-untyped-def]
    """Paint a crowd on a finished panel, umbrellas and lampshades with this opacity.

    Args:
        panel: RGB image, painted in place, (H, W, 3) uint8.
        camera: Packed camera whose pixels are the panel's.
        view: Cos and sin of the camera's heading and the point below it, (1, 4).
        ground: Point of the plane that each pixel sees, in the camera's frame, (H, W, 2) m.
        spread: Distance on the plane between neighboring pixels, (H, W) m.
        strength: Darkness of shadows, 0 to 1.
        opacity: Opacity of umbrellas and lampshades, 0 to 1.
        people: Positions, (P, >= 2) m.
        crowd: Gait and appearance, `CrowdTables`.
    """
    height, width = spread.shape
    walk, outfits, umbrella, lamps = crowd.walk, crowd.outfits, crowd.umbrella, crowd.lamps
    count, things = len(people), 2 * len(people) + len(lamps)
    poses, places = np.empty((count, POSE_NUMBERS)), np.empty((1, things, 2))
    for k in range(count):
        pose(outfits[k], walk[k, 0], walk[k, 1], walk[k, 2], poses[k])
        for axis in range(2):
            places[0, k, axis] = places[0, count + k, axis] = people[k, axis]
    for k in range(len(lamps)):
        places[0, 2 * count + k, 0], places[0, 2 * count + k, 1] = lamps[k, 0], lamps[k, 1]
    boxes = np.empty((2, things, 4), np.int64)
    find_boxes(camera, 1.0, height, width, view, places, poses, umbrella, lamps, boxes)
    shade, canvas = np.ones((height, width), np.float32), np.empty((height, width, 3), np.float32)
    paint_shadows(shade, ground, spread, strength, view, places, umbrella, lamps, boxes)
    for i in range(height):
        for j in range(width):
            for channel in range(3):
                canvas[i, j, channel] = panel[i, j, channel] * shade[i, j]
    paint_crowd(canvas, ground, spread, opacity, view, places, crowd, poses, boxes)
    for i in range(height):
        for j in range(width):
            for channel in range(3):
                panel[i, j, channel] = np.uint8(min(max(canvas[i, j, channel] + 0.5, 0.0), 255.0))
