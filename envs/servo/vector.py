"""N arm servos stepped together as a Gymnasium vector environment, bit-identical to N single environments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from servotrack.envs.actions import check_actions
from servotrack.envs.arguments import check_count
from servotrack.envs.servo.engine import chosen_engine
from servotrack.envs.servo.env import METADATA, Observation, action_space, feature_observations, feature_space
from servotrack.envs.servo.levels import ServoConfig, reach_config, servo_config
from servotrack.envs.servo.world import SUCCESS_DISTANCE, ServoWorld
from servotrack.envs.vector_env import BatchedVectorEnv, masked_infos
from servotrack.estimators.types import Array, Mask

if TYPE_CHECKING:
    from servotrack.envs.servo.recorder import Recorder


class UncalibServoVectorEnv(BatchedVectorEnv):
    """N `UncalibServo-v0` environments in one, created by `gym.make_vec("UncalibServo-v0", num_envs=N)`.

    Args:
        num_envs: Number of arms N.
        level: Level of difficulty, 0 to 6.
        render_mode: None or `rgb_array`; `render` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Largest number of steps of an episode, like the argument of `gym.make`.
        engine: `pymunk`, `compiled` (same bits, many times as fast), or None for `compiled` where a check at first use
            finds that its bits are pymunk's on this machine, and `pymunk` elsewhere.
        threads: Number of threads that share a step of the compiled engine. The results do not depend on it; more than
            one pays from some hundred arms on.
        **axes: Fields of `ServoConfig` that override the level's values.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]
    world: ServoWorld

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 3,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        engine: str | None = None,
        threads: int = 1,
        **axes: Any,
    ) -> None:
        count = check_count(num_envs)
        self.engine, self.threads = chosen_engine(engine, "compiled"), check_count(threads, "threads")
        self.config = self._configure(level, axes)
        self.level = level
        self.max_joint_rate = self.config.max_joint_rate
        super().__init__(
            self._make_world(count),
            count,
            action_space(),
            self._single_observation_space(),
            metadata=type(self).metadata,
            render_mode=render_mode,
            autoreset_mode=autoreset_mode,
            max_episode_steps=max_episode_steps,
        )

    def _configure(self, level: int, axes: dict[str, Any]) -> ServoConfig:
        return servo_config(level, **axes)

    def _make_world(self, count: int) -> ServoWorld:
        return ServoWorld(self.config, count, engine=self.engine, threads=self.threads)

    def _single_observation_space(self) -> gym.spaces.Dict:
        return feature_space(self.config)

    def _observe(self) -> Observation:
        return feature_observations(self.world)

    def _step_and_restart(self, actions: Array, waiting: Mask) -> None:
        # In one go, so that threads share it.
        rows, seeds = self._drawn_seeds(waiting)
        self.world.step(actions, ~waiting, np.array(rows), np.array(seeds))
        self._over = self._over & ~waiting

    def _checked(self, actions: Any) -> Array:
        return check_actions(actions, (self.num_envs, 2))

    def _recorder(self, row: int) -> Recorder:
        from servotrack.envs.servo.recorder import Recorder, level_caption

        return Recorder(self.world, row, level_caption(self.level))

    def _infos(self, chosen: Mask) -> dict[str, Any]:
        return masked_infos(self._all_infos(), chosen)

    def _all_infos(self) -> dict[str, Any]:
        """Info of all rows: arrays, or dictionaries of arrays, with a leading axis of N."""
        world = self.world
        success = world.tracking_error < SUCCESS_DISTANCE
        return {
            "tracking_error": world.tracking_error,
            "feature_error": world.feature_error,
            "success": success,
            "is_success": success,
            "truth": {
                "joint_angles": world.joints,
                "tool": world.tool,
                "target": world.target[:, :2],
                "target_velocity": world.target[:, 2:],
            },
        }


class UncalibServoReachVectorEnv(UncalibServoVectorEnv):
    """N `UncalibServoReach-v0` environments in one."""

    def _configure(self, level: int, axes: dict[str, Any]) -> ServoConfig:
        return reach_config(level, **axes)
