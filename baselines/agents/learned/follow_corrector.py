"""Follow one person of a crowd: a classical follower identifies the person, a network corrects its servo action."""

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


class FollowingMemory(NamedTuple):
    """Memory of `BehindFollower`.

    Attributes:
        follow: State of the classical follower.
        own: Memory of the encoding behind it.
        action: Action of the classical follower. Shape (N, actions).
    """

    follow: FollowServoState
    own: Any
    action: FloatArray


@dataclass(frozen=True)
class BehindFollower(PlainAnswers):
    """Encodes the followed person's features as a servo would observe them, and the classical follower's action.

    Attributes:
        follower: The classical agent.
        encoding: Encoding of the person's features.
    """

    follower: FollowServo
    encoding: Encoding

    @property
    def size(self) -> int:
        """Length of a row: the encoding's, the follower's action (2), and the time since the person was seen (1)."""
        return self.encoding.size + 3

    def initial(self, observation: Any) -> FollowingMemory:
        """Return the memory before an episode; see `Encoding.initial`."""
        follow = self.follower.initial(observation)
        own = self.encoding.initial(self._person(follow, observation))
        return FollowingMemory(follow, own, np.zeros(np.shape(observation["joint_angles"]), np.float32))

    def step(self, memory: FollowingMemory, observation: Any, action: FloatArray) -> tuple[FollowingMemory, FloatArray]:
        """Process one observation; see `Encoding.step`."""
        classical, follow = self.follower.predict(observation, memory.follow)
        own, rows = self.encoding.step(memory.own, self._person(follow, observation), action)
        unseen = np.log1p(follow.person.unseen)[:, None].astype(np.float32)
        return FollowingMemory(follow, own, classical), np.concatenate([rows, classical, unseen], axis=1)

    def act(self, memory: FollowingMemory, answer: FloatArray) -> tuple[FollowingMemory, FloatArray]:
        """Convert the network's answer to actions; see `Encoding.act`."""
        return memory, memory.action + answer

    def _person(self, follow: FollowServoState, observation: Mapping[str, Any]) -> dict[str, Any]:
        """Return the observation of a servo on the person, in the camera's pixels."""
        newest = follow.frame_time >= np.asarray(observation["frame_time"])[:, 0]
        visible = newest & (follow.person.unseen == 0)
        # In the order of the space's keys.
        return {
            "features": follow.belief,
            "frame_time": observation["frame_time"],
            "goal": self.follower.goal(observation),
            "joint_angles": observation["joint_angles"],
            "time": observation["time"],
            "visible": visible[:, None].astype(np.float64),
        }


def behind_follower(name: str, env: Any, encoding_of: Callable[[spaces.Dict], Encoding]) -> BehindFollower:
    """Create the encoding behind an agent that follows a person.

    Args:
        name: Name of that agent.
        env: A Gymnasium environment or vector environment.
        encoding_of: Creates the encoding of a servo's observation space.

    Raises:
        ValueError: Another kind of agent or environment, or an error of `encoding_of`.
    """
    follower = create_agent(name, env)
    if not isinstance(follower, FollowServo):
        raise ValueError(f"follower must name an agent that follows one person of many, got {name!r}")
    space = getattr(env, "single_observation_space", env.observation_space)
    person = {**space.spaces, "features": space["goal"], "visible": spaces.Box(0.0, 1.0, (1,))}
    return BehindFollower(follower, encoding_of(spaces.Dict({key: person[key] for key in OBSERVATION_KEYS})))
