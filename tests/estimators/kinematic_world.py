"""A kinematic world for tests: a planar two-link arm carries a camera, and the joints do exactly what they are told.

Everything is batched: one world holds `rows` independent arms. The image of the target is

    y = c + alpha F R(theta1 + theta2 + psi)^T (p_target - p_tool),    F = diag(1, -1)

and the faults of timing (latency, dropped frames, rolling shutter) and sensors (pixel noise, outliers, encoder noise)
are those of the ladder, so that estimators can be driven in closed loop without a physics engine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from servotrack.estimators.jacobian.contract import ServoMeasurement
from servotrack.estimators.types import Array

Target = Callable[[Array], Array]
"""Time (rows,) s -> position (rows, 2) m."""

IMAGE_CENTER = 240.0
HALF_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def paper_target(time: Array) -> Array:
    """The ellipse of Zhang 2011, eq. (32)."""
    return np.stack([0.5 + 0.3 * np.cos(time), 0.5 + 0.2 * np.sin(time)], axis=-1)


def still_target(position: ArrayLike) -> Target:
    """A target at rest; `position` (2,) or (rows, 2) m."""
    return lambda time: np.broadcast_to(np.asarray(position, float), (*time.shape, 2)).copy()


def ellipse_target(rng: np.random.Generator, rows: int, size: ArrayLike = 1.0) -> Target:
    """One random ellipse per row, angular rate 0.5 to 1.5 rad/s; `size` scales the lengths with the arm."""
    scale = np.broadcast_to(np.asarray(size, float), (rows,))[:, None]
    center = scale * (0.5 + rng.uniform(-0.05, 0.05, (rows, 2)))
    radii = scale * rng.uniform([0.15, 0.1], [0.3, 0.2], (rows, 2))
    rate, phase = rng.uniform(0.5, 1.5, rows), rng.uniform(0, 2 * np.pi, rows)

    def position(time: Array) -> Array:
        angle = rate * time + phase
        return center + radii * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    return position


def two_sine_target(rng: np.random.Generator, rows: int, size: ArrayLike = 1.0) -> Target:
    """Every coordinate is a sum of two sines of different rates: no ellipse, but smooth."""
    scale = np.broadcast_to(np.asarray(size, float), (rows,))[:, None]
    rates, phases = rng.uniform(0.4, 1.6, (2, rows, 2)), rng.uniform(0, 2 * np.pi, (2, rows, 2))
    amplitudes = np.array([0.14, 0.08])

    def position(time: Array) -> Array:
        waves = np.sin(rates * time[:, None] + phases)
        return scale * (0.5 + np.einsum("k,krc->rc", amplitudes, waves))

    return position


def waypoint_target(rng: np.random.Generator, rows: int, speed: float = 0.25, legs: int = 64) -> Target:
    """Straight legs at constant speed between random corners: the velocity jumps at every corner."""
    corners = rng.uniform([0.3, 0.35], [0.75, 0.7], (rows, legs + 1, 2))
    lengths = np.hypot(*np.moveaxis(np.diff(corners, axis=1), -1, 0))
    arrival = np.concatenate([np.zeros((rows, 1)), np.cumsum(lengths / speed, axis=1)], axis=1)

    def position(time: Array) -> Array:
        return np.stack(
            [[np.interp(t, arrival[r], corners[r, :, c]) for c in (0, 1)] for r, t in enumerate(np.atleast_1d(time))]
        )

    return position


@dataclass
class KinematicWorld:
    """`rows` arms, each above its own target. Scalars given for per-row quantities are broadcast.

    Args:
        target: Time (rows,) to position (rows, 2) m.
        rows: Number of arms.
        seed: Of all noise.
        links: Lengths. Shape (2,) or (rows, 2), m.
        alpha: Pixels per meter on the plane. Shape () or (rows,).
        mounting: Angle psi of the camera about its axis. Shape () or (rows,), rad.
        center, goal: Principal point and wanted features. Shape (2,) or (rows, 2), px. The tool is over the
            target where the feature lies on `center`; a goal elsewhere is an offset, as in positioning.
        pixel_noise, encoder_noise: Standard deviations, px and rad.
        latency: Age of a frame when it arrives, in periods. Shape () or (rows,), integers.
        stamped: Whether `frame_time` tells the capture; if not it tells the arrival.
        drop_rate, outlier_rate, outlier_size: Share of frames lost, share displaced, standard deviation of that, px.
        rolling_shutter: Read-out time of a whole image, s; `frame_time` is that of the middle row.
        start: Joint angles at the beginning. Shape (2,) or (rows, 2), rad.
        joint_low, joint_high, max_joint_rate: Limits, rad and rad/s; rates are clipped per joint as hardware does.
        warmup: Steps before time 0.
        image_size: Width and height of the image about (240, 240), px.
    """

    target: Target = paper_target
    rows: int = 1
    seed: int = 0
    links: ArrayLike = (0.5, 0.5)
    alpha: ArrayLike = 160 / 0.35
    mounting: ArrayLike = 0.0
    center: ArrayLike = (240.0, 240.0)
    goal: ArrayLike | None = None
    pixel_noise: ArrayLike = 0.0
    encoder_noise: ArrayLike = 0.0
    latency: ArrayLike = 0
    stamped: bool = True
    drop_rate: float = 0.0
    outlier_rate: float = 0.0
    outlier_size: float = 30.0
    rolling_shutter: float = 0.0
    start: ArrayLike = (0.0, np.pi / 2)
    joint_low: ArrayLike = (-np.pi / 2, 0.0)
    joint_high: ArrayLike = (np.pi / 2, np.pi)
    max_joint_rate: float = 2.0
    warmup: int = 8
    image_size: float = 480.0
    period: float = 0.05

    def reset(self) -> ServoMeasurement:
        """Begin an episode and return the first measurement."""
        rows = self.rows

        def per_row(value: ArrayLike, *shape: int) -> Array:
            return np.broadcast_to(np.asarray(value, float), (rows, *shape)).copy()

        self._rng = np.random.default_rng(self.seed)
        self._links, self._alpha, self._psi = per_row(self.links, 2), per_row(self.alpha), per_row(self.mounting)
        self._center = per_row(self.center, 2)
        self._goal = self._center if self.goal is None else per_row(self.goal, 2)
        self._latency = per_row(self.latency).astype(int)
        self.joints = per_row(self.start, 2)
        self.time = -self.warmup * self.period
        self._joint_history = [self.joints]
        self._features, self._visible = self._goal.copy(), np.zeros(rows, bool)
        self._frame_time = per_row(self.time)
        return self._observe(first=True)

    def step(self, joint_rate: ArrayLike) -> ServoMeasurement:
        """Move for one period at `joint_rate` (rows, 2) rad/s and measure."""
        rate = np.clip(np.asarray(joint_rate, float), -self.max_joint_rate, self.max_joint_rate)
        self.joints = np.clip(self.joints + rate * self.period, self.joint_low, self.joint_high)
        self.time += self.period
        self._joint_history.append(self.joints)
        return self._observe(first=False)

    @property
    def tool(self) -> Array:
        """Tool position, (rows, 2) m."""
        return self._tool(self.joints)

    @property
    def tracking_error(self) -> Array:
        """Distance from tool to target now, (rows,) m."""
        return np.hypot(*np.moveaxis(self.target(self._now) - self.tool, -1, 0))

    @property
    def error(self) -> Array:
        """True features minus goal now, without noise or delay, (rows, 2) px."""
        return self._project(self._now, self.joints) - self._goal

    @property
    def jacobian(self) -> Array:
        """True total image Jacobian now, (rows, 2, 3) px/rad and px/s."""
        turn = self._turn(self.joints)
        elbow = self._links[:, :1] * np.stack([np.cos(self.joints[:, 0]), np.sin(self.joints[:, 0])], axis=-1)
        a = np.einsum("rij,rj->ri", turn, self.target(self._now))
        b = np.einsum("rij,rj->ri", turn, elbow)
        half = 1e-5
        velocity = (self.target(self._now + half) - self.target(self._now - half)) / (2 * half)
        columns = [a @ HALF_TURN.T, (a - b) @ HALF_TURN.T, np.einsum("rij,rj->ri", turn, velocity)]
        return np.stack(columns, axis=-1)

    @property
    def _now(self) -> Array:
        return np.full(self.rows, self.time)

    def _tool(self, joints: Array) -> Array:
        first, second = joints[:, 0], joints.sum(axis=1)
        l1, l2 = self._links.T
        return np.stack([l1 * np.cos(first) + l2 * np.cos(second), l1 * np.sin(first) + l2 * np.sin(second)], axis=-1)

    def _turn(self, joints: Array) -> Array:
        angle = joints.sum(axis=1) + self._psi
        c, s = self._alpha * np.cos(angle), self._alpha * np.sin(angle)
        return np.stack([np.stack([c, s], axis=-1), np.stack([s, -c], axis=-1)], axis=-2)

    def _project(self, time: Array, joints: Array) -> Array:
        return self._center + np.einsum("rij,rj->ri", self._turn(joints), self.target(time) - self._tool(joints))

    def _joints_at(self, time: Array) -> Array:
        """Joint angles at past times: linear within a period, as commanded; the last known ones for later times."""
        history = np.stack(self._joint_history[-8:])
        newest = len(history) - 1
        place = np.clip(newest + (time - self.time) / self.period, 0, newest)
        before = np.minimum(place.astype(int), max(newest - 1, 0))
        after, share = np.minimum(before + 1, newest), (place - before)[:, None]
        rows = np.arange(self.rows)
        return (1 - share) * history[before, rows] + share * history[after, rows]

    def _observe(self, *, first: bool) -> ServoMeasurement:
        rng, rows = self._rng, self.rows
        capture = self.time - self._latency * self.period
        image = self._project(capture, self._joints_at(capture))
        if self.rolling_shutter:
            # Lines are read one after another, so the target is caught earlier above the middle row and later below it.
            for _ in range(3):
                caught = capture + self.rolling_shutter * (image[:, 1] - IMAGE_CENTER) / self.image_size
                image = self._project(caught, self._joints_at(caught))
        displaced = (rng.random(rows) < self.outlier_rate)[:, None]
        image = image + np.asarray(self.pixel_noise)[..., None] * rng.standard_normal((rows, 2))
        image = image + displaced * self.outlier_size * rng.standard_normal((rows, 2))
        dropped = rng.random(rows) < self.drop_rate
        inside = (np.abs(image - IMAGE_CENTER) <= self.image_size / 2).all(axis=1)
        self._visible = inside & (first | ~dropped)
        stamp = capture if self.stamped else self._now
        self._features = np.where(self._visible[:, None], image, self._features)
        self._frame_time = np.where(self._visible, stamp, self._frame_time)
        encoders = self.joints + np.asarray(self.encoder_noise)[..., None] * rng.standard_normal((rows, 2))
        return ServoMeasurement(
            encoders, self._features.copy(), self._goal.copy(), self._visible.copy(), self._frame_time.copy(), self._now
        )


def closed_loop(controller: Any, world: KinematicWorld, steps: int = 252) -> Array:
    """Drive `world` and return the tracking errors, (warmup + steps, rows) m.

    Args:
        controller: An object with `initial(measurement)` and `step(state, measurement) -> (state, joint_rate)`, or a
            callable from a measurement to joint rates (rows, 2) rad/s.
        world: The arms; reset here.
        steps: Scored control periods, after the warm-up.
    """
    measurement = world.reset()
    state = controller.initial(measurement) if hasattr(controller, "initial") else None
    errors = []
    for _ in range(world.warmup + steps):
        if state is None:
            rate = controller(measurement)
        else:
            state, rate = controller.step(state, measurement)
        measurement = world.step(rate)
        errors.append(world.tracking_error)
    return np.array(errors)


def wander(estimator: Any, world: KinematicWorld, steps: int, seed: int = 1) -> Iterator[tuple[Any, Any]]:
    """Move the arms at random; yield the estimator's state and estimate at every step, the world as of that instant."""
    rng = np.random.default_rng(seed)
    rate = np.zeros((world.rows, 2))
    for step in range(steps):
        if step == 0:
            measurement = world.reset()
            state = estimator.initial(measurement)
        else:
            rate = 0.8 * rate + rng.uniform(-0.4, 0.4, rate.shape)
            measurement = world.step(rate)
        state, estimate = estimator.step(state, measurement)
        yield state, estimate
