"""Gain by lucky sealed seeds: `python -m servotrack.baselines.board.seed_luck AGENT` searches 10,000 variants.

A comment in an agent's file changes its digest, and with it its sealed seeds. Authors may try many comments and keep
the luckiest. The gain is the score of the luckiest variant minus the mean score of all. Each cell has a pool of
episodes on sealed seeds, from which every variant draws its own; running all variants in full would take hours and give
the same distribution.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.recording import AgentPlayer
from servotrack.baselines.board.replay import ReplayError, replayed
from servotrack.baselines.board.sealed_seeds import sealed_seeds
from servotrack.baselines.board.suites import Suite, load_suite
from servotrack.estimators.types import Array

VARIANTS = 10_000
POOL = 1000
"""Episodes in the pool of a cell. Raising it takes longer and makes equal draws rarer."""
SEALED = (10, 25, 100, 400)
WANTED = 0.01
_TOGETHER = 100


def pools(suite: Suite, agent: str, env_id: str) -> list[Array]:
    """Return the scores of an agent on `POOL` sealed seeds of each cell of a world."""
    found = []
    player = AgentPlayer(agent_card(agent))
    for cell in suite.cells:
        if cell.env_id != env_id:
            continue
        seeds = sealed_seeds("0" * 64, f"{suite.name}/luck", cell.name, POOL)
        episodes = [
            episode
            for start in range(0, POOL, _TOGETHER)
            for episode in player.play(suite, cell, seeds[start : start + _TOGETHER])
        ]
        rows = [row for row in replayed(suite, cell, episodes) if not isinstance(row, ReplayError)]
        found.append(cell.scores(rows))
    return found


def luckiest(scores: Sequence[Array], sealed: int, variants: int = VARIANTS, seed: int = 0) -> tuple[float, float]:
    """Return the gain of the luckiest of many variants, and the standard deviation over variants.

    Args:
        scores: Scores of the pools, one array per cell.
        sealed: Sealed episodes of each cell.
        variants: Number of variants.
        seed: Seed of the draws.
    """
    draws = np.random.default_rng(seed)
    means = np.mean([pool[draws.integers(len(pool), size=(variants, sealed))].mean(axis=1) for pool in scores], axis=0)
    return float(means.max() - means.mean()), float(means.std())


def main(arguments: Sequence[str]) -> None:
    """Print the gains for several numbers of sealed episodes."""
    suite = load_suite("2027a")
    for agent in arguments or ("kf",):
        for env_id in dict.fromkeys(cell.env_id for cell in suite.cells):
            scores = pools(suite, agent, env_id)
            for sealed in SEALED:
                gain, spread = luckiest(scores, sealed)
                print(f"{agent} {env_id}: {sealed:4d} sealed episodes a cell: luckiest {gain:+.4f}, s.d. {spread:.4f}")
            single = np.sqrt(sum(pool.var() for pool in scores)) / len(scores)
            # The largest of 10,000 normal values lies 3.85 standard deviations above their mean.
            needed = (3.85 * single / WANTED) ** 2
            print(f"{agent} {env_id}: a gain below {WANTED} needs some {needed:.0f} sealed episodes a cell", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
