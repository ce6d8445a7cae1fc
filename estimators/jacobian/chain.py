"""Image Jacobian of a rigid chain: everything that a camera sees of a serial arm follows from few constants.

A camera in the hand looks at points in the world, or a fixed camera looks at points on the tool. With S_1 ... S_n the
screws of the joints at a posture q_0, T the tool's pose there, C the camera's and W the board's pose on the tool or in
the base, a point in the camera's frame is, with theta = q - q_0,

    hand:   C^-1 T^-1 exp(-S_n theta_n) ... exp(-S_1 theta_1) W X' = exp(eta_n theta_n) ... exp(eta_1 theta_1) X
    world:  C^-1 exp(S_1 theta_1) ... exp(S_n theta_n) T W X'      = exp(xi_1 theta_1) ... exp(xi_n theta_n) X

(product of exponentials; Lynch and Park, Modern Robotics, 2017, eq. 4.14). All is moved to the frame of the camera at
q_0: the points X as the camera sees them there, and xi = Ad S, eta = -Ad S. So each is a product of n exponentials
whose parameters absorb mounting, optical frame, homing errors and the posture q_0, but in opposite orders. They are not
one family: equality of the first derivatives at q_0 makes xi = eta, and then the mixed second derivatives, xi_i xi_j
and xi_j xi_i, differ by the Lie bracket [xi_i, xi_j], which vanishes only for joints whose axes commute (parallel
sliders, or a common axis). By first order alone, from which a Jacobian filter learns, nothing can tell them apart;
moves of two joints after one another do. Hence a bank of two orders, compared by their fit.

Observable are the joints' lines, the points up to scale (the mean depth is 1), and the focal length, because the angles
are in rad: |w| = 1. An offset of the principal point turns the frame of the camera to first order, which all other
parameters follow; only perspective of second order over the image reveals it. It is therefore estimated with a tight
prior about a given center.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from servotrack.estimators.jacobian.adaptive import AdaptiveKalmanJacobian
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState
from servotrack.estimators.jacobian.chain_estimate import ChainEstimate
from servotrack.estimators.jacobian.chain_fit import update_chains
from servotrack.estimators.jacobian.chain_records import ChainFrame, ChainMemory, ChainOutput, ChainSettings
from servotrack.estimators.jacobian.chain_scores import foresee
from servotrack.estimators.jacobian.contract import Increment, JacobianEstimator, ServoMeasurement
from servotrack.estimators.jacobian.measurement import checked
from servotrack.estimators.types import Array, Mask
from servotrack.estimators.validation import as_mask, as_numbers


class ChainState(NamedTuple):
    """State of `ChainJacobian`.

    Attributes:
        linear: State of the linear filter.
        alignment: Encoder history and newest frame; the features' mask counts as m further features.
        center: Expected principal point. Shape (*batch, 2), px.
        scale: Expected focal length, in units of `ChainJacobian.focal_unit`. Shape (*batch,).
        seen_joints: Joint angles of the newest frame that showed each feature. Shape (*batch, m, n), rad.
        seen_features: Each feature in it. Shape (*batch, m), px.
        seen_time: Instant of it. Shape (*batch, m), s.
        seen: True once a feature has been seen. Shape (*batch, m), bool.
        jacobian: Total image Jacobian of the linear filter. Shape (*batch, m, n + 1).
        chain: Keyframes and parameters of the chain.
    """

    linear: Any
    alignment: AlignmentState
    center: Array
    scale: Array
    seen_joints: Array
    seen_features: Array
    seen_time: Array
    seen: Mask
    jacobian: Array
    chain: ChainMemory


@dataclass(frozen=True)
class ChainJacobian:
    """Estimator of any serial arm's image Jacobian as that of a rigid chain, beside a linear filter.

    Joint axes, points and focal length are fitted to keyframes spread over all postures so far, by Levenberg-Marquardt
    steps on a robust likelihood with weak priors. The features at present are the chain's, which averages the noise of
    all frames and knows points out of view. A linear filter runs beside it and takes over where it predicts new frames
    better, as when the target moves: unless `moving`, the chain assumes a target at rest, and its J_t is 0.

    Args:
        linear: Linear filter, for whose features an entry of `visible` each is valid. It serves until the chain is as
            good.
        focal: Expected focal length, px; about the width of the image. None: the sum of the expected principal point's
            coordinates, or the extent of the features and their goal in the first measurement if that is larger.
        focal_spread: Prior standard deviation of its logarithm. Larger values need more motion to find it.
        center: Expected principal point, px; usually the middle of the image. None: the middle of the goal's features
            in the first measurement.
        center_spread: Prior standard deviation of each of its coordinates, as a share of the expected focal length.
            Larger values need more motion, 1e-5 makes it known.
        revolute: True for each joint that turns, False for those that slide; None: all turn. Shape (n,).
        keyframes: Number K of stored postures, at least 2. Larger values keep more of the past; computing time grows in
            proportion.
        axis_spread: Prior standard deviation of each component of a joint's axis before it has moved.
        moment_spread: Prior standard deviation of each component of an axis' moment, in mean depths of the points.
            Larger values suit axes far from the camera.
        relief_spread: Prior standard deviation of a point's depth, in mean depths.
        rigidity: Least relative standard deviation of an axis' length and pitch. Larger values suit encoders with
            wrong scales.
        caution: Deviation of an axis' length and pitch beyond that, in deviations of a feature divided by what the
            joint has moved the image. Larger values learn a new joint more freely and use less of what is known.
        noise: Expected standard deviation of a feature, px of a camera whose focal length is 600 px, as `least_noise`
            and `drift`; it is estimated online.
        least_noise: Least estimate of it, px. Larger values trust the priors longer.
        freedom: Degrees of freedom of the noise (Student's t). Smaller values down-weight outliers more.
        most_frames: Number of frames that count at one posture. Larger values make the chain fit better where the arm
            rests and worse elsewhere.
        spacing: Largest difference of joint angles of frames that become one keyframe at once, rad.
        reach: Largest difference of joint angles of keyframes that are merged when their number is `keyframes`, rad; of
            farther ones, one is dropped. Larger values keep more of the past, with the errors of the chain then.
        iterations: Largest number of iterations of a fit. After the first `eager` frames, fits of the chain that serves
            make one. Larger values learn faster and take more time.
        memory: Number of frames over which the prediction errors of chain and linear filter are compared.
        margin: Largest ratio of the chain's mean squared prediction error to the linear filter's with which the chain
            serves. Larger values prefer the chain.
        offset_time: Correlation time of the features' offsets from the chain, s. Offsets from backlash, sag and lens
            distortion are filtered as far as they are correlated.
        patience: Number of frames in a row with twice the errors of the linear filter, or four times the chain's own
            least, after which a chain that has served as long forgets its keyframes, as after a bump. Larger values
            keep them during longer disturbances.
        drift: Standard deviation of the features' velocity that is not the arm's while the chain serves, px/s; it only
            enters `covariance`.
        eager: Number of frames that are fitted as they come. Larger values learn sooner what the first moves show.
        refit: Number of frames between two fits after that, most of which search for a better explanation; the frames
            between them correct the last fit. Larger values take less time, and find it later.
        resting: Part of a frame, in (0, 1], that one at a posture with several frames already counts in `refit`: it
            shows little that is new. Larger values take more time while the arm rests.
        moving: True for a rigid target that moves by itself, in the hand's or the world's frame. Its motion is filtered
            from what the chain leaves unexplained, and gives J_t, without a variance: a law feeds it forward in full.
        target_speed: Prior standard deviation of a moving target's rates, rad/s and mean depths of the points/s.
        target_change: Standard deviation of their change within a second while the target seems to rest. Larger values
            follow sooner, and average less.
        target_turn: The same as a share of the rates themselves. Larger values follow targets that turn, and average
            less.
        alignment: Pairing of joints and features by time stamps; use the linear filter's.
    """

    linear: JacobianEstimator = field(default_factory=AdaptiveKalmanJacobian)
    focal: float | None = None
    focal_spread: float = 0.4
    center: tuple[float, float] | None = None
    center_spread: float = 0.06
    revolute: tuple[bool, ...] | None = None
    keyframes: int = 64
    axis_spread: float = 1.0
    moment_spread: float = 3.0
    relief_spread: float = 0.4
    rigidity: float = 1e-3
    caution: float = 4.0
    noise: float = 1.0
    least_noise: float = 0.02
    freedom: float = 5.0
    most_frames: float = 50.0
    spacing: float = 0.005
    reach: float = 0.1
    iterations: int = 2
    memory: float = 15.0
    margin: float = 1.2
    offset_time: float = 1.0
    patience: float = 40.0
    drift: float = 5.0
    eager: float = 100.0
    refit: int = 4
    resting: float = 0.25
    moving: bool = False
    target_speed: float = 0.02
    target_change: float = 0.015
    target_turn: float = 1.0
    alignment: Alignment = field(default_factory=Alignment)

    row_covariances: ClassVar[bool] = True
    focal_unit: ClassVar[float] = 600.0

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and > 0, got {getattr(self, name)}")
        if self.focal is not None and not 0.0 < self.focal < np.inf:
            raise ValueError(f"focal must be finite and > 0 px, or None, got {self.focal}")
        if self.center is not None and not (len(self.center) == 2 and np.isfinite(self.center).all()):
            raise ValueError(f"center must be two finite coordinates in px, or None, got {self.center}")
        if self.keyframes < 2:
            raise ValueError(f"keyframes must be at least 2, got {self.keyframes}")
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")
        if self.refit < 1:
            raise ValueError(f"refit must be at least 1 frame, got {self.refit}")
        if not self.resting <= 1.0:
            raise ValueError(f"resting must be in (0, 1], got {self.resting}")
        if self.memory < 1.0:
            raise ValueError(f"memory must be at least 1 frame, got {self.memory}")

    def initial(self, measurement: ServoMeasurement) -> ChainState:
        """State before the first frame. With `center=None` or `focal=None` the goal and the features are read.

        Raises:
            ValueError: As `checked` and the linear filter do, or if the features are not two for each point.
        """
        whole = checked_points(measurement)
        *shape, m = whole.features.shape
        batch, n = tuple(shape), whole.joint_angles.shape[-1]
        if m % 2:
            raise ValueError(
                f"features must hold two coordinates of each point, got {m}; pass columns and rows of whole points, or "
                "use AdaptiveKalmanJacobian for other features"
            )
        self.settings(n)
        center, scale = self._optics(whole)
        return ChainState(
            linear=self.linear.initial(measurement),
            alignment=self.alignment.initial(_masked(whole)),
            center=center,
            scale=scale,
            seen_joints=np.zeros((*batch, m, n)),
            seen_features=np.zeros((*batch, m)),
            seen_time=np.zeros((*batch, m)),
            seen=np.zeros((*batch, m), np.bool_),
            jacobian=np.zeros((*batch, m, n + 1)),
            chain=self._memory(batch, n, m),
        )

    def step(self, state: ChainState, measurement: ServoMeasurement) -> tuple[ChainState, ChainEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` and the linear filter do."""
        whole = checked_points(measurement)
        alignment, increment = self.alignment.step(state.alignment, _masked(whole))
        linear, estimate = self.linear.step(state.linear, measurement)
        *shape, m = whole.features.shape
        batch, n = tuple(shape), whole.joint_angles.shape[-1]
        frame = _frame(state, alignment, increment)
        memory = ChainMemory(*(each.copy() for each in state.chain))  # type: ignore[arg-type]
        output = ChainOutput(
            features=np.zeros((*batch, m)),
            jacobian=np.zeros((*batch, m, n + 1)),
            covariance=np.zeros((*batch, m, n + 1, n + 1)),
            variance=np.zeros((*batch, m)),
            log_likelihood=np.zeros(batch),
            nis=np.zeros(batch),
            best=np.zeros(batch, np.int64),
            chained=np.zeros(batch, np.bool_),
            parameters=np.zeros((*batch, state.chain.parameters.shape[-1])),
        )
        axes = len(batch)
        update_chains(_rows(memory, axes), _rows(frame, axes), self.settings(n), _rows(output, axes))
        seen, joints, time = frame.seen, alignment.frame_joints, alignment.frame_time
        new = ChainState(
            linear=linear,
            alignment=alignment,
            center=state.center,
            scale=state.scale,
            seen_joints=np.where(seen[..., None], joints[..., None, :], state.seen_joints),
            seen_features=np.where(seen, alignment.frame_features[..., :m], state.seen_features),
            seen_time=np.where(seen, time[..., None], state.seen_time),
            seen=state.seen | seen,
            jacobian=np.array(estimate.jacobian),
            chain=memory,
        )
        offset = np.tile(state.center, m // 2) - whole.goal
        return new, self._estimate(new, _in_pixels(output, frame, state.scale), estimate, offset, frame)

    def forget(self, state: ChainState) -> ChainState:
        """Forget all keyframes, and reset the linear filter's covariance if it can; the means stay."""
        forget = getattr(self.linear, "forget", None)
        chain = state.chain
        return state._replace(
            linear=state.linear if forget is None else forget(state.linear),
            chain=chain._replace(
                weights=np.zeros_like(chain.weights),
                scatter=np.zeros_like(chain.scatter),
                damping=np.zeros_like(chain.damping),
                cost=np.zeros_like(chain.cost),
                challenge=np.zeros_like(chain.challenge),
                since=np.zeros_like(chain.since),
                frames=np.zeros_like(chain.frames),
            ),
        )

    def _estimate(
        self, state: ChainState, output: ChainOutput, linear: Any, offset: Array, frame: ChainFrame
    ) -> ChainEstimate:
        """Choose between chain and linear filter, feature by feature: points never seen are not part of the chain."""
        chain = state.chain
        chained = output.chained[..., None] & np.repeat(chain.known, 2, axis=-1)
        covariance, variance = getattr(linear, "covariance", None), getattr(linear, "error_variance", None)
        if covariance is None:
            covariance = output.covariance
        if variance is None:
            variance = np.where(state.seen, (chain.noise * state.scale**2)[..., None], np.inf)
        return ChainEstimate(
            error=np.where(chained, output.features + offset, linear.error),
            jacobian=np.where(chained[..., None], output.jacobian, linear.jacobian),
            log_likelihood=np.where(output.chained, output.log_likelihood, linear.log_likelihood),
            nis=np.where(output.chained, output.nis, linear.nis),
            covariance=np.where(chained[..., None, None], output.covariance, covariance),
            error_variance=np.where(chained, output.variance, variance),
            chained=chained,
            parameters=output.parameters,
            reverse=np.take_along_axis(chain.reverse, output.best[..., None], axis=-1)[..., 0],
            focal=self.focal_unit * state.scale,
            angles=frame.present - chain.origin,
        )

    def _optics(self, whole: ServoMeasurement) -> tuple[Array, Array]:
        """Expected principal point (*batch, 2), px, and focal length (*batch,), in units of `focal_unit`."""
        features = np.where(whole.visible, whole.features, whole.goal)
        center, extent = np.empty((*whole.time.shape, 2)), np.empty((*whole.time.shape, 2))
        for axis in range(2):
            goal, both = whole.goal[..., axis::2], np.stack([whole.goal[..., axis::2], features[..., axis::2]])
            middle = 0.5 * (goal.min(axis=-1) + goal.max(axis=-1))
            center[..., axis] = middle if self.center is None else self.center[axis]
            extent[..., axis] = both.max(axis=(0, -1)) - both.min(axis=(0, -1))
        if self.focal is not None:
            return center, np.full(whole.time.shape, self.focal / self.focal_unit)
        # Of an image whose coordinates begin at its corner, the focal length is about the width.
        focal = np.maximum(np.abs(center).sum(axis=-1), np.hypot(extent[..., 0], extent[..., 1]))
        focal = np.where(focal > 0.0, focal, self.focal_unit)
        return center, np.clip(focal, 1e-3, 1e6) / self.focal_unit

    def _memory(self, batch: tuple[int, ...], joints: int, features: int) -> ChainMemory:
        points, m = features // 2, features
        parameters = np.zeros((*batch, 2, 6 * joints + 3 * points + 3))
        # Points before they are seen: on the optical axis, at the mean depth.
        parameters[..., 6 * joints + 2 : 6 * joints + 3 * points : 3] = 1.0
        return ChainMemory(
            started=np.zeros(batch, np.bool_),
            origin=np.zeros((*batch, joints)),
            angles=np.zeros((*batch, self.keyframes, joints)),
            features=np.zeros((*batch, self.keyframes, m)),
            weights=np.zeros((*batch, self.keyframes, m)),
            scatter=np.zeros(batch),
            known=np.zeros((*batch, points), np.bool_),
            parameters=parameters,
            factor=np.zeros((*batch, parameters.shape[-1], parameters.shape[-1])),
            clock=np.zeros((*batch, 2)),
            since=np.zeros(batch),
            damping=np.zeros((*batch, 2)),
            cost=np.zeros((*batch, 2)),
            reverse=np.broadcast_to(np.array([False, True]), (*batch, 2)).copy(),
            challenge=np.zeros((*batch, 2)),
            noise=np.full(batch, float(self.noise) ** 2),
            offset=np.zeros((*batch, m)),
            offset_variance=np.zeros((*batch, m)),
            offset_power=np.zeros(batch),
            residual_power=np.full(batch, float(self.noise) ** 2),
            white=np.full(batch, float(self.noise) ** 2),
            residual=np.zeros((*batch, m)),
            recent=np.zeros((*batch, m)),
            errors=np.zeros((*batch, 2)),
            failures=np.zeros(batch),
            served=np.zeros(batch),
            least_error=np.full(batch, ChainSettings._field_defaults["no_error"]),
            frames=np.zeros(batch),
            moves=np.full(batch, self.moving),
            motion=np.zeros((*batch, 12)),
            motion_covariance=np.zeros((*batch, 12, 12)),
            evidence=np.zeros(batch),
        )

    def settings(self, joints: int) -> ChainSettings:
        """Return the parameters for the kernels. Raises ValueError if `revolute` does not fit."""
        turning = np.ones(joints, np.bool_) if self.revolute is None else np.asarray(self.revolute, np.bool_)
        if turning.shape != (joints,):
            raise ValueError(
                f"revolute must have one entry per joint, got {turning.size} for {joints} joints; None: all turn"
            )
        numbers: dict[str, Any] = {name: float(getattr(self, name)) for name in _POSITIVE}
        return ChainSettings(
            focal=self.focal_unit,
            **numbers,
            turning=turning,
            iterations=int(self.iterations),
            refit=int(self.refit),
        )


_POSITIVE = (
    "focal_spread",
    "center_spread",
    "axis_spread",
    "moment_spread",
    "relief_spread",
    "rigidity",
    "caution",
    "noise",
    "least_noise",
    "freedom",
    "most_frames",
    "spacing",
    "reach",
    "memory",
    "margin",
    "offset_time",
    "patience",
    "drift",
    "eager",
    "resting",
    "target_speed",
    "target_change",
    "target_turn",
)


def checked_points(measurement: ServoMeasurement) -> ServoMeasurement:
    """Check a measurement with a mask of single features."""
    joint_angles = as_numbers("joint_angles", measurement.joint_angles)
    features = as_numbers("features", measurement.features)
    if joint_angles.shape[:-1] != features.shape[:-1]:
        raise ValueError(
            f"joint_angles and features must have the same leading batch axes, got shapes {joint_angles.shape} and "
            f"{features.shape}; give every field the same leading batch axes"
        )
    if as_mask("visible", measurement.visible).ndim < joint_angles.ndim:
        # One entry for whole frames: then no feature of a visible frame may be missing.
        checked(measurement)
    return checked(measurement, each_feature=True)


def _masked(measurement: ServoMeasurement) -> ServoMeasurement:
    """Whole frames for `Alignment`, with the mask of the features as m further features."""
    seen = measurement.visible
    return measurement._replace(
        features=np.concatenate([np.where(seen, measurement.features, 0.0), seen.astype(np.float64)], axis=-1),
        goal=np.concatenate([measurement.goal, np.zeros_like(measurement.goal)], axis=-1),
        visible=np.asarray(seen.any(axis=-1)),
    )


def _frame(state: ChainState, alignment: AlignmentState, increment: Increment) -> ChainFrame:
    """Newest frame, with the innovation of the linear filter."""
    m = state.seen.shape[-1]
    fresh = increment.fresh | (alignment.seen & ~state.alignment.seen)
    features, seen = alignment.frame_features[..., :m], (alignment.frame_features[..., m:] > 0.5) & fresh[..., None]
    rows, n = fresh.size, alignment.frame_joints.shape[-1]
    expected = foresee(
        state.seen_joints.reshape(rows, m, n),
        state.seen_features.reshape(rows, m),
        state.jacobian.reshape(rows, m, n + 1),
        alignment.frame_joints.reshape(rows, n),
    ).reshape(features.shape)
    expected += state.jacobian[..., -1] * (alignment.frame_time[..., None] - state.seen_time)
    scale = state.scale[..., None]
    return ChainFrame(
        fresh=fresh,
        angles=alignment.frame_joints,
        features=np.where(seen, (features - np.tile(state.center, m // 2)) / scale, 0.0),
        seen=seen,
        duration=increment.time,
        linear_error=(features - expected) / scale,
        compared=seen & state.seen,
        present=alignment.frame_joints + increment.pending_joints,
        pending=increment.pending_time,
    )


def _in_pixels(output: ChainOutput, frame: ChainFrame, scale: Array) -> ChainOutput:
    """Results in px instead of parts of the expected focal length."""
    return output._replace(
        features=output.features * scale[..., None],
        jacobian=output.jacobian * scale[..., None, None],
        covariance=output.covariance * (scale * scale)[..., None, None, None],
        variance=output.variance * (scale * scale)[..., None],
        log_likelihood=output.log_likelihood - np.sum(frame.seen, axis=-1) * np.log(scale),
    )


def _rows(fields: Any, axes: int) -> Any:
    """Views of arrays with one leading axis in the place of all batch axes."""
    return type(fields)(*(each.reshape(-1, *each.shape[axes:]) for each in fields))
