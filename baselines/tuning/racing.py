"""Search of a structure within a budget of environment steps: races of random candidates, then of small changes.

A race is sequential halving (Z. Karnin, T. Koren and O. Somekh, Almost optimal exploration in multi-armed bandits,
ICML 2013) with thirds instead of halves: all candidates play a few episodes, the best third plays on. The first race is
between random draws. Every further one is between the winner so far and small changes of it, on new seeds.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.baselines.agents.protocol import AgentCard
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.episodes import full_episode_steps
from servotrack.baselines.evaluation.evaluate import make_vector, run_episodes
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.tuning.search import Measured, episode_cost
from servotrack.baselines.tuning.structures import Structure, StructureSpace, structures_for
from servotrack.baselines.worlds import world_of_id
from servotrack.estimators.types import Array

FIRST_RACE = 0.4
"""Share of the budget of the race between random draws."""
FURTHER_RACES = 4
RIVALS = 9
"""Candidates of a further race, the winner so far included."""
KEPT = 3
"""One candidate of so many goes on to the next heat."""
FIRST_RIVALS = ((3_000_000, 243), (300_000, 81), (0, 27))
"""Random draws of the first race, by the least budget in environment steps."""


@dataclass
class Race:
    """One race.

    Attributes:
        candidates: The structures.
        costs: Mean cost of each candidate over the episodes that it played; see `episode_cost`.
        episodes: Number of episodes that each candidate played; the same for all that reached the last heat.
        steps: Environment steps of all its episodes.
    """

    candidates: list[Structure]
    costs: list[float]
    episodes: list[int]
    steps: int

    @property
    def winner(self) -> Structure:
        """Best candidate among those that played most."""
        most = max(self.episodes)
        finalists = [i for i, played in enumerate(self.episodes) if played == most]
        return self.candidates[min(finalists, key=lambda i: self.costs[i])]


@dataclass
class StructureSearch:
    """Record of a search.

    Attributes:
        races: The races in order.
    """

    races: list[Race] = field(default_factory=list)

    @property
    def chosen(self) -> Structure:
        """Winner of the last race."""
        return self.races[-1].winner

    @property
    def steps(self) -> int:
        """Environment steps of all races."""
        return sum(race.steps for race in self.races)

    def as_record(self) -> list[dict[str, Any]]:
        """Return the races as JSON can hold them: costs of all candidates, and the winner; seeds give the others."""
        return [
            {
                "winner": race.winner,
                "costs": [round(cost, 3) for cost in race.costs],
                "episodes": race.episodes,
                "steps": race.steps,
            }
            for race in self.races
        ]


Play = Callable[[Structure, Sequence[int]], Measured]
"""Plays one episode of a candidate per seed."""


def player(env_id: str, env_kwargs: Mapping[str, Any], card: Callable[[Structure], AgentCard]) -> Play:
    """Return the function that plays candidates in one environment.

    Args:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        card: Returns the card of a candidate.
    """
    world = world_of_id(env_id)

    def play(structure: Structure, seeds: Sequence[int]) -> Measured:
        rows, _ = run_episodes(env_id, card(structure), seeds, env_kwargs)
        return Measured(np.array([episode_cost(world, row) for row in rows]), sum(row["length"] for row in rows))

    return play


def search_cell(
    env_id: str, level: int, budget: int, run: int = 0, on_episodes: Callable[[int], None] = lambda steps: None
) -> StructureSearch:
    """Search the structure of a classical agent for one world and level.

    Args:
        env_id: Gymnasium id; see `structures_for`.
        level: Level of the environment.
        budget: Environment steps of all episodes together.
        run: Number of the run; candidates and seeds derive from it.
        on_episodes: Called with the environment steps taken so far.

    Raises:
        ValueError: A world without a search space, or a budget that is too small.
    """
    space, env_kwargs = structures_for(env_id), {"level": level}
    env = make_vector(env_id, 1, env_kwargs, privileged=False)
    try:
        episode_steps = full_episode_steps(env)
    finally:
        env.close()
    assert episode_steps is not None, "worlds with a search space have a limit of steps"
    inner, taken = player(env_id, env_kwargs, space.card), 0

    def play(structure: Structure, seeds: Sequence[int]) -> Measured:
        nonlocal taken
        played = inner(structure, seeds)
        taken += played.steps
        on_episodes(taken)
        return played

    return search_structure(space, play, budget, episode_steps, np.random.default_rng([run, level, budget]))


def search_structure(
    space: StructureSpace, play: Play, budget: int, episode_steps: int, rng: np.random.Generator
) -> StructureSearch:
    """Search a space within a budget of environment steps, on seeds of the tune range.

    Args:
        space: The candidates. No default of a shipped agent takes part: its search would have to be counted.
        play: Plays one episode of a candidate per seed.
        budget: Environment steps of all episodes together. Larger budgets try more candidates on more episodes.
        episode_steps: Steps of a full episode; episodes that end early cost less.
        rng: Draws candidates and seeds.

    Raises:
        ValueError: A budget too small for the first race.
    """
    rivals = next(count for least, count in FIRST_RIVALS if budget >= least)
    least = _least_race(rivals, episode_steps)
    if int(FIRST_RACE * budget) < least:
        raise ValueError(
            f"budget must be at least {int(np.ceil(least / FIRST_RACE))} environment steps, for episodes of "
            f"{episode_steps} steps, got {budget}"
        )
    search = StructureSearch()
    drawn = [space.draw(rng) for _ in range(rivals)]
    search.races.append(_race(drawn, play, int(FIRST_RACE * budget), episode_steps, rng))
    for left in range(FURTHER_RACES, 0, -1):
        best = search.chosen
        changed = [space.changed(best, rng) for _ in range(RIVALS - 1)]
        share = (budget - search.steps) // left
        if share < _least_race(RIVALS, episode_steps):
            break
        search.races.append(_race([best, *changed], play, share, episode_steps, rng))
    return search


def _race(candidates: list[Structure], play: Play, budget: int, episode_steps: int, rng: np.random.Generator) -> Race:
    """Let candidates play in heats on common seeds, of which each goes on with the best third."""
    costs: list[Array] = [np.zeros(0) for _ in candidates]
    running, steps = list(range(len(candidates))), 0
    for left in range(_heats(len(candidates)), 0, -1):
        count = (budget - steps) // left // (len(running) * episode_steps)
        seeds = (seed_ranges.TUNE.start + rng.choice(len(seed_ranges.TUNE), count, replace=False)).tolist()
        for i in running:
            played = play(candidates[i], seeds)
            costs[i], steps = np.concatenate([costs[i], played.costs]), steps + played.steps
        running = sorted(running, key=lambda i: costs[i].mean())[: max(1, len(running) // KEPT)]
    return Race(candidates, [float(one.mean()) for one in costs], [len(one) for one in costs], steps)


def _heats(candidates: int) -> int:
    """Return the number of heats that leave one candidate, each with the best third of the one before."""
    return max(1, round(np.log(candidates) / np.log(KEPT)))


def _least_race(candidates: int, episode_steps: int) -> int:
    """Return the steps of the smallest race: each heat has those of one episode of every candidate."""
    return _heats(candidates) * candidates * episode_steps


def write_search(search: StructureSearch, path: Path, arguments: Mapping[str, Any]) -> None:
    """Write a search as JSON: `chosen`, `steps`, `races`, arguments and provenance.

    Args:
        search: The search.
        path: File to write.
        arguments: Arguments of the search.

    Raises:
        StorageError: The file cannot be written.
    """
    document = {
        "format": "servotrack-structure", "format_version": 1, "arguments": dict(arguments), "steps": search.steps,
        "chosen": search.chosen, "races": search.as_record(), "provenance": provenance(),
    }  # fmt: skip
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
