"""What fate deals an episode of the following world: a servo's episode whose target is a person, and the crowd."""

from __future__ import annotations

from dataclasses import dataclass, fields

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.crowd import Crowd, draw_paths, walking_crowd
from servotrack.envs.follow.looks import Looks, draw_looks, hidden_people
from servotrack.envs.servo.episode import Episode, ServoStreams, draw_episode, samples
from servotrack.estimators.types import Array, Mask


@dataclass(frozen=True)
class FollowEpisode(Episode):
    """A servo's episode and the crowd around its target, K samples of P people; the person to follow is the first.

    Attributes:
        crowd: Where people walk.
        looks: How they look.
        hidden: Who is under a lampshade or an umbrella, shape (K, P).
    """

    crowd: Crowd
    looks: Looks
    hidden: Mask


def draw_follow_episode(config: FollowConfig, seed: int) -> FollowEpisode:
    """Draw all of an episode.

    Args:
        config: The world.
        seed: Non-negative integer.

    Raises:
        ValueError: As `servotrack.envs.servo.episode.draw_episode`.
    """
    drawn: list[Array] = []

    def motion(streams: ServoStreams, links: Array) -> Array:
        drawn[:] = [draw_paths(config, streams, links, samples(config))]
        return drawn[0][:, 0]

    servo = draw_episode(config, seed, motion)
    crowd = walking_crowd(drawn[0], servo.streams)
    looks = draw_looks(config, servo.streams, crowd)
    parts = {field.name: getattr(servo, field.name) for field in fields(Episode)}
    return FollowEpisode(**parts, crowd=crowd, looks=looks, hidden=hidden_people(crowd, looks))
