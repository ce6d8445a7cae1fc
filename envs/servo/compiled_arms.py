"""Planar two-link arms in compiled code: Chipmunk's solver, written out for this arm, with the same bits.

pymunk's time goes into the latency of five substeps with twenty solver iterations for two bodies each. Here
`LANES` arms lie side by side in a table and every operation is done for all of them, which the compiler turns into
vector instructions. Each lane does the operations of Chipmunk 7 in Chipmunk's order, so the bits do not depend on the
number of arms.

The order of a substep: positions, then all constraints prepared in the order in which they are added to a Space
(motors, stops, pivots), then their impulses of the substep before, then the iterations over all constraints. No fused
multiply-add, no reordering.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pymunk
from numpy.typing import NDArray

from servotrack.envs.servo.arm import PIVOT_BIAS, SQUARE, rods_at_rest
from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.targets import JOINT_HIGH, JOINT_LOW, PERIOD, START
from servotrack.envs.state import State, entry
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Array, Labels

LANES = 16
"""Number of arms side by side in a block of the table."""
MOVING = 20
"""Number of quantities of an arm that change: two bodies' positions (x, y, angle) and velocities, and the impulses of
two motors, two stops and two pivots (x, y)."""

# Places of the quantities in a block, in units of lanes. A flat block with constant places is what lets the compiler
# see that they do not overlap.
_X1, _Y1, _A1, _VX1, _VY1, _W1 = (k * LANES for k in range(0, 6))
_X2, _Y2, _A2, _VX2, _VY2, _W2 = (k * LANES for k in range(6, 12))
_MOTOR1, _MOTOR2, _STOP1, _STOP2 = (k * LANES for k in range(12, 16))
_PX1, _PY1, _PX2, _PY2 = (k * LANES for k in range(16, 20))
# Constant for an episode: inverse masses and moments, distances from the centers of gravity to the pivots, and the
# inverse moments that the motors feel.
_M1, _I1, _M2, _I2, _HALF, _CENTER, _FELT1, _FELT2 = (k * LANES for k in range(20, 28))
# Prepared in each step or substep: rates, cosines and sines, biases, inverse masses that the pivots feel.
_RATE1, _RATE2, _COS1, _SIN1, _COS2, _SIN2, _BIAS1, _BIAS2 = (k * LANES for k in range(28, 36))
_K11, _K12, _K22, _BX1, _BY1, _L11, _L12, _L22, _BX2, _BY2 = (k * LANES for k in range(36, 46))
_FIELDS = 46


SOLVER = np.dtype(
    [
        ("substep", np.float64),
        ("substeps", np.int64),
        ("iterations", np.int64),
        ("impulse", np.float64),
        ("low", np.float64, 2),
        ("high", np.float64, 2),
        ("pivot", np.float64),
        ("stop", np.float64),
        ("two", np.float64),
    ],
    align=True,
)
"""Constants of the solver.

`substep`, duration of a substep, s; `substeps` per control period; `iterations` per substep; `impulse`, largest of a
motor in a substep, N m s; `low` and `high` joint stops, rad; `pivot` and `stop`, shares of the position errors of
pivots and stops that are corrected in a substep; `two`, see `rods_at_rest`.
"""


def solver(config: ServoConfig) -> NDArray[np.void]:
    """Return the solver's constants, (1,) record, with pymunk's defaults where the reference engine keeps them."""
    substep = PERIOD / config.substeps
    # The default is rounded to single precision on its way: it is read from a constraint.
    stop_bias = pymunk.RotaryLimitJoint(pymunk.Body(1.0, 1.0), pymunk.Body(1.0, 1.0), 0.0, 1.0).error_bias
    constants = np.zeros(1, SOLVER)
    constants["substep"], constants["substeps"] = substep, config.substeps
    constants["iterations"], constants["impulse"] = config.solver_iterations, config.max_motor_torque * substep
    constants["low"], constants["high"] = JOINT_LOW, JOINT_HIGH
    constants["pivot"], constants["stop"] = 1.0 - PIVOT_BIAS**substep, 1.0 - stop_bias**substep
    constants["two"] = SQUARE
    return constants


class CompiledArms:
    """N arms side by side in compiled code. Copies (`copy.deepcopy`, `pickle`) go on with the same bits.

    Args:
        config: Torque limit, substeps and solver iterations.
        count: Number of arms N.

    Attributes:
        angles: True joint angles, shape (N, 2), rad; updated by every `step`, never replaced.
        blocks: Quantities of `LANES` arms in each row, see the module's constants.
        solver: Constants of the solver, (1,) record `SOLVER`.
    """

    def __init__(self, config: ServoConfig, count: int) -> None:
        self.solver = solver(config)
        self.angles = np.tile(START, (count, 1))
        self.blocks = np.zeros((-(-count // LANES), _FIELDS * LANES))
        self._started, self._waiting = np.zeros(count, np.bool_), True

    def reset(self, rows: Labels, links: Array) -> None:
        """Restart the arms of rows (n,) with links (n, 2) m at the start pose. The other arms are not changed."""
        _start(rows, links, self.blocks, self.angles, self.solver)
        self.note_started(rows)

    def note_started(self, rows: Labels) -> None:
        """Note that the arms of rows (n,) were restarted, by `reset` or by a kernel that calls `start_arm`."""
        if self._waiting:
            self._started[rows] = True
            self._waiting = not self._started.all()

    def _lane(self, row: int) -> Array:
        """View of all quantities of an arm, shape (fields,)."""
        return self.blocks[row // LANES, row % LANES :: LANES]

    def step(self, rates: Array) -> None:
        """Drive all joints at `rates` (N, 2) rad/s for one control period and read the angles."""
        self.check_started()
        _move(self.blocks, rates, self.angles, self.solver)

    def check_started(self) -> None:
        """Raise a RuntimeError if an arm was never reset."""
        if self._waiting:
            raise RuntimeError(f"arms {np.flatnonzero(~self._started).tolist()} were never reset")

    def get_state(self) -> State:
        """Return what `set_state` needs besides the links: `bodies`, the quantities that change, (N, MOVING)."""
        return {"bodies": self._by_arm()[: len(self.angles)].copy()}

    def check_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Raise a ValueError for a state that `set_state` cannot use."""
        entry(state, "bodies", (len(self.angles), MOVING), np.float64)

    def set_state(self, state: Mapping[str, NDArray[Any]], links: Array) -> None:
        """Bring all arms into a state that `get_state` returned, with links (N, 2) m."""
        self.reset(np.arange(len(links)), links)
        bodies = state["bodies"]
        padded = np.zeros((len(self.blocks) * LANES, MOVING))
        padded[: len(bodies)] = bodies
        lanes = self.blocks.reshape(len(self.blocks), _FIELDS, LANES)
        lanes[:, :MOVING] = padded.reshape(len(self.blocks), LANES, MOVING).swapaxes(1, 2)
        self.angles[:, 0], self.angles[:, 1] = bodies[:, 2], bodies[:, 8] - bodies[:, 2]

    def _by_arm(self) -> Array:
        """Positions, velocities and impulses, shape (lanes, MOVING)."""
        lanes = self.blocks.reshape(len(self.blocks), _FIELDS, LANES)
        return lanes[:, :MOVING].swapaxes(1, 2).reshape(-1, MOVING)

    def tool_gap(self) -> float:
        """Largest gap between two ends that a pivot holds together, m: the solver's error."""
        worst = 0.0
        for row in np.flatnonzero(self._started).tolist():
            lane = self._lane(row)
            (x1, y1, a1), (x2, y2, a2), half, center = lane[:3], lane[6:9], lane[MOVING + 4], lane[MOVING + 5]
            c1, s1, c2, s2 = math.cos(a1), math.sin(a1), math.cos(a2), math.sin(a2)
            base = math.hypot(x1 - half * c1, y1 - half * s1)
            elbow = math.hypot(x2 - center * c2 - x1 - half * c1, y2 - center * s2 - y1 - half * s1)
            worst = max(worst, base, elbow)
        return worst


@njit(cache=True, nogil=True)
def _start(rows, links, blocks, angles, solver):  # type: ignore[no-untyped-def]
    """Write arms at rest into their lanes."""
    for n in range(len(rows)):
        start_arm(rows[n], links[n], blocks, angles, solver[0])


@njit(cache=True, nogil=True)
def start_arm(row, links, blocks, angles, constants):  # type: ignore[no-untyped-def]
    """Write an arm at rest into its lane.

    Args:
        row: Index of the arm.
        links: Link lengths of this arm, (2,) m.
        blocks: Quantities of all arms, (blocks, fields x LANES).
        angles: Joint angles of all arms, the row overwritten, (N, 2) rad.
        constants: Constants of the solver, a record `SOLVER`.
    """
    s, k = blocks[row // LANES], row % LANES
    rods = rods_at_rest(links[0], links[1], constants.two)
    for field in range(_FIELDS):
        s[field * LANES + k] = 0.0
    s[_X1 + k], s[_Y1 + k] = rods.positions[0]
    s[_X2 + k], s[_Y2 + k] = rods.positions[1]
    s[_A1 + k], s[_A2 + k] = rods.angles
    i1, i2 = 1.0 / rods.moments[0], 1.0 / rods.moments[1]
    s[_M1 + k], s[_I1 + k], s[_M2 + k], s[_I2 + k] = 1.0 / rods.masses[0], i1, 1.0 / rods.masses[1], i2
    s[_HALF + k], s[_CENTER + k] = rods.half, rods.center
    s[_FELT1 + k], s[_FELT2 + k] = 1.0 / i1, 1.0 / (i1 + i2)
    angles[row, 0], angles[row, 1] = START[0], START[1]


@njit(cache=True, nogil=True)
def _move(blocks, rates, angles, solver):  # type: ignore[no-untyped-def]
    """Drive all arms for one control period."""
    move_blocks(blocks, rates, angles, solver, 0, blocks.shape[0])


@njit(cache=True, nogil=True)
def move_blocks(blocks, rates, angles, solver, first, last):  # type: ignore[no-untyped-def]
    """Drive the arms of the blocks from `first` to before `last` for one control period.

    Args:
        blocks: Quantities of all arms, (blocks, fields x LANES).
        rates: Joint rates, (N, 2) rad/s.
        angles: Joint angles, overwritten, (N, 2) rad.
        solver: Constants, (1,) record `SOLVER`.
        first: First block.
        last: Block after the last one.
    """
    constants = solver[0]
    impulse = constants.impulse
    for block in range(first, last):
        s, row = blocks[block], block * LANES
        lanes = min(LANES, rates.shape[0] - row)
        for k in range(lanes):
            # Chipmunk's motors turn the second body against the sign of their rate.
            s[_RATE1 + k] = -rates[row + k, 0]
            s[_RATE2 + k] = -rates[row + k, 1]
        for _ in range(constants.substeps):
            _prepare(s, lanes, constants)
            for _iteration in range(constants.iterations):
                _iterate(s, lanes, impulse)
        for k in range(lanes):
            angles[row + k, 0] = s[_A1 + k]
            angles[row + k, 1] = s[_A2 + k] - s[_A1 + k]


@njit(cache=True, nogil=True)
def _excess(angle, low, high):  # type: ignore[no-untyped-def]
    """Angle from a joint to the stop that it has passed, 0 between the stops."""
    if angle > high:
        return high - angle
    if angle < low:
        return low - angle
    return 0.0


@njit(cache=True, nogil=True)
def _prepare(s, lanes, solver):  # type: ignore[no-untyped-def]
    """Advance positions by a substep, prepare the constraints and apply their impulses of the substep before."""
    dt, stop = solver.substep, solver.stop
    low1, low2, high1, high2 = solver.low[0], solver.low[1], solver.high[0], solver.high[1]
    for k in range(lanes):
        s[_X1 + k] += s[_VX1 + k] * dt
        s[_Y1 + k] += s[_VY1 + k] * dt
        s[_A1 + k] += s[_W1 + k] * dt
        s[_X2 + k] += s[_VX2 + k] * dt
        s[_Y2 + k] += s[_VY2 + k] * dt
        s[_A2 + k] += s[_W2 + k] * dt
    # Calls of the mathematics library are not vectorized: they get a loop of their own.
    for k in range(lanes):
        s[_COS1 + k], s[_SIN1 + k] = math.cos(s[_A1 + k]), math.sin(s[_A1 + k])
        s[_COS2 + k], s[_SIN2 + k] = math.cos(s[_A2 + k]), math.sin(s[_A2 + k])
    pull = -solver.pivot / dt
    for k in range(lanes):
        m1, i1, m2, i2 = s[_M1 + k], s[_I1 + k], s[_M2 + k], s[_I2 + k]
        a1 = s[_A1 + k]
        bias1 = -stop * _excess(a1, low1, high1) / dt
        bias2 = -stop * _excess(s[_A2 + k] - a1, low2, high2) / dt
        s[_BIAS1 + k], s[_BIAS2 + k] = bias1, bias2
        # A stop that is not touched forgets its impulse.
        stop1 = 0.0 if bias1 == 0.0 else s[_STOP1 + k]
        stop2 = 0.0 if bias2 == 0.0 else s[_STOP2 + k]
        s[_STOP1 + k], s[_STOP2 + k] = stop1, stop2

        # Shoulder, from the first rod's center of gravity. The ground adds its zeros in Chipmunk, so no term is lost.
        rx, ry = s[_COS1 + k] * -s[_HALF + k], s[_SIN1 + k] * -s[_HALF + k]
        k11, k12, k22 = m1 + ry * ry * i1, -rx * ry * i1 + 0.0, m1 + rx * rx * i1
        scale = 1.0 / (k11 * k22 - k12 * k12)
        s[_K11 + k], s[_K12 + k], s[_K22 + k] = k22 * scale, -k12 * scale, k11 * scale
        s[_BX1 + k], s[_BY1 + k] = (s[_X1 + k] + rx) * pull, (s[_Y1 + k] + ry) * pull

        # Elbow, from both centers of gravity.
        ux, uy = s[_COS1 + k] * s[_HALF + k], s[_SIN1 + k] * s[_HALF + k]
        qx, qy = s[_COS2 + k] * -s[_CENTER + k], s[_SIN2 + k] * -s[_CENTER + k]
        k11, k12, k22 = m1 + m2 + uy * uy * i1, -ux * uy * i1 + 0.0, m1 + m2 + ux * ux * i1
        k11, k12, k22 = k11 + qy * qy * i2, k12 + -qx * qy * i2, k22 + qx * qx * i2
        scale = 1.0 / (k11 * k22 - k12 * k12)
        s[_L11 + k], s[_L12 + k], s[_L22 + k] = k22 * scale, -k12 * scale, k11 * scale
        s[_BX2 + k] = (s[_X2 + k] + qx - (s[_X1 + k] + ux)) * pull
        s[_BY2 + k] = (s[_Y2 + k] + qy - (s[_Y1 + k] + uy)) * pull

        w1, w2 = s[_W1 + k] + s[_MOTOR1 + k] * i1, s[_W2 + k]
        j = s[_MOTOR2 + k]
        w1, w2 = w1 - j * i1, w2 + j * i2
        w1 += stop1 * i1
        w1, w2 = w1 - stop2 * i1, w2 + stop2 * i2
        jx, jy = s[_PX1 + k], s[_PY1 + k]
        vx1, vy1, w1 = s[_VX1 + k] + jx * m1, s[_VY1 + k] + jy * m1, w1 + i1 * (rx * jy - ry * jx)
        jx, jy = s[_PX2 + k], s[_PY2 + k]
        s[_VX1 + k], s[_VY1 + k] = vx1 - jx * m1, vy1 - jy * m1
        s[_W1 + k] = w1 + i1 * (ux * -jy - uy * -jx)
        s[_VX2 + k] += jx * m2
        s[_VY2 + k] += jy * m2
        s[_W2 + k] = w2 + i2 * (qx * jy - qy * jx)


@njit(cache=True, nogil=True)
def _stopped(impulse, bias):  # type: ignore[no-untyped-def]
    """Impulse of a stop: it pushes only back into the range, and not at all inside."""
    if bias == 0.0:
        return 0.0
    return max(impulse, 0.0) if bias < 0.0 else min(impulse, 0.0)


@njit(cache=True, nogil=True)
def _iterate(s, lanes, limit):  # type: ignore[no-untyped-def]
    """Solve every constraint once."""
    for k in range(lanes):
        m1, i1, m2, i2 = s[_M1 + k], s[_I1 + k], s[_M2 + k], s[_I2 + k]
        felt1, felt2, bias1, bias2 = s[_FELT1 + k], s[_FELT2 + k], s[_BIAS1 + k], s[_BIAS2 + k]
        vx1, vy1, w1 = s[_VX1 + k], s[_VY1 + k], s[_W1 + k]
        vx2, vy2, w2 = s[_VX2 + k], s[_VY2 + k], s[_W2 + k]
        rx, ry = s[_COS1 + k] * -s[_HALF + k], s[_SIN1 + k] * -s[_HALF + k]
        ux, uy = s[_COS1 + k] * s[_HALF + k], s[_SIN1 + k] * s[_HALF + k]
        qx, qy = s[_COS2 + k] * -s[_CENTER + k], s[_SIN2 + k] * -s[_CENTER + k]

        # Motors
        old = s[_MOTOR1 + k]
        new = min(max(old - (w1 + s[_RATE1 + k]) * felt1, -limit), limit)
        s[_MOTOR1 + k] = new
        w1 += (new - old) * i1
        old = s[_MOTOR2 + k]
        new = min(max(old - (w2 - w1 + s[_RATE2 + k]) * felt2, -limit), limit)
        s[_MOTOR2 + k] = new
        w1, w2 = w1 - (new - old) * i1, w2 + (new - old) * i2

        # Stops
        old = s[_STOP1 + k]
        new = _stopped(old - (bias1 + w1) * felt1, bias1)
        s[_STOP1 + k] = new
        w1 += (new - old) * i1
        old = s[_STOP2 + k]
        new = _stopped(old - (bias2 + (w2 - w1)) * felt2, bias2)
        s[_STOP2 + k] = new
        w1, w2 = w1 - (new - old) * i1, w2 + (new - old) * i2

        # Shoulder
        tx, ty = s[_BX1 + k] - (vx1 + -ry * w1), s[_BY1 + k] - (vy1 + rx * w1)
        ox, oy = s[_PX1 + k], s[_PY1 + k]
        px, py = ox + (tx * s[_K11 + k] + ty * s[_K12 + k]), oy + (tx * s[_K12 + k] + ty * s[_K22 + k])
        s[_PX1 + k], s[_PY1 + k] = px, py
        jx, jy = px - ox, py - oy
        vx1, vy1, w1 = vx1 + jx * m1, vy1 + jy * m1, w1 + i1 * (rx * jy - ry * jx)

        # Elbow
        tx = s[_BX2 + k] - (vx2 + -qy * w2 - (vx1 + -uy * w1))
        ty = s[_BY2 + k] - (vy2 + qx * w2 - (vy1 + ux * w1))
        ox, oy = s[_PX2 + k], s[_PY2 + k]
        px, py = ox + (tx * s[_L11 + k] + ty * s[_L12 + k]), oy + (tx * s[_L12 + k] + ty * s[_L22 + k])
        s[_PX2 + k], s[_PY2 + k] = px, py
        jx, jy = px - ox, py - oy
        s[_VX1 + k], s[_VY1 + k] = vx1 + -jx * m1, vy1 + -jy * m1
        s[_W1 + k] = w1 + i1 * (ux * -jy - uy * -jx)
        s[_VX2 + k], s[_VY2 + k] = vx2 + jx * m2, vy2 + jy * m2
        s[_W2 + k] = w2 + i2 * (qx * jy - qy * jx)
