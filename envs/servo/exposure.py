"""Compiled kernels that render the arm's camera: rays to the floor, floor texture, markers, noise."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo.floor import SIDE, TILE
from servotrack.envs.servo.sensing import interpolate_path
from servotrack.envs.servo.targets import PERIOD
from servotrack.estimators.camera import ground_point, project_ground
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, FloatArray, Labels

DISC_RADIUS = 0.025
"""Radius of a marker's colored disc, m."""
RING_RADIUS = 0.033
"""Outer radius of the white ring around the disc, m."""
TARGET_COLOR = (222, 64, 38)
DISTRACTOR_COLOR = (46, 98, 196)
RING_COLOR = (236, 234, 228)
NOISE_SIDE = 256
"""Period of the noise tile along rows and columns, px; a power of two."""

_VIGNETTING = 0.30  # loss of light at one half width from the principal point
_WIDEST_MARKER_PIXEL = 0.2  # width of the floor in a pixel beyond which markers are invisible and left out, m
_SHIFT = 64.0  # added to texture coordinates so that they are positive, tiles
_SAMPLES = 4  # samples per axis in a pixel at a marker's edge


class Arms(NamedTuple):
    """Cameras and poses of N arms.

    Attributes:
        cameras: Packed cameras, (N, CAMERA_SIZE).
        links: Link lengths, (N, 2) m.
        history: True joint angles of the last samples, a ring buffer indexed by sample modulo RING, (N, RING, 2) rad.
    """

    cameras: Array
    links: Array
    history: Array


class Rays(NamedTuple):
    """Rays of the pixels of N cameras, constant during an episode.

    Attributes:
        ground: Floor points at the pixels' centers in the cameras' untilted frames, (N, S, S, 2) m.
        light: Share of the light that arrives, 0 for pixels that show no floor, (N, S, S).
        spread: Distance on the floor between neighboring pixels, (N, S, S) m.
        detail: Level of detail of the floor's texture for that distance, (N, S, S).
    """

    ground: FloatArray
    light: FloatArray
    spread: FloatArray
    detail: NDArray[np.uint8]


class Floors(NamedTuple):
    """Floors below N cameras: one texture, placed and colored by the episode.

    Attributes:
        corners: Texture at all levels of detail, see `floor_texture`.
        pose: Rotation (cos, sin) and shift (x, y) of the texture, (N, 4), shift in tiles.
        color: Color at brightness 1, (N, 3), gray levels.
    """

    corners: FloatArray
    pose: Array
    color: Array


class Places(NamedTuple):
    """Places of one image row's pixels in the texture; overwritten by every row.

    Attributes:
        x: Column, (S,) texels.
        y: Row, (S,) texels.
        texel: Index of the texel above and left of the place, (S,).
    """

    x: Array
    y: Array
    texel: NDArray[np.int32]


class SensorNoise(NamedTuple):
    """Noise of the pixels of N cameras, read from one tile.

    Attributes:
        tile: Noise, periodic in rows and columns, pixels flat: (NOISE_SIDE, 3 (NOISE_SIDE + S)), gray levels.
        offset: First row and column in the tile of each of K frames, (N, K, 2).
    """

    tile: FloatArray
    offset: Labels


@njit(cache=True, nogil=True)
def trace_rays(camera, step, ground, light, spread, detail):  # type: ignore[no-untyped-def]
    """Fill one camera's ray tables; `step` is the number of camera pixels per image pixel."""
    size = ground.shape[0]
    for i in range(size):
        for j in range(size):
            u, v = (j + 0.5) * step, (i + 0.5) * step
            gx, gy = ground_point(camera, u, v)
            ground[i, j, 0] = gx
            ground[i, j, 1] = gy
            back_u, back_v, seen = project_ground(camera, gx, gy)
            # Pixels beyond the lens's fold or above the horizon do not project back to themselves.
            if seen and abs(back_u - u) + abs(back_v - v) < 0.5:
                rho2 = ((u - camera[2]) ** 2 + (v - camera[3]) ** 2) * camera[17] ** 2
                light[i, j] = 1.0 / (1.0 + _VIGNETTING * rho2)
            else:
                light[i, j] = 0.0
    for i in range(size):
        for j in range(size):
            a, b = min(i + 1, size - 1), min(j + 1, size - 1)
            du = math.hypot(ground[i, b, 0] - ground[i, b - 1, 0], ground[i, b, 1] - ground[i, b - 1, 1])
            dv = math.hypot(ground[a, j, 0] - ground[a - 1, j, 0], ground[a, j, 1] - ground[a - 1, j, 1])
            spread[i, j] = max(du, dv)
            texels = max(spread[i, j] * (SIDE / TILE), 1.0)
            detail[i, j] = min(int(math.log2(texels) + 0.5), int(math.log2(SIDE)))


@njit(cache=True, nogil=True)
def _covered(gx, gy, xu, yu, xv, yv, x, y):  # type: ignore[no-untyped-def]
    """Shares of a pixel that the disc and the ring of a marker at (x, y) cover.

    The pixel's center is at (gx, gy) on the floor; (xu, yu) and (xv, yv) lead from there to its right and lower
    neighbors.
    """
    disc, whole = 0, 0
    for p in range(_SAMPLES):
        ov = (p + 0.5) / _SAMPLES - 0.5
        for q in range(_SAMPLES):
            ou = (q + 0.5) / _SAMPLES - 0.5
            dx = gx + ou * xu + ov * xv - x
            dy = gy + ou * yu + ov * yv - y
            distance2 = dx * dx + dy * dy
            disc += distance2 < DISC_RADIUS * DISC_RADIUS
            whole += distance2 < RING_RADIUS * RING_RADIUS
    return disc / (_SAMPLES * _SAMPLES), (whole - disc) / (_SAMPLES * _SAMPLES)


@njit(cache=True, nogil=True)
def row_view(y, shutter, camera, links, history, frame, view):  # type: ignore[no-untyped-def]
    """Write the camera's heading (cos, sin) and the tool at the instant of the image row at height `y` (0 to 1).

    Returns the sample before that instant, and the elapsed share of the period from there to the frame's own sample.
    """
    before = max(frame - 1, 0)
    f = 1.0 - shutter * (1.0 - y) / PERIOD
    old, now = history[before % history.shape[0]], history[frame % history.shape[0]]
    theta1 = old[0] + f * (now[0] - old[0])
    phi = theta1 + old[1] + f * (now[1] - old[1])
    c2, s2 = math.cos(phi), math.sin(phi)
    view[0] = c2 * camera[5] - s2 * camera[6]
    view[1] = s2 * camera[5] + c2 * camera[6]
    view[2] = links[0] * math.cos(theta1) + links[1] * c2
    view[3] = links[0] * math.sin(theta1) + links[1] * s2
    return before, f


@njit(cache=True, nogil=True)
def _marker_view(y, shutter, camera, links, history, path, distractor, frame, view):  # type: ignore[no-untyped-def]
    """Like `row_view`, and also write target and distractor in the camera's untilted frame."""
    before, f = row_view(y, shutter, camera, links, history, frame, view)
    for k in range(2):
        table = path if k == 0 else distractor
        px, py = interpolate_path(table[before], table[frame], f)
        px -= view[2]
        py -= view[3]
        view[4 + 2 * k] = view[0] * px + view[1] * py
        view[5 + 2 * k] = view[1] * px - view[0] * py


@njit(cache=True, nogil=True)
def empty_places(size):  # type: ignore[no-untyped-def]
    """Return uninitialized places of a row of `size` pixels."""
    return Places(np.empty(size), np.empty(size), np.empty(size, np.int32))


@njit(cache=True, nogil=True)
def _find_places(i, views, ground, detail, pose, places):  # type: ignore[no-untyped-def]
    """Write the places of image row i in the floor's texture, in texels of each pixel's level of detail."""
    v, x, y = i % views.shape[0], places.x, places.y
    # From the camera's frame to texture coordinates in tiles, shifted so that they are positive.
    fc, fs = pose[0] / TILE, pose[1] / TILE
    xx, xy = fc * views[v, 0] - fs * views[v, 1], fc * views[v, 1] + fs * views[v, 0]
    yx, yy = xy, -xx
    x0 = fc * views[v, 2] - fs * views[v, 3] + pose[2] + _SHIFT
    y0 = fs * views[v, 2] + fc * views[v, 3] + pose[3] + _SHIFT
    for j in range(detail.shape[1]):
        side = SIDE >> detail[i, j]
        gx, gy = ground[i, 2 * j], ground[i, 2 * j + 1]
        x[j] = (xx * gx + xy * gy + x0) * side
        y[j] = (yx * gx + yy * gy + y0) * side


@njit(cache=True, nogil=True)
def _split_places(i, detail, places):  # type: ignore[no-untyped-def]
    """Split the places of image row i into the texel above and left of them, and fractions of a texel."""
    x, y, texel = places.x, places.y, places.texel
    for j in range(detail.shape[1]):
        side = SIDE >> detail[i, j]
        column, row = np.int32(x[j]), np.int32(y[j])
        x[j] -= column
        y[j] -= row
        texel[j] = (side + (row & (side - 1))) * side + (column & (side - 1))


@njit(cache=True, nogil=True)
def look_down(views, ground, detail, corners, pose, places, bright):  # type: ignore[no-untyped-def]
    """Compute the floor's brightness in one image, bilinear at each pixel's level of detail.

    Short loops over contiguous numbers, without slices: the compiler turns all but the last, which gathers, into
    vector instructions.

    Args:
        views: Heading and tool of each image row or of all, see `row_view`, (S or 1, >= 4).
        ground: Floor points at the pixels' centers, (S, S, 2) m.
        detail: Level of detail of each pixel, (S, S).
        corners: Texture, see `floor_texture`.
        pose: Pose of the texture, see `Floors`, (4,).
        places: Arrays to overwrite, `Places`.
        bright: Brightness, written in place, (S, S).
    """
    x, y, texel, size = places.x, places.y, places.texel, bright.shape[0]
    flat = ground.reshape(size, 2 * size)
    for i in range(size):
        _find_places(i, views, flat, detail, pose, places)
        _split_places(i, detail, places)
        for j in range(size):
            # Unsigned indices avoid a check for negative values at every access.
            at = np.uint32(4) * np.uint32(texel[j])
            upper = corners[at] + (corners[at + np.uint32(1)] - corners[at]) * x[j]
            lower = corners[at + np.uint32(2)] + (corners[at + np.uint32(3)] - corners[at + np.uint32(2)]) * x[j]
            bright[i, j] = upper + (lower - upper) * y[j]


@njit(cache=True, nogil=True)
def _develop(bright, light, color, tile, first, image):  # type: ignore[no-untyped-def]
    """Convert brightness to noisy pixels. The noise begins at row and column `first` of the tile."""
    red, green, blue = np.float32(color[0]), np.float32(color[1]), np.float32(color[2])
    half, black, white = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    size, left = light.shape[0], 3 * first[1]
    flat = image.reshape(size, 3 * size)
    for i in range(size):
        # A slice, since the sign of `left` would be checked at every access.
        grain = tile[(i + first[0]) & (NOISE_SIDE - 1), left : left + 3 * size]
        for j in range(size):
            value, k = bright[i, j] * light[i, j], 3 * j
            flat[i, k] = np.uint8(min(max(value * red + grain[k] + half, black), white))
            flat[i, k + 1] = np.uint8(min(max(value * green + grain[k + 1] + half, black), white))
            flat[i, k + 2] = np.uint8(min(max(value * blue + grain[k + 2] + half, black), white))


@njit(cache=True, nogil=True)
def _paint_markers(box, views, rays, bright, color, tile, first, image):  # type: ignore[no-untyped-def]
    """Paint both markers over the pixels of a box, the target last, on top of the distractor.

    Args:
        box: Rows and columns, see `_marker_box`.
        views: Heading, tool and markers of each image row or of all, see `_marker_view`, (S or 1, 8).
        rays: Rays of the camera, `Rays` without the leading axis.
        bright: Brightness of the floor, (S, S).
        color: Color of the floor at brightness 1, (3,).
        tile: Noise, see `SensorNoise`.
        first: First row and column in the tile, (2,).
        image: Image, painted in place, (S, S, 3).
    """
    ground, light, spread, size, paint = rays.ground, rays.light, rays.spread, bright.shape[0], np.empty(3)
    for i in range(box[0], box[1]):
        row, a, v = (i + first[0]) & (NOISE_SIDE - 1), min(max(i, 1), size - 2), i % views.shape[0]
        for j in range(box[2], box[3]):
            if spread[i, j] > _WIDEST_MARKER_PIXEL or light[i, j] == 0.0:
                continue
            # Half the diagonal of a square pixel.
            near, b, covered = RING_RADIUS + 0.71 * spread[i, j], min(max(j, 1), size - 2), False
            for channel in range(3):
                paint[channel] = color[channel] * bright[i, j]
            for marker, paint_color in ((6, DISTRACTOR_COLOR), (4, TARGET_COLOR)):
                x, y = views[v, marker], views[v, marker + 1]
                if (ground[i, j, 0] - x) ** 2 + (ground[i, j, 1] - y) ** 2 > near * near:
                    continue
                xu, yu = ground[i, b + 1, 0] - ground[i, b - 1, 0], ground[i, b + 1, 1] - ground[i, b - 1, 1]
                xv, yv = ground[a + 1, j, 0] - ground[a - 1, j, 0], ground[a + 1, j, 1] - ground[a - 1, j, 1]
                disc, ring = _covered(
                    ground[i, j, 0], ground[i, j, 1], 0.5 * xu, 0.5 * yu, 0.5 * xv, 0.5 * yv, x, y
                )  # fmt: skip
                covered |= disc + ring > 0.0
                for channel in range(3):
                    paint[channel] = (
                        (1.0 - disc - ring) * paint[channel] + disc * paint_color[channel] + ring * RING_COLOR[channel]
                    )
            if covered:
                for channel in range(3):
                    value = paint[channel] * light[i, j] + tile[row, 3 * (first[1] + j) + channel]
                    image[i, j, channel] = np.uint8(min(max(value + 0.5, 0.0), 255.0))


@njit(cache=True, nogil=True)
def _marker_box(camera, gx0, gy0, gx1, gy1, step, spread):  # type: ignore[no-untyped-def]
    """Rows and columns (first, last + 1) of a marker that moves between two points of the camera's frame."""
    size = spread.shape[0]
    u0, v0, seen0 = project_ground(camera, gx0, gy0)
    u1, v1, seen1 = project_ground(camera, gx1, gy1)
    if not (seen0 or seen1):
        return 0, 0, 0, 0
    i = min(max(int(0.5 * (v0 + v1) / step), 0), size - 1)
    j = min(max(int(0.5 * (u0 + u1) / step), 0), size - 1)
    # The finest pixels nearby give an upper bound of the marker's size.
    finest = spread[i, j]
    for a in (max(i - 2, 0), min(i + 2, size - 1)):
        for b in (max(j - 2, 0), min(j + 2, size - 1)):
            finest = min(finest, spread[a, b])
    margin = 1.4 * RING_RADIUS / finest + 2.0
    return (
        max(int(min(v0, v1) / step - margin), 0), min(int(max(v0, v1) / step + margin) + 1, size),
        max(int(min(u0, u1) / step - margin), 0), min(int(max(u0, u1) / step + margin) + 1, size),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def expose(  # type: ignore[no-untyped-def]
    rows, frames, shutter, step, arms, paths, distractors, rays, floors, noise, images
):
    """Render the given frames of the chosen rows. A rolling shutter exposes every image row at its own instant.

    Args:
        rows: Mask of the rows, (N,) bool.
        frames: Index of each row's frame in the episode's tables, (N,) int.
        shutter: Duration of the rolling shutter's readout, s; 0 is a global shutter.
        step: Camera pixels per image pixel.
        arms: Cameras and poses, `Arms`.
        paths: Positions and velocities of the targets at all samples, (N, K, 4) m, m/s.
        distractors: Positions and velocities of the distractors, (N, K, 4) m, m/s.
        rays: Rays of the cameras, `Rays`.
        floors: Floors, `Floors`.
        noise: Noise of the pixels, `SensorNoise`.
        images: RGB images, written in place, (N, S, S, 3) uint8.
    """
    cameras, links, history = arms.cameras, arms.links, arms.history
    size = images.shape[1]
    instants = size if shutter > 0.0 else 1
    views, bright, places = np.empty((instants, 8)), np.empty((size, size), np.float32), empty_places(size)
    for n in range(rows.shape[0]):
        if not rows[n]:
            continue
        frame, image, color, first = frames[n], images[n], floors.color[n], noise.offset[n, frames[n]]
        own = Rays(rays.ground[n], rays.light[n], rays.spread[n], rays.detail[n])
        for i in range(instants):
            y = (i + 0.5) / size
            _marker_view(y, shutter, cameras[n], links[n], history[n], paths[n], distractors[n], frame, views[i])
        look_down(views, own.ground, own.detail, floors.corners, floors.pose[n], places, bright)
        _develop(bright, own.light, color, noise.tile, first, image)
        start, end = views[0], views[instants - 1]
        for k in (4, 6):
            box = _marker_box(cameras[n], start[k], start[k + 1], end[k], end[k + 1], step, own.spread)
            _paint_markers(box, views, own, bright, color, noise.tile, first, image)
