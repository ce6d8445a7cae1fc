"""Episodes as the page draws them: worlds stepped again from action traces, packed per task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from servotrack.baselines.evaluation.episodes import EpisodeRecorder, full_episode_steps
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.leaderboard.site.arm_replays import ArmWatcher
from servotrack.baselines.leaderboard.site.packing import Packer
from servotrack.baselines.leaderboard.site.set_replays import BoxWatcher, SetWatcher
from servotrack.estimators.types import Array

SAME_ROW = 1e-6
"""Largest difference between the numbers of a replay and those of its row, as between mathematics libraries."""


class Drawn(Protocol):
    """Something that the page can draw: the scene of a seed, or the motion of an agent in it."""

    def packed(self, packer: Packer) -> dict[str, Any]:
        """Return it for the page; curves go to the packer."""


class Watcher(Protocol):
    """Records a vector environment while it is stepped, made with (env, steps) after the reset."""

    def record(self, step: int, observation: Any) -> None:
        """Store what there is after `step` steps, 0 for the reset."""

    def scenes(self) -> Sequence[Drawn]:
        """Return the scene of each row."""

    def motion(self, row: int, length: int) -> Drawn:
        """Return the motion of a row whose episode took `length` steps."""


_WATCHERS: Mapping[str, Callable[[Any, int], Watcher]] = {
    "servo": ArmWatcher,
    "clutter": SetWatcher,
    "people": SetWatcher,
    "sonar": SetWatcher,
    "color": BoxWatcher,
}
"""Recorders by kind of world."""


def can_replay(cell: CellResults) -> bool:
    """Return True if the page can draw the world of these results; recordings of people take too long to play again."""
    return cell.kind in _WATCHERS and not (cell.kind == "people" and cell.env_kwargs.get("source"))


@dataclass(frozen=True)
class Replay:
    """Episodes of an agent in one environment, stepped again from their actions.

    Attributes:
        motions: Motions by seed. Episodes that differ from their rows are left out.
        scenes: Scenes by seed.
        faithful: True if every row of the results was recomputed, each number to within `SAME_ROW`.
    """

    motions: dict[int, Any]
    scenes: dict[int, Any]
    faithful: bool


def replay(cell: CellResults, actions: Mapping[int, Array]) -> Replay:
    """Step the cell's environment with recorded actions; nothing of the agent is run.

    Args:
        cell: Results; names the environment. Its rows are compared with the replayed ones.
        actions: Actions by seed, each (length, *shape of an action).
    """
    seeds = [seed for seed in actions if len(actions[seed])]
    if not seeds:
        return Replay({}, {}, False)
    lengths = np.array([len(actions[seed]) for seed in seeds])
    env = make_vector(cell.env_id, len(seeds), cell.env_kwargs, privileged=False)
    try:
        observation, _ = env.reset(seed=seeds)
        steps = min(int(lengths.max()), full_episode_steps(env) or int(lengths.max()))
        commands = np.zeros((len(seeds), steps, *env.single_action_space.shape))
        for row, seed in enumerate(seeds):
            commands[row, : lengths[row]] = actions[seed][:steps]
        recorder, watcher = EpisodeRecorder(seeds, env, observation), _WATCHERS[cell.kind](env, steps)
        watcher.record(0, observation)
        for step in range(steps):
            observation, reward, terminated, truncated, info = env.step(commands[:, step])
            recorder.record(observation, reward, terminated | truncated, info)
            watcher.record(step + 1, observation)
        rows, scenes = recorder.rows(), watcher.scenes()
        given = {row["seed"]: row for row in cell.rows}
        same = {
            seed: watcher.motion(k, row["length"])
            for k, (seed, row) in enumerate(zip(seeds, rows, strict=True))
            if seed in given and row["length"] == lengths[k] and _is_same(row, given[seed])
        }
    finally:
        env.close()
    kept = {seed: scene for seed, scene in zip(seeds, scenes, strict=True) if seed in same}
    return Replay(same, kept, set(same) == set(given))


def _is_same(row: Mapping[str, Any], given: Mapping[str, Any]) -> bool:
    return row.keys() == given.keys() and all(abs(row[name] - given[name]) <= SAME_ROW for name in row)


def chosen_seeds(values: Mapping[int, float], high_is_good: bool, shared: Sequence[int]) -> dict[int, list[str]]:
    """Return the seeds of an agent's replays with their labels: `best`, `median`, `worst`, or none for a shared seed.

    Args:
        values: Score or headline measure by seed, at least one.
        high_is_good: True if larger is better.
        shared: Seeds that all agents show.
    """
    order = sorted(values, key=lambda seed: (-values[seed] if high_is_good else values[seed], seed))
    labels: dict[int, list[str]] = {}
    for name, place in (("best", 0), ("median", (len(order) - 1) // 2), ("worst", len(order) - 1)):
        labels.setdefault(order[place], []).append(name)
    for seed in shared:
        if seed in values:
            labels.setdefault(seed, [])
    return labels


def pack(
    motions: Mapping[str, Mapping[int, Drawn]],
    labels: Mapping[str, Mapping[int, list[str]]],
    scenes: Mapping[int, Drawn],
    values: Mapping[str, Mapping[int, float]],
) -> dict[str, Any]:
    """Pack the replays of one task.

    Args:
        motions: Motions by agent and seed.
        labels: Labels of those to keep, by agent and seed, see `chosen_seeds`.
        scenes: Scenes by seed.
        values: Headline measure by agent and seed.

    Returns:
        A document for the page: `scenes`, `replays`, `curves` and their `samples`.
    """
    packer = Packer()
    kept = [
        (agent, seed, names)
        for agent, of_agent in labels.items()
        for seed, names in of_agent.items()
        if seed in motions.get(agent, {})
    ]
    needed = sorted({seed for _, seed, _ in kept})
    packed_scenes = {str(seed): scenes[seed].packed(packer) for seed in needed}
    replays = [
        {
            "agent": agent,
            "seed": seed,
            "labels": names,
            "value": float(f"{values[agent][seed]:.8g}"),
            **motions[agent][seed].packed(packer),
        }
        for agent, seed, names in kept
    ]
    return {"scenes": packed_scenes, "replays": replays, "curves": packer.curves, "samples": packer.text()}
