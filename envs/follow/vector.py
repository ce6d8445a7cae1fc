"""N arms over N crowds as a Gymnasium vector environment, bit for bit the single one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym

from servotrack.envs.follow.config import FollowConfig, follow_config
from servotrack.envs.follow.env import METADATA, level_caption, people_now, pictured
from servotrack.envs.follow.sensors import FollowSensors
from servotrack.envs.follow.world import ON_TARGET, FollowWorld
from servotrack.envs.servo.env import Observation
from servotrack.envs.servo.vector import UncalibServoVectorEnv

if TYPE_CHECKING:
    from servotrack.envs.follow.recorder import Recorder


class PedestrianServoVectorEnv(UncalibServoVectorEnv):
    """`PedestrianServo-v0`, N at a time: what `gym.make_vec("PedestrianServo-v0", num_envs=N)` makes.

    Args:
        num_envs: Number of arms N.
        level: As in `PedestrianServoEnv`.
        observation: As in `PedestrianServoEnv`.
        image_size: As in `PedestrianServoEnv`.
        image_noise: As in `PedestrianServoEnv`.
        **arguments: As in `UncalibServoVectorEnv`, axes as in `PedestrianServoEnv`.
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    config: FollowConfig
    world: FollowWorld

    def __init__(
        self,
        num_envs: int = 1,
        level: int = 2,
        *,
        observation: str = "detections",
        image_size: int = 128,
        image_noise: float = 3.0,
        **arguments: Any,
    ) -> None:
        self._sees = observation, image_size, image_noise
        super().__init__(num_envs, level, **arguments)

    def _configure(self, level: int, axes: dict[str, Any]) -> FollowConfig:
        return follow_config(level, **axes)

    def _make_world(self, count: int) -> FollowWorld:
        world = FollowWorld(self.config, count)
        self._sensors = FollowSensors(world, *self._sees)
        return world

    def _single_observation_space(self) -> gym.spaces.Dict:
        return self._sensors.space()

    def _observe(self) -> Observation:
        return self._sensors.observe()

    def _recorder(self, row: int) -> Recorder:  # type: ignore[override]
        from servotrack.envs.follow.recorder import Recorder

        return Recorder(self.world, row, level_caption(self.level))

    def _pictured(self, row: int) -> dict[str, Any]:
        return pictured(self._sensors, row)

    def _told(self) -> dict[str, Any]:
        world, told = self.world, super()._told()
        told["truth"]["people"] = people_now(world)
        return told | {
            "success": world.tracking_error < ON_TARGET,
            "time_on_target": world.time_on_target,
            "identity_error": world.identity_error,
            "lost": world.lost,
            "losses": world.losses,
            "reacquisitions": world.reacquisitions,
            "kept": world.kept,
        }

    def privileged(self) -> Observation:
        """What `VectorPrivilegedObservation` adds, with a leading axis of N."""
        return self.world.privileged() | self._sensors.privileged()
