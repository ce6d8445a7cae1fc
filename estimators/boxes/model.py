"""Models of one person in the image for the filters of `servotrack.estimators.rfs`, and their measurements.

Time is counted in frames here, as in Wu and Hu 2010: velocities are px per frame.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from servotrack.estimators.detect.detections import Detections
from servotrack.estimators.rfs.models import HiddenMarkovModel
from servotrack.estimators.types import Array

Kind = Literal["centroid", "box"]


def centroid_model(process_noise: float, measurement_noise: float, frames: float = 1.0) -> HiddenMarkovModel:
    """Constant velocity of the centroid, state [x, vx, y, vy] (Wu and Hu 2010, equations 7 to 11).

    Args:
        process_noise: sigma_v, so that Q = sigma_v^2 [[t^4/4, t^3/2], [t^3/2, t^2]] per axis, px per frame^2.
        measurement_noise: sigma_w, standard deviation of a measured coordinate, px.
        frames: t, time between two measurements, frames.

    Raises:
        ValueError: A value is not positive.
    """
    _check(process_noise=process_noise, measurement_noise=measurement_noise, frames=frames)
    axes = np.eye(2)
    F, Q = _axis(process_noise, frames)
    return HiddenMarkovModel(
        transition=np.asarray(np.kron(axes, F), dtype=np.float64),
        process_noise=np.asarray(np.kron(axes, Q), dtype=np.float64),
        observation=np.asarray(np.kron(axes, [[1.0, 0.0]]), dtype=np.float64),
        measurement_noise=measurement_noise**2 * axes,
    )


def box_model(
    process_noise: float, measurement_noise: float, drift: float, size_noise: float, frames: float = 1.0
) -> HiddenMarkovModel:
    """Constant velocity of the box's center and a random walk of its size, state [x, vx, y, vy, w, h].

    Args:
        process_noise: Process noise of the center as in `centroid_model`, px per frame^2.
        measurement_noise: Standard deviation of a measured center, px.
        drift: Standard deviation of the change of the size per frame, px.
        size_noise: Standard deviation of a measured width or height, px.
        frames: Time between two measurements, frames.

    Raises:
        ValueError: A value is not positive.
    """
    _check(drift=drift, size_noise=size_noise)
    center = centroid_model(process_noise, measurement_noise, frames)
    still = np.eye(2)
    return HiddenMarkovModel(
        transition=_blocks(center.transition, still),
        process_noise=_blocks(center.process_noise, drift**2 * frames * still),
        observation=_blocks(center.observation, still),
        measurement_noise=_blocks(center.measurement_noise, size_noise**2 * still),
    )


def measurements(detections: Detections, kind: Kind) -> Array:
    """Measurements of a frame for a filter: centroids, or centers and sizes. Shape (k, 2) or (k, 4), px."""
    if kind == "centroid":
        return np.asarray(detections.centroids, dtype=np.float64)
    boxes = np.asarray(detections.boxes, dtype=np.float64)
    return np.concatenate([boxes[:, :2] + boxes[:, 2:] / 2.0, boxes[:, 2:]], axis=1)


def _axis(process_noise: float, t: float) -> tuple[Array, Array]:
    F = np.array([[1.0, t], [0.0, 1.0]])
    return F, process_noise**2 * np.array([[t**4 / 4.0, t**3 / 2.0], [t**3 / 2.0, t**2]])


def _blocks(first: Array, second: Array) -> Array:
    out = np.zeros((first.shape[0] + second.shape[0], first.shape[1] + second.shape[1]))
    out[: first.shape[0], : first.shape[1]] = first
    out[first.shape[0] :, first.shape[1] :] = second
    return out


def _check(**values: float) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} must be finite and > 0, got {value!r}")
