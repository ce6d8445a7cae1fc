"""Equally difficult forms of the sealed episodes, as an examination has several forms of one test.

Seeds that are drawn freely for every agent are a lottery: authors may change a comment in a file until the draw is
lucky. So a cell has one pool of seeds, which is divided once into a few forms. The digest of an agent's files chooses
its form, and all cells take the same one. However many variants are tried, there are no more draws than forms.

Seeds are divided by the scores of reference agents that work in different ways: on each form, each of them has almost
the mean score that it has on the whole pool. What makes a seed hard for one agent (noise, a target that turns sharply,
a bad first view) makes it hard for most, so forms are close to equal for other agents, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.recording import AgentPlayer
from servotrack.baselines.board.replay import ReplayError, replayed
from servotrack.baselines.board.suites import Suite, SuiteCell
from servotrack.estimators.types import Array

REFERENCES: Mapping[str, tuple[str, ...]] = {
    "servo": (
        "kf", "lifted-kf", "broyden", "rls", "ukf-as-printed", "latency-bank-kf", "fixed-jacobian", "oracle", "random",
    ),
    "clutter": (
        "gm-phd", "gm-cbmember", "pmb", "robust-pmb", "gnn", "raw-measurements", "association-oracle", "random",
    ),
}  # fmt: skip
"""Agents of a kind of world whose scores make forms equal. More agents of other kinds make forms more equal for unknown
agents."""
FORMS = 4
"""Number of forms. Raising it hides more seeds from each agent, takes a larger pool, and leaves more draws to luck."""
_SWEEPS = 40
_LEAST_GAIN = 1e-12
_TOGETHER = 100


def pool_scores(suite: Suite, cell: SuiteCell, agent: str) -> Array:
    """Return the scores of an agent on all seeds of a cell's pool, shape (seeds,).

    Args:
        suite: The suite.
        cell: The cell.
        agent: Name of an agent of the package.
    """
    player, seeds = AgentPlayer(agent_card(agent)), suite.pool(cell)
    episodes = [
        episode
        for start in range(0, len(seeds), _TOGETHER)
        for episode in player.play(suite, cell, seeds[start : start + _TOGETHER], start)
    ]
    return cell.scores([row for row in replayed(suite, cell, episodes) if not isinstance(row, ReplayError)])


def divided(scores: Sequence[Array], forms: int, seed: int = 0) -> str:
    """Divide a pool into forms on which all reference agents have nearly equal mean scores.

    Seeds are swapped between forms as long as that lowers the sum, over agents, of the variances of the forms' means.

    Args:
        scores: Scores of each reference agent on the pool, each of shape (seeds,).
        forms: Number of forms; the number of seeds must be a multiple.
        seed: Seed of the beginning and of the order of swaps.

    Returns:
        One hexadecimal digit for each seed.

    Raises:
        ValueError: A number of seeds that is not a multiple of `forms`.
    """
    centered = np.stack([values - values.mean() for values in scores], axis=1)
    if len(centered) % forms:
        raise ValueError(f"the number of seeds must be a multiple of {forms}, the number of forms, got {len(centered)}")
    draws = np.random.default_rng(seed)
    form: NDArray[np.int64] = draws.permutation(np.arange(len(centered)) % forms)
    sums = np.stack([centered[form == number].sum(axis=0) for number in range(forms)])
    for _ in range(_SWEEPS):
        if not sum(_swapped(centered, form, sums, i) for i in draws.permutation(len(centered))):
            break
    return "".join(f"{number:x}" for number in form)


def _swapped(centered: Array, form: NDArray[np.int64], sums: Array, i: int) -> bool:
    """Swap a seed with the one of another form that lowers the sum of squares most; return False if none does."""
    own, moved = form[i], centered - centered[i]
    squares = (sums**2).sum(axis=1)
    change = ((sums[own] + moved) ** 2).sum(axis=1) + ((sums[form] - moved) ** 2).sum(axis=1) - squares[own]
    change = np.where(form == own, 0.0, change - squares[form])
    j = int(change.argmin())
    if change[j] > -_LEAST_GAIN:
        return False
    sums[own] += moved[j]
    sums[form[j]] -= moved[j]
    form[i], form[j] = form[j], own
    return True


def form_means(scores: Mapping[str, Array], forms: Mapping[str, str]) -> Array:
    """Return the mean score over cells of each form, shape (forms,).

    Args:
        scores: Scores on the pool by name of the cell.
        forms: Digits of the forms by name of the cell.
    """
    means = []
    for name, values in scores.items():
        digits = np.array(list(forms[name]))
        means.append([values[digits == digit].mean() for digit in np.unique(digits)])
    return np.mean(means, axis=0)
