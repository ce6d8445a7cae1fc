"""The serial-arm servo as a Gymnasium environment."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from servotrack.envs.actions import check_actions
from servotrack.envs.arguments import available_render_modes
from servotrack.envs.servo3d.arms import SerialArm
from servotrack.envs.servo3d.episode import LEAD, PERIOD
from servotrack.envs.servo3d.levels import Servo3DConfig, servo3d_config
from servotrack.envs.servo3d.world import Servo3DWorld
from servotrack.envs.single_env import SingleEnv
from servotrack.estimators.types import Array

if TYPE_CHECKING:
    from servotrack.envs.servo3d.recorder import Recorder

Observation = dict[str, NDArray[Any]]

METADATA: dict[str, Any] = {
    "servotrack_kind": "servo3d",
    "render_modes": available_render_modes(),
    "render_fps": round(1 / PERIOD),
}


def action_space(joints: int) -> gym.spaces.Box:
    """Joint rates as fractions of `max_joint_rate`."""
    return gym.spaces.Box(-1.0, 1.0, (joints,), np.float32)


def observation_space(config: Servo3DConfig, arm: SerialArm) -> gym.spaces.Dict:
    """Observation space of one arm. All bounds are finite."""

    def box(low: Any, high: Any, size: int) -> gym.spaces.Box:
        return gym.spaces.Box(low, high, (size,), np.float64)

    p = config.points
    extent = np.tile([float(config.width), float(config.height)], p)
    # Encoders read the motors' angles, which the limits bind, with their homing errors and in whole steps.
    slack = config.homing + (2.0 * np.pi / config.encoder_steps if config.encoder_steps else 0.0) + 1e-9
    first, last = -LEAD * PERIOD, config.horizon * PERIOD
    return gym.spaces.Dict(
        {
            "joint_angles": box(arm.low - slack, arm.high + slack, arm.joints),
            "features": box(np.zeros(2 * p), extent, 2 * p),
            "goal": box(-extent, 2.0 * extent, 2 * p),
            "visible": box(0.0, 1.0, p),
            "frame_time": box(first, last, 1),
            "joint_time": box(first, last, 1),
            "time": box(first, last, 1),
        }
    )


def all_observations(world: Servo3DWorld) -> Observation:
    """Return the newest observations of all rows, as new arrays with a leading axis of N."""
    sample = world.sample
    return {
        "joint_angles": sample.joint_angles.copy(),
        "features": sample.features.copy(),
        "goal": sample.goal.copy(),
        "visible": sample.visible.copy(),
        "frame_time": sample.frame_time[:, None].copy(),
        "joint_time": sample.joint_time[:, None].copy(),
        "time": sample.time[:, None].copy(),
    }


def all_infos(world: Servo3DWorld) -> dict[str, Any]:
    """Info of all rows: arrays, or dictionaries of arrays, with a leading axis of N."""
    sample, success = world.sample, world.success()
    return {
        "tip_error": sample.tip_error,
        "tip_angle": sample.tip_angle,
        "tracking_error": sample.error,
        "feature_error": sample.feature_error,
        "at_limit": world.state.at_limit.any(axis=1),
        "success": success,
        "is_success": success,
        "truth": {"joint_angles": world.state.joints},
    }


class UncalibServo3DEnv(SingleEnv):
    """A serial arm of any number of joints with an uncalibrated camera reaches or follows a pose.

    ## Description

    An arm of two or more joints (the named ones have five to seven), and an uncalibrated camera: on the tool, looking
    at a board of points in the world (`camera="hand"`), or fixed in the world, looking at a board on the tool
    (`camera="world"`). The agent commands joint rates and has to bring the board's points to their goal in the image,
    which brings the tool to the goal's pose. Kinematics, optics, mounting and board are unknown to the agent. Joint
    limits, rates and accelerations are limited; one control period is 50 ms.

    | level | adds |
    |---|---|
    | 0 `plain` | exact sensors, camera along the tool's axis, a small displacement |
    | 1 `noise` | 0.5 px of noise, any mounting, random optics and board |
    | 2 `hobby` | encoders of 4096 steps, homing errors up to 3 degrees, motors that lag by 0.05 to 0.15 s |
    | 3 `play` | backlash of 1 degree, sag under gravity, frames one period old, joint angles 0 to 2 periods old |
    | 4 `hidden` | 2 or 3 points in the image at the start, points hidden one by one |
    | 5 `turns` | turns up to 3 rad about the optical axis, twice the distance, starts near a singular posture |
    | 6 `everything` | a goal that moves, frames 0 to 2 periods old without time stamps, lost frames |

    ## Action Space

    `Box(-1, 1, (n,), float32)`: the joint rates as fractions of `max_joint_rate` (1 rad/s), clipped joint by joint and
    limited in their change. Motors stop at their limits; links may be outside by backlash and sag. The public
    attributes `max_joint_rate`, `max_joint_acceleration`, `joint_low` and `joint_high` are those of the data sheet.

    ## Observation Space

    A `Dict` of float64 arrays, for n joints and p points:

    | key | shape | unit | meaning |
    |---|---|---|---|
    | `joint_angles` | (n,) | rad | encoder readings at `joint_time` |
    | `features` | (2p,) | px | column and row of each point, in the newest frame in which it was seen |
    | `goal` | (2p,) | px | desired column and row of each point |
    | `visible` | (p,) | 0 or 1 | 1: a new frame that shows this point arrived; 0: its features are old |
    | `frame_time` | (1,) | s | time when the newest frame was taken, or arrived if `stamped` is false |
    | `joint_time` | (1,) | s | time when the encoders were read, or arrived if `stamped` is false |
    | `time` | (1,) | s | current time |

    ## Rewards

    `max(1 - ln(1 + e) / ln(501), 0)` with e = sqrt((d / 2 mm)^2 + (a / 1 degree)^2), d the distance and a the angle
    between the tool's pose and the goal's. The reward is 0 at termination, so that ending an episode never pays.

    `info` is for evaluation, not for agents: `tip_error` (d, m), `tip_angle` (a, rad), `tracking_error` (e),
    `feature_error` (mean distance of the true points from the goal, px), `at_limit` (a motor is at its limit),
    `success` (d below 2 mm and a below 1 degree), `is_success` (the same) and `truth` (`joint_angles`). With
    `points=1`, which leaves the pose open, d is the point's distance from the goal's line of sight and a is 0.

    ## Starting State

    The goal is near the arm's ready posture. The start differs from it by a drawn shift, tilt, turn and distance of the
    board in the image. A layout is drawn again until both are within the joint limits and in view. Lengths scale with
    the arm's reach. Every quantity is drawn from the seed by a random stream of its own.

    ## Episode End

    Termination: no point was in the image for 40 consecutive samples. Truncation: after `horizon` steps (40 s).

    ## Arguments

    `level` (0 to 6, default 2) and every field of `Servo3DConfig` as a keyword that overrides the level's value, for
    example `gym.make("UncalibServo3D-v0", arm="panda", camera="world", level=3, points=20)`. `arm` is `ur5e`, `panda`,
    `so101` or the fields of a `SerialArm`. `render_mode`: `rgb_array` or `human`.

    ## References

    Chaumette and Hutchinson, "Visual servo control, part I: basic approaches", IEEE Robotics and Automation Magazine
    13(4), 2006, pp. 82-90. Lynch and Park, "Modern Robotics", Cambridge University Press, 2017.

    ## Version History

    * v0: initial version
    """

    metadata: ClassVar[dict[str, Any]] = METADATA  # type: ignore[misc]

    config: Servo3DConfig
    world: Servo3DWorld

    def __init__(self, level: int = 2, *, render_mode: str | None = None, **axes: Any) -> None:
        self.config = servo3d_config(level, **axes)
        self.level = level
        world = Servo3DWorld(self.config, 1)
        self.max_joint_rate = self.config.max_joint_rate
        self.max_joint_acceleration = self.config.max_joint_acceleration
        self.joint_low, self.joint_high = world.arm.low, world.arm.high
        spaces = observation_space(self.config, world.arm), action_space(world.arm.joints)
        super().__init__(world, *spaces, render_mode, type(self).__name__)

    def _make_recorder(self) -> Recorder:
        from servotrack.envs.servo3d.recorder import Recorder, level_caption

        return Recorder(self.world, caption=level_caption(self.config, self.level))

    def _observe(self) -> Observation:
        return {key: value[0] for key, value in all_observations(self.world).items()}

    def _checked(self, action: Any) -> Array:
        return check_actions(action, (self.world.arm.joints,))

    def _info(self) -> dict[str, Any]:
        info = all_infos(self.world)
        return {
            **{key: float(info[key][0]) for key in ("tip_error", "tip_angle", "tracking_error", "feature_error")},
            **{key: bool(info[key][0]) for key in ("at_limit", "success", "is_success")},
            "truth": {key: value[0].copy() for key, value in info["truth"].items()},
        }
