"""The arm's camera over a walking crowd as a Gymnasium environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from servotrack.envs.follow.config import LEVEL_NAMES, FollowConfig, follow_config
from servotrack.envs.follow.sensors import FollowSensors
from servotrack.envs.follow.world import ON_TARGET_DISTANCE, FollowWorld
from servotrack.envs.servo.env import METADATA as SERVO_METADATA
from servotrack.envs.servo.env import Observation, UncalibServoEnv
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.state import Stateful
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from servotrack.envs.follow.recorder import Recorder

METADATA: dict[str, Any] = SERVO_METADATA | {"servotrack_kind": "follow"}
_COUNTED = ("time_on_target", "identity_error", "lost", "losses", "reacquisitions", "kept")
"""Attributes of the world that `info` holds under the same name."""


class PedestrianServoEnv(UncalibServoEnv):
    """An arm with an uncalibrated camera keeps one person of a walking crowd centered.

    ## Description

    The arm of `UncalibServo-v0` at four times its scale (links of 2 m, the camera 4 m up, 80 px to the meter) carries
    its camera over a plane on which people walk, driven by social forces. At reset the agent gets a picture of one of
    them. It has to keep this person under the tool while people cross, merge into one detection, wear the same clothes,
    or are occluded by lampshades and umbrellas. The tracker's estimate decides where the camera looks next. People are
    drawn from above and flat on the plane, without the parallax of their height.

    | level | adds to the arm | adds to the crowd |
    |---|---|---|
    | 0 `plain` | fixed links (2 m) and camera, no noise | 6 people, all detected |
    | 1 `noise` | 2 px of noise | misses, false detections, people closer than 0.4 m are one detection |
    | 2 `geometry` | random links, focal length, height; mounting within 30 degrees; 3 px | |
    | 3 `optics` | any mounting angle, principal point, distortion, tilt, aspect | one in five dressed alike |
    | 4 `dynamics` | noisy joint rates and encoders, lost frames | three lampshades, an umbrella |
    | 5 `timing` | one frame of latency, rolling shutter | a companion walks beside the person |
    | 6 `heavy` | latency of 0 to 2 frames without time stamps | 12 people, every second dressed alike |

    ## Action Space

    Same as in `UncalibServo-v0`: `Box(-1, 1, (2,), float32)`, fractions of `max_joint_rate` (2 rad/s).

    ## Observation Space

    A `Dict`. With `observation="detections"` (the default) and `observation="pixels"`:

    | key | shape | type | unit | meaning |
    |---|---|---|---|---|
    | `joint_angles` | (2,) | float64 | rad | encoder readings at `time` |
    | `goal` | (2,) | float64 | px | desired image position of the person: the image of the point under the tool |
    | `frame_time` | (1,) | float64 | s | time when the newest frame was taken, or arrived if `stamped` is false |
    | `time` | (1,) | float64 | s | current time |
    | `target_patch` | (32, 32, 3) | uint8 | gray levels | the person to follow in the first frame, 0.8 m wide |
    | `target_box` | (4,) | float64 | px | left, top, width, height of the person in the first frame |
    | `detections` | (M, 8) | float64 | px | existence (0 or 1), column, row, width, height, mean red, green, blue |
    | `image` | (S, S, 3) | uint8 | gray levels | the newest frame; S is `image_size` |

    The dictionary holds either `detections` or `image`. `target_patch` and `target_box` are constant during an episode.
    A lost frame leaves the old one in place, with its old time stamp. Rows of `detections` are in random order, unused
    rows are zeros. With `detections`, pixels are the camera's (`camera_size` to a side); with `pixels`, those of
    `image`.

    `servotrack.envs.FlatSets` scales all this for networks, and enlarges the picture for those that need 36 px.

    `observation="identity"`, for debugging, gives the observation of `UncalibServo-v0` with the features of the right
    person: a perfect tracker.

    ## Rewards

    Same as in `UncalibServo-v0`, with the distance between tool and person.

    `info` is for evaluation, not for agents. It holds:

    | key | meaning |
    |---|---|
    | `tracking_error` | distance between tool and person, m |
    | `feature_error` | distance between feature and goal, px |
    | `success`, `is_success` | true if the distance is below 10 cm; Stable-Baselines3 logs the second name |
    | `time_on_target` | share of the samples so far with a distance below 10 cm |
    | `identity_error` | true if the tool is within 0.5 m of another person and not of the right one |
    | `lost` | true if the person was farther away than 1 m and has not been within 0.5 m since |
    | `losses`, `reacquisitions` | number of times the person was lost, and reached again |
    | `kept` | mean distance over the last second below 0.5 m; at the end of an episode: the right person was kept |
    | `truth` | `joint_angles`, `tool`, `target`, `target_velocity` and `people` |

    ## Starting State

    Joints at (0, 90) degrees, the person within 1 m of the tool and in view. Everything is drawn from the seed, each
    quantity from its own stream. A path that the arm could not follow is drawn again.

    ## Episode End

    Termination: the person was out of view for 60 consecutive samples (3 s). Truncation: after `warmup` + `horizon`
    steps (400, 20 s).

    ## Arguments

    `level` (0 to 6, default 2), `observation` (`detections`, `pixels` or `identity`), `image_size` (32 to 480 px,
    default 128) and `image_noise` (gray levels, default 3), and every field of `FollowConfig` as a keyword that
    overrides the level's value, for example `gym.make("PedestrianServo-v0", script="crossings", people=9)`.
    `render_mode`: `rgb_array` or `human`.

    To show an agent's estimate of the person's position in rendered pictures, set
    `env.unwrapped.belief = (column, row)`, in camera pixels; None removes it.

    ## References

    Helbing and Molnar, "Social force model for pedestrian dynamics", Physical Review E 51(5), 1995, for the motion
    of people. Zhang Ying-bo, "Unscented Kalman filter for on-line estimation of Jacobian matrix", Journal of Computer
    Applications 31(6), 2011, pp. 1699-1702, for the arm and its camera. The world is this package's own.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    config: FollowConfig
    world: FollowWorld

    def __init__(
        self,
        level: int = 2,
        *,
        observation: str = "detections",
        image_size: int = 128,
        image_noise: float = 3.0,
        render_mode: str | None = None,
        **axes: Any,
    ) -> None:
        self._sensor_arguments = observation, image_size, image_noise
        self.belief: Any = None
        super().__init__(level, render_mode=render_mode, **axes)

    def _configure(self, level: int, axes: dict[str, Any]) -> FollowConfig:
        return follow_config(level, **axes)

    def _make_world(self) -> FollowWorld:
        return FollowWorld(self.config, 1, self.engine)

    def _make_recorder(self) -> Recorder:  # type: ignore[override]
        from servotrack.envs.follow.recorder import Recorder

        return Recorder(self.world, caption=level_caption(self.level))

    def _observation_space(self) -> gym.spaces.Dict:
        self._sensors = FollowSensors(self.world, *self._sensor_arguments)
        return self._sensors.space()

    def _observe(self) -> Observation:
        return {key: value[0] for key, value in self._sensors.observe().items()}

    def _parts(self) -> dict[str, Stateful]:
        return {**super()._parts(), "sensors": self._sensors}

    def _pictured(self) -> dict[str, Any]:
        belief = None if self.belief is None else np.asarray(self.belief, dtype=np.float64)
        return pictured(self._sensors, 0) | {"belief": belief}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start a new episode, see `UncalibServoEnv.reset`."""
        self.belief = None
        return super().reset(seed=seed, options=options)

    def _info(self) -> dict[str, Any]:
        world = self.world
        info = super()._info()
        info["success"] = info["is_success"] = info["tracking_error"] < ON_TARGET_DISTANCE
        info["truth"]["people"] = world.people[0, world.steps[0] + LEAD, :, :2].copy()
        for name in _COUNTED:
            info[name] = getattr(world, name).item(0)
        return info

    def privileged(self) -> Observation:
        """Entries that `PrivilegedObservation` adds: those of `FollowWorld` and `FollowSensors`, first row."""
        return {key: value[0] for key, value in (self.world.privileged() | self._sensors.privileged()).items()}


def people_now(world: FollowWorld) -> Array:
    """Current positions of all people, (N, P, 2) m."""
    return world.people[np.arange(world.count), world.now, :, :2]


def pictured(sensors: FollowSensors, row: int) -> dict[str, Any]:
    """Sensor data of a row that its picture shows: keywords of `Recorder.frame`."""
    if sensors.camera is not None:
        return {"camera_image": sensors.camera.images[row]}
    return {"detections": sensors.detector.detections[row] if sensors.observation == "detections" else None}


def level_caption(level: int) -> str:
    """Number and name of a level, the caption of pictures."""
    return f"level {level} {LEVEL_NAMES[level]}"
