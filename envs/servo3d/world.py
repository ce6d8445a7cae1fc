"""The state of N serial arms with their cameras, stepped together by compiled kernels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.servo3d.arms import SerialArm, arm_of
from servotrack.envs.servo3d.episode import LEAD, PERIOD, Episode, draw_episode, layout_parts, samples
from servotrack.envs.servo3d.kinematics import largest_torque
from servotrack.envs.servo3d.levels import Servo3DConfig
from servotrack.envs.servo3d.motors import move, settle
from servotrack.envs.servo3d.sensing import begin, sense
from servotrack.envs.servo3d.state import (
    ANGLE_BOUND,
    DISTANCE_BOUND,
    RING,
    ArmState,
    EpisodeTables,
    Sample,
    WorldSettings,
)
from servotrack.envs.servo3d.truth import true_matrices
from servotrack.envs.state import State, entry, part, put, taken
from servotrack.estimators.types import Array, Mask


class Servo3DWorld:
    """N serial arms with uncalibrated cameras.

    Args:
        config: Parameters.
        count: Number of arms N.

    Attributes:
        steps: Steps since the reset. Shape (N,).
        state: Arms, see `ArmState`.
        sample: Newest sample, see `Sample`: `tip_error` (m) and `tip_angle` (rad) between the tool's pose and the
            goal's; `error`, both in units of their bounds, combined as the root of their squares' sum; `feature_error`,
            mean distance of the true points from the goal (px).
        reward: Rewards of the newest step. Shape (N,).
        terminated: True where the board was out of view for too long. Shape (N,).
        truncated: True where the horizon is reached. Shape (N,).
        episodes: Draws of each row's episode, None before the first reset.
    """

    def __init__(self, config: Servo3DConfig, count: int) -> None:
        self.config, self.count = config, count
        self.arm: SerialArm = arm_of(config.arm)
        n, p, length = self.arm.joints, config.points, samples(config)
        self.episodes: list[Episode | None] = [None] * count
        self.steps, self.seeds = np.zeros(count, np.int64), np.full(count, -1)
        self.state = ArmState(
            motors=np.zeros((count, n)),
            rates=np.zeros((count, n)),
            commands=np.zeros((count, n)),
            joints=np.zeros((count, n)),
            geared=np.zeros((count, n)),
            motor_history=np.zeros((RING, count, n)),
            at_limit=np.zeros((count, n), np.bool_),
            tool=np.zeros((count, 3, 4)),
            goal_joints=np.zeros((count, n)),
            goal_tool=np.zeros((count, 3, 4)),
            placed=np.zeros((count, p, 3)),
            target=np.zeros((count, p, 3)),
            depth=np.zeros(count),
            images=np.zeros((RING, count, 2 * p)),
            in_image=np.zeros((RING, count, p), np.bool_),
        )
        self.tables = EpisodeTables(
            optics=np.zeros((count, 5)),
            mount=np.zeros((count, 3, 4)),
            board=np.zeros((count, 3, 4)),
            marks=np.zeros((count, p, 3)),
            motion=np.zeros((count, n, 4)),
            feature_noise=np.zeros((count, length if config.pixel_noise > 0.0 else 0, 2 * p)),
            dropped=np.zeros((count, length if config.dropout > 0.0 else 0), np.bool_),
            hidden=np.zeros((count, length if config.hiding > 0.0 and p > 2 else 0, p), np.bool_),
            homing=np.zeros((count, n)),
            lag=np.zeros(count),
            latency=np.zeros(count, np.int64),
            encoder_age=np.zeros(count, np.int64),
        )
        self.sample = Sample(
            time=np.zeros(count),
            tip_error=np.zeros(count),
            tip_angle=np.zeros(count),
            error=np.zeros(count),
            feature_error=np.zeros(count),
            out_of_view=np.zeros(count, np.int64),
            reward=np.zeros(count),
            terminated=np.zeros(count, np.bool_),
            truncated=np.zeros(count, np.bool_),
            joint_angles=np.zeros((count, n)),
            joint_time=np.zeros(count),
            features=np.zeros((count, 2 * p)),
            visible=np.zeros((count, p)),
            goal=np.zeros((count, 2 * p)),
            frame_time=np.zeros(count),
        )
        self._arm, self._layouts = self.arm.tables(), layout_parts(config, self.arm)
        torque = largest_torque(self._arm)
        self._settings = WorldSettings(
            in_hand=config.camera == "hand",
            moving=config.motion > 0.0,
            horizon=config.horizon,
            max_rate=config.max_joint_rate,
            max_acceleration=config.max_joint_acceleration,
            backlash=config.backlash,
            # An arm without masses does not sag.
            compliance=config.sag / torque if torque > 0.0 else 0.0,
            encoder_steps=config.encoder_steps,
            stamped=config.stamped,
        )
        self.reward, self.terminated, self.truncated = (
            self.sample.reward,
            self.sample.terminated,
            self.sample.truncated,
        )
        self._all_rows = np.ones(count, np.bool_)

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> None:
        """Start new episodes in some rows. The other rows are not changed.

        Args:
            rows: Indices of the rows, 0 to N - 1.
            seeds: Episode seed of each of these rows, non-negative integers.
        """
        chosen = np.zeros(self.count, np.bool_)
        for row, seed in zip(rows, seeds, strict=True):
            self._begin(row, seed)
            chosen[row] = True
        settle(chosen, self._arm, self._settings, self.state)
        begin(chosen, self._arm, self._settings, self.tables, self.state, self.sample)
        self._sense(chosen)

    def step(self, actions: Array, rows: Mask | None = None) -> None:
        """Advance rows by one control period.

        Args:
            actions: Fractions of `max_joint_rate`, clipped to [-1, 1] joint by joint. Shape (N, n).
            rows: Mask of the rows whose episode is running, shape (N,); None for all. The others do not move.
        """
        rows = self._all_rows if rows is None else rows
        move(rows, self._arm, self._settings, self.tables.lag, actions, self.steps, self.state)
        self._sense(rows)

    def success(self) -> Mask:
        """True where the tool is within both bounds of the goal. Shape (N,)."""
        return (self.sample.tip_error < DISTANCE_BOUND) & (self.sample.tip_angle < ANGLE_BOUND)

    def _begin(self, row: int, seed: int) -> None:
        episode = draw_episode(self.config, self.arm, seed, self._layouts)
        self.episodes[row], self.seeds[row] = episode, seed
        for name in EpisodeTables._fields:
            getattr(self.tables, name)[row] = getattr(episode, name)
        state = self.state
        for name in ("motors", "geared", "joints"):
            getattr(state, name)[row] = episode.start
        state.rates[row], state.commands[row], state.at_limit[row] = 0.0, 0.0, False
        sample = self.sample
        self.steps[row] = 0
        sample.out_of_view[row] = 0
        # Before they are first seen, points are reported in the middle of the image.
        sample.features[row] = np.tile([self.config.width / 2.0, self.config.height / 2.0], self.config.points)
        sample.frame_time[row] = -LEAD * PERIOD

    def _sense(self, rows: Mask) -> None:
        sense(rows, self._arm, self._settings, self.tables, self.steps, self.state, self.sample)

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, and what has happened since their resets."""
        state = taken(self, ("seeds", "steps"))
        state |= {f"sample/{name}": value.copy() for name, value in self.sample._asdict().items()}
        return state | {f"arm/{name}": by_row.copy() for name, by_row in self._state_by_row().items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Episodes of other seeds are drawn again.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        seeds, steps = (entry(state, name, (self.count,), np.int64) for name in ("seeds", "steps"))
        if seeds.min() < 0 or steps.min() < 0 or steps.max() > self.config.horizon:
            raise ValueError(f"state's seeds must be at least 0 and its steps lie in 0 to {self.config.horizon}")
        others = np.flatnonzero(self.seeds != seeds)
        self.reset(others.tolist(), seeds[others].tolist())
        put(self, ("steps",), state)
        put(self.sample, Sample._fields, part(state, "sample"))
        for name, by_row in self._state_by_row().items():
            by_row[...] = entry(state, f"arm/{name}", by_row.shape, by_row.dtype)

    def _state_by_row(self) -> dict[str, NDArray[Any]]:
        """Views of the arms' state with a leading axis of N; rings have it behind the time."""
        views = self.state._asdict()
        return views | {name: views[name].swapaxes(0, 1) for name in ("motor_history", "images", "in_image")}

    @property
    def episode_steps(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.horizon

    def privileged(self) -> dict[str, Array]:
        """Additional observations for calibrated and privileged agents, arrays of N rows.

        Returns:
            `true_jacobian` (N, 2p, n + 1) of the features at the present joint angles, px/rad, last column px/s;
            `goal_velocity` (N, 2p) of the goal's features, px/s; `true_interaction` and `goal_interaction` (N, 2p, 6),
            px/m and px/rad, of the present points and of the goal's (Chaumette and Hutchinson 2006, eq. 11);
            `twist_jacobian` (N, 6, n), velocity (m/s) and angular velocity (rad/s) of the camera relative to the board
            in the camera's frame, per joint rate; `true_joint_angles` and `goal_joint_angles` (N, n) rad;
            `true_optics` (N, 5) px; `true_marks` (N, 3p) m.
        """
        return true_matrices(self._arm, self._settings, self.tables, self.sample.time, self.state)

    def debug_view(self, row: int = 0) -> str:
        """State of one row as text, for debugging."""
        sample = self.sample
        return (
            f"t={sample.time[row]:.2f} s  joints={np.degrees(self.state.joints[row]).round(1)} deg  "
            f"tip error={1e3 * sample.tip_error[row]:.2f} mm, {math.degrees(sample.tip_angle[row]):.2f} deg  "
            f"feature error={sample.feature_error[row]:.1f} px  visible={sample.visible[row].astype(int)}"
        )
