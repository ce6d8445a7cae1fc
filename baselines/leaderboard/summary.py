"""From rows to what a leaderboard says: computed here each time, stored nowhere."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from servotrack.baselines.evaluation import statistics
from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.evaluation.statistics import Interval, PairedDifference
from servotrack.baselines.leaderboard.anchoring import Anchoring, bounds_of, column_of, find_anchors
from servotrack.baselines.worlds import RANDOM_AGENT, WORLDS, EpisodeBound, World
from servotrack.estimators.types import Array

EQUAL_SCORE = 0.02
"""Margin of equivalence: agents share a row of the overview if the 95 % interval of the paired difference of their
scores lies within plus or minus this in every task. Raising it folds more agents."""

_NOTHING = 1e-12
"""Mean bounds up to this are zero, so that nothing can be divided by them."""


@dataclass(frozen=True)
class AgentSummary:
    """One row of a task's table; None where a number is not defined for the environment or was not measured.

    Attributes:
        agent: Name.
        information: Information class: what the agent may know.
        privileged: True if it saw the truth.
        episodes: Number of episodes.
        mean_return: Over episodes.
        success: Rate with Wilson's interval.
        steady: Mean steady error, m.
        worst_error: Mean of the worst tenth of the steady errors, m.
        score: Mean score; 0 is random, 1 the bound, or the agent that knows the system where there is no bound.
        worst_score: Mean of the worst tenth of the scores.
        scores: Scores of all episodes, in the order of `seeds`.
        seeds: Seeds of the episodes.
        over_bound: Mean of the world's bounded column over the mean bound of the same episodes.
        measures: Means over episodes of the world's measures, by column, in the rows' units.
        difference: The world's headline measure minus the reference's, paired by seed.
        adjusted_p: P-value of the difference after Holm's correction over the task's table.
        step_seconds: Median compute time of one step, s.
        tuning_steps: Environment steps spent on tuning or training; None where they were not counted.
    """

    agent: str
    information: str
    privileged: bool
    episodes: int
    mean_return: Interval
    success: Interval | None
    steady: Interval | None
    worst_error: float | None
    score: Interval | None
    worst_score: float | None
    scores: Array | None
    seeds: tuple[int, ...]
    over_bound: float | None
    measures: Mapping[str, Interval]
    difference: PairedDifference | None
    adjusted_p: float | None
    step_seconds: float | None
    tuning_steps: int | None


@dataclass(frozen=True)
class TaskSummary:
    """One environment with its arguments, and its agents from best to worst.

    Attributes:
        environment: Id and arguments in one line.
        env_id: Gymnasium id.
        level: The argument `level` where it is the only one, else None.
        rows: Best first.
        deterministic: True if all episodes of every agent but the random one came out the same.
        world: Record of its kind: metrics, reference agent, anchors of the score.
        anchoring: Scale of its scores; None without scores.
        notes: Reasons for missing scores, and other reservations, one sentence each.
    """

    environment: str
    env_id: str
    level: int | None
    rows: tuple[AgentSummary, ...]
    deterministic: bool
    world: World
    notes: tuple[str, ...] = ()
    anchoring: Anchoring | None = None

    @property
    def bound(self) -> AgentSummary | None:
        """The row that "x bound" divides by, None where it divides by the bounds of episodes."""
        name = None if self.world.anchors is None else self.world.anchors.bound
        return None if name is None else self.row(name)

    def row(self, agent: str) -> AgentSummary | None:
        """The row of an agent, if it has one."""
        return next((row for row in self.rows if row.agent == agent), None)


@dataclass(frozen=True)
class OverallSummary:
    """An agent over all tasks.

    Attributes:
        agent: Name.
        information: Information class.
        privileged: True if it saw the truth.
        score: Interquartile mean of its scores.
        success: Success rate over all episodes.
        worst_score: Mean over tasks of the mean of the worst tenth of its scores, which an interquartile mean hides.
    """

    agent: str
    information: str
    privileged: bool
    score: Interval
    success: Interval
    worst_score: float


def summarize(cells: Iterable[CellResults]) -> list[TaskSummary]:
    """One summary per environment, in the order of their names.

    Compute time is that of the agent in any environment of the same id where it was measured: it does not depend on the
    arguments, and is measured where nothing else runs.
    """
    tasks: dict[str, list[CellResults]] = {}
    step_seconds: dict[tuple[str, str], float] = {}
    for cell in cells:
        if cell.rows:
            tasks.setdefault(cell.environment, []).append(cell)
        if cell.step_seconds:
            step_seconds[cell.env_id, cell.agent] = float(np.median(cell.step_seconds))
    return [_summarize_task(name, tasks[name], step_seconds) for name in sorted(tasks)]


def overall(tasks: Sequence[TaskSummary]) -> list[OverallSummary]:
    """Agents that have a score in every task that has scores, best first."""
    scored = [task for task in tasks if any(row.scores is not None for row in task.rows)]
    if not scored:
        return []
    summaries = []
    for first in scored[0].rows:
        rows = [row for task in scored if (row := task.row(first.agent)) is not None and row.scores is not None]
        if len(rows) < len(scored):
            continue
        scores = [row.scores for row in rows if row.scores is not None]
        successes = sum(round(row.success.value * row.episodes) for row in rows if row.success)
        summaries.append(
            OverallSummary(
                first.agent,
                first.information,
                first.privileged,
                statistics.stratified_interquartile_mean(scores),
                statistics.wilson_interval(successes, sum(row.episodes for row in rows)),
                float(np.mean([row.worst_score for row in rows if row.worst_score is not None])),
            )
        )
    return sorted(summaries, key=lambda summary: -summary.score.value)


def fold_equal(
    tasks: Sequence[TaskSummary], ranked: Sequence[OverallSummary]
) -> list[tuple[OverallSummary, list[str]]]:
    """Gather equivalent agents, so that they share a row.

    An agent joins one above it of the same information class if in every task their scores are equal to the bit, or the
    95 % interval of their paired difference lies within plus or minus `EQUAL_SCORE`.

    Args:
        tasks: Tasks of `summarize`.
        ranked: Agents of `overall`, best first.

    Returns:
        One agent per group, the one with the shortest name, best group first; and the names of the others.
    """
    groups: list[list[OverallSummary]] = []
    for agent in ranked:
        for group in groups:
            same_class = group[0].information == agent.information
            if same_class and all(_are_equal(task, group[0].agent, agent.agent) for task in tasks):
                group.append(agent)
                break
        else:
            groups.append([agent])
    shown = [min(group, key=lambda agent: len(agent.agent)) for group in groups]
    return [
        (kept, [agent.agent for agent in group if agent is not kept]) for kept, group in zip(shown, groups, strict=True)
    ]


def _are_equal(task: TaskSummary, first: str, second: str) -> bool:
    a, b = task.row(first), task.row(second)
    if a is None or b is None or a.scores is None or b.scores is None:
        return False
    position = {seed: i for i, seed in enumerate(b.seeds)}
    if set(a.seeds) != set(position):
        return False
    other = b.scores[[position[seed] for seed in a.seeds]]
    if np.array_equal(a.scores, other):
        return True
    difference = statistics.bootstrap_mean(a.scores - other)
    return max(-difference.low, difference.high) < EQUAL_SCORE


def stamp(cells: Iterable[CellResults]) -> str:
    """Return the first 12 hexadecimal digits of the SHA-256 over all rows: equal for tables of the same results."""
    digest = hashlib.sha256()
    for cell in sorted(cells, key=lambda cell: (cell.environment, cell.agent)):
        digest.update(json.dumps([cell.environment, cell.agent, cell.rows], sort_keys=True).encode())
    return digest.hexdigest()[:12]


def _summarize_task(name: str, cells: list[CellResults], step_seconds: dict[tuple[str, str], float]) -> TaskSummary:
    by_agent = {cell.agent: cell for cell in cells}
    world = WORLDS[cells[0].kind]
    anchoring, notes = find_anchors(by_agent, world)
    rows = [_summarize_cell(cell, world, by_agent, anchoring, step_seconds) for cell in cells]
    notes += [] if anchoring is None else anchoring.missing(cells)
    if unsealed := [cell.agent for cell in cells if not cell.has_digests]:
        notes.append(f"Files of servotrack 0.1.0 have no digests that would show later changes: {', '.join(unsealed)}.")
    compared = [row for row in rows if row.difference is not None]
    adjusted = statistics.holm([row.difference.p_value for row in compared if row.difference is not None])
    p_of = {row.agent: p for row, p in zip(compared, adjusted, strict=True)}
    rows = [replace(row, adjusted_p=p_of.get(row.agent)) for row in rows]
    kwargs = cells[0].env_kwargs
    level = kwargs["level"] if set(kwargs) == {"level"} and type(kwargs["level"]) is int else None
    acting = [cell for cell in cells if cell.agent != RANDOM_AGENT and len(cell.rows) > 1]
    deterministic = bool(acting) and all(len({row["return"] for row in cell.rows}) == 1 for cell in acting)
    env_id = cells[0].env_id
    headline = world.headline

    def rank(row: AgentSummary) -> float:
        if row.score is not None:
            return -row.score.value
        mean = row.measures.get(headline.column)
        if mean is None:
            return -row.mean_return.value
        return -mean.value if headline.high_is_good else mean.value

    return TaskSummary(
        name, env_id, level, tuple(sorted(rows, key=rank)), deterministic, world, tuple(notes), anchoring
    )


def _summarize_cell(
    cell: CellResults,
    world: World,
    by_agent: dict[str, CellResults],
    anchoring: Anchoring | None,
    step_seconds: dict[tuple[str, str], float],
) -> AgentSummary:
    measured = {measure.column: _mean_of(cell, measure.column) for measure in world.shown}
    has_success = all("success" in row for row in cell.rows)
    errors = None if world.anchors is None else column_of(cell, world.anchors.column)
    scores = None if anchoring is None or errors is None else anchoring.scores(cell, errors)
    return AgentSummary(
        agent=cell.agent,
        information=cell.card["information"],
        privileged="truth" in cell.card["requires"],
        episodes=len(cell.rows),
        mean_return=statistics.bootstrap_mean([row["return"] for row in cell.rows]),
        success=statistics.wilson_interval(sum(row["success"] for row in cell.rows), len(cell.rows))
        if has_success
        else None,
        steady=None if errors is None else statistics.bootstrap_mean(errors),
        worst_error=None if errors is None else statistics.worst_tenth(errors, high_is_bad=True),
        score=None if scores is None else statistics.bootstrap_mean(scores),
        worst_score=None if scores is None else statistics.worst_tenth(scores, high_is_bad=False),
        scores=scores,
        seeds=tuple(cell.seeds),
        over_bound=_over_bound(cell, world.bound_of(cell.env_id)),
        measures={column: mean for column, mean in measured.items() if mean is not None},
        difference=_difference(cell, by_agent.get(world.reference), world.headline.column),
        adjusted_p=None,
        step_seconds=step_seconds.get((cell.env_id, cell.agent)),
        tuning_steps=cell.card["tuning_steps"],
    )


def _over_bound(cell: CellResults, bound: EpisodeBound | None) -> float | None:
    """Mean of the bounded column over the mean bound of the same episodes."""
    if bound is None or (values := column_of(cell, bound.column)) is None:
        return None
    least = bounds_of(cell, bound)
    return float(np.mean(values[: len(least)]) / np.mean(least)) if least and np.mean(least) > _NOTHING else None


def _mean_of(cell: CellResults, name: str) -> Interval | None:
    values = column_of(cell, name)
    return None if values is None else statistics.bootstrap_mean(values)


def _difference(cell: CellResults, reference: CellResults | None, name: str) -> PairedDifference | None:
    if reference is None or reference.agent == cell.agent:
        return None
    if column_of(cell, name) is None or column_of(reference, name) is None:
        return None
    known = set(reference.seeds)
    common = [seed for seed in cell.seeds if seed in known]
    if not common:
        return None
    return statistics.paired_difference(
        [row[name] for row in cell.select(common)], [row[name] for row in reference.select(common)]
    )
