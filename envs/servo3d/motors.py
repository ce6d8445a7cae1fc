"""Compiled motors and gears of serial arms: limits, lag, backlash, and sag under gravity."""

from __future__ import annotations

import math

import numpy as np

from servotrack.envs.servo3d.episode import PERIOD
from servotrack.envs.servo3d.kinematics import axes_now, gravity_torques
from servotrack.estimators.compilation import njit


@njit(cache=True, nogil=True)
def move(rows, arm, settings, lags, actions, steps, state):  # type: ignore[no-untyped-def]
    """Advance the motors of the chosen rows by one period and count their steps.

    Args:
        rows: Mask of the rows. Shape (N,).
        arm: An `ArmTables`.
        settings: A `WorldSettings`.
        lags: Time constants of the motors. Shape (N,), s.
        actions: Fractions of the rate limit. Shape (N, n).
        steps: Steps since the reset. Shape (N,); changed.
        state: An `ArmState`; changed.
    """
    motors, rates, commands, at_limit = state.motors, state.rates, state.commands, state.at_limit
    lows, highs, max_rate, change = arm.low, arm.high, settings.max_rate, settings.max_acceleration * PERIOD
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        steps[i] += 1
        lag = lags[i]
        decay = math.exp(-PERIOD / lag) if lag > 0.0 else 0.0
        for j in range(actions.shape[1]):
            wanted = min(max(actions[i, j], -1.0), 1.0) * max_rate
            old = commands[i, j]
            command = min(max(wanted, old - change), old + change)
            # Exact solution of lag * rate' = command - rate over the period.
            difference = rates[i, j] - command
            angle = motors[i, j] + command * PERIOD + difference * lag * (1.0 - decay)
            rate = command + difference * decay
            low, high = lows[j], highs[j]
            stopped = angle <= low or angle >= high
            if stopped:
                # The mechanical stop takes all speed.
                angle = min(max(angle, low), high)
                rate = 0.0
                command = 0.0
            at_limit[i, j] = stopped
            motors[i, j] = angle
            rates[i, j] = rate
            commands[i, j] = command
    settle(rows, arm, settings, state)


@njit(cache=True, nogil=True)
def settle(rows, arm, settings, state):  # type: ignore[no-untyped-def]
    """Compute the joint angles of the links: motor angles behind backlash and sag.

    Args:
        rows: Mask of the rows. Shape (N,).
        arm: An `ArmTables`.
        settings: A `WorldSettings`.
        state: An `ArmState`; `geared` and `joints` change.
    """
    motors, geared, joints = state.motors, state.geared, state.joints
    n = motors.shape[1]
    axes, points, tool, masses = arm.axes, arm.points, arm.tool, arm.masses
    chain, pose, lines, torques = np.empty((3, 4)), np.empty((3, 4)), np.empty((n, 6)), np.empty(n)
    play, compliance = 0.5 * settings.backlash, settings.compliance
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        for j in range(n):
            motor = motors[i, j]
            angle = min(max(geared[i, j], motor - play), motor + play)
            geared[i, j] = angle
            joints[i, j] = angle
        if compliance > 0.0:
            axes_now(axes, points, tool, geared, i, chain, lines, pose)
            gravity_torques(lines, pose, masses, torques)
            for j in range(n):
                joints[i, j] += compliance * torques[j]
