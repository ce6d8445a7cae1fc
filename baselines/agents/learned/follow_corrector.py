"""One person of many: a classical follower decides who it is, a network corrects how it servos on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from servotrack.baselines.agents.follow.follow_servo import FollowServo, FollowServoState
from servotrack.baselines.agents.learned.contract import Encoding, PlainAnswers
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.agents.servo.jacobian_servo import OBSERVATION_KEYS
from servotrack.estimators.types import FloatArray


class Following(NamedTuple):
    """Memory of `BehindFollower`.

    Attributes:
        follow: Of the classical follower.
        own: Of the encoding behind it.
        action: What the classical follower does. Shape (N, actions).
    """

    follow: FollowServoState
    own: Any
    action: FloatArray


@dataclass(frozen=True)
class BehindFollower(PlainAnswers):
    """What a servo would see of the person whom a classical follower follows, and what that one does.

    Attributes:
        follower: The classical agent.
        encoding: What is seen of the person.
    """

    follower: FollowServo
    encoding: Encoding

    @property
    def size(self) -> int:
        """Numbers in a row: those of the encoding, what the follower does, and how long it has seen nobody."""
        return self.encoding.size + 3

    def initial(self, observation: Any) -> Following:
        """As `Encoding.initial`."""
        follow = self.follower.initial(observation)
        own = self.encoding.initial(self._person(follow, observation))
        return Following(follow, own, np.zeros(np.shape(observation["joint_angles"]), np.float32))

    def step(self, memory: Following, observation: Any, action: FloatArray) -> tuple[Following, FloatArray]:
        """As `Encoding.step`."""
        classical, follow = self.follower.predict(observation, memory.follow)
        own, rows = self.encoding.step(memory.own, self._person(follow, observation), action)
        unseen = np.log1p(follow.person.unseen)[:, None].astype(np.float32)
        return Following(follow, own, classical), np.concatenate([rows, classical, unseen], axis=1)

    def act(self, memory: Following, answer: FloatArray) -> tuple[Following, FloatArray]:
        """As `Encoding.act`."""
        return memory, memory.action + answer

    def _person(self, follow: FollowServoState, observation: Mapping[str, Any]) -> dict[str, Any]:
        """What a servo would observe of the person, in the camera's pixels."""
        newest = follow.frame_time >= np.asarray(observation["frame_time"])[:, 0]
        visible = newest & (follow.person.unseen == 0)
        # In the order of a space's keys, as environments give them.
        return {
            "features": follow.belief,
            "frame_time": observation["frame_time"],
            "goal": self.follower.goal(observation),
            "joint_angles": observation["joint_angles"],
            "time": observation["time"],
            "visible": visible[:, None].astype(np.float64),
        }


def behind_follower(name: str, env: Any, encoding_of: Callable[[spaces.Dict], Encoding]) -> BehindFollower:
    """The encoding behind an agent that follows.

    Args:
        name: Of that agent.
        env: A Gymnasium environment or vector environment.
        encoding_of: What is made of a servo's observation space.

    Raises:
        ValueError: Another kind of agent or environment, or as `encoding_of` does.
    """
    follower = create_agent(name, env)
    if not isinstance(follower, FollowServo):
        raise ValueError(f"follower must name an agent that follows one person of many, got {name!r}")
    space = getattr(env, "single_observation_space", env.observation_space)
    person = {**space.spaces, "features": space["goal"], "visible": spaces.Box(0.0, 1.0, (1,))}
    return BehindFollower(follower, encoding_of(spaces.Dict({key: person[key] for key in OBSERVATION_KEYS})))
