"""Heights of people by their place in the image, learned as the frames pass: people stand on one ground plane.

The height of a person in px is nearly linear in the row of the feet and the column, h = a + b row + c column, for any
camera above a plane (Hoiem, Efros and Hebert 2008). A detection of another height is false more often. The regression
minimizes relative errors and weighs each detection by the probability that it is a person and by time, so that it
counts person-seconds at any frame rate.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array


class HeightRules(NamedTuple):
    """Learning of heights.

    Attributes:
        spread: Prior standard deviation of the relative height among people. Raising it tolerates other heights.
        spread_weight: Weight of that prior, person-seconds.
        slope_precision: Prior precision of the slopes b and c, in units of the inverse variance of the relative height.
        smallest_share: Smallest expected height, as a share of the detection's own.
        farthest: Upper limit of a deviation, standard deviations.
        outlier: Deviation from which a box counts for `outlier_weight`: children, sitting people, false detections.
        outlier_weight: Weight of such a box.
        least: Weight from which heights are judged, person-seconds.
        memory: Time for which heights are remembered, s.
    """

    spread: float = 0.15
    spread_weight: float = 2.0
    slope_precision: float = 0.05
    smallest_share: float = 0.1
    farthest: float = 4.0
    outlier: float = 3.0
    outlier_weight: float = 0.05
    least: float = 1.0
    memory: float = 20.0


def initial_heights() -> Array:
    """State before the first detection: six entries of the normal matrix, three of the right side, weight, errors.

    Returns:
        Shape (11,).
    """
    return np.zeros(11)


@njit(cache=True, nogil=True)
def height_errors(state, boxes, rules):  # type: ignore[no-untyped-def]
    """Deviations of the heights from those expected, in standard deviations of the prediction; 0 while little is known.

    Args:
        state: State as in `initial_heights`.
        boxes: Left, top, width, height. Shape (k, 4), px.
        rules: A `HeightRules`.

    Returns:
        Absolute deviations of the log heights. Shape (k,).
    """
    out = np.zeros(boxes.shape[0])
    if state[9] < rules.least:
        return out
    matrix = np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = state[0], state[1], state[2]
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = state[1], state[3] + rules.slope_precision, state[4]
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = state[2], state[4], state[5] + rules.slope_precision
    # The unit of the first coefficient is px: scaled, so that the matrix is well conditioned at any zoom.
    unit = math.sqrt(state[9] / state[0])
    scale = np.array([unit, 1.0, 1.0])
    inverse = np.linalg.inv(matrix * scale.reshape(3, 1) * scale.reshape(1, 3))
    a, b, c = (inverse @ (state[6:9] * scale)) * scale
    variance = (state[10] + rules.spread_weight * rules.spread**2) / (state[9] + rules.spread_weight)
    for j in range(boxes.shape[0]):
        left, top, width, height = boxes[j]
        row, column = (top + height) / height, (left + width / 2.0) / height
        expected = max(a / height + b * row + c * column, rules.smallest_share)
        phi = np.array([unit / height, row, column]) / expected
        leverage = 0.0
        for i in range(3):
            for k in range(3):
                leverage += phi[i] * inverse[i, k] * phi[k]
        out[j] = min(abs(math.log(expected)) / math.sqrt(variance * (1.0 + leverage)), rules.farthest)
    return out


@njit(cache=True, nogil=True)
def learn_heights(state, boxes, error, person, dt, rules):  # type: ignore[no-untyped-def]
    """Return the state updated with the boxes of a frame.

    Args:
        state: State as in `initial_heights`.
        boxes: Left, top, width, height. Shape (k, 4), px.
        error: Result of `height_errors`. Shape (k,).
        person: Probability of each box that it is a person. Shape (k,).
        dt: Time since the last frame, s.
        rules: A `HeightRules`.
    """
    out = state * math.exp(-dt / rules.memory)
    variance = (state[10] + rules.spread_weight * rules.spread**2) / (state[9] + rules.spread_weight)
    for j in range(boxes.shape[0]):
        left, top, width, height = boxes[j]
        weight = dt * person[j] * (1.0 if error[j] < rules.outlier else rules.outlier_weight)
        one, row, column = 1.0 / height, (top + height) / height, (left + width / 2.0) / height
        out[0] += weight * one * one
        out[1] += weight * one * row
        out[2] += weight * one * column
        out[3] += weight * row * row
        out[4] += weight * row * column
        out[5] += weight * column * column
        out[6] += weight * one
        out[7] += weight * row
        out[8] += weight * column
        out[9] += weight
        out[10] += weight * variance * error[j] ** 2
    return out
