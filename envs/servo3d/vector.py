"""N serial-arm servos as a Gymnasium vector environment, bit-identical to N single environments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from gymnasium.vector import AutoresetMode

from servotrack.envs.actions import check_actions
from servotrack.envs.arguments import check_count
from servotrack.envs.servo3d.env import (
    METADATA,
    Observation,
    action_space,
    all_infos,
    all_observations,
    observation_space,
)
from servotrack.envs.servo3d.levels import servo3d_config
from servotrack.envs.servo3d.world import Servo3DWorld
from servotrack.envs.vector_env import BatchedVectorEnv, masked_infos
from servotrack.estimators.types import Array, Mask

if TYPE_CHECKING:
    from servotrack.envs.servo3d.recorder import Recorder


class UncalibServo3DVectorEnv(BatchedVectorEnv):
    """N `UncalibServo3D-v0` environments in one, created by `gym.make_vec("UncalibServo3D-v0", num_envs=N)`.

    Args:
        num_envs: Number of arms N.
        level: Level of difficulty, 0 to 6.
        render_mode: None or `rgb_array`; `render` returns a tuple of N frames.
        autoreset_mode: NEXT_STEP, SAME_STEP or DISABLED, as a Gymnasium `AutoresetMode` or its value.
        max_episode_steps: Largest number of steps of an episode, like the argument of `gym.make`.
        **axes: Fields of `Servo3DConfig` that override the level's values.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]
    world: Servo3DWorld

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 2,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        **axes: Any,
    ) -> None:
        count = check_count(num_envs)
        self.config = servo3d_config(level, **axes)
        self.level = level
        world = Servo3DWorld(self.config, count)
        self.max_joint_rate = self.config.max_joint_rate
        self.max_joint_acceleration = self.config.max_joint_acceleration
        self.joint_low, self.joint_high = world.arm.low, world.arm.high
        super().__init__(
            world,
            count,
            action_space(world.arm.joints),
            observation_space(self.config, world.arm),
            metadata=type(self).metadata,
            render_mode=render_mode,
            autoreset_mode=autoreset_mode,
            max_episode_steps=max_episode_steps,
        )

    def _observe(self) -> Observation:
        return all_observations(self.world)

    def _checked(self, actions: Any) -> Array:
        return check_actions(actions, (self.num_envs, self.world.arm.joints))

    def _recorder(self, row: int) -> Recorder:
        from servotrack.envs.servo3d.recorder import Recorder, level_caption

        return Recorder(self.world, row, level_caption(self.config, self.level))

    def _infos(self, chosen: Mask) -> dict[str, Any]:
        return masked_infos(all_infos(self.world), chosen)
