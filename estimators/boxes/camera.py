"""Motion of the camera: from the pictures where there are any, else the part of the innovations that all tracks share.

People move on their own, a camera moves everything by the same shift. The shift of a frame has a Gaussian prior around
the one that continues the camera's velocity; its variance is learned from the shifts of the sequence, so that a still
camera stays still. Where that explains few of the tracks, the shift is searched for among the differences of tracks
and detections, and taken if it explains enough of them: a jolt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array
from servotrack.estimators.validation import LIMITS, as_numbers, check_within


class CameraRules(NamedTuple):
    """Conditions and gains of the estimation of the camera's motion.

    Attributes:
        least: Smallest number of tracks, weighted by their existence, that tell the motion.
        jolt: Decrease of the summed squared Mahalanobis distance from which a found shift is taken. Raising it needs
            more tracks that agree.
        farthest: Squared distance from which a track counts as unexplained.
        reach: Largest shift of a jolt, heights.
        leading: Number of tracks from whose differences to detections a jolt is searched.
        caution: Variances of the tracks' mean innovation that are taken off its square before it counts as motion of
            the camera; 1 is unbiased. Raising it keeps a still camera stiller and finds slow shaking later.
        persistence: Time in which the velocity of the camera falls by a factor e, s. Raising it follows a steady pan
            sooner and a stop later.
        memory: Time over which the variance of the shifts is learned, s.
    """

    least: float = 1.5
    jolt: float = 20.0
    farthest: float = 16.0
    reach: float = 2.0
    leading: int = 6
    caution: float = 2.0
    persistence: float = 1.0
    memory: float = 1.0


class CameraState(NamedTuple):
    """Motion of the camera.

    Attributes:
        shift: Shift of the picture from the last frame to this one. Shape (2,), px.
        velocity: Shape (2,), px/s.
        variance: Learned variance of what is new in a shift; a camera is still where it is below 0. Shape (2,), px^2/s.
    """

    shift: Array
    velocity: Array
    variance: Array


def initial_camera() -> CameraState:
    """A camera that stands still."""
    return CameraState(np.zeros(2), np.zeros(2), np.zeros(2))


def camera_step(
    state: CameraState,
    mean: Array,
    variance: Array,
    weight: Array,
    boxes: Array,
    noise: Array,
    dt: float,
    rules: CameraRules,
) -> CameraState:
    """Estimate the shift of a frame.

    Args:
        state: State after the last frame.
        mean: Predicted means of the tracks, as in `predict_boxes`. Shape (T, 6).
        variance: Variances of the tracks. Shape (T, 8).
        weight: Weight of each track, in [0, 1]. Shape (T,).
        boxes: Left, top, width, height of the detections. Shape (Z, 4), px.
        noise: Standard deviations of a measured center column, center row, width and height, heights. Shape (4,).
        dt: Time since the last frame, s.
        rules: Conditions and gains.
    """
    return CameraState(
        *_shifted(state.velocity, state.variance, mean, variance, weight, boxes, noise, float(dt), rules)
    )


def checked_motion(motion: ArrayLike) -> Array:
    """Return the motion of a picture as an array.

    Raises:
        ValueError: It has another shape than (2, 3), is not finite, or is no similarity that a camera makes in a frame.
    """
    found = as_numbers("motion", motion)
    if found.shape != (2, 3):
        raise ValueError(f"motion must have shape (2, 3), [linear part | shift in px], got {found.shape}")
    check_within("motion", found, LIMITS.boxes, "pass None where it is unknown")
    if not 0.1 <= abs(float(np.linalg.det(found[:, :2]))) <= 10.0:
        raise ValueError(
            f"motion must keep areas within a factor of 10, got {found.tolist()}; pass None where it is unknown"
        )
    return found


def seen_camera(motion: Array, size: tuple[int, int] | None, dt: float) -> CameraState:
    """State of a camera whose motion was seen in the pictures.

    Args:
        motion: Maps a point (x, y, 1) of the last frame to this one. Shape (2, 3).
        size: Width and height of the frame, px; None: the shift is that of the point (0, 0).
        dt: Time since the last frame, s.
    """
    middle = np.array([0.0, 0.0] if size is None else [size[0] / 2.0, size[1] / 2.0])
    shift = motion[:, :2] @ middle + motion[:, 2] - middle
    return CameraState(shift, shift / dt, np.zeros(2))


def move_tracks(mean: Array, variance: Array, motion: Array) -> tuple[Array, Array]:
    """Means and variances of tracks after a similarity of the picture.

    Args:
        mean: Means of the tracks, as in `predict_boxes`. Shape (T, 6).
        variance: Variances of the tracks. Shape (T, 8).
        motion: Maps a point (x, y, 1) of the last frame to this one. Shape (2, 3).
    """
    turn, scale = motion[:, :2], math.sqrt(abs(float(np.linalg.det(motion[:, :2]))))
    out = mean * scale
    out[:, [0, 2]] = mean[:, [0, 2]] @ turn.T + motion[:, 2]
    out[:, [1, 3]] = mean[:, [1, 3]] @ turn.T
    # Turns of a camera are small: rows and columns stay uncorrelated.
    return out, variance * scale**2


@njit(cache=True, nogil=True)
def _shifted(velocity, novelty, mean, variance, weight, boxes, noise, dt, rules):  # type: ignore[no-untyped-def]
    least, jolt, farthest, reach, leading, caution, persistence, memory = rules
    expected, still = velocity * (dt * math.exp(-dt / persistence)), np.zeros(2)
    if weight.sum() < least or boxes.shape[0] == 0:
        return expected, expected / dt, novelty.copy()
    cost, found = _explained(expected, mean, variance, weight, boxes, noise, farthest)
    other, others = _explained(still, mean, variance, weight, boxes, noise, farthest)
    if other < cost:
        expected, cost, found = still, other, others
    if cost > 0.25 * farthest * weight.sum():
        best, shift = _searched(mean, variance, weight, boxes, noise, farthest, reach, leading)
        if best < cost - jolt:
            expected = shift
            cost, found = _explained(expected, mean, variance, weight, boxes, noise, farthest)
    shift, learned = expected.copy(), novelty.copy()
    rate = min(dt / memory, 1.0)
    for axis in range(2):
        # Weighted mean of the gaps and, from their scatter, its variance, whatever the predicted variances say.
        total, mean_gap, scatter, squares = 0.0, 0.0, 0.0, 0.0
        for i in range(mean.shape[0]):
            j = found[i]
            if j >= 0:
                own = weight[i] / ((noise[axis] * mean[i, 5]) ** 2 + variance[i, 3 * axis])
                gap = boxes[j, axis] + boxes[j, 2 + axis] / 2.0 - mean[i, 2 * axis] - expected[axis]
                total += own
                squares += own * own
                change = gap - mean_gap
                mean_gap += own / total * change
                scatter += own * change * (gap - mean_gap)
        if total == 0.0 or total * total < least * squares:
            continue
        number = total * total / squares
        spread = scatter / total / max(number - 1.0, 0.5)
        learned[axis] += rate * ((mean_gap**2 - caution * spread) / dt - learned[axis])
        new = max(learned[axis], 0.0) * dt
        shift[axis] += mean_gap * new / (new + max(spread, 1.0 / total))
    return shift, shift / dt, learned


@njit(cache=True, nogil=True)
def _distance(shift, mean, variance, box, noise, i):  # type: ignore[no-untyped-def]
    """Squared Mahalanobis distance of a box from track i, shifted."""
    total = 0.0
    for axis in range(2):
        S = (noise[axis] * mean[i, 5]) ** 2 + variance[i, 3 * axis]
        total += (box[axis] + box[2 + axis] / 2.0 - mean[i, 2 * axis] - shift[axis]) ** 2 / S
        S = (noise[2 + axis] * mean[i, 5]) ** 2 + variance[i, 6 + axis]
        total += (box[2 + axis] - mean[i, 4 + axis]) ** 2 / S
    return total


@njit(cache=True, nogil=True)
def _explained(shift, mean, variance, weight, boxes, noise, farthest):  # type: ignore[no-untyped-def]
    """Weighted sum of the distances to the nearest detections, each at most `farthest`, and these detections."""
    cost, found = 0.0, np.full(mean.shape[0], -1)
    for i in range(mean.shape[0]):
        if weight[i] <= 0.0:
            continue
        nearest = farthest
        for j in range(boxes.shape[0]):
            distance = _distance(shift, mean, variance, boxes[j], noise, i)
            if distance < nearest:
                nearest, found[i] = distance, j
        cost += weight[i] * nearest
    return cost, found


@njit(cache=True, nogil=True)
def _searched(mean, variance, weight, boxes, noise, farthest, reach, leading):  # type: ignore[no-untyped-def]
    """The shift from a track to a detection of like size that explains all tracks best, and its cost."""
    best, shift = np.inf, np.zeros(2)
    candidate = np.zeros(2)
    for i in np.argsort(-weight)[:leading]:
        for j in range(boxes.shape[0]):
            for axis in range(2):
                candidate[axis] = boxes[j, axis] + boxes[j, 2 + axis] / 2.0 - mean[i, 2 * axis]
            if max(abs(candidate[0]), abs(candidate[1])) > reach * mean[i, 5]:
                continue
            if _distance(candidate, mean, variance, boxes[j], noise, i) > farthest:
                continue
            cost, _ = _explained(candidate, mean, variance, weight, boxes, noise, farthest)
            if cost < best:
                best = cost
                shift[:] = candidate
    return best, shift
