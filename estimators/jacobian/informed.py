"""The informed bound: what a causal agent can do that is told camera, links and latency, but not the future.

No uncalibrated agent knows this much, so its score says how much of an error is the task's and how much is the
estimator's. With the geometry known, every frame is rectified: the target's ground point is found, and seen anew by
an ideal camera that looks straight down. What is left to estimate is the target, by the same interacting models as in
`LiftedKalman`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from servotrack.estimators.camera import ground_points
from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.jacobian.lifted import SWINGING_MODELS, LiftedEstimate, LiftedKalman, LiftedState
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array, Mask


class Geometry(NamedTuple):
    """What the informed agent is told.

    Attributes:
        camera: Packed as by `servotrack.estimators.camera.pack_camera`. Shape (*batch, CAMERA_SIZE).
        links: Link lengths. Shape (*batch, 2), m.
        latency: Age of a frame beyond what its stamp says. Shape (*batch,), s.
        readout: Time a rolling shutter takes for the whole image; the stamp is that of the middle row. Shape
            (*batch,), s.
    """

    camera: Array
    links: Array
    latency: Array
    readout: Array


class InformedMeasurement(NamedTuple):
    """A `ServoMeasurement` and the truth about who took it: its six fields, and `geometry`."""

    joint_angles: Array
    features: Array
    goal: Array
    visible: Mask
    frame_time: Array
    time: Array
    geometry: Geometry


@dataclass(frozen=True)
class InformedKalman:
    """Tracks the target with the true geometry; privileged. Its estimates are in the pixels of the ideal camera.

    Args:
        target: The filter of the target; what it would learn about arm and camera is given to it instead.
    """

    target: LiftedKalman = field(
        default_factory=lambda: LiftedKalman(models=SWINGING_MODELS, drift=0.0, optics_error=0.0)
    )

    def __post_init__(self) -> None:
        if self.target.drift != 0.0:
            raise ValueError(f"target must have drift=0, the geometry is known; got drift={self.target.drift}")

    def initial(self, measurement: InformedMeasurement) -> LiftedState:
        """State before the first frame. Raises ValueError as `LiftedKalman.initial` does."""
        state = self.target.initial(_rectified(measurement))
        camera, links, _, _ = measurement.geometry
        scale = _pixels_per_meter(camera)
        mounting = camera[..., 5] + 1j * camera[..., 6]
        mean, covariance = state.mean.copy(), state.covariance.copy()
        mean[..., 3] = (mounting * scale * links[..., 0])[..., None]
        mean[..., 4] = (mounting * scale * links[..., 1])[..., None]
        covariance[..., 3:, :] = 0.0
        covariance[..., :, 3:] = 0.0
        return state._replace(mean=mean, covariance=covariance)

    def step(self, state: LiftedState, measurement: InformedMeasurement) -> tuple[LiftedState, LiftedEstimate]:
        """Fold one measurement in. Raises ValueError as `LiftedKalman.step` does."""
        return self.target.step(state, _rectified(measurement))


def _pixels_per_meter(camera: Array) -> Array:
    return camera[..., 0] / camera[..., 4]


def _rectified(measurement: InformedMeasurement) -> ServoMeasurement:
    """What an ideal camera would have seen, at the instant at which the target's row was read."""
    geometry = measurement.geometry
    seen = checked(ServoMeasurement(*measurement[:6]))
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
