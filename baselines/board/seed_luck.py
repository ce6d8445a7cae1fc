"""Gain by lucky sealed seeds: `python -m servotrack.baselines.board.seed_luck [--suite NAME] [AGENT ...]`.

Without agents: unlike ones, the reference agents of the suite and some others.

A comment in an agent's file changes its digest, and with it the form that it plays. Authors may try many comments and
keep the luckiest. The gain is the mean score on the luckiest form minus that on all, so no number of variants gains
more. It stands beside two other designs with as many episodes, by draws from the same pool: the forms by chance, and
free seeds for every digest, of which 10,000 variants are searched.

The suite's forms are equal for the reference agents by construction. So the pool is also divided anew, several times,
by the reference agents other than the agent: the mean gain is that of an unknown agent of its kind.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Mapping, Sequence

import numpy as np

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.equal_forms import FORMS, REFERENCES, divided, form_means, pool_scores
from servotrack.baselines.board.suites import Suite, load_suite
from servotrack.baselines.board.verification import SUSPICIOUS
from servotrack.baselines.board.verify import FRESH
from servotrack.estimators.types import Array

VARIANTS = 10_000
DIVISIONS = 5
"""Divisions whose mean gain is printed. Raising it takes longer."""
OTHERS: Mapping[str, tuple[str, ...]] = {
    "servo": ("latency-bank-lifted-kf", "level-kf"),
    "clutter": ("pmbm", "gm-phd-hmm"),
}
"""Agents of a kind of world that have no part in its forms."""
MANY_FRESH = 400

Scores = Mapping[str, Array]
"""Scores on the pool by name of the cell."""


def scores_of(suite: Suite, agent: str, env_id: str) -> Scores:
    """Return the scores of an agent on the pools of a world's cells, those that it was made for."""
    made_for = agent_card(agent).trained_in
    cells = [cell for cell in suite.cells if cell.env_id == env_id and (made_for is None or cell.name in made_for)]
    return {cell.name: pool_scores(suite, cell, agent) for cell in cells}


def luckiest(means: Array) -> float:
    """Return the largest of some mean scores minus their mean."""
    return float(means.max() - means.mean())


def gain_on_free_seeds(scores: Scores, sealed: Mapping[str, int], seed: int = 0) -> float:
    """Return the gain of the luckiest of `VARIANTS` variants, each with seeds of its own from the pools.

    Args:
        scores: Scores on the pools.
        sealed: Sealed episodes of each cell.
        seed: Seed of the draws.
    """
    draws = np.random.default_rng(seed)
    means = [
        values[draws.integers(len(values), size=(VARIANTS, sealed[name]))].mean(axis=1)
        for name, values in scores.items()
    ]
    return luckiest(np.mean(means, axis=0))


def gain_on_forms(scores: Scores, references: Sequence[Scores]) -> float:
    """Return the mean gain over several divisions of the pools into forms.

    Args:
        scores: Scores of an agent.
        references: Scores of the reference agents; none divides by chance.
    """
    gains = []
    for seed in range(DIVISIONS):
        forms = {
            name: divided([other[name] for other in references] or [np.zeros(len(values))], FORMS, seed)
            for name, values in scores.items()
        }
        gains.append(luckiest(form_means(scores, forms)))
    return float(np.mean(gains))


def correlation(a: Scores, b: Scores) -> float:
    """Return the correlation of two agents' scores over seeds, within the cells of both."""
    shared = [name for name in a if name in b]
    both = [np.concatenate([scores[name] - scores[name].mean() for name in shared]) for scores in (a, b)]
    return float(np.corrcoef(both)[0, 1])


def note_threshold(suite: Suite, scores: Sequence[Scores], fresh: int) -> float:
    """Return the gap between known and fresh seeds from which the verifier makes a note.

    Args:
        suite: The suite.
        scores: Scores of one agent in each world.
        fresh: Fresh episodes in each cell.
    """
    found = {name: values for world in scores for name, values in world.items()}
    known = {cell.name: cell.public + cell.sealed for cell in suite.cells}
    variance = sum(values.var() * (1 / known[name] + 1 / fresh) for name, values in found.items())
    return SUSPICIOUS * float(np.sqrt(variance)) / len(found)


def main(arguments: Sequence[str]) -> None:
    """Print the gains in each world."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--suite", default="2027a")
    parser.add_argument("agents", nargs="*")
    chosen = parser.parse_args(arguments)
    suite = load_suite(chosen.suite)
    (kind,) = {cell.world.kind for cell in suite.cells}
    references = REFERENCES[kind]
    agents = chosen.agents or [*references, *OTHERS[kind]]
    worlds = list(dict.fromkeys(cell.env_id for cell in suite.cells))
    sealed = {cell.name: cell.sealed for cell in suite.cells}
    forms = {cell.name: cell.forms for cell in suite.cells}
    scores = {
        agent: [scores_of(suite, agent, env_id) for env_id in worlds] for agent in dict.fromkeys([*references, *agents])
    }
    print("| agent | world | forms of the suite | equal forms by other agents | forms by chance | free seeds |")
    print("|---|---|---|---|---|---|")
    for agent in agents:
        for k, env_id in enumerate(worlds):
            own = scores[agent][k]
            here = luckiest(form_means(own, forms))
            others = [scores[other][k] for other in references if other != agent]
            gains = [here, gain_on_forms(own, others), gain_on_forms(own, []), gain_on_free_seeds(own, sealed)]
            print(f"| {agent} | {env_id} | " + " | ".join(f"{gain:+.4f}" for gain in gains) + " |", flush=True)
    for k, env_id in enumerate(worlds):
        pairs = itertools.combinations([scores[agent][k] for agent in agents if agent != "random"], 2)
        found = [correlation(*pair) for pair in pairs]
        print(f"{env_id}: scores of two agents correlate by {min(found):.2f} to {max(found):.2f} over seeds")
    for fresh in (FRESH, MANY_FRESH):
        gaps = [note_threshold(suite, scores[agent], fresh) for agent in agents]
        print(f"{fresh} fresh episodes: a gap of {min(gaps):.3f} to {max(gaps):.3f} makes a note", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
