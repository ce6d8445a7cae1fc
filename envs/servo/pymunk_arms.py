"""Planar two-link arms in one pymunk Space: the reference engine.

Arms share the Space but do not interact. Constraints are solved in the order in which they were added: motors, stops,
pivots last, so that a motor never pulls a joint apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pymunk
import pymunk.batch
from numpy.typing import NDArray

from servotrack.envs.servo.arm import PIVOT_BIAS, SQUARE, Rods, rods_at_rest
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW, PERIOD, START
from servotrack.envs.state import State, entry
from servotrack.estimators.types import Array, Labels

_ANGLES = pymunk.batch.BodyFields.BODY_ID | pymunk.batch.BodyFields.ANGLE
_FEW_BODIES = 16
"""Up to this number of bodies, angles are read one by one; more are read in one call, which costs as much as twenty."""
_KEPT = 512
"""Number of steps whose rates are kept before those from before the oldest reset are dropped."""
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

    def start(self, rods: Rods) -> None:
        """Rest at the start pose. The motion that follows is bit-identical to that in a new Space."""
        # Removing a constraint moves the Space's last one into its slot. In reverse order, a whole arm moves in order.
        for constraint in reversed(self._constraints):
            self._space.remove(constraint)
        upper, lower = self.bodies
        for body, mass, moment, angle, position in zip(
            self.bodies, rods.masses, rods.moments, rods.angles, rods.positions, strict=True
        ):
            body.mass, body.moment = mass, moment
            body.angle, body.position = angle, position
            body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
            body.force, body.torque = (0.0, 0.0), 0.0
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
            pymunk.PivotJoint(ground, upper, (0.0, 0.0), (-rods.half, 0.0)),
            pymunk.PivotJoint(upper, lower, (rods.half, 0.0), (-rods.center, 0.0)),
        )
        for pivot in self.pivots:
            pivot.error_bias = PIVOT_BIAS
        self._constraints = (*self.motors, *stops, *self.pivots)
        self._space.add(*self._constraints)


class PymunkArms:
    """N arms in one Space, driven by joint rates, one control period per step.

    A Space cannot be copied with its solver's state, so the rates since the resets are kept: a copy (`copy.deepcopy`,
    `pickle`) and `set_state` drive new arms with them, and go on with the same bits.

    Args:
        config: Torque limit, substeps and solver iterations.
        count: Number of arms N.

    Attributes:
        angles: True joint angles, shape (N, 2), rad; updated by every `step`, never replaced.
    """

    def __init__(self, config: ServoConfig, count: int) -> None:
        self._config = config
        self.angles = np.tile(START, (count, 1))
        self._links = np.zeros((count, 2))
        self._clear()

    def _clear(self) -> None:
        """Make an empty Space."""
        count = len(self.angles)
        self._space = pymunk.Space()
        self._space.gravity = (0.0, 0.0)
        self._space.iterations = self._config.solver_iterations
        self._substep = PERIOD / self._config.substeps
        self._arms: list[_Arm | None] = [None] * count
        self._not_started = count
        self._bodies: list[Any] = [None] * (2 * count)
        self._motors: list[pymunk.SimpleMotor | None] = [None] * (2 * count)
        self._body_ids = np.zeros((count, 2), np.int64)
        self._places: NDArray[np.intp] | None = None
        self._buffer = pymunk.batch.Buffer()
        self._driven: list[Array] = []
        self._since = [0] * count
        self._most_kept = _KEPT

    def reset(self, rows: Labels, links: Array) -> None:
        """Restart the arms of rows (n,) with links (n, 2) m at the start pose. The other arms are not changed."""
        for row, own in zip(rows.tolist(), links.tolist(), strict=True):
            self._restart(row, own, rods_at_rest(*own, SQUARE))

    def _restart(self, row: int, links: list[float], rods: Rods) -> None:
        arm = self._arms[row]
        if arm is None:
            arm = self._arms[row] = _Arm(self._space, self._config.max_motor_torque)
            self._bodies[2 * row : 2 * row + 2] = arm.bodies
            self._body_ids[row] = [body.id for body in arm.bodies]
            self._places = None
            self._not_started -= 1
        arm.start(rods)
        self._motors[2 * row : 2 * row + 2] = arm.motors
        self.angles[row], self._links[row] = START, links
        self._since[row] = len(self._driven)

    def step(self, rates: Array) -> None:
        """Drive all joints at `rates` (N, 2) rad/s for one control period and read the angles."""
        if self._not_started:
            raise RuntimeError(f"arms {[row for row, arm in enumerate(self._arms) if arm is None]} were never reset")
        self._drive(rates)
        self._driven.append(rates.copy())
        if len(self._driven) > self._most_kept:
            first = min(self._since)
            del self._driven[:first]
            self._since = [start - first for start in self._since]
            self._most_kept = max(_KEPT, 2 * len(self._driven))
        if len(self._bodies) <= _FEW_BODIES:
            for row, (upper, lower) in enumerate(zip(self._bodies[::2], self._bodies[1::2], strict=True)):
                first = upper.angle
                self.angles[row, 0], self.angles[row, 1] = first, lower.angle - first
        else:
            angles = self._all_angles()
            self.angles[:, 0] = angles[:, 0]
            self.angles[:, 1] = angles[:, 1] - angles[:, 0]

    def _drive(self, rates: Array) -> None:
        """Move the arms that have been reset."""
        # Chipmunk's motors turn the second body against the sign of their rate.
        for motor, rate in zip(self._motors, rates.ravel().tolist(), strict=True):
            if motor is not None:
                _set_rate(motor, -rate)
        for _ in range(self._config.substeps):
            self._space.step(self._substep)

    def get_state(self) -> State:
        """Return what `set_state` needs besides the links.

        Returns:
            `rates`, the joint rates of each arm's steps since its reset, the last steps at the end, rad/s, shape (N,
            steps, 2); `driven`, the number of these steps, shape (N,).
        """
        driven = len(self._driven) - np.array(self._since)
        last = self._driven[len(self._driven) - driven.max() :] if driven.max() else []
        return {"rates": np.array(last).reshape(-1, *self.angles.shape).swapaxes(0, 1).copy(), "driven": driven}

    def check_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raise a ValueError for a state that `set_state` cannot use."""
        count = len(self.angles)
        rates, driven = entry(state, "rates", (count, None, 2), np.float64), entry(state, "driven", (count,), np.int64)
        if driven.min() < 0 or driven.max() > rates.shape[1]:
            raise ValueError(
                f"state's 'driven' must lie in 0 to {rates.shape[1]}, got {driven.min()} to {driven.max()}"
            )

    def set_state(self, state: Mapping[str, NDArray[Any]], links: Array) -> None:
        """Bring all arms into a state that `get_state` returned, with links (N, 2) m: they are driven there again."""
        rates = state["rates"].swapaxes(0, 1)
        self._drive_again([step.copy() for step in rates], len(rates) - state["driven"], links)

    def _drive_again(self, driven: list[Array], since: Labels, links: Array) -> None:
        """Drive new arms at all steps' rates (N, 2), rad/s, each from the step of its reset; -1: it never had one."""
        self._clear()
        for step in range(len(driven) + 1):
            started = np.flatnonzero(since == step)
            self.reset(started, links[started])
            if step < len(driven):
                self._drive(driven[step])
        self._driven, self._since = driven, np.maximum(since, 0).tolist()
        for row, arm in enumerate(self._arms):
            if arm is not None and since[row] < len(driven):
                upper, lower = arm.bodies
                self.angles[row] = upper.angle, lower.angle - upper.angle

    def __getstate__(self) -> dict[str, Any]:
        """Configuration, angles, links and the rates since the resets: a Space itself cannot be copied."""
        since = [-1 if arm is None else start for arm, start in zip(self._arms, self._since, strict=True)]
        return {
            "config": self._config,
            "angles": self.angles,
            "links": self._links,
            "driven": self._driven,
            "since": np.array(since),
        }

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Drive new arms to the state of the copied ones."""
        self._config, self.angles, self._links = kept["config"], kept["angles"], kept["links"]
        self._drive_again(kept["driven"], kept["since"], self._links)

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
