"""Random draws of one episode of PedestrianServo: a servo episode whose target is a person, and the crowd."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.crowd import Crowd, crowd_ranges_of, draw_first_phases, draw_paths, start_crowd_streams
from servotrack.envs.follow.outfits import Outfits, draw_outfits, hidden_people
from servotrack.envs.servo.episode import Episode, draw_episode, samples
from servotrack.envs.streams import Streams
from servotrack.estimators.types import Array, Mask


@dataclass(frozen=True)
class FollowEpisode(Episode):
    """A servo episode and the crowd around its target, K samples of P people. The person to follow is the first one.

    Attributes:
        crowd: Paths and gait of the people.
        outfits: Clothes, umbrellas and lampshades.
        hidden: Mask of the people under a lampshade or another person's umbrella, shape (K, P).
    """

    crowd: Crowd
    outfits: Outfits
    hidden: Mask


def draw_follow_episode(config: FollowConfig, seed: int) -> FollowEpisode:
    """Make all random draws of one episode.

    Args:
        config: Parameters of the world.
        seed: Seed of the episode, a non-negative integer.

    Raises:
        ValueError: Raised by `servotrack.envs.servo.episode.draw_episode`.
    """
    ranges, states, drawn = crowd_ranges_of(config), start_crowd_streams(seed), np.zeros((0, config.people, 4))

    def motion(_: Streams, arm: np.void) -> Array:
        nonlocal drawn
        drawn = draw_paths(ranges, states, arm, samples(config))
        return drawn[:, 0]

    servo = draw_episode(config, seed, motion)
    crowd = Crowd(drawn, draw_first_phases(states, config.people))
    outfits = draw_outfits(config, servo.streams, crowd)
    parts = {field.name: getattr(servo, field.name) for field in fields(Episode)}
    return FollowEpisode(**parts, crowd=crowd, outfits=outfits, hidden=hidden_people(crowd, outfits))
