"""Kalman filter of boxes: nearly constant velocity of the center, random walk of the size, noise in body heights."""

from __future__ import annotations

import math

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


@njit(cache=True, nogil=True)
def predict_boxes(mean, variance, missed, period, acceleration, drift, memory):  # type: ignore[no-untyped-def]
    """Predict all tracks one frame ahead: nearly constant velocity of the center, nearly constant size.

    Args:
        mean: Center column, its velocity, center row, its velocity, width, height. Shape (T, 6), px and px/s.
        variance: Variance of the position, covariance of position and velocity, variance of the velocity, for columns
            and then for rows; then variances of width and height. Shape (T, 8).
        missed: Number of frames since the last detection. Shape (T,).
        period: Time between frames, s.
        acceleration: Root spectral densities of the acceleration along columns and rows, heights/s^1.5. Shape (2,).
        drift: Relative random walks of width and height, 1/s^0.5. Shape (2,).
        memory: Time constant of the velocity of an undetected track, s.

    Returns:
        Predicted mean and variance.
    """
    t = period
    out_mean, out = np.empty_like(mean), np.empty_like(variance)
    for i in range(mean.shape[0]):
        height = mean[i, 5]
        keep = math.exp(-t / memory) if missed[i] > 0 else 1.0
        for axis in range(2):
            a, k = 2 * axis, 3 * axis
            q = (acceleration[axis] * height) ** 2
            out_mean[i, a] = mean[i, a] + t * mean[i, a + 1]
            out_mean[i, a + 1] = keep * mean[i, a + 1]
            p, c, v = variance[i, k], variance[i, k + 1], variance[i, k + 2]
            out[i, k] = p + 2.0 * t * c + t * t * v + q * t**3 / 3.0
            out[i, k + 1] = keep * (c + t * v) + q * t**2 / 2.0
            out[i, k + 2] = keep * keep * v + q * t
        for axis in range(2):
            out_mean[i, 4 + axis] = mean[i, 4 + axis]
            out[i, 6 + axis] = variance[i, 6 + axis] + (drift[axis] * mean[i, 4 + axis]) ** 2 * t
    return out_mean, out


@njit(cache=True, nogil=True)
def correct_place(mean, variance, axis, place, noise):  # type: ignore[no-untyped-def]
    """Kalman correction, in place, of the position and velocity of one track along one axis.

    Args:
        mean: Mean of the track as in `predict_boxes`; changed. Shape (6,).
        variance: Variances of the track as in `predict_boxes`; changed. Shape (8,).
        axis: 0 for columns, 1 for rows.
        place: Measured center, px.
        noise: Variance of the measurement, px^2.

    Returns:
        Innovation divided by its standard deviation.
    """
    a, p = 2 * axis, 3 * axis
    S = noise + variance[p]
    gain, gain_velocity = variance[p] / S, variance[p + 1] / S
    gap = place - mean[a]
    mean[a] += gain * gap
    mean[a + 1] += gain_velocity * gap
    variance[p + 2] -= gain_velocity * variance[p + 1]
    variance[p + 1] *= 1.0 - gain
    variance[p] *= 1.0 - gain
    return gap / math.sqrt(S)


@njit(cache=True, nogil=True)
def correct_boxes(mean, variance, partner, boxes, noise, smallest_size):  # type: ignore[no-untyped-def]
    """Kalman correction, in place, of the tracks that have a partner; the four measured entries are independent.

    Args:
        mean: Means as in `predict_boxes`; changed. Shape (T, 6).
        variance: Variances as in `predict_boxes`; changed. Shape (T, 8).
        partner: Index of each track's detection, -1 for none. Shape (T,).
        boxes: Left, top, width, height of the detections. Shape (Z, 4), px.
        noise: Standard deviations of a measured center column, center row, width and height, heights. Shape (4,).
        smallest_size: Lower limit of width and height, px.

    Returns:
        Innovations divided by their standard deviations, zero without a partner. Shape (T, 4).
    """
    innovation = np.zeros((mean.shape[0], 4))
    for i in range(mean.shape[0]):
        j = partner[i]
        if j < 0:
            continue
        height = mean[i, 5]
        for k in range(2):
            place = boxes[j, k] + boxes[j, 2 + k] / 2
            innovation[i, k] = correct_place(mean[i], variance[i], k, place, (noise[k] * height) ** 2)
        for k in range(2):
            S = (noise[2 + k] * height) ** 2 + variance[i, 6 + k]
            gain = variance[i, 6 + k] / S
            gap = boxes[j, 2 + k] - mean[i, 4 + k]
            innovation[i, 2 + k] = gap / math.sqrt(S)
            mean[i, 4 + k] = max(mean[i, 4 + k] + gain * gap, smallest_size)
            variance[i, 6 + k] *= 1.0 - gain
    return innovation


def started_boxes(boxes: Array, noise: Array, speed: float, smallest_size: float) -> tuple[Array, Array]:
    """Mean and variance of new tracks with one detection each.

    Args:
        boxes: Left, top, width, height of the detections. Shape (k, 4), px.
        noise: Standard deviations of a measured center column, center row, width and height, heights. Shape (4,).
        speed: Standard deviation of the velocity, heights/s.
        smallest_size: Lower limit of width and height, px.
    """
    height = boxes[:, 3:]
    mean, variance = np.zeros((len(boxes), 6)), np.zeros((len(boxes), 8))
    mean[:, [0, 2]] = boxes[:, :2] + boxes[:, 2:] / 2.0
    mean[:, 4:] = np.maximum(boxes[:, 2:], smallest_size)
    variance[:, [0, 3]] = (noise[:2] * height) ** 2
    variance[:, [2, 5]] = (speed * height) ** 2
    variance[:, 6:] = (noise[2:] * height) ** 2
    return mean, variance


@njit(cache=True, nogil=True)
def center_boxes(mean):  # type: ignore[no-untyped-def]
    """Boxes of tracks with means as in `predict_boxes`: left, top, width, height. Shape (T, 4), px."""
    boxes = np.empty((mean.shape[0], 4))
    for i in range(mean.shape[0]):
        for axis in range(2):
            boxes[i, 2 + axis] = mean[i, 4 + axis]
            boxes[i, axis] = mean[i, 2 * axis] - 0.5 * mean[i, 4 + axis]
    return boxes
