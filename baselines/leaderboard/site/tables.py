"""Tables of the page as plain data: what `summarize` computes, rounded, with units and proof."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from servotrack.baselines.evaluation.statistics import Interval, bootstrap_mean
from servotrack.baselines.leaderboard.site.entries import Entry
from servotrack.baselines.leaderboard.summary import AgentSummary, TaskSummary, overall
from servotrack.baselines.worlds import RankingMetric
from servotrack.envs.servo.levels import LEVEL_NAMES
from servotrack.envs.track.clutter.config import LEVEL_NAMES as CLUTTER_LEVEL_NAMES

_DIGITS = 5
_LEVEL_NAMES = {"servo": LEVEL_NAMES, "clutter": CLUTTER_LEVEL_NAMES}


def task_table(
    task: TaskSummary, entries: Mapping[str, Entry], watchable: Mapping[str, Collection[str]]
) -> dict[str, Any]:
    """One task for the page.

    Args:
        task: Summary of the task.
        entries: Entries of its agents by name.
        watchable: Labels of the replays by agent, see `chosen_seeds`.
    """
    measures = {measure.column: measure for measure in task.world.shown}
    return {
        "name": task.environment,
        "level": task.level,
        "label": _level_label(task),
        "scored": any(row.score for row in task.rows),
        "reference": task.world.reference,
        "headline": task.world.headline.column,
        "measures": [_measure(measure) for measure in measures.values()],
        "notes": list(task.notes),
        "rows": [{**_row(row, entries[row.agent]), "watch": sorted(watchable.get(row.agent, ()))} for row in task.rows],
    }


def overall_table(tasks: Sequence[TaskSummary]) -> list[dict[str, Any]]:
    """Agents over all tasks of a world that have a score in each: interquartile mean, success, worst tenth."""
    return [
        {
            "agent": row.agent,
            "score": _interval(row.score),
            "success": _interval(row.success),
            "worst": _number(row.worst_score),
        }
        for row in overall(tasks)
    ]


def episode_values(task: TaskSummary, entries: Mapping[str, Entry]) -> dict[str, Any]:
    """Headline measure of every episode on a seed that several agents met: `seeds`, values by agent, None for gaps."""
    column = task.world.headline.column
    met = Counter(seed for row in task.rows for seed in row.seeds)
    seeds = sorted(seed for seed, agents in met.items() if agents > 1 or len(task.rows) == 1)
    values = {}
    for row in task.rows:
        by_seed = {episode["seed"]: episode.get(column) for episode in entries[row.agent].cell.rows}
        values[row.agent] = [_number(by_seed.get(seed)) for seed in seeds]
    return {"seeds": seeds, "values": values}


def agent_facts(entries: Iterable[Entry]) -> dict[str, Any]:
    """Card and provenance of each agent by name, from one of its cells."""
    facts: dict[str, Any] = {}
    for entry in entries:
        record = entry.cell.provenance
        facts.setdefault(
            entry.cell.agent,
            {
                "summary": entry.cell.card.get("summary", ""),
                "version": record.get("versions", {}).get("servotrack", ""),
                "machine": record.get("machine", {}).get("system", ""),
                "engine": record.get("engine", ""),
                "created": record.get("created", ""),
                "command": record.get("command", ""),
            },
        )
    return facts


def _level_label(task: TaskSummary) -> str:
    if task.level is None:
        return task.environment
    names = _LEVEL_NAMES.get(task.world.kind, ())
    return f"{task.level} {names[task.level]}" if task.level < len(names) else str(task.level)


def _measure(measure: RankingMetric) -> dict[str, Any]:
    return {
        "column": measure.column,
        "heading": measure.heading,
        "unit": measure.unit,
        "factor": measure.factor,
        "digits": measure.digits,
        "highIsGood": measure.high_is_good,
    }


def _row(row: AgentSummary, entry: Entry) -> dict[str, Any]:
    difference = row.difference
    return {
        "agent": row.agent,
        "information": row.information,
        "privileged": row.privileged,
        "proof": entry.proof,
        "stale": entry.stale,
        "episodes": row.episodes + len(entry.sealed),
        "score": _interval(row.score),
        "worst": _number(row.worst_score),
        "success": _interval(row.success),
        "return": _interval(row.mean_return),
        "measures": {column: _interval(mean) for column, mean in row.measures.items()},
        "difference": None
        if difference is None
        else [_number(difference.value), _number(difference.low), _number(difference.high)],
        "sealed": _sealed(entry),
        "fresh": None if entry.fresh is None else _number(entry.fresh[0]),
        "p": _number(row.adjusted_p),
        "overBound": _number(row.over_bound),
        "stepSeconds": _number(row.step_seconds),
        "tuningSteps": row.tuning_steps,
    }


def _sealed(entry: Entry) -> list[float | None] | None:
    """Mean score on the seeds that follow from the agent's files."""
    return None if entry.sealed_scores is None else _interval(bootstrap_mean(entry.sealed_scores))


def _interval(interval: Interval | None) -> list[float | None] | None:
    return None if interval is None else [_number(value) for value in (interval.value, interval.low, interval.high)]


def _number(value: Any) -> float | None:
    """A number with few digits; None for what is missing or not finite, which JSON cannot hold."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{float(value):.{_DIGITS}g}")
