"""Replay of traces by the compiled vector engine: rows follow from seeds and actions, and no agent runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.board.action_grid import ActionGrid
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.baselines.evaluation.episodes import EpisodeRecorder
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import Row
from servotrack.estimators.types import Mask

BATCH = 2000
"""Episodes that are replayed side by side. Raising it takes more memory and less time, up to some thousands."""


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
    return [row for batch in _batches(episodes) for row in _replayed(suite, cell, batch)]


def _batches(episodes: Sequence[Episode]) -> Iterator[Sequence[Episode]]:
    for start in range(0, len(episodes), BATCH):
        yield episodes[start : start + BATCH]


def _replayed(suite: Suite, cell: SuiteCell, episodes: Sequence[Episode]) -> Iterable[Row | ReplayError]:
    seeds = [episode.seed for episode in episodes]
    lengths = np.array([len(episode.points) for episode in episodes])
    width = episodes[0].points.shape[1]
    points = np.zeros((int(lengths.max()), len(episodes), width), np.int16)
    for k, episode in enumerate(episodes):
        points[: len(episode.points), k] = episode.points
    env = make_replay_env(cell, len(seeds))
    try:
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
