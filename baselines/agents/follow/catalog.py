"""The agents that follow one person, by what each of their three parts is told."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from servotrack.baselines.agents.follow.follow_servo import KEYS, FollowServo
from servotrack.baselines.agents.servo.catalog import servo_controller
from servotrack.baselines.worlds import public_attribute
from servotrack.estimators.follow import PersonFollower

PATIENCE = 60
"""Steps for which the servo goes where the person is predicted before it goes back to where they were last seen."""


def create_follow_agent(env: Any, told: tuple[str, ...] = (), identity: str = "tracked") -> FollowServo:
    """An agent for `PedestrianServo-v0`, of which only `max_joint_rate` and the observation space are read.

    Args:
        env: The environment or vector environment.
        told: What an oracle tells: any of "identity", "jacobian", "detections".
        identity: "tracked", or "nearest" for the nearest detection and a Kalman filter of the Jacobian.

    Raises:
        ValueError: The environment is another one, or observes the right person's features.
    """
    space = getattr(env, "single_observation_space", env.observation_space)
    max_joint_rate = public_attribute(env, "max_joint_rate")
    keys = set(getattr(space, "spaces", ()))
    if max_joint_rate is None or not keys.issuperset(KEYS) or not keys & {"detections", "image"}:
        name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        raise ValueError(
            f"this agent follows one person of many and needs max_joint_rate and the observations {', '.join(KEYS)} "
            f'and detections or image; {name} is none: choose PedestrianServo-v0 with observation="detections" or '
            '"pixels", or another agent'
        )
    nearest = identity == "nearest"
    estimator, law = ("kf", "pi") if nearest else ("lifted-kf", "one-step")
    if "jacobian" in told:
        estimator, law = "oracle", "pi"
    controller = servo_controller(estimator, law, float(max_joint_rate))
    if controller.supervisor is not None:
        controller = replace(controller, supervisor=replace(controller.supervisor, unseen_limit=PATIENCE))
    return FollowServo(
        controller,
        PersonFollower(),
        "oracle" if "identity" in told else "nearest" if nearest else "tracked",
        "oracle" if "detections" in told else "observed",
        "jacobian" in told,
    )
