"""Whether training wins: several runs of one recipe against a classical agent, runs and episodes resampled, crossed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servotrack.baselines import seeds as seed_ranges
from servotrack.baselines.evaluate import evaluate
from servotrack.baselines.leaderboard.measures import JUDGMENTS, Measure
from servotrack.baselines.leaderboard.summary import LOWER_ANCHOR, UPPER_ANCHOR
from servotrack.baselines.learned.card import LearnedCard, load_card
from servotrack.baselines.learned.shipped import agent_in_file
from servotrack.baselines.protocol import world_of
from servotrack.baselines.registry import agent_card
from servotrack.baselines.results import CellResults, ResultsFolder
from servotrack.baselines.statistics import Interval, crossed_difference, score

ENOUGH = 10
"""Training runs that a claim about training needs."""


@dataclass(frozen=True)
class Comparison:
    """What several training runs reach, less what one agent does.

    Attributes:
        environment: Id and arguments in one line.
        recipe: What was trained.
        against: The agent.
        runs: How many trainings.
        episodes: Each.
        headline: The world's measure.
        of_runs: Mean of the headline of each run.
        of_other: Mean of the other agent's.
        difference: Of the headline, runs less other.
        score: Of the mean score; None where the world has none.
        success: Of the success rate; None where there is none.
    """

    environment: str
    recipe: str
    against: str
    runs: int
    episodes: int
    headline: Measure
    of_runs: tuple[float, ...]
    of_other: float
    difference: Interval
    score: Interval | None
    success: Interval | None

    def markdown(self) -> str:
        """The comparison as a table."""
        unit, factor, digits = self.headline.unit, self.headline.factor, self.headline.digits
        means = factor * np.array(self.of_runs)
        lines = [
            f"| {self.environment} | {self.recipe}, {self.runs} runs | {self.against} | difference |",
            "|---|---|---|---|",
            f"| {self.headline.heading}, {unit} | {means.mean():.{digits}f} ({means.min():.{digits}f} to "
            f"{means.max():.{digits}f}) | {factor * self.of_other:.{digits}f} | "
            f"{_signed(self.difference, digits, factor)} |",
        ]
        lines += [
            f"| {name} | | | {_signed(interval, 3)} |"
            for name, interval in (("score", self.score), ("success", self.success))
            if interval is not None
        ]
        note = f"{self.episodes} seeds; brackets: 95 % intervals, runs and episodes resampled, crossed." + (
            "" if self.runs >= ENOUGH else f" Fewer than {ENOUGH} runs: no claim about training."
        )
        return "\n".join([*lines, "", note, ""])


def compare(
    folder: Path,
    recipe: str,
    against: str,
    results: ResultsFolder,
    episodes: int,
    split: str = "test",
    on_run: Callable[[], None] = lambda: None,
) -> Comparison:
    """Evaluate all training runs of a recipe and an agent on the same seeds.

    Args:
        folder: Of an environment, as `servotrack train` writes it.
        recipe: Whose runs lie there.
        against: Name of the other agent.
        results: Keeps the episodes, so that an interrupted comparison goes on.
        episodes: Per run.
        split: Of the seeds.
        on_run: Called after each.

    Raises:
        ValueError: Fewer than two runs.
        AgentFileError: A run whose agent cannot be used.
    """
    cards = sorted(folder.glob(f"{recipe}-seed*/agent.json"))
    if len(cards) < 2:
        raise ValueError(f"{folder} must hold at least two runs of {recipe!r}, found {len(cards)}; train more seeds")
    card: LearnedCard = load_card(cards[0])
    seeds = seed_ranges.take(split, episodes)

    def cell(agent: str) -> CellResults:
        named = agent_in_file(Path(agent)) if agent.endswith(".json") else agent_card(agent)
        done = evaluate(card.env_id, named, seeds, card.env_kwargs, folder=results, timing=False)
        on_run()
        return done

    runs = [cell(str(path)) for path in cards]
    other = cell(against)
    headline = JUDGMENTS[world_of(card.env_id)].headline

    def column(of: CellResults, name: str) -> list[float]:
        return [float(row[name]) for row in of.select(seeds)]

    def difference(name: str) -> Interval:
        return crossed_difference([column(run, name) for run in runs], column(other, name))

    scored = None
    if world_of(card.env_id) == "servo":
        anchors = [column(cell(name), headline.column) for name in (LOWER_ANCHOR, UPPER_ANCHOR)]
        scores = [score(column(one, headline.column), *anchors) for one in (*runs, other)]
        scored = crossed_difference(scores[:-1], scores[-1])
    return Comparison(
        card.environment,
        recipe,
        against,
        len(runs),
        episodes,
        headline,
        tuple(float(np.mean(column(run, headline.column))) for run in runs),
        float(np.mean(column(other, headline.column))),
        difference(headline.column),
        scored,
        difference("success") if "success" in other.rows[0] else None,
    )


def _signed(interval: Interval, digits: int, factor: float = 1.0) -> str:
    value, low, high = (f"{factor * part:+.{digits}f}" for part in interval)
    return f"{value} [{low}, {high}]"
