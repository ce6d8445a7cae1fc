"""Compiled kernels that render the images of the arm's camera over a crowd from the world's tables."""

from __future__ import annotations

import numpy as np
from numba import njit

from servotrack.envs.follow.figures import POSE_NUMBERS, pose
from servotrack.envs.follow.painting import find_boxes, paint_crowd, paint_shadows
from servotrack.envs.servo.exposure import NOISE_SIDE, look_down, row_view
from servotrack.envs.servo.world import interpolate_path


@njit(cache=True, nogil=True, error_model="numpy")
def _develop(canvas, light, noise, image):  # type: ignore[no-untyped-def]
    """Turn one row of the canvas into one row of noisy pixels."""
    half, black, white = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    for j in range(image.shape[0]):
        for channel in range(3):
            value = canvas[j, channel] * light[j] + noise[j, channel] + half
            image[j, channel] = np.uint8(min(max(value, black), white))


@njit(cache=True, nogil=True, error_model="numpy")
def _expose_one(  # type: ignore[no-untyped-def]
    frame, views, places, step, strength, camera, walk, outfits, umbrella, umbrella_color, lamps, ground, light, spread,
    detail, texels, starts, floor_pose, floor_color, noise, first_row, first_column, boxes, shade, canvas, image,
):  # fmt: skip
    """Render one image: floor, shadows, people, umbrellas and lampshades, light and noise."""
    size = image.shape[0]
    people = len(umbrella)
    poses = np.empty((people, POSE_NUMBERS))
    for k in range(people):
        pose(outfits[k], walk[frame, k, 0], walk[frame, k, 1], walk[frame, k, 2], poses[k])
    find_boxes(camera, step, size, size, views, places, poses, umbrella, lamps, boxes)
    shade[:] = np.float32(1.0)
    if strength > 0.0:
        paint_shadows(shade, ground, spread, strength, views, places, umbrella, lamps, boxes)
    red, green, blue = np.float32(floor_color[0]), np.float32(floor_color[1]), np.float32(floor_color[2])
    bright = np.empty(size, np.float32)
    for i in range(size):
        look_down(views[i % len(views)], ground[i], detail[i], texels, starts, floor_pose, bright)
        for j in range(size):
            value = bright[j] * shade[i, j]
            canvas[i, j, 0], canvas[i, j, 1], canvas[i, j, 2] = value * red, value * green, value * blue
    paint_crowd(
        canvas, ground, spread, 1.0, views, places, walk[frame, :, 0], outfits, poses, umbrella, umbrella_color, lamps,
        boxes,
    )  # fmt: skip
    for i in range(size):
        grain = noise[(i + first_row) & (NOISE_SIDE - 1), first_column : first_column + size]
        _develop(canvas[i], light[i], grain, image[i])


@njit(cache=True, nogil=True, error_model="numpy")
def expose_crowd(  # type: ignore[no-untyped-def]
    rows, frames, shutter, step, strength, cameras, links, history, paths, walk, outfits, umbrella, umbrella_color,
    lamps, ground, light, spread, detail, texels, starts, floor_pose, floor_color, noise, noise_offset, images,
):  # fmt: skip
    """Render the given frames of the chosen rows. A rolling shutter exposes every image row at its own instant."""
    size, people = images.shape[1], paths.shape[2]
    instants = size if shutter > 0.0 else 1
    views, places = np.empty((instants, 4)), np.empty((instants, 2 * people + lamps.shape[1], 2))
    boxes = np.empty((2, 2 * people + lamps.shape[1], 4), np.int64)
    shade, canvas = np.empty((size, size), np.float32), np.empty((size, size, 3), np.float32)
    for n in range(rows.shape[0]):
        if not rows[n]:
            continue
        frame = frames[n]
        for i in range(instants):
            before, f = row_view((i + 0.5) / size, shutter, cameras[n], links[n], history[n], frame, views[i])
            for k in range(people):
                x, y = interpolate_path(paths[n, before, k], paths[n, frame, k], f)
                places[i, k, 0], places[i, k, 1] = x, y
                places[i, people + k, 0], places[i, people + k, 1] = x, y
            for k in range(lamps.shape[1]):
                places[i, 2 * people + k, 0], places[i, 2 * people + k, 1] = lamps[n, k, 0], lamps[n, k, 1]
        _expose_one(
            frame, views, places, step, strength, cameras[n], walk[n], outfits[n], umbrella[n], umbrella_color[n],
            lamps[n], ground[n], light[n], spread[n], detail[n], texels, starts, floor_pose[n], floor_color[n], noise,
            noise_offset[n, frame, 0], noise_offset[n, frame, 1], boxes, shade, canvas, images[n],
        )  # fmt: skip
