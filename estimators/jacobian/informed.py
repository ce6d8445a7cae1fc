"""Informed filter: a causal filter that knows camera, links and latency, and only has to estimate the target.

No uncalibrated agent knows this much. Its error therefore shows how much of the error of an agent comes from what the
agent does not know; a bound it is not, since another filter may be better. With known geometry every frame is
rectified: the target's ground point is computed and projected into an ideal camera that looks straight down. The target
is estimated with the interacting models of `LiftedKalman`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.camera import CAMERA_SIZE, ground_points
from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.jacobian.lifted import SWINGING_MODELS, LiftedEstimate, LiftedKalman, LiftedState
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import LIMITS, as_numbers, check_within


class Geometry(NamedTuple):
    """True geometry of camera and arm, known to the informed filter.

    Attributes:
        camera: Cameras packed by `servotrack.estimators.camera.pack_camera`. Shape (*batch, CAMERA_SIZE).
        links: Link lengths. Shape (*batch, 2), m.
        latency: Age of a frame at its time stamp. Shape (*batch,), s.
        readout: Readout time of the rolling shutter for the whole image; the stamp is that of the middle row. Shape
            (*batch,), s.
    """

    camera: Array
    links: Array
    latency: Array
    readout: Array


class InformedMeasurement(NamedTuple):
    """`ServoMeasurement` with the true geometry as seventh field.

    Attributes:
        joint_angles: Encoder readings, see `ServoMeasurement`. Shape (*batch, n), rad.
        features: Image features of the newest frame. Shape (*batch, m), px.
        goal: Desired features. Shape (*batch, m), px.
        visible: True if the features come from a new frame that shows the target. Shape (*batch,), bool.
        frame_time: Time stamp of the frame. Shape (*batch,), s.
        time: Present time. Shape (*batch,), s.
        geometry: True geometry of camera and arm.
    """

    joint_angles: Array
    features: Array
    goal: Array
    visible: Mask
    frame_time: Array
    time: Array
    geometry: Geometry


@dataclass(frozen=True)
class InformedKalman:
    """Privileged filter that tracks the target with the true geometry. Estimates are in pixels of the ideal camera.

    Args:
        target: Filter of the target. Its arm vectors are set from the true geometry instead of being estimated, so
            `drift` must be 0.
    """

    target: LiftedKalman = field(
        default_factory=lambda: LiftedKalman(models=SWINGING_MODELS, drift=0.0, optics_error=0.0)
    )

    def __post_init__(self) -> None:
        if self.target.drift != 0.0:
            raise ValueError(f"target must have drift=0 because the geometry is known, got drift={self.target.drift}")

    def initial(self, measurement: InformedMeasurement) -> LiftedState:
        """State before the first frame. Raises ValueError as `LiftedKalman.initial` does, or for a bad geometry."""
        rectified = _rectified(measurement)
        state = self.target.initial(rectified)
        camera, links, _, _ = _checked_geometry(measurement.geometry, rectified.time.shape)
        scale = _pixels_per_meter(camera)
        mounting = camera[..., 5] + 1j * camera[..., 6]
        mean, covariance = state.mean.copy(), state.covariance.copy()
        mean[..., 3] = (mounting * scale * links[..., 0])[..., None]
        mean[..., 4] = (mounting * scale * links[..., 1])[..., None]
        covariance[..., 3:, :] = 0.0
        covariance[..., :, 3:] = 0.0
        return state._replace(mean=mean, covariance=covariance)

    def step(self, state: LiftedState, measurement: InformedMeasurement) -> tuple[LiftedState, LiftedEstimate]:
        """Update with one measurement. Raises ValueError as `LiftedKalman.step` does, or for a bad geometry."""
        return self.target.step(state, _rectified(measurement))


def _pixels_per_meter(camera: Array) -> Array:
    return camera[..., 0] / camera[..., 4]


def _checked_geometry(geometry: Geometry, batch: tuple[int, ...]) -> Geometry:
    """Convert a geometry to float64 arrays; raise ValueError for wrong shapes and values."""
    shapes = {"camera": (*batch, CAMERA_SIZE), "links": (*batch, 2), "latency": batch, "readout": batch}
    arrays = Geometry(*(as_numbers(name, getattr(geometry, name)) for name in shapes))
    for name, shape in shapes.items():
        array = getattr(arrays, name)
        if array.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {array.shape}; give it the measurement's batch axes")
        check_within(name, array, LIMITS.pixels, "pass the true geometry")
    camera = arrays.camera
    if not (camera[..., [0, 1, 4, 17]] > 0.0).all():
        raise ValueError(
            "camera must have focal lengths, a depth and a width above 0, got "
            f"{camera[..., [0, 1, 4, 17]].tolist()}; make it with pack_camera"
        )
    return arrays


def _rectified(measurement: InformedMeasurement) -> ServoMeasurement:
    """Convert to the measurement of an ideal camera at the instant at which the target's image row was read."""
    seen = checked(ServoMeasurement(*measurement[:6]))
    geometry = _checked_geometry(measurement.geometry, seen.time.shape)
    camera = geometry.camera
    scale = _pixels_per_meter(camera)[..., None]
    height = 2.0 / camera[..., 17]
    row = seen.features[..., 1] / height - 0.5
    instant = np.minimum(seen.frame_time - geometry.latency + geometry.readout * row, seen.time)
    return seen._replace(
        features=scale * ground_points(camera, seen.features),
        goal=scale * ground_points(camera, seen.goal),
        frame_time=instant,
    )
