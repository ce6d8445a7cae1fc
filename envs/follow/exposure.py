"""Compiled kernels that render the images of the arm's camera over a crowd from the world's tables."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.follow.figures import POSE_NUMBERS, pose
from servotrack.envs.follow.painting import CrowdTables, find_boxes, paint_crowd, paint_shadows
from servotrack.envs.servo.exposure import (
    NOISE_SIDE,
    Floors,
    Places,
    Rays,
    SensorNoise,
    empty_places,
    look_down,
    row_view,
)
from servotrack.envs.servo.sensing import interpolate_path
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import FloatArray


class _Scratch(NamedTuple):
    """Arrays that are overwritten by every image.

    Attributes:
        boxes: Bounding boxes in the image of shadows and of objects, (2, 2 P + L, 4).
        shade: Share of the light that reaches each pixel's point, (S, S) float32.
        bright: Brightness of the floor, (S, S) float32.
        canvas: Image without light falloff and noise, (S, S, 3) float32.
        places: Places of an image row in the floor's texture.
    """

    boxes: NDArray[np.int64]
    shade: FloatArray
    bright: FloatArray
    canvas: FloatArray
    places: Places


@njit(cache=True, nogil=True, error_model="numpy")
def _develop(canvas, light, tile, first, image):  # type: ignore[no-untyped-def]
    """Turn the canvas into noisy pixels. The noise begins at row and column `first` of the tile."""
    half, black, white = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    size, left = light.shape[0], 3 * first[1]
    flat, painted = image.reshape(size, 3 * size), canvas.reshape(size, 3 * size)
    for i in range(size):
        grain = tile[(i + first[0]) & (NOISE_SIDE - 1), left : left + 3 * size]
        for j in range(size):
            for k in range(3 * j, 3 * j + 3):
                value = painted[i, k] * light[i, j] + grain[k] + half
                flat[i, k] = np.uint8(min(max(value, black), white))


@njit(cache=True, nogil=True, error_model="numpy")
def _expose_one(  # type: ignore[no-untyped-def]
    views, places, step, strength, camera, crowd, rays, floor, noise, scratch, image
):
    """Render one image: floor, shadows, people, umbrellas and lampshades, light and noise.

    Args:
        views: Cos and sin of the camera's heading and the point below it, per image row or for all rows. (R, 4).
        places: Positions of all objects at those instants, (R, 2 P + L, 2) m.
        step: Camera pixels per image pixel.
        strength: Darkness of shadows, 0 to 1.
        camera: Packed camera.
        crowd: Gait and appearance at the frame, `CrowdTables` of one crowd.
        rays: Rays of the camera, `Rays` without the leading axis.
        floor: Floor, `Floors` with one pose (4,) and one color (3,).
        noise: Noise of the pixels, `SensorNoise` with the offset of the frame, (2,).
        scratch: Arrays to overwrite, `_Scratch`.
        image: RGB image, written in place, (S, S, 3) uint8.
    """
    size, people = image.shape[0], len(crowd.umbrella)
    ground, light, spread, detail = rays.ground, rays.light, rays.spread, rays.detail
    walk, outfits, umbrella, lamps = crowd.walk, crowd.outfits, crowd.umbrella, crowd.lamps
    boxes, shade, canvas, bright = scratch.boxes, scratch.shade, scratch.canvas, scratch.bright
    poses = np.empty((people, POSE_NUMBERS))
    for k in range(people):
        pose(outfits[k], walk[k, 0], walk[k, 1], walk[k, 2], poses[k])
    find_boxes(camera, step, size, size, views, places, poses, umbrella, lamps, boxes)
    shade[:] = np.float32(1.0)
    if strength > 0.0:
        paint_shadows(shade, ground, spread, strength, views, places, umbrella, lamps, boxes)
    red, green, blue = np.float32(floor.color[0]), np.float32(floor.color[1]), np.float32(floor.color[2])
    look_down(views, ground, detail, floor.corners, floor.pose, scratch.places, bright)
    for i in range(size):
        for j in range(size):
            value = bright[i, j] * shade[i, j]
            canvas[i, j, 0], canvas[i, j, 1], canvas[i, j, 2] = value * red, value * green, value * blue
    paint_crowd(canvas, ground, spread, 1.0, views, places, crowd, poses, boxes)
    _develop(canvas, light, noise.tile, noise.offset, image)


@njit(cache=True, nogil=True, error_model="numpy")
def expose_crowd(  # type: ignore[no-untyped-def]
    rows, frames, shutter, step, strength, arms, paths, crowds, rays, floors, noise, images
):
    """Render the given frames of the chosen rows. A rolling shutter exposes every image row at its own instant.

    Args:
        rows: Mask of the rows, (N,) bool.
        frames: Index of each row's frame in the episode's tables, (N,) int.
        shutter: Duration of the rolling shutter's readout, s; 0 is a global shutter.
        step: Camera pixels per image pixel.
        strength: Darkness of shadows, 0 to 1.
        arms: Cameras and poses, `Arms`.
        paths: Positions and velocities of all people at all samples, (N, K, P, 4) m, m/s.
        crowds: Gait at all samples, and appearance, `CrowdTables` with a leading axis of N.
        rays: Rays of the cameras, `Rays`.
        floors: Floors, `Floors`.
        noise: Noise of the pixels, `SensorNoise`.
        images: RGB images, written in place, (N, S, S, 3) uint8.
    """
    size, people, lamps = images.shape[1], paths.shape[2], crowds.lamps
    cameras, links, history = arms.cameras, arms.links, arms.history
    instants = size if shutter > 0.0 else 1
    views, places = np.empty((instants, 4)), np.empty((instants, 2 * people + lamps.shape[1], 2))
    scratch = _Scratch(
        np.empty((2, 2 * people + lamps.shape[1], 4), np.int64),
        np.empty((size, size), np.float32),
        np.empty((size, size), np.float32),
        np.empty((size, size, 3), np.float32),
        empty_places(size),
    )
    for n in range(rows.shape[0]):
        if not rows[n]:
            continue
        frame, camera = frames[n], cameras[n]
        for i in range(instants):
            before, f = row_view((i + 0.5) / size, shutter, camera, links[n], history[n], frame, views[i])
            for k in range(people):
                x, y = interpolate_path(paths[n, before, k], paths[n, frame, k], f)
                places[i, k, 0], places[i, k, 1] = x, y
                places[i, people + k, 0], places[i, people + k, 1] = x, y
            for k in range(lamps.shape[1]):
                places[i, 2 * people + k, 0], places[i, 2 * people + k, 1] = lamps[n, k, 0], lamps[n, k, 1]
        crowd = CrowdTables(
            crowds.walk[n, frame], crowds.outfits[n], crowds.umbrella[n], crowds.umbrella_color[n], lamps[n]
        )
        own = Rays(rays.ground[n], rays.light[n], rays.spread[n], rays.detail[n])
        floor = Floors(floors.corners, floors.pose[n], floors.color[n])
        grain = SensorNoise(noise.tile, noise.offset[n, frame])
        _expose_one(views, places, step, strength, camera, crowd, own, floor, grain, scratch, images[n])
