"""N arms over N crowds: the servo's world with people for targets, and who is followed."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numba import njit

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.episode import FollowEpisode, draw_follow_episode
from servotrack.envs.servo.episode import LEAD, samples
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import Labels, Mask

LOST_AFTER = 60
"""Consecutive samples in which the person is out of view that end an episode."""
ON_TARGET = 0.10
"""Distance of tool and person that counts as on target, m."""
FOLLOWED = 0.5
"""Distance up to which the tool is with somebody, m."""
AWAY = 1.0
"""Distance from which on the person counts as lost, m."""
LAST_SECOND = 20
"""Samples over which the distance is averaged that decides whether the person is kept."""


class FollowWorld(ServoWorld):
    """N arms, each with its camera over a crowd of P people of whom the first is to be followed.

    Args:
        config: The world's parameters.
        count: Number of arms N.

    Attributes:
        people: Everybody's positions and velocities at all samples, (N, K, P, 4) m, m/s.
        hidden: Who is under a lampshade or somebody's umbrella, (N, K, P).
        identity_error: The tool is with another person and not with the right one, (N,) bool.
        lost: The right person got away and has not been reached again, (N,) bool.
        losses: How often they got away, (N,).
        reacquisitions: How often they were reached again, (N,).
        kept: The mean distance to the right person over the last second is below `FOLLOWED`, (N,) bool.
        time_on_target: Share of the episode's samples so far with a distance below `ON_TARGET`, (N,).
    """

    config: FollowConfig

    def __init__(self, config: FollowConfig, count: int) -> None:
        super().__init__(config, count, LOST_AFTER)
        table = count, samples(config), config.people
        self.people, self.hidden = np.zeros((*table, 4)), np.zeros(table, np.bool_)
        self.identity_error, self.lost = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.losses, self.reacquisitions = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.kept, self.time_on_target = np.zeros(count, np.bool_), np.zeros(count)
        self._on_target = np.zeros(count, np.int64)
        self._last_errors = np.zeros((count, LAST_SECOND))

    @property
    def now(self) -> Labels:
        """Index of the present sample in the tables of each row, (N,)."""
        return self.steps + LEAD

    def episode(self, row: int) -> FollowEpisode:
        """The episode of a row that has been reset."""
        return cast(FollowEpisode, self.episodes[row])

    def _draw(self, seed: int) -> FollowEpisode:
        return draw_follow_episode(self.config, seed)

    def _begin(self, row: int, seed: int) -> None:
        super()._begin(row, seed)
        episode = self.episode(row)
        self.people[row], self.hidden[row] = episode.crowd.paths, episode.hidden

    def _observe(self, rows: Mask) -> None:
        if self.config.lamps or self.config.umbrellas:
            before = self.features.copy(), self.frame_time.copy()
            super()._observe(rows)
            _cover(rows, self.captured, self.hidden, *before, self.visible, self.features, self.frame_time)
        else:
            super()._observe(rows)
        _follow(
            rows, self.steps, self.people, self.tool, self._last_errors, self._on_target, self.identity_error,
            self.lost, self.losses, self.reacquisitions, self.kept, self.time_on_target,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _cover(rows, captured, hidden, old_features, old_time, visible, features, frame_time):  # type: ignore[no-untyped-def]
    """A frame in which the person is under something tells no more of them than a lost one."""
    for i in range(rows.shape[0]):
        if rows[i] and visible[i] > 0.0 and hidden[i, captured[i], 0]:
            visible[i] = 0.0
            features[i] = old_features[i]
            frame_time[i] = old_time[i]


@njit(cache=True, nogil=True)
def _follow(  # type: ignore[no-untyped-def]
    rows, steps, people, tool, last_errors, on_target, identity_error, lost, losses, reacquisitions, kept, share
):
    """Keep the books of every chosen row: whom the tool is with, and how long."""
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        now = people[i, steps[i] + LEAD]
        own = math.hypot(tool[i, 0] - now[0, 0], tool[i, 1] - now[0, 1])
        nearest = np.inf
        for k in range(1, now.shape[0]):
            nearest = min(nearest, math.hypot(tool[i, 0] - now[k, 0], tool[i, 1] - now[k, 1]))
        identity_error[i] = nearest < FOLLOWED < own
        if steps[i] == 0:
            # Nobody has been followed yet, the right one no more than another.
            identity_error[i] = lost[i] = False
            losses[i] = reacquisitions[i] = on_target[i] = 0
            share[i] = 0.0
            last_errors[i] = own
            kept[i] = own < FOLLOWED
            continue
        if lost[i] and own < FOLLOWED:
            lost[i] = False
            reacquisitions[i] += 1
        elif not lost[i] and own > AWAY:
            lost[i] = True
            losses[i] += 1
        on_target[i] += own < ON_TARGET
        share[i] = on_target[i] / steps[i]
        last_errors[i, steps[i] % LAST_SECOND] = own
        kept[i] = last_errors[i].mean() < FOLLOWED
