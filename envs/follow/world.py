"""N arms over N crowds: the servo world with people as targets, and the scores of following."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from servotrack.envs.follow.config import FollowConfig
from servotrack.envs.follow.episode import FollowEpisode, draw_follow_episode
from servotrack.envs.servo.episode import samples
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.servo.world import ServoWorld
from servotrack.envs.state import State, put, taken
from servotrack.estimators.compilation import njit
from servotrack.estimators.types import Labels, Mask

LOST_SAMPLES = 60
"""An episode ends after this many consecutive samples with the person out of view."""
ON_TARGET_DISTANCE = 0.10
"""Largest distance between tool and person that counts as on target, m."""
FOLLOWED_DISTANCE = 0.5
"""Largest distance at which the tool counts as following a person, m."""
LOST_DISTANCE = 1.0
"""Distance beyond which the person counts as lost, m."""
KEPT_SAMPLES = 20
"""Number of last samples whose mean distance decides `kept`: one second."""

_SCORES = (
    "identity_error", "lost", "losses", "reacquisitions", "kept", "time_on_target", "_on_target", "_last_errors",
)  # fmt: skip


class FollowWorld(ServoWorld):
    """N arms, each with a camera over a crowd of P people. The first person is the one to follow.

    Args:
        config: Parameters of the world.
        count: Number of arms N.
        engine: Name of the engine that moves the arms.
        threads: Number of threads that share a step of the compiled engine.

    Attributes:
        people: Positions and velocities of all people at all samples, (N, K, P, 4) m, m/s.
        hidden: Mask of the people under a lampshade or another person's umbrella, (N, K, P).
        identity_error: The tool is within `FOLLOWED_DISTANCE` of another person and not of the right one, (N,) bool.
        lost: The right person was farther away than `LOST_DISTANCE` and has not been within `FOLLOWED_DISTANCE` since,
            (N,) bool.
        losses: Number of times the person was lost, (N,).
        reacquisitions: Number of times the person was reached again, (N,).
        kept: The mean distance to the right person over the last second is below `FOLLOWED_DISTANCE`, (N,) bool.
        time_on_target: Share of the episode's samples so far with a distance below `ON_TARGET_DISTANCE`, (N,).
    """

    config: FollowConfig

    def __init__(self, config: FollowConfig, count: int, engine: str = "pymunk", threads: int = 1) -> None:
        super().__init__(config, count, LOST_SAMPLES, engine, threads)
        self._episodes: list[FollowEpisode | None] = [None] * count
        table = count, samples(config), config.people
        self.people, self.hidden = np.zeros((*table, 4)), np.zeros(table, np.bool_)
        self.identity_error, self.lost = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        self.losses, self.reacquisitions = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.kept, self.time_on_target = np.zeros(count, np.bool_), np.zeros(count)
        self._on_target = np.zeros(count, np.int64)
        self._last_errors = np.zeros((count, KEPT_SAMPLES))
        self._old_features, self._old_time = np.zeros((count, 2)), np.zeros(count)

    @property
    def now(self) -> Labels:
        """Index of the current sample in the tables of each row, (N,)."""
        return self.steps + LEAD

    def episode(self, row: int) -> FollowEpisode:
        """The episode of a row that has been reset."""
        episode = self._episodes[row]
        assert episode is not None, "a row has no episode before its first reset"
        return episode

    def _draw(self, rows: Labels, seeds: Labels) -> None:
        for row, seed in zip(rows.tolist(), seeds.tolist(), strict=True):
            episode = draw_follow_episode(self.config, seed)
            self._load(row, episode)
            self._episodes[row] = episode
            self.people[row], self.hidden[row] = episode.crowd.paths, episode.hidden

    def get_state(self) -> State:
        """Return the exact state: the episodes' seeds, and what has happened since their resets."""
        return super().get_state() | taken(self, _SCORES)

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go back to a state that `get_state` returned. Episodes of other seeds are drawn again.

        Raises:
            ValueError: An entry is missing, or does not fit.
        """
        super().set_state(state)
        put(self, _SCORES, state)

    def _before_sensing(self) -> None:
        if self.config.lamps or self.config.umbrellas:
            self._old_features[:], self._old_time[:] = self.features, self.frame_time

    def _after_sensing(self, rows: Mask) -> None:
        if self.config.lamps or self.config.umbrellas:
            _cover(
                rows, self.captured, self.hidden, self._old_features, self._old_time, self.visible, self.features,
                self.frame_time,
            )  # fmt: skip
        _follow(
            rows, self.steps, self.people, self.tool, self._last_errors, self._on_target, self.identity_error,
            self.lost, self.losses, self.reacquisitions, self.kept, self.time_on_target,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _cover(rows, captured, hidden, old_features, old_time, visible, features, frame_time):  # type: ignore[no-untyped-def]
    """Treat a frame in which the person is covered like a lost frame: the features keep their old values."""
    for i in range(rows.shape[0]):
        if rows[i] and visible[i] > 0.0 and hidden[i, captured[i], 0]:
            visible[i] = 0.0
            features[i] = old_features[i]
            frame_time[i] = old_time[i]


@njit(cache=True, nogil=True)
def _follow(  # type: ignore[no-untyped-def]
    rows, steps, people, tool, last_errors, on_target, identity_error, lost, losses, reacquisitions, kept, share
):
    """Update the scores of every chosen row: distances, identity errors, losses and reacquisitions."""
    for i in range(rows.shape[0]):
        if not rows[i]:
            continue
        now = people[i, steps[i] + LEAD]
        own = math.hypot(tool[i, 0] - now[0, 0], tool[i, 1] - now[0, 1])
        nearest = np.inf
        for k in range(1, now.shape[0]):
            nearest = min(nearest, math.hypot(tool[i, 0] - now[k, 0], tool[i, 1] - now[k, 1]))
        identity_error[i] = nearest < FOLLOWED_DISTANCE < own
        if steps[i] == 0:
            # At the first sample no person has been followed yet, neither the right one nor another.
            identity_error[i] = lost[i] = False
            losses[i] = reacquisitions[i] = on_target[i] = 0
            share[i] = 0.0
            last_errors[i] = own
            kept[i] = own < FOLLOWED_DISTANCE
            continue
        if lost[i] and own < FOLLOWED_DISTANCE:
            lost[i] = False
            reacquisitions[i] += 1
        elif not lost[i] and own > LOST_DISTANCE:
            lost[i] = True
            losses[i] += 1
        on_target[i] += own < ON_TARGET_DISTANCE
        share[i] = on_target[i] / steps[i]
        last_errors[i, steps[i] % KEPT_SAMPLES] = own
        kept[i] = last_errors[i].mean() < FOLLOWED_DISTANCE
