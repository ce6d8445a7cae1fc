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
        texels: All levels of detail of the texture, one after the other, brightness about 1, float32.
        starts: Index in `texels` of the first texel of each level.
        pose: Rotation (cos, sin) and shift (x, y) of the texture, (N, 4), shift in tiles.
        color: Color at brightness 1, (N, 3), gray levels.
    """

    texels: FloatArray
    starts: NDArray[np.uint64]
    pose: Array
    color: Array


class SensorNoise(NamedTuple):
    """Noise of the pixels of N cameras, read from one tile.

    Attributes:
        tile: Noise, periodic in rows and columns, (NOISE_SIDE, NOISE_SIDE + S, 3), gray levels.
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
def _covered(ground, i, j, x, y):  # type: ignore[no-untyped-def]
    """Shares of pixel (i, j) that the disc and the ring of a marker at (x, y) cover."""
    size = ground.shape[0]
    a, b = min(max(i, 1), size - 2), min(max(j, 1), size - 2)
    xu, yu = 0.5 * (ground[i, b + 1, 0] - ground[i, b - 1, 0]), 0.5 * (ground[i, b + 1, 1] - ground[i, b - 1, 1])
    xv, yv = 0.5 * (ground[a + 1, j, 0] - ground[a - 1, j, 0]), 0.5 * (ground[a + 1, j, 1] - ground[a - 1, j, 1])
    disc, ring = 0, 0
    for p in range(_SAMPLES):
        ov = (p + 0.5) / _SAMPLES - 0.5
        for q in range(_SAMPLES):
            ou = (q + 0.5) / _SAMPLES - 0.5
            dx = ground[i, j, 0] + ou * xu + ov * xv - x
            dy = ground[i, j, 1] + ou * yu + ov * yv - y
            distance2 = dx * dx + dy * dy
            if distance2 < DISC_RADIUS * DISC_RADIUS:
                disc += 1
            elif distance2 < RING_RADIUS * RING_RADIUS:
                ring += 1
    return disc / (_SAMPLES * _SAMPLES), ring / (_SAMPLES * _SAMPLES)


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
def look_down(view, ground, detail, texels, starts, pose, out):  # type: ignore[no-untyped-def]
    """Compute the floor's brightness along one image row, bilinear at each pixel's level of detail."""
    # From the camera's frame to texture coordinates in tiles, shifted so that they are positive.
    fc, fs = pose[0] / TILE, pose[1] / TILE
    xx, xy = fc * view[0] - fs * view[1], fc * view[1] + fs * view[0]
    yx, yy = xy, -xx
    x0 = fc * view[2] - fs * view[3] + pose[2] + _SHIFT
    y0 = fs * view[2] + fc * view[3] + pose[3] + _SHIFT
    one = np.uint64(1)
    for j in range(ground.shape[0]):
        level = detail[j]
        side = SIDE >> level
        last = np.uint64(side - 1)
        gx, gy = ground[j, 0], ground[j, 1]
        x, y = (xx * gx + xy * gy + x0) * side, (yx * gx + yy * gy + y0) * side
        whole_x, whole_y = np.int64(x), np.int64(y)
        fx, fy = x - whole_x, y - whole_y
        # Unsigned indices avoid a check for negative values at every access.
        column, row = np.uint64(whole_x), np.uint64(whole_y)
        start = starts[level]
        top, bottom = start + (row & last) * np.uint64(side), start + ((row + one) & last) * np.uint64(side)
        left, right = column & last, (column + one) & last
        upper = texels[top + left] + (texels[top + right] - texels[top + left]) * fx
        lower = texels[bottom + left] + (texels[bottom + right] - texels[bottom + left]) * fx
        out[j] = upper + (lower - upper) * fy


@njit(cache=True, nogil=True)
def _develop(bright, light, color, noise, image):  # type: ignore[no-untyped-def]
    """Convert one row of brightness to noisy pixels."""
    red, green, blue = np.float32(color[0]), np.float32(color[1]), np.float32(color[2])
    half, black, white = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    for j in range(image.shape[0]):
        value = bright[j] * light[j]
        image[j, 0] = np.uint8(min(max(value * red + noise[j, 0] + half, black), white))
        image[j, 1] = np.uint8(min(max(value * green + noise[j, 1] + half, black), white))
        image[j, 2] = np.uint8(min(max(value * blue + noise[j, 2] + half, black), white))


@njit(cache=True, nogil=True)
def _paint_marker(ground, spread, i, j, x, y, color, paint):  # type: ignore[no-untyped-def]
    """Paint a marker at (x, y) over the color of pixel (i, j). Returns True if it touches the pixel."""
    # Half the diagonal of a square pixel.
    near = RING_RADIUS + 0.71 * spread[i, j]
    if (ground[i, j, 0] - x) ** 2 + (ground[i, j, 1] - y) ** 2 > near * near:
        return False
    disc, ring = _covered(ground, i, j, x, y)
    for channel in range(3):
        paint[channel] = (1.0 - disc - ring) * paint[channel] + disc * color[channel] + ring * RING_COLOR[channel]
    return disc + ring > 0.0


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
    ground, light, spread, detail = rays.ground, rays.light, rays.spread, rays.detail
    texels, starts, pose, color = floors.texels, floors.starts, floors.pose, floors.color
    tile, offset = noise.tile, noise.offset
    size = images.shape[1]
    views, bright, paint = np.empty((size, 8)), np.empty((size, size), np.float32), np.empty(3)
    for n in range(rows.shape[0]):
        if not rows[n]:
            continue
        frame = frames[n]
        first_row, first_column = offset[n, frame, 0], offset[n, frame, 1]
        for i in range(size):
            if i == 0 or shutter > 0.0:
                y = (i + 0.5) / size
                _marker_view(y, shutter, cameras[n], links[n], history[n], paths[n], distractors[n], frame, views[i])
            else:
                views[i] = views[0]
            grain = tile[(i + first_row) & (NOISE_SIDE - 1), first_column : first_column + size]
            look_down(views[i], ground[n, i], detail[n, i], texels, starts, pose[n], bright[i])
            _develop(bright[i], light[n, i], color[n], grain, images[n, i])
        for marker in range(2):
            k = 4 + 2 * marker
            top, bottom, left, right = _marker_box(
                cameras[n], views[0, k], views[0, k + 1], views[size - 1, k], views[size - 1, k + 1], step, spread[n]
            )
            for i in range(top, bottom):
                grain = tile[(i + first_row) & (NOISE_SIDE - 1)]
                for j in range(left, right):
                    if spread[n, i, j] > _WIDEST_MARKER_PIXEL or light[n, i, j] == 0.0:
                        continue
                    for channel in range(3):
                        paint[channel] = color[n, channel] * bright[i, j]
                    # Both markers at every pixel, the target last, on top of the distractor.
                    look, width = ground[n], spread[n]
                    covered = _paint_marker(look, width, i, j, views[i, 6], views[i, 7], DISTRACTOR_COLOR, paint)
                    covered |= _paint_marker(look, width, i, j, views[i, 4], views[i, 5], TARGET_COLOR, paint)
                    if covered:
                        for channel in range(3):
                            value = paint[channel] * light[n, i, j] + grain[first_column + j, channel]
                            images[n, i, j, channel] = np.uint8(min(max(value + 0.5, 0.0), 255.0))
