"""Agents that follow one person, by the source of each of their three parts: estimated or an oracle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from servotrack.baselines.agents.follow.crowd_servo import CrowdServo
from servotrack.baselines.agents.follow.follow_servo import KEYS, FollowServo
from servotrack.baselines.agents.hyper_parameters import with_values
from servotrack.baselines.agents.servo.catalog import servo_controller
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.follow import CrowdFollower, PersonFollower
from servotrack.estimators.jacobian import Supervisor

NEVER = 1 << 40
"""Number of steps that no episode reaches."""
IMAGE_VALUES = {
    "position_noise": 6.0,
    "color_noise": 14.0,
    "color_drift": 1.5,
    "size_noise": 0.3,
    # Colors in images err alike for many frames, so that another person's can pass for evidence of a leap there.
    "lose_rate": 0.001,
}
"""Values of `CrowdFollower` for detections in images that differ from its defaults, in its units."""
UNSEEN_LIMIT = 60
"""Steps without the person after which the servo returns from the predicted to the last seen position."""


def create_follow_agent(
    env: Any,
    oracles: tuple[str, ...] = (),
    identity: str = "tracked",
    values: Mapping[str, float] | None = None,
) -> FollowServo:
    """Create an agent for `PedestrianServo-v0`; only `max_joint_rate` and the observation space are read.

    Args:
        env: The environment or vector environment.
        oracles: Parts that come from an oracle: any of "identity", "jacobian", "detections".
        identity: "tracked", or "nearest" for the nearest detection and a Kalman filter of the Jacobian.
        values: Numbers of the `PersonFollower` that differ from its defaults, by path; see `with_values`.

    Raises:
        ValueError: Another environment, one that observes the right person's features, or values that do not fit.
    """
    max_joint_rate, _ = _checked(env)
    nearest = identity == "nearest"
    estimator, law = ("kf", "pi") if nearest else ("lifted-kf", "one-step")
    if "jacobian" in oracles:
        estimator, law = "oracle", "pi"
    controller = servo_controller(estimator, law, float(max_joint_rate))
    if isinstance(controller.supervisor, Supervisor):
        controller = replace(controller, supervisor=replace(controller.supervisor, unseen_limit=UNSEEN_LIMIT))
    return FollowServo(
        controller,
        with_values(PersonFollower(), values or {}),
        "oracle" if "identity" in oracles else "nearest" if nearest else "tracked",
        "oracle" if "detections" in oracles else "observed",
        "jacobian" in oracles,
    )


def create_crowd_agent(env: Any, values: Mapping[str, float] | None = None) -> CrowdServo:
    """Create the agent with several hypotheses for `PedestrianServo-v0`; reads the same as `create_follow_agent`.

    Args:
        env: The environment or vector environment.
        values: Numbers of the `CrowdFollower` that differ from its defaults, by path; see `with_values`.

    Raises:
        ValueError: As `create_follow_agent`.
    """
    max_joint_rate, keys = _checked(env)
    controller = servo_controller("latency-bank-agile-kf", "one-step", max_joint_rate)
    assert isinstance(controller.supervisor, Supervisor)
    # The follower itself says where to look for a person out of view.
    controller = replace(controller, supervisor=replace(controller.supervisor, unseen_limit=NEVER))
    images = IMAGE_VALUES if "image" in keys else {}
    return CrowdServo(controller, with_values(CrowdFollower(), {**images, **(values or {})}))


def _checked(env: Any) -> tuple[float, set[str]]:
    """Return the joint rate limit and the observation's keys; raise ValueError for an environment without a crowd."""
    space = getattr(env, "single_observation_space", env.observation_space)
    max_joint_rate = public_attribute(env, "max_joint_rate")
    keys = set(getattr(space, "spaces", ()))
    if max_joint_rate is None or not keys.issuperset(KEYS) or not keys & {"detections", "image"}:
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"this agent follows one person of a crowd; it needs max_joint_rate and the observations {', '.join(KEYS)} "
            f'and detections or image; {name} lacks them: choose PedestrianServo-v0 with observation="detections" or '
            '"pixels", or another agent'
        )
    return float(max_joint_rate), keys
