"""Measurement, estimate and interface of the Jacobian estimators.

A camera on an arm of n joints sees a moving target as m image features (pixel coordinates of image points). Camera
and arm are not calibrated. Between two frames the features move by

    dy = J_theta dtheta + J_t dt = J ds,    J = [J_theta J_t],  ds = [dtheta; dt]        (Zhang 2011, eqs 4 to 6)

with J the *total image Jacobian*. Every estimator of this package is a frozen dataclass of parameters with

    initial(measurement) -> state                   made from the first measurement's shapes and values
    step(state, measurement) -> (state, estimate)

`state` is a NamedTuple of arrays. All of them have the measurement's leading batch axes (`*batch`, possibly none), so
that rows can be selected, saved and replaced. `estimate` is a `ServoEstimate`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from servotrack.estimators.types import Array, Estimator, Mask


class ServoMeasurement(NamedTuple):
    """Readings of a robot's encoders and camera at one control instant.

    Attributes:
        joint_angles: Encoder readings at `joint_time`. Shape (*batch, n), rad; other units for joints that slide.
        features: Image features of the newest frame, captured at `frame_time`. Shape (*batch, m), px.
        goal: Desired features. Shape (*batch, m), px.
        visible: True if `features` come from a new frame that shows the target. If false, they repeat the last visible
            ones with their old `frame_time`. Shape (*batch,), or (*batch, g) for one entry per group of m / g features
            in a row: (*batch, p) for p points in the plane, (*batch, m) for single features; bool.
        frame_time: Time stamp of the frame. Shape (*batch,), s.
        time: Present time. Shape (*batch,), s.
        joint_time: Time stamp of the encoder readings. None: read at `time`. Shape (*batch,), s.
    """

    joint_angles: Array
    features: Array
    goal: Array
    visible: Mask
    frame_time: Array
    time: Array
    joint_time: Array | None = None


class Increment(NamedTuple):
    """Changes of joints and features between two frames, paired by time stamps, and the joint motion since then.

    Attributes:
        joints: Joint motion dtheta between the instants of the two frames. Shape (*batch, n), rad.
        time: Time dt between the two frames. Shape (*batch,), s.
        features: Feature motion dy between the two frames. Shape (*batch, m), px.
        fresh: True if there is a new pair of frames. If false, the three fields above are zeros. Shape (*batch,), bool.
        pending_joints: Joint motion from the newest frame to the present. Where encoders are older than the present,
            the joints' velocity is held. Shape (*batch, n), rad.
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
    """Result of an estimator at the present instant: latency between frame and present is already compensated."""

    @property
    def error(self) -> Array:
        """Features minus goal at present. Shape (*batch, m), px."""

    @property
    def jacobian(self) -> Array:
        """Total image Jacobian [J_theta J_t] at present. Shape (*batch, m, n + 1), px/rad and px/s."""

    @property
    def log_likelihood(self) -> Array:
        """Log density of the newest measurement given the earlier ones, 0 without a new frame. Shape (*batch,)."""

    @property
    def nis(self) -> Array:
        """Normalized innovation squared (NIS), divided by m: 1 on average for a consistent filter. Shape (*batch,).

        The squared innovation is normalized by its predicted covariance. It is 0 without a new frame. Estimators
        without a covariance normalize by a running mean square of the innovation.
        """

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Predict the error after a joint motion.

        Args:
            joint_motion: Joint motion dtheta from the present on. Shape (*batch, n), rad.
            duration: Time that the motion takes. A number or shape (*batch,), s.

        Returns:
            Predicted features minus goal. Shape (*batch, m), px.
        """


@dataclass(frozen=True)
class LinearEstimate:
    """`ServoEstimate` with linear prediction: e + J_theta dtheta + J_t dt.

    Attributes:
        error: Features minus goal at present. Shape (*batch, m), px.
        jacobian: Total image Jacobian at present. Shape (*batch, m, n + 1), px/rad and px/s.
        log_likelihood: Log density of the newest measurement, 0 without a new frame. Shape (*batch,).
        nis: Normalized innovation squared divided by m, 0 without a new frame. Shape (*batch,).
        covariance: Covariance of each row of `jacobian`; None from estimators without one. Shape (*batch, m, n + 1,
            n + 1).
        error_variance: Variance of each entry of `error`, infinite for a feature that was never seen; None from
            estimators without one. Shape (*batch, m), px^2.
        goal_velocity: Velocity of the goal, which is already subtracted from the last column of `jacobian` and has no
            variance; None: it rests. Shape (*batch, m), px/s.
    """

    error: Array
    jacobian: Array
    log_likelihood: Array
    nis: Array
    covariance: Array | None = None
    error_variance: Array | None = None
    goal_velocity: Array | None = None

    def predict_error(self, joint_motion: Array, duration: Array | float) -> Array:
        """Predict the error after a motion, to first order. Arguments as in `ServoEstimate.predict_error`."""
        moved = np.einsum("...ij,...j->...i", self.jacobian[..., :-1], joint_motion)
        return self.error + moved + self.jacobian[..., -1] * np.asarray(duration)[..., None]


class JacobianEstimator(Estimator[ServoMeasurement, Any, ServoEstimate], Protocol):
    """Interface of the estimators of the total image Jacobian.

    `initial` and `step` raise a ValueError that names the field for wrong shapes or values that are not finite. An
    estimator may also have `forget(state) -> state`, which keeps the mean and resets the covariance to the prior's.
    """
