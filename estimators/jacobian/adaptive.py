"""Kalman filter of the total image Jacobian whose noise follows from what the arm does and what the camera shows.

The Jacobian of an arm changes because the arm moves, by about its own size within a radian. So process noise grows with
the motion instead of with time, in proportion to the Jacobian's own size, and an increment is trusted the less the
farther the arm moved in it. The noise of the features is measured while the arm rests. What is left to say are units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np

from servotrack.estimators.compilation import njit
from servotrack.estimators.definite import is_definite, repair
from servotrack.estimators.jacobian.alignment import Alignment, AlignmentState
from servotrack.estimators.jacobian.contract import Increment, LinearEstimate, ServoMeasurement
from servotrack.estimators.jacobian.feature_wise import each_feature
from servotrack.estimators.types import Array, Mask


class AdaptiveFilter(NamedTuple):
    """Part of an `AdaptiveState` that the increments change.

    Attributes:
        jacobian: Mean of the total image Jacobian. Shape (*batch, m, n + 1).
        covariance: Covariance of each of its rows. Shape (*batch, m, n + 1, n + 1).
        resting_change: Change of each feature in its last increment, if the arm rested in it. Shape (*batch, m).
        resting_time: Duration of that increment, 0 if the arm moved. Shape (*batch, m), s.
        gathered: Motion of joints and time since the increment used last. Shape (*batch, m, n + 1).
        gathered_change: Change of each feature since then. Shape (*batch, m).
        squares: Sum of the squared noise of features at rest, in units of `feature_noise`. Shape (*batch,).
        terms: Number of terms in `squares`. Shape (*batch,).
        excess: Mean square of innovations beyond their predicted variance, in squared feature ranges. Shape (*batch,).
    """

    jacobian: Array
    covariance: Array
    resting_change: Array
    resting_time: Array
    gathered: Array
    gathered_change: Array
    squares: Array
    terms: Array
    excess: Array


class AdaptiveState(NamedTuple):
    """State of an `AdaptiveKalmanJacobian`.

    Attributes:
        alignment: Encoder history and newest frame of each feature, with batch axes (*batch, m).
        filter: Mean, covariance and noise.
    """

    alignment: AlignmentState
    filter: AdaptiveFilter


@dataclass(frozen=True)
class AdaptiveKalmanJacobian:
    """Kalman filter of each row of the total image Jacobian (Zhang 2011, eq. 9), for arms with any number of joints.

    Features are seen one by one (`ServoMeasurement.visible` with one entry per feature or point). Numbers may be given
    once or for every feature or joint, so that features and joints may have different units.

    Args:
        feature_range: Change of a feature that one unit of a joint can cause, for rotations about the width of the
            image. It sets the prior and must not be far too small. A number, or shape (m,), px.
        feature_noise: Standard deviation of a feature before it has been measured. A number, or shape (m,), px.
        joint_unit: Motion that changes the Jacobian by about its own size: 1 rad for a joint that turns, about the
            distance of the target for one that slides. A number, or shape (n,).
        joint_noise: Standard deviation of encoder readings, in joint units. Changes below twice that are rest. Larger
            values trust small moves less.
        least_motion: Motion after which an increment is used, in joint units; shorter ones are joined. Larger values
            average less, and protect an arm at its goal from learning noise and the play of its gears.
        longest_increment: Time after which an increment is used even so, s. Larger values see a target's motion later.
        change: Share of its size by which the Jacobian changes within a joint unit. Larger values follow faster and
            average fewer increments.
        memory: Motion over which such changes keep their direction, in joint units. Larger values add uncertainty.
        curvature: Error of the linear model in an increment, as a share of the Jacobian's size times the squared
            motion. Larger values trust large moves less.
        target_speed: Standard deviation of the features' own velocity before it is known, in feature ranges per s.
        target_change: Standard deviation of its change within a second while the target seems to rest, in feature
            ranges per s. Larger values notice sooner that it moves, and mistake the arm's motion for the target's.
        target_turn: Standard deviation of its change within a second, as a share of the velocity that has been found.
            Larger values follow targets that turn, and average less.
        excess: Weight of an increment in the running mean of the errors that these variances do not explain: play of
            gears, sag, late motors. That mean is added to the noise. Larger values notice them sooner; 0 trusts the
            variances.
        excess_target: Share of these errors that the target's own motion may explain. Larger values follow targets that
            turn, and mistake the arm's errors for the target's motion.
        alignment: Pairing of joints and features by time stamps.
    """

    feature_range: float | tuple[float, ...] = 1000.0
    feature_noise: float | tuple[float, ...] = 0.5
    joint_unit: float | tuple[float, ...] = 1.0
    joint_noise: float = 0.0005
    least_motion: float = 0.01
    longest_increment: float = 0.5
    change: float = 0.2
    memory: float = 0.2
    curvature: float = 1.0
    target_speed: float = 0.2
    target_change: float = 0.0005
    target_turn: float = 1.0
    excess: float = 0.05
    excess_target: float = 0.03
    alignment: Alignment = field(default_factory=Alignment)

    row_covariances: ClassVar[bool] = True

    def __post_init__(self) -> None:
        for name in ("feature_range", "feature_noise", "joint_unit"):
            value = np.asarray(getattr(self, name), np.float64)
            if value.ndim > 1 or not ((value > 0.0) & (value < np.inf)).all():
                raise ValueError(f"{name} must be a finite number > 0, or a row of them, got {getattr(self, name)}")
        for name in (
            "joint_noise",
            "least_motion",
            "longest_increment",
            "change",
            "memory",
            "curvature",
            "target_speed",
            "target_change",
            "target_turn",
            "excess",
            "excess_target",
        ):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be finite and >= 0, got {getattr(self, name)}")

    def initial(self, measurement: ServoMeasurement) -> AdaptiveState:
        """State before the first increment. Raises ValueError as `checked` does, or if units do not fit n and m."""
        single = each_feature(measurement)
        *batch, m, n = single.joint_angles.shape
        units = self.units(m, n)
        start = AdaptiveFilter(
            jacobian=np.zeros((*batch, m, n + 1)),
            covariance=np.tile(self._prior(units), (*batch, 1, 1, 1)),
            resting_change=np.zeros((*batch, m)),
            resting_time=np.zeros((*batch, m)),
            gathered=np.zeros((*batch, m, n + 1)),
            gathered_change=np.zeros((*batch, m)),
            squares=np.zeros(batch),
            terms=np.zeros(batch),
            excess=np.zeros(batch),
        )
        return AdaptiveState(self.alignment.initial(single), start)

    def step(self, state: AdaptiveState, measurement: ServoMeasurement) -> tuple[AdaptiveState, LinearEstimate]:
        """Update with one measurement. Raises ValueError as `Alignment.step` does."""
        single = each_feature(measurement)
        alignment, increment = self.alignment.step(state.alignment, single)
        *batch, m, n = single.joint_angles.shape
        units = self.units(m, n)
        rows = math.prod(batch)
        offset = alignment.frame_features[..., 0] - single.goal[..., 0]
        flat = _flat_rows((state.filter, increment, offset, alignment.seen), rows, len(batch))
        results = filter_rows(*flat, units, self.noise())
        shaped = [result.reshape((*batch, *result.shape[1:])) for result in results]
        return AdaptiveState(alignment, AdaptiveFilter(*shaped[:9])), LinearEstimate(*shaped[9:])

    def forget(self, state: AdaptiveState) -> AdaptiveState:
        """Keep the mean, and doubt it: add half of the Jacobian's typical size to the deviations of its entries."""
        jacobian, covariance = state.filter.jacobian, state.filter.covariance.copy()
        *_, m, d = jacobian.shape
        units = self.units(m, d - 1)
        scale = units.range[:, None] / units.joint
        sizes = np.mean((jacobian[..., :-1] / scale) ** 2, axis=(-2, -1), keepdims=True)
        np.einsum("...ii->...i", covariance)[..., :-1] += 0.25 * sizes * scale**2
        return state._replace(filter=state.filter._replace(covariance=covariance))

    def units(self, features: int, joints: int) -> _Units:
        """Return the units for the kernel. Raises ValueError if they do not fit the numbers of features and joints."""
        return _Units(
            self._each("feature_range", features, "feature"),
            self._each("feature_noise", features, "feature"),
            self._each("joint_unit", joints, "joint"),
        )

    def _each(self, name: str, count: int, of: str) -> Array:
        value = np.asarray(getattr(self, name), np.float64)
        if value.ndim and value.shape != (count,):
            raise ValueError(f"{name} must be one number or one per {of}, got {value.size} for {count} {of}s")
        return np.full(count, value) if value.ndim == 0 else np.ascontiguousarray(value)

    def _prior(self, units: _Units) -> Array:
        """Covariance of each row before the first increment. Shape (m, n + 1, n + 1)."""
        deviations = units.range[:, None] * np.append(1.0 / units.joint, self.target_speed)
        return deviations[:, :, None] ** 2 * np.eye(deviations.shape[1])

    def noise(self) -> _Noise:
        """Return the variances and limits for the kernel."""
        return _Noise(
            self.joint_noise**2,
            self.least_motion,
            self.longest_increment,
            self.change**2 * self.memory,
            self.curvature**2,
            self.target_change**2,
            self.target_turn**2,
            self.excess,
            self.excess_target,
        )


class _Units(NamedTuple):
    """Ranges and noise of features, and units of joints. Shapes (m,), (m,) and (n,)."""

    range: Array
    noise: Array
    joint: Array


class _Noise(NamedTuple):
    """Variances and limits, in feature ranges and joint units.

    Attributes:
        reading: Variance of an encoder reading.
        least_motion: Motion after which an increment is used.
        longest: Time after which an increment is used, s.
        change: Variance of an entry of J per motion.
        curvature: Variance of an increment per fourth power of the motion.
        drift: Variance of the features' own velocity per second, at rest.
        turn: The same as a share of its square, if it is known.
        excess: Weight of an increment in the mean of unexplained errors.
        target: Share of these errors that the target's motion may explain.
    """

    reading: float
    least_motion: float
    longest: float
    change: float
    curvature: float
    drift: float
    turn: float
    excess: float
    target: float


def _flat_rows(
    parts: tuple[AdaptiveFilter, Increment, Array, Mask], rows: int, axes: int
) -> tuple[AdaptiveFilter, Increment, Array, Mask]:
    """Merge the batch axes of the state and an increment to one."""

    def flat(values: Any) -> Any:
        return values.reshape((rows, *values.shape[axes:]))

    state, increment, offset, seen = parts
    return AdaptiveFilter(*map(flat, state)), Increment(*map(flat, increment)), flat(offset), flat(seen)


@njit(cache=True, nogil=True)
def filter_rows(before, increment, offset, seen, units, noise):  # type: ignore[no-untyped-def]
    """`AdaptiveKalmanJacobian.step` over rows.

    Returns the fields of an `AdaptiveFilter`, then those of a `LinearEstimate`.
    """
    rows, m, d = before.jacobian.shape
    n = d - 1
    jacobian, covariance = before.jacobian.copy(), before.covariance.copy()
    resting_change, resting_time = before.resting_change.copy(), before.resting_time.copy()
    gathered, gathered_change = before.gathered.copy(), before.gathered_change.copy()
    squares, terms = before.squares.copy(), before.terms.copy()
    excess = before.excess.copy()
    error, variance = np.zeros((rows, m)), np.full((rows, m), np.inf)
    log_likelihood, nis = np.zeros(rows), np.zeros(rows)
    direction = np.empty(d)
    for row in range(rows):
        for i in range(m):
            if not increment.fresh[row, i]:
                continue
            duration, change = increment.time[row, i], increment.features[row, i, 0]
            moved = 0.0
            for j in range(n):
                moved = max(moved, abs(increment.joints[row, i, j]) / units.joint[j])
            if moved * moved > 4.0 * noise.reading:
                resting_time[row, i] = 0.0
                continue
            if resting_time[row, i] > 0.0:
                # The second difference knows nothing of a target in uniform motion.
                ratio = duration / resting_time[row, i]
                second = change - ratio * resting_change[row, i]
                spread = units.noise[i] ** 2 * (1.0 + (1.0 + ratio) ** 2 + ratio**2)
                squares[row] += second * second / spread
                terms[row] += 1.0
            resting_change[row, i], resting_time[row, i] = change, duration
        # One term is the number before it was measured.
        level = (1.0 + squares[row]) / (1.0 + terms[row])

        size = 0.0
        for i in range(m):
            for j in range(n):
                size += (jacobian[row, i, j] * units.joint[j] / units.range[i]) ** 2
        size /= m * n
        # At less than ten deviations, errors of the model look like a target that moves.
        speed, doubt = 0.0, 0.0
        for i in range(m):
            speed += (jacobian[row, i, n] / units.range[i]) ** 2 / m
            doubt += covariance[row, i, n, n] / units.range[i] ** 2 / m
        turn = noise.turn * speed * speed / (speed + 100.0 * doubt) if speed > 0.0 else 0.0

        used, updated, beyond = 0, 0, 0.0
        for i in range(m):
            sensor = units.noise[i] ** 2 * level
            if increment.fresh[row, i]:
                for j in range(n):
                    direction[j] = increment.joints[row, i, j]
                direction[n] = increment.time[row, i]
                gathered[row, i] += direction
                gathered_change[row, i] += increment.features[row, i, 0]
                # Judged by every frame, however rarely the increments are used.
                innovation, total = increment.features[row, i, 0], 2.0 * sensor
                total += units.range[i] ** 2 * (excess[row] + 2.0 * n * size * noise.reading)
                for j in range(d):
                    innovation -= jacobian[row, i, j] * direction[j]
                    for k in range(d):
                        total += direction[j] * covariance[row, i, j, k] * direction[k]
                used += 1
                nis[row] += innovation * innovation / total
                log_likelihood[row] -= 0.5 * (innovation * innovation / total + np.log(2.0 * np.pi * total))
                far, squared = 0.0, 0.0
                for j in range(n):
                    part = gathered[row, i, j] / units.joint[j]
                    far += abs(part)
                    squared += part * part
                if far >= noise.least_motion or gathered[row, i, n] >= noise.longest:
                    scale = size * units.range[i] ** 2
                    for j in range(n):
                        covariance[row, i, j, j] += noise.change * far * scale / units.joint[j] ** 2
                    covariance[row, i, n, n] += (noise.drift + turn) * units.range[i] ** 2 * gathered[row, i, n]
                    total = 2.0 * sensor + scale * (2.0 * n * noise.reading + noise.curvature * squared * squared)
                    total += excess[row] * units.range[i] ** 2
                    covariance[row, i, n, n] += noise.target * excess[row] * (units.range[i] / gathered[row, i, n]) ** 2
                    innovation, total = _update(
                        jacobian[row, i], covariance[row, i], gathered[row, i], gathered_change[row, i], total
                    )
                    gathered[row, i] = 0.0
                    gathered_change[row, i] = 0.0
                    updated += 1
                    beyond += (innovation * innovation - total) / units.range[i] ** 2
            if seen[row, i]:
                for j in range(n):
                    direction[j] = increment.pending_joints[row, i, j]
                direction[n] = increment.pending_time[row, i]
                error[row, i] = offset[row, i]
                # What an encoder cannot tell apart, no servo removes.
                variance[row, i] = sensor + size * units.range[i] ** 2 * n * noise.reading
                for j in range(d):
                    error[row, i] += jacobian[row, i, j] * direction[j]
                    for k in range(d):
                        variance[row, i] += direction[j] * covariance[row, i, j, k] * direction[k]
        nis[row] /= max(used, 1)
        if updated > 0:
            excess[row] = max(0.0, excess[row] + noise.excess * beyond / updated)
    return (
        jacobian,
        covariance,
        resting_change,
        resting_time,
        gathered,
        gathered_change,
        squares,
        terms,
        excess,
        error,
        jacobian,
        log_likelihood,
        nis,
        covariance,
        variance,
    )


@njit(cache=True, nogil=True)
def _update(mean, covariance, direction, measured, variance):  # type: ignore[no-untyped-def]
    """Update one row with z = mean . h + noise, in Joseph form. Returns the innovation and its variance."""
    d = len(mean)
    spread, gain = np.empty(d), np.empty(d)
    half, factor, before = np.empty((d, d)), np.empty((d, d)), np.empty(d)
    innovation, total = measured, variance
    for i in range(d):
        spread[i] = 0.0
        for j in range(d):
            spread[i] += covariance[i, j] * direction[j]
        total += direction[i] * spread[i]
        innovation -= mean[i] * direction[i]
        before[i] = covariance[i, i]
    for i in range(d):
        gain[i] = spread[i] / total
        mean[i] += gain[i] * innovation
    for i in range(d):
        for j in range(d):
            half[i, j] = covariance[i, j] - gain[i] * spread[j]
    for i in range(d):
        projected = 0.0
        for j in range(d):
            projected += half[i, j] * direction[j]
        for j in range(i + 1):
            value = half[i, j] - projected * gain[j] + variance * gain[i] * gain[j]
            covariance[i, j] = value
            covariance[j, i] = value
    if not is_definite(covariance, 0.0, factor):
        repair(covariance, before, factor)
    return innovation, total
