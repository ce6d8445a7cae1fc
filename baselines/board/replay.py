"""Replay of traces by the compiled vector engine: rows follow from seeds and actions, and no agent runs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from servotrack.baselines.board.action_grid import ActionGrid
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.baselines.evaluation.episodes import EpisodeRecorder, full_episode_steps
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Mask

BATCH = 2000
"""Most episodes that are replayed side by side. Raising it takes more memory and less time, up to some thousands."""
MOST_HELD = 10_000_000
"""Most numbers of observations and actions of the episodes of a batch: some worlds draw whole episodes at the reset."""

LONGEST_EPISODE = 100_000
"""Most steps of an episode."""


class Episode(NamedTuple):
    """Seed and actions of one episode.

    Attributes:
        seed: Seed of the environment.
        points: Actions as grid points, shape (steps, n).
    """

    seed: int
    points: NDArray[np.int16]


class ReplayError(ValueError):
    """A trace that is not a record of the episode of its seed."""


def replayed(suite: Suite, cell: SuiteCell, episodes: Sequence[Episode]) -> list[Row | ReplayError]:
    """Recompute the rows of a cell from seeds and actions.

    Args:
        suite: The suite.
        cell: The cell.
        episodes: Episodes, of any number of agents. Their order and number do not change a bit.

    Returns:
        One row per episode, or an error for an episode that ends earlier or later than its trace.
    """
    size = _batch_size(cell.env_id, json.dumps(cell.env_kwargs))
    return [row for batch in _batches(episodes, size) for row in _replayed(suite, cell, batch)]


@lru_cache(maxsize=64)
def _batch_size(env_id: str, env_kwargs: str) -> int:
    env = make_vector(env_id, 1, json.loads(env_kwargs), privileged=False)
    try:
        held = spaces.flatdim(env.single_observation_space) + spaces.flatdim(env.single_action_space)
        return max(min(BATCH, MOST_HELD // (held * (full_episode_steps(env) or 1))), 1)
    finally:
        env.close()


def _batches(episodes: Sequence[Episode], size: int) -> Iterator[Sequence[Episode]]:
    for start in range(0, len(episodes), size):
        yield episodes[start : start + size]


def _replayed(suite: Suite, cell: SuiteCell, episodes: Sequence[Episode]) -> Iterable[Row | ReplayError]:
    seeds = [episode.seed for episode in episodes]
    lengths = np.array([len(episode.points) for episode in episodes])
    env = make_replay_env(cell, len(seeds))
    try:
        # What lies beyond the end of the longest episode is never stepped.
        longest = min(int(lengths.max()), full_episode_steps(env) or LONGEST_EPISODE)
        points = np.zeros((longest, len(episodes), episodes[0].points.shape[1]), np.int16)
        for k, episode in enumerate(episodes):
            points[: len(episode.points), k] = episode.points[:longest]
        grid = ActionGrid.of(env.single_action_space, suite.grid)
        observation, _ = env.reset(seed=seeds)
        recorder = EpisodeRecorder(seeds, env, observation)
        finished: Mask = np.zeros(len(seeds), dtype=bool)
        for step in range(len(points)):
            observation, reward, terminated, truncated, info = env.step(grid.actions(points[step]))
            recorder.record(observation, reward, terminated | truncated, info)
            finished |= terminated | truncated
        for k, row in enumerate(recorder.rows()):
            if row["length"] != lengths[k] or not finished[k]:
                end = f"after {row['length']} steps" if finished[k] else "later"
                yield ReplayError(f"the episode of seed {seeds[k]} ends {end}, its trace after {lengths[k]} steps")
            else:
                yield row
    finally:
        env.close()


def make_replay_env(cell: SuiteCell, count: int) -> Any:
    """Return the vector environment of a cell that traces are replayed in."""
    return make_vector(cell.env_id, count, cell.env_kwargs, privileged=False)
