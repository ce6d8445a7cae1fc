"""Records of the fit of a rigid chain: parameters, state, newest frame and results."""

from __future__ import annotations

from typing import NamedTuple

from servotrack.estimators.types import Array, Labels, Mask


class ChainSettings(NamedTuple):
    """Parameters of the fit.

    Attributes:
        focal: Expected focal length, in the unit of the features.
        turning: True for joints that turn. Shape (n,).
        axis_spread: Prior standard deviation of the components of w.
        moment_spread: Prior standard deviation of the components of v, mean depths.
        relief_spread: Prior standard deviation of a point's depth about the mean, mean depths.
        focal_spread: Prior standard deviation of log f.
        center_spread: Prior standard deviation of the principal point, focal lengths.
        rigidity: Least standard deviation of |w|^2 - 1 and of w . v.
        noise: Prior standard deviation of a feature, px.
        least_noise: Least estimate of it, px.
        freedom: Degrees of freedom of the noise.
        most_frames: Number of frames at one posture that count, the others add nothing.
        spacing: Largest difference of joint angles of frames that are merged at once, rad.
        reach: Largest difference of joint angles of keyframes that are merged for lack of space, rad.
        caution: Factor of the constraints' standard deviations that what a joint has moved the image leaves open.
        iterations: Iterations of a fit; after the `eager` frames, fits of the better chain make one.
        memory: Memory of the comparison with the linear filter, and of the offsets' size, frames.
        offset_time: Correlation time of the offsets, s.
        margin: Factor of the mean squared errors that the chain must not exceed.
        patience: Frames of failure after which the chain starts anew.
        drift: Standard deviation of the features' velocity at rest, px/s.
        target_speed: Prior standard deviation of a moving target's rates, rad/s and mean depths/s.
        target_change: Standard deviation of their change within a second, at rest.
        target_turn: The same as a share of the rates themselves.
        eager: Number of frames that are fitted as they come.
        refit: Number of frames between two fits after that, of either order.
        resting: Part of a frame that one at a posture with `enough` frames counts in this number.
        first_damping: Damping of the first fit, relative to the diagonal of the normal equations.
        least_damping: Least damping.
        largest_damping: Largest damping.
        least_pivot: Least pivot of a factorization, relative to the diagonal.
        least_gain: Expected decrease of the cost, a log likelihood, below which a fit is complete.
        small_gain: Decrease of the cost after which further iterations wait for the next frame.
        first_trial: Number of frames in which both orders are fitted side by side.
        trial: Number of iterations after which a worse chain has lost.
        rarely: Number of frames between two fits of the worse chain, once it has lost often.
        own_share: Number of these fits of which one is that of the better chain, the others of its challenger.
        failed: Ratio of the mean squared errors of chain and linear filter that counts as a failure; its square is that
            of the chain's to their own least value.
        no_error: Least error before there is one, px^2.
        outlier: Square of a residual, relative to the variance, that counts at most in the estimate of the noise.
        enough: Number of frames of all features at one posture after which another one shows little that is new.
        settling: Time over which residuals are averaged before they count as evidence, s: a step of play settles, a
            target's motion does not.
        forgetting: Memory of the evidence per frame, see `ChainMemory`.
    """

    focal: float
    turning: Mask
    axis_spread: float
    moment_spread: float
    relief_spread: float
    focal_spread: float
    center_spread: float
    rigidity: float
    noise: float
    least_noise: float
    freedom: float
    most_frames: float
    spacing: float
    reach: float
    caution: float
    iterations: int
    memory: float
    offset_time: float
    margin: float
    patience: float
    drift: float
    target_speed: float
    target_change: float
    target_turn: float
    eager: float
    refit: int
    resting: float
    first_damping: float = 1e-3
    least_damping: float = 1e-6
    largest_damping: float = 1e6
    least_pivot: float = 1e-14
    least_gain: float = 1e-8
    small_gain: float = 0.1
    first_trial: float = 20.0
    trial: float = 12.0
    rarely: float = 8.0
    own_share: int = 4
    failed: float = 4.0
    no_error: float = 1e12
    outlier: float = 9.0
    enough: float = 5.0
    settling: float = 0.5
    forgetting: float = 0.98


class ChainMemory(NamedTuple):
    """State of the chain, see `ChainState`.

    `moves` is true for chains whose target moves, `motion` and `motion_covariance` are its turn and shift, and their
    rates, see `chain_target`. `evidence` is the mean log density of a feature, without its offset, summed over past
    frames with decreasing weights. `factor` is that of the normal equations of the better chain at its last fit,
    `since` the number of frames since then. `clock` is the number of all frames, of which those that add nothing count
    less, and that of the turns taken. The chains of a `ChainBank` share it, each with an offset of its own.
    """

    started: Mask
    origin: Array
    angles: Array
    features: Array
    weights: Array
    scatter: Array
    known: Mask
    parameters: Array
    factor: Array
    clock: Array
    since: Array
    damping: Array
    cost: Array
    reverse: Mask
    challenge: Array
    noise: Array
    offset: Array
    offset_variance: Array
    offset_power: Array
    residual_power: Array
    white: Array
    residual: Array
    recent: Array
    errors: Array
    failures: Array
    served: Array
    least_error: Array
    frames: Array
    moves: Mask
    motion: Array
    motion_covariance: Array
    evidence: Array


class ChainFrame(NamedTuple):
    """Newest frame and the present posture of each row.

    Attributes:
        fresh: True for a new frame. Shape (B,).
        angles: Joint angles at the frame's instant. Shape (B, n), rad.
        features: Features, 0 where unseen. Shape (B, m), px.
        seen: Mask of the features. Shape (B, m).
        duration: Time since the previous frame. Shape (B,), s.
        linear_error: Innovation of the linear filter. Shape (B, m), px.
        compared: Mask of the features that have such an innovation. Shape (B, m).
        present: Joint angles at present. Shape (B, n), rad.
        pending: Age of the newest frame. Shape (B,), s.
    """

    fresh: Mask
    angles: Array
    features: Array
    seen: Mask
    duration: Array
    linear_error: Array
    compared: Mask
    present: Array
    pending: Array


class ChainOutput(NamedTuple):
    """Results of each row: features, Jacobian by the joints, covariances and scores, see `ChainEstimate`.

    `parameters` are those of the better chain, with its points where they are at present.
    """

    features: Array
    jacobian: Array
    covariance: Array
    variance: Array
    log_likelihood: Array
    nis: Array
    best: Labels
    chained: Mask
    parameters: Array
