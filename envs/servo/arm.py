"""Planar two-link arms in one pymunk Space.

Each arm has two dynamic rods, the camera's 0.2 kg added to the second one, and pivots, joint stops and motors as
constraints. There is no gravity. Arms share the Space but do not interact. Constraints are solved in the order in which
they were added: motors, stops, pivots last, so that a motor never pulls a joint apart.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymunk
import pymunk.batch
from numpy.typing import NDArray

from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW, PERIOD, START
from servotrack.estimators.types import Array

LINK_MASS = 1.0
"""Mass of each link, kg."""
CAMERA_MASS = 0.2
"""Mass of the camera, kg."""
_PIVOT_BIAS = 0.01**60
_ANGLES = pymunk.batch.BodyFields.BODY_ID | pymunk.batch.BodyFields.ANGLE
_FEW_BODIES = 16
"""Up to this number of bodies, angles are read one by one; more are read in one call, which costs as much as twenty."""
_set_rate = pymunk.SimpleMotor.rate.fset  # type: ignore[attr-defined]
"""Setter behind `motor.rate = ...`; pymunk's own `__setattr__` would double the time."""


class _Arm:
    """One arm in a Space: two permanent bodies, and constraints that every start creates anew."""

    def __init__(self, space: pymunk.Space, max_motor_torque: float) -> None:
        self._space = space
        self._max_motor_torque = max_motor_torque
        self.bodies = (pymunk.Body(1.0, 1.0), pymunk.Body(1.0, 1.0))
        self.motors: tuple[pymunk.SimpleMotor, ...] = ()
        self.pivots: tuple[pymunk.PivotJoint, ...] = ()
        self._constraints: tuple[pymunk.Constraint, ...] = ()
        space.add(*self.bodies)

    def start(self, links: Array) -> None:
        """Rest at the start pose with links (2,) m. The motion that follows is bit-identical to that in a new Space."""
        # Removing a constraint moves the Space's last one into its slot. In reverse order, a whole arm moves in order.
        for constraint in reversed(self._constraints):
            self._space.remove(constraint)
        l1, l2 = float(links[0]), float(links[1])
        # The camera sits at the far end of link 2: center of gravity and moment of inertia move with it.
        mass = LINK_MASS + CAMERA_MASS
        center = (LINK_MASS * l2 / 2 + CAMERA_MASS * l2) / mass
        moment = LINK_MASS * (l2 * l2 / 12 + (center - l2 / 2) ** 2) + CAMERA_MASS * (l2 - center) ** 2
        theta1, theta2 = float(START[0]), float(START[1])
        upper, lower = self.bodies
        _rest(upper, LINK_MASS, LINK_MASS * l1 * l1 / 12, theta1, (l1 / 2 * np.cos(theta1), l1 / 2 * np.sin(theta1)))
        _rest(
            lower,
            mass,
            moment,
            theta1 + theta2,
            (
                l1 * np.cos(theta1) + center * np.cos(theta1 + theta2),
                l1 * np.sin(theta1) + center * np.sin(theta1 + theta2),
            ),
        )
        # Constraints keep impulses that cannot be cleared, so new ones are created.
        ground = self._space.static_body
        self.motors = (pymunk.SimpleMotor(ground, upper, 0.0), pymunk.SimpleMotor(upper, lower, 0.0))
        for motor in self.motors:
            motor.max_force = self._max_motor_torque
        stops = (
            pymunk.RotaryLimitJoint(ground, upper, JOINT_LOW[0], JOINT_HIGH[0]),
            pymunk.RotaryLimitJoint(upper, lower, JOINT_LOW[1], JOINT_HIGH[1]),
        )
        self.pivots = (
            pymunk.PivotJoint(ground, upper, (0.0, 0.0), (-l1 / 2, 0.0)),
            pymunk.PivotJoint(upper, lower, (l1 / 2, 0.0), (-center, 0.0)),
        )
        for pivot in self.pivots:
            pivot.error_bias = _PIVOT_BIAS
        self._constraints = (*self.motors, *stops, *self.pivots)
        self._space.add(*self._constraints)


def _rest(body: pymunk.Body, mass: float, moment: float, angle: float, position: tuple[float, float]) -> None:
    body.mass, body.moment = mass, moment
    body.angle, body.position = angle, position
    body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
    body.force, body.torque = (0.0, 0.0), 0.0


class ArmSpace:
    """N arms in one Space, driven by joint rates, one control period per step.

    Args:
        config: Torque limit, substeps and solver iterations.
        count: Number of arms N.
    """

    def __init__(self, config: ServoConfig, count: int) -> None:
        self._config = config
        self._space = pymunk.Space()
        self._space.gravity = (0.0, 0.0)
        self._space.iterations = config.solver_iterations
        self._substep = PERIOD / config.substeps
        self._arms: list[_Arm | None] = [None] * count
        self._not_started = count
        self._bodies: list[Any] = [None] * (2 * count)
        self._motors: list[pymunk.SimpleMotor | None] = [None] * (2 * count)
        self._body_ids = np.zeros((count, 2), np.int64)
        self._places: NDArray[np.intp] | None = None
        self._buffer = pymunk.batch.Buffer()
        self.angles = np.tile(START, (count, 1))
        """True joint angles, shape (N, 2), rad; updated by every `step`."""

    def reset(self, row: int, links: Array) -> None:
        """Restart one arm with links (2,) m at the start pose. The other arms are not changed."""
        arm = self._arms[row]
        if arm is None:
            arm = self._arms[row] = _Arm(self._space, self._config.max_motor_torque)
            self._bodies[2 * row : 2 * row + 2] = arm.bodies
            self._body_ids[row] = [body.id for body in arm.bodies]
            self._not_started -= 1
        arm.start(links)
        self._motors[2 * row : 2 * row + 2] = arm.motors
        self.angles[row] = START

    def step(self, rates: Array) -> None:
        """Drive all joints at `rates` (N, 2) rad/s for one control period and read the angles."""
        if self._not_started:
            raise RuntimeError(f"arms {[row for row, arm in enumerate(self._arms) if arm is None]} were never reset")
        # Chipmunk's motors turn the second body against the sign of their rate.
        for motor, rate in zip(self._motors, rates.ravel().tolist(), strict=True):
            _set_rate(motor, -rate)
        for _ in range(self._config.substeps):
            self._space.step(self._substep)
        if len(self._bodies) <= _FEW_BODIES:
            for row, (upper, lower) in enumerate(zip(self._bodies[::2], self._bodies[1::2], strict=True)):
                first = upper.angle
                self.angles[row, 0], self.angles[row, 1] = first, lower.angle - first
        else:
            angles = self._all_angles()
            self.angles[:, 0] = angles[:, 0]
            self.angles[:, 1] = angles[:, 1] - angles[:, 0]

    def _all_angles(self) -> Array:
        """Angles of all bodies, read in one call and reordered: the Space lists bodies in its own order."""
        self._buffer.clear()
        pymunk.batch.get_space_bodies(self._space, _ANGLES, self._buffer)
        if self._places is None:
            ids = np.frombuffer(self._buffer.int_buf(), np.int64)
            order = np.argsort(ids)
            self._places = order[np.searchsorted(ids[order], self._body_ids)]
        return np.frombuffer(self._buffer.float_buf(), np.float64)[self._places]

    def tool_gap(self) -> float:
        """Largest gap between two ends that a pivot holds together, m: the solver's error."""
        worst = 0.0
        for arm in filter(None, self._arms):
            for pivot in arm.pivots:
                gap = pivot.a.local_to_world(pivot.anchor_a) - pivot.b.local_to_world(pivot.anchor_b)
                worst = max(worst, gap.length)
        return worst
