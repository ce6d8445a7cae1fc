"""Kalman filter of boxes: nearly constant velocity of the center, a random walk of the size, noises in body heights."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from servotrack.estimators.types import Array

SMALLEST_SIZE = 2.0
"""Lowest width and height of a track, px."""


@njit(cache=True, nogil=True)
def predict_boxes(mean, variance, missed, period, noise):  # type: ignore[no-untyped-def]
    """Predict all tracks one frame ahead: nearly constant velocity of the center, nearly constant size.

    Args:
        mean: Center column, its velocity, center row, its velocity, width, height. Shape (T, 6), px and px/s.
        variance: Of position, of both, of velocity, for columns and for rows; of width, of height. Shape (T, 8).
        missed: Frames since the last detection. Shape (T,).
        period: Time between frames, s.
        noise: Acceleration, heights/s^1.5; drift of the sizes, 1/s^0.5; memory of a velocity while unseen, s.

    Returns:
        The predicted mean and variance.
    """
    acceleration, drift, memory = noise
    t = period
    out_mean, out = np.empty_like(mean), np.empty_like(variance)
    for i in range(mean.shape[0]):
        height = mean[i, 5]
        q = (acceleration * height) ** 2
        keep = math.exp(-t / memory) if missed[i] > 0 else 1.0
        for axis in range(2):
            a, k = 2 * axis, 3 * axis
            out_mean[i, a] = mean[i, a] + t * mean[i, a + 1]
            out_mean[i, a + 1] = keep * mean[i, a + 1]
            p, c, v = variance[i, k], variance[i, k + 1], variance[i, k + 2]
            out[i, k] = p + 2.0 * t * c + t * t * v + q * t**3 / 3.0
            out[i, k + 1] = keep * (c + t * v) + q * t**2 / 2.0
            out[i, k + 2] = keep * keep * v + q * t
        for axis in range(2):
            out_mean[i, 4 + axis] = mean[i, 4 + axis]
            out[i, 6 + axis] = variance[i, 6 + axis] + (drift * mean[i, 4 + axis]) ** 2 * t
    return out_mean, out


@njit(cache=True, nogil=True)
def correct_boxes(mean, variance, partner, boxes, noise):  # type: ignore[no-untyped-def]
    """Kalman correction, in place, of the tracks that have a partner; the four measured entries are independent."""
    for i in range(mean.shape[0]):
        j = partner[i]
        if j < 0:
            continue
        height = mean[i, 5]
        for k in range(2):
            a, p = 2 * k, 3 * k
            S = (noise[0] * height) ** 2 + variance[i, p]
            gain, gain_velocity = variance[i, p] / S, variance[i, p + 1] / S
            gap = boxes[j, k] + boxes[j, 2 + k] / 2 - mean[i, a]
            mean[i, a] += gain * gap
            mean[i, a + 1] += gain_velocity * gap
            variance[i, p + 2] -= gain_velocity * variance[i, p + 1]
            variance[i, p + 1] *= 1.0 - gain
            variance[i, p] *= 1.0 - gain
        for k in range(2):
            S = (noise[1] * height) ** 2 + variance[i, 6 + k]
            gain = variance[i, 6 + k] / S
            mean[i, 4 + k] = max(mean[i, 4 + k] + gain * (boxes[j, 2 + k] - mean[i, 4 + k]), SMALLEST_SIZE)
            variance[i, 6 + k] *= 1.0 - gain


def started_boxes(boxes: Array, position_noise: float, size_noise: float, speed: float) -> tuple[Array, Array]:
    """Mean and variance of new tracks, of which one detection is known; noises as shares of the height."""
    height = boxes[:, 3:]
    mean, variance = np.zeros((len(boxes), 6)), np.zeros((len(boxes), 8))
    mean[:, [0, 2]] = boxes[:, :2] + boxes[:, 2:] / 2.0
    mean[:, 4:] = np.maximum(boxes[:, 2:], SMALLEST_SIZE)
    variance[:, [0, 3]] = (position_noise * height) ** 2
    variance[:, [2, 5]] = (speed * height) ** 2
    variance[:, 6:] = (size_noise * height) ** 2
    return mean, variance


def center_boxes(mean: Array) -> Array:
    """The boxes of tracks: left, top, width, height. Shape (T, 4), px."""
    boxes = np.empty((len(mean), 4))
    boxes[:, 2:] = mean[:, 4:]
    boxes[:, :2] = mean[:, [0, 2]] - 0.5 * mean[:, 4:]
    return boxes
