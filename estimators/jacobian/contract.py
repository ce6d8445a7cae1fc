"""What goes into a Jacobian estimator and what comes out of it.

A camera rides on an arm of n joints and sees a moving target as m image features (pixels of image points). Nobody
told the estimator anything about either. Between two frames the features move by

    dy = J_theta dtheta + J_t dt = J ds,    J = [J_theta J_t],  ds = [dtheta; dt]        (paper 002, eqs 4 to 6)

with J the *total image Jacobian*. Every estimator of this package is a frozen dataclass of parameters with

    initial(measurement) -> state                   nothing known but the first measurement's shapes and values
    step(state, measurement) -> (state, estimate)

where `state` is a NamedTuple of arrays that all carry the measurement's leading batch axes (`*batch`, possibly none),
so that rows can be selected, saved and replaced, and `estimate` is a `ServoEstimate`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from servotrack.estimators.types import Array, Mask


class ServoMeasurement(NamedTuple):
    """What a robot's encoders and camera report at one control instant.

    Attributes:
        joint_angles: Encoder readings at `time`. Shape (*batch, n), rad.
        features: Image features of the newest frame, captured at `frame_time`. Shape (*batch, m), px.
        goal: Wanted features. Shape (*batch, m), px.
        visible: Whether `features` come from a new frame in which the target was seen; where false they repeat the last
            seen ones with their old `frame_time`. Shape (*batch,), bool.
        frame_time: Time stamp of the frame. Shape (*batch,), s.
        time: The present time. Shape (*batch,), s.
    """

    joint_angles: Array
    features: Array
    goal: Array
    visible: Mask
    frame_time: Array
    time: Array


class Increment(NamedTuple):
    """What changed between two frames, joints and features paired by time stamps, and what has changed since.

    Attributes:
        joints: dtheta between the two frames' instants. Shape (*batch, n), rad.
        time: dt between them. Shape (*batch,), s.
        features: dy. Shape (*batch, m), px.
        fresh: Whether there is a new pair; where false the three fields above are zeros. Shape (*batch,), bool.
        pending_joints: Joint motion from the newest frame to the present. Shape (*batch, n), rad.
        pending_time: Age of the newest frame. Shape (*batch,), s.
    """

    joints: Array
    time: Array
    features: Array
    fresh: Mask
    pending_joints: Array
    pending_time: Array


@runtime_checkable
class ServoEstimate(Protocol):
    """What an estimator believes at the present instant (not at the frame's: latency is already bridged)."""

    @property
    def error(self) -> Array:
        """Features minus goal, now. Shape (*batch, m), px."""

    @property
    def jacobian(self) -> Array:
        """Total image Jacobian [J_theta J_t], now. Shape (*batch, m, n + 1), px/rad and px/s."""

    @property
    def log_likelihood(self) -> Array:
        """Log density of the newest measurement given the earlier ones; 0 where no new frame came. Shape (*batch,)."""

    @property
    def surprise(self) -> Array:
        """Squared innovation over its predicted covariance, divided by m: 1 on average for a consistent filter.

        Zero where no new frame came. Estimators without a covariance use a running mean square of the innovation.
        Shape (*batch,).
        """

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Error after the joints moved by `joint_motion` (*batch, n) rad in `duration` s. Shape (*batch, m), px."""


@dataclass(frozen=True)
class LinearEstimate:
    """A `ServoEstimate` that predicts by its Jacobian alone: e + J_theta dtheta + J_t dt."""

    error: Array
    jacobian: Array
    log_likelihood: Array
    surprise: Array

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Error after a motion, to first order. Shapes as in `ServoEstimate.predict_error`."""
        moved = np.einsum("...ij,...j->...i", self.jacobian[..., :-1], joint_motion)
        return self.error + moved + self.jacobian[..., -1] * np.asarray(duration)[..., None]


class JacobianEstimator(Protocol):
    """The interface of every estimator here."""

    def initial(self, measurement: ServoMeasurement) -> Any:
        """State before anything but the first measurement is known."""

    def step(self, state: Any, measurement: ServoMeasurement) -> tuple[Any, ServoEstimate]:
        """Fold one measurement in. Raises ValueError naming the field for wrong shapes or non-finite values."""
