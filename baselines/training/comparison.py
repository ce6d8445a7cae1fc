"""Compare several training runs of one recipe with one agent; intervals resample runs and episodes, crossed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servotrack.baselines.agents.learned.card import LearnedCard, load_card
from servotrack.baselines.agents.learned.shipped import agent_in_file
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder
from servotrack.baselines.evaluation.statistics import Interval, crossed_difference
from servotrack.baselines.leaderboard.anchoring import find_anchors
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.worlds import RankingMetric, describe_environment, world_of_id

MIN_RUNS = 10
"""Smallest number of training runs that supports a claim about training."""


@dataclass(frozen=True)
class Comparison:
    """Results of several training runs minus those of one agent.

    Attributes:
        environment: Id and arguments in one line.
        recipe: Recipe of the runs.
        against: Name of the agent.
        runs: Number of training runs.
        episodes: Number of episodes of each run.
        headline: Ranking metric of the world.
        of_runs: Mean headline metric of each run.
        of_other: Mean headline metric of the agent.
        difference: Difference of the headline metric, runs minus agent.
        score: Difference of the mean score; None where the world has no score.
        success: Difference of the success rate; None where the world has none.
        returned: Difference of the mean return.
    """

    environment: str
    recipe: str
    against: str
    runs: int
    episodes: int
    headline: RankingMetric
    of_runs: tuple[float, ...]
    of_other: float
    difference: Interval
    score: Interval | None
    success: Interval | None
    returned: Interval

    def grid(self) -> Grid:
        """Return the comparison as a table: one row per measure."""
        unit, factor, digits = self.headline.unit, self.headline.factor, self.headline.digits
        means = factor * np.array(self.of_runs)
        rows = [
            [
                f"{self.headline.heading}, {unit}",
                f"{means.mean():.{digits}f} ({means.min():.{digits}f} to {means.max():.{digits}f})",
                f"{factor * self.of_other:.{digits}f}",
                _signed(self.difference, digits, factor),
            ]
        ]
        rows += [
            [name, "", "", _signed(interval, digits)]
            for name, interval, digits in (
                ("score", self.score, 3), ("success", self.success, 3),
                ("return", None if self.score is not None else self.returned, 1),
            )
            if interval is not None
        ]  # fmt: skip
        return Grid([self.environment, f"{self.recipe}, {self.runs} runs", self.against, "difference"], rows, 4)

    def markdown(self) -> str:
        """Return the comparison as a Markdown table with a note."""
        note = f"{self.episodes} seeds; brackets: 95 % intervals, runs and episodes resampled, crossed." + (
            "" if self.runs >= MIN_RUNS else f" Fewer than {MIN_RUNS} runs: no claim about training."
        )
        return f"{as_markdown(self.grid())}\n{note}\n"


def compare(
    folder: Path,
    recipe: str,
    against: str,
    results: ResultsFolder,
    episodes: int,
    split: str = "test",
    on_run: Callable[[], None] = lambda: None,
) -> list[Comparison]:
    """Evaluate all training runs of a recipe and one agent on the same seeds, at each level of the training.

    Args:
        folder: Folder of an environment, written by `servotrack train`.
        recipe: Recipe of the runs.
        against: Name of the agent.
        results: Folder that keeps the episodes, so that an interrupted comparison resumes.
        episodes: Number of episodes per run and level.
        split: Seed range, "test" or "tune".
        on_run: Called after each evaluation.

    Raises:
        ValueError: Fewer than two runs.
        AgentFileError: A run whose agent file is invalid.
    """
    cards = sorted(folder.glob(f"{recipe}-seed*/agent.json"))
    if len(cards) < 2:
        raise ValueError(f"{folder} must hold at least two runs of {recipe!r}, found {len(cards)}; train more seeds")
    card: LearnedCard = load_card(cards[0])
    seeds = seed_ranges.take(split, episodes)

    def at(env_kwargs: dict[str, Any]) -> Comparison:
        def cell(agent: str) -> CellResults:
            named = agent_in_file(Path(agent)) if agent.endswith(".json") else agent_card(agent)
            done = evaluate(card.env_id, named, seeds, env_kwargs, folder=results, timing=False)
            on_run()
            return done

        runs, other = [cell(str(path)) for path in cards], cell(against)
        world = world_of_id(card.env_id)
        names = [] if world.anchors is None else [world.anchors.lower, world.anchors.upper]
        anchors = [cell(name) for name in (names[:1] if world.bound_of(card.env_id) else names)]
        return _compared(describe_environment(card.env_id, env_kwargs), recipe, against, seeds, runs, other, anchors)

    return [at({**card.env_kwargs, "level": level}) for level in card.levels] or [at(card.env_kwargs)]


def _compared(
    environment: str,
    recipe: str,
    against: str,
    seeds: list[int],
    runs: list[CellResults],
    other: CellResults,
    anchors: list[CellResults],
) -> Comparison:
    world = world_of_id(other.env_id)
    headline = world.headline

    def column(of: CellResults, name: str) -> list[float]:
        return [float(row[name]) for row in of.select(seeds)]

    def difference(name: str) -> Interval:
        return crossed_difference([column(run, name) for run in runs], column(other, name))

    scored = None
    anchoring, _ = find_anchors({anchor.agent: anchor for anchor in anchors}, world)
    if anchoring is not None:
        scores = [anchoring.scale(np.array(column(one, headline.column))) for one in (*runs, other)]
        scored = crossed_difference(scores[:-1], scores[-1])
    return Comparison(
        environment,
        recipe,
        against,
        len(runs),
        len(seeds),
        headline,
        tuple(float(np.mean(column(run, headline.column))) for run in runs),
        float(np.mean(column(other, headline.column))),
        difference(headline.column),
        scored,
        difference("success") if "success" in other.rows[0] else None,
        difference("return"),
    )


def _signed(interval: Interval, digits: int, factor: float = 1.0) -> str:
    value, low, high = (f"{factor * part:+.{digits}f}" for part in interval)
    return f"{value} [{low}, {high}]"
