"""Rows of the board before they are summarized: results with their proof and, where there are traces, their actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from servotrack.baselines.agents.registry import AGENTS, agent_card, create_agent
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder
from servotrack.baselines.reporting.files import ResultsError
from servotrack.estimators.types import Array

Proof = Literal["replayed", "re-run", "self-reported"]
"""Check behind a row: its trace was replayed, its agent was run again, or neither."""

ActionsOf = Callable[[CellResults, Sequence[int]], Mapping[int, Array]]
"""Function that returns the actions of episodes by seed, each (length, n); seeds without a trace are left out."""


@dataclass(frozen=True)
class Entry:
    """One agent in one environment.

    Attributes:
        suite: Name of the suite, "" for results outside a suite.
        cell: Results.
        proof: Check behind the rows.
        stale: True if the package's rollouts have changed since the rows were made.
        actions: Source of the episodes' actions.
    """

    suite: str
    cell: CellResults
    proof: Proof
    stale: bool
    actions: ActionsOf


def entries_of(folder: Path) -> list[Entry]:
    """Read a folder of results, or a folder of such folders as `servotrack bench` makes them.

    Raises:
        ResultsError: There are no results, or a file is damaged.
    """
    folders = [folder] if any(folder.glob("*/*.json")) else sorted({p.parents[1] for p in folder.glob("*/*/*.json")})
    if not folders:
        raise ResultsError(f"{folder} holds no results; run `servotrack bench` first")
    return [
        Entry("", cell, "self-reported", False, rerun_actions)
        for results in folders
        for cell in ResultsFolder(results).load_all()
        if cell.rows
    ]


def rerun_actions(cell: CellResults, seeds: Sequence[int]) -> Mapping[int, Array]:
    """Run a registered agent again and return its actions by seed, each (length, n).

    Agents that this package does not have yield nothing: no foreign code is run.

    Args:
        cell: Results of the agent, which name the environment.
        seeds: Seeds of the episodes.
    """
    if cell.agent not in AGENTS or not seeds:
        return {}
    card = agent_card(cell.agent)
    env = make_vector(cell.env_id, len(seeds), cell.env_kwargs, privileged=card.privileged)
    try:
        agent = create_agent(card, env)
        observation, _ = env.reset(seed=list(seeds))
        state, starts, ended = None, np.ones(len(seeds), dtype=bool), np.zeros(len(seeds), dtype=bool)
        over = ended
        taken: list[list[Array]] = [[] for _ in seeds]
        while not over.all():
            action, state = agent.predict(observation, state=state, episode_start=starts, deterministic=True)
            for row in np.flatnonzero(~over):
                taken[row].append(np.array(action[row], dtype=np.float64))
            observation, _, terminated, truncated, _ = env.step(action)
            # In Gymnasium's next-step mode the step after an end only resets: its observation starts an episode.
            starts, ended = ended, terminated | truncated
            over = over | ended
    finally:
        env.close()
    return {seed: np.stack(rows) for seed, rows in zip(seeds, taken, strict=True)}
