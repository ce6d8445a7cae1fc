"""N arms over N crowds as a Gymnasium vector environment, bit-identical to N single environments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym

from servotrack.envs.follow.config import FollowConfig, follow_config
from servotrack.envs.follow.env import METADATA, level_caption, people_now, pictured
from servotrack.envs.follow.sensors import FollowSensors
from servotrack.envs.follow.world import ON_TARGET_DISTANCE, FollowWorld
from servotrack.envs.servo.env import Observation
from servotrack.envs.servo.vector import UncalibServoVectorEnv
from servotrack.envs.state import Stateful

if TYPE_CHECKING:
    from servotrack.envs.follow.recorder import Recorder


class PedestrianServoVectorEnv(UncalibServoVectorEnv):
    """N `PedestrianServo-v0` environments in one, created by `gym.make_vec("PedestrianServo-v0", num_envs=N)`.

    Args:
        num_envs: Number of arms N.
        level: Level of difficulty, 0 to 6.
        observation: Kind of observation: `detections`, `pixels` or `identity`.
        image_size: Width and height of images, px.
        image_noise: Standard deviation of the noise on every pixel and channel, gray levels.
        **arguments: Arguments of `UncalibServoVectorEnv`, and fields of `FollowConfig`.
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
        self._sensor_arguments = observation, image_size, image_noise
        super().__init__(num_envs, level, **arguments)

    def _configure(self, level: int, axes: dict[str, Any]) -> FollowConfig:
        return follow_config(level, **axes)

    def _make_world(self, count: int) -> FollowWorld:
        world = FollowWorld(self.config, count, self.engine, self.threads)
        self._sensors = FollowSensors(world, *self._sensor_arguments)
        return world

    def _single_observation_space(self) -> gym.spaces.Dict:
        return self._sensors.space()

    def _observe(self) -> Observation:
        return self._sensors.observe()

    def _recorder(self, row: int) -> Recorder:  # type: ignore[override]
        from servotrack.envs.follow.recorder import Recorder

        return Recorder(self.world, row, level_caption(self.level))

    def _parts(self) -> dict[str, Stateful]:
        return {**super()._parts(), "sensors": self._sensors}

    def _pictured(self, row: int) -> dict[str, Any]:
        return pictured(self._sensors, row)

    def _all_infos(self) -> dict[str, Any]:
        world, infos = self.world, super()._all_infos()
        infos["truth"]["people"] = people_now(world)
        success = world.tracking_error < ON_TARGET_DISTANCE
        return infos | {
            "success": success,
            "is_success": success,
            "time_on_target": world.time_on_target,
            "identity_error": world.identity_error,
            "lost": world.lost,
            "losses": world.losses,
            "reacquisitions": world.reacquisitions,
            "kept": world.kept,
        }

    def privileged(self) -> Observation:
        """Entries that `VectorPrivilegedObservation` adds to observations, with a leading axis of N."""
        return self.world.privileged() | self._sensors.privileged()
