"""The arm servo as a Gymnasium environment: tracking and positioning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.actions import check_actions
from servotrack.envs.arguments import available_render_modes
from servotrack.envs.servo.engine import chosen_engine
from servotrack.envs.servo.levels import ServoConfig, reach_config, servo_config
from servotrack.envs.servo.records import PLACES
from servotrack.envs.servo.targets import LEAD, PERIOD
from servotrack.envs.servo.world import SUCCESS_DISTANCE, ServoWorld
from servotrack.envs.single_env import SingleEnv
from servotrack.envs.vector_env import copied
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from servotrack.envs.servo.recorder import Recorder

Observation = dict[str, NDArray[Any]]

METADATA: dict[str, Any] = {
    "servotrack_kind": "servo",
    "render_modes": available_render_modes(),
    "render_fps": round(1 / PERIOD),
}

# Places of what is observed and reported in a sample's numbers.
_JOINT_ANGLES, _FEATURES, _VISIBLE, _FRAME_TIME, _TIME, _TOOL = (
    PLACES[name] for name in ("joint_angles", "features", "visible", "frame_time", "time", "tool")
)
_TRACKING_ERROR, _FEATURE_ERROR = PLACES["tracking_error"].start, PLACES["feature_error"].start
_TARGET = slice(PLACES["target"].start, PLACES["target"].start + 2)
_TARGET_VELOCITY = slice(_TARGET.stop, PLACES["target"].stop)


def action_space() -> gym.spaces.Box:
    """Joint rates as fractions of `max_joint_rate`."""
    return gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


def feature_space(config: ServoConfig) -> gym.spaces.Dict:
    """Observation space of the feature environments. All bounds are finite."""

    def box(low: float, high: float, size: int) -> gym.spaces.Box:
        return gym.spaces.Box(low, high, (size,), np.float64)

    first, last = -(LEAD + config.warmup + 1) * PERIOD, config.horizon * PERIOD
    return gym.spaces.Dict(
        {
            "joint_angles": box(-2 * np.pi, 2 * np.pi, 2),
            "features": box(0.0, config.camera_size, 2),
            "goal": box(-config.camera_size, 2.0 * config.camera_size, 2),
            "visible": box(0.0, 1.0, 1),
            "frame_time": box(first, last, 1),
            "time": box(first, last, 1),
        }
    )


def feature_observations(world: ServoWorld) -> Observation:
    """Return the newest observations of all rows, as new arrays with a leading axis of N."""
    return {
        "joint_angles": copied(world.joint_angles),
        "features": copied(world.features),
        "goal": copied(world.goal),
        "visible": world.visible[:, None].copy(),
        "frame_time": world.frame_time[:, None].copy(),
        "time": world.time[:, None].copy(),
    }


class UncalibServoEnv(SingleEnv):
    """An arm with an uncalibrated camera follows a moving target.

    ## Description

    A planar two-link arm carries a camera at its tool that looks down on a plane. A target moves on the plane. The
    agent commands joint rates and has to keep the target under the tool, that is, at the goal pixel. The link lengths,
    the focal length, the height and mounting of the camera, and the target's motion are unknown to the agent. Higher
    levels add lens distortion, noise, lost frames and latency. The physics engine is pymunk, with five substeps per
    control period of 50 ms.

    | level | adds |
    |---|---|
    | 0 `paper` | Zhang 2011, eq. 32: an ellipse, fixed start, no noise, 8 unscored warm-up steps |
    | 1 `noise` | 0.5 px of noise, a random ellipse |
    | 2 `geometry` | random links, focal length, height; mounting within 30 degrees; 1 px; no warm-up |
    | 3 `optics` | any mounting angle, principal point, distortion, tilt, aspect |
    | 4 `dynamics` | a target that moves along two sines per axis, noisy joint rates and encoders, lost frames |
    | 5 `timing` | one frame of latency, rolling shutter |
    | 6 `heavy` | abrupt waypoints, outliers, more lost frames, latency of 0 to 2 frames without time stamps |

    ## Action Space

    `Box(-1, 1, (2,), float32)`: the joint rates as fractions of `max_joint_rate` (2 rad/s). Each
    rate is clipped separately, as hardware does; scale the whole vector to keep its direction. Joints halt just
    before their stops.

    ## Observation Space

    A `Dict` of float64 arrays:

    | key | shape | unit | meaning |
    |---|---|---|---|
    | `joint_angles` | (2,) | rad | encoder readings at `time` |
    | `features` | (2,) | px | image point of the target in the newest frame in which it was seen |
    | `goal` | (2,) | px | desired image point of the target: the image of the point under the tool |
    | `visible` | (1,) | 0 or 1 | 1: a new frame that shows the target arrived; 0: `features` and `frame_time` are old |
    | `frame_time` | (1,) | s | time when that frame was taken (middle row), or arrived if `stamped` is false |
    | `time` | (1,) | s | current time; the warm-up is before 0, scoring starts after 0 |

    ## Rewards

    `clip(1 - ln(1 + d / 2 mm) / ln(1 + 2 m / 2 mm), 0, 1)` with d the distance between tool and target in the plane.
    The logarithm gives a slope from meters down to millimeters. The reward is 0 during the warm-up and at termination,
    so ending an episode early never pays.

    `info` is for evaluation, not for agents. It holds `tracking_error` (d, m), `feature_error` (distance between the
    true current features and the goal, px), `success` (d below 10 mm), `is_success` (the same under the name that
    Stable-Baselines3 logs) and `truth` (`joint_angles`, `tool`, `target`, `target_velocity`).

    ## Starting State

    Joints at (0, 90) degrees. Links, camera, target and noise are drawn from the seed, each from its own random stream.
    A layout is drawn again until the arm can follow the target with a margin to its joint stops, at most 0.8 of the
    joint rate limit and away from the eye-in-hand singularity, and until the target is in view at the start.

    ## Episode End

    Termination: the target was out of view for 20 consecutive samples. Truncation: after `warmup` + `horizon` steps.

    ## Arguments

    `level` (0 to 6, default 3) and every field of `ServoConfig` as a keyword that overrides the level's value, for
    example `gym.make("UncalibServo-v0", level=5, pixel_noise=2.0, latency=(0, 2))`. `render_mode`: `rgb_array` or
    `human`.

    `engine`: `pymunk` (the default and the reference), or `compiled`, which solves for the same motion with the same
    bits several times as fast. Vector environments use `compiled` where a check at first use finds the bits equal, as
    on x86-64.

    `get_state` and `set_state` (see `servotrack.envs.state`), `copy.deepcopy` and `pickle` go on to the bit with both
    engines. pymunk cannot copy its solver, so a copy is driven there again from its last reset; planners use
    `compiled`.

    ## References

    Zhang Ying-bo, "Unscented Kalman filter for on-line estimation of Jacobian matrix", Journal of Computer
    Applications 31(6), 2011, pp. 1699-1702, section 3.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    config: ServoConfig
    world: ServoWorld

    def __init__(
        self, level: int = 3, *, render_mode: str | None = None, engine: str | None = None, **axes: Any
    ) -> None:
        self.engine = chosen_engine(engine, "pymunk")
        self.config = self._configure(level, axes)
        self.level = level
        self.max_joint_rate = self.config.max_joint_rate
        # Observation spaces and recorders are made for a world.
        self.world = self._make_world()
        super().__init__(self.world, self._observation_space(), action_space(), render_mode, type(self).__name__)

    def _configure(self, level: int, axes: dict[str, Any]) -> ServoConfig:
        return servo_config(level, **axes)

    def _make_world(self) -> ServoWorld:
        return ServoWorld(self.config, 1, engine=self.engine)

    def _make_recorder(self) -> Recorder:
        from servotrack.envs.servo.recorder import Recorder, level_caption

        return Recorder(self.world, caption=level_caption(self.level))

    def _observation_space(self) -> gym.spaces.Dict:
        return feature_space(self.config)

    def _observe(self) -> Observation:
        numbers = self.world.newest()
        return {
            "joint_angles": numbers[_JOINT_ANGLES],
            "features": numbers[_FEATURES],
            "goal": self.world.goal[0].copy(),
            "visible": numbers[_VISIBLE],
            "frame_time": numbers[_FRAME_TIME],
            "time": numbers[_TIME],
        }

    def _checked(self, action: Any) -> Array:
        return check_actions(action, (2,))

    def _info(self) -> dict[str, Any]:
        numbers = self.world.newest()
        error = float(numbers[_TRACKING_ERROR])
        return {
            "tracking_error": error,
            "feature_error": float(numbers[_FEATURE_ERROR]),
            "success": error < SUCCESS_DISTANCE,
            "is_success": error < SUCCESS_DISTANCE,
            "truth": {
                "joint_angles": self.world.joints[0].copy(),
                "tool": numbers[_TOOL],
                "target": numbers[_TARGET],
                "target_velocity": numbers[_TARGET_VELOCITY],
            },
        }


class UncalibServoReachEnv(UncalibServoEnv):
    """An arm with an uncalibrated camera moves its tool over a target at rest.

    ## Description

    Same as `UncalibServo-v0`, but the target rests: at (0.6, 0.6) m at level 0 (Zhang 2011, section 3.2), anywhere
    within reach at higher levels.

    ## Action Space

    Same as in `UncalibServo-v0`.

    ## Observation Space

    Same as in `UncalibServo-v0`.

    ## Rewards

    Same as in `UncalibServo-v0`.

    ## Starting State

    Same as in `UncalibServo-v0`.

    ## Episode End

    Same as in `UncalibServo-v0`, with a default `horizon` of 100 steps (5 s).

    ## Arguments

    Same as in `UncalibServo-v0`.

    ## References

    Zhang Ying-bo, "Unscented Kalman filter for on-line estimation of Jacobian matrix", Journal of Computer
    Applications 31(6), 2011, pp. 1699-1702, section 3.2.

    ## Version History

    * v0: initial version
    """

    def _configure(self, level: int, axes: dict[str, Any]) -> ServoConfig:
        return reach_config(level, **axes)
