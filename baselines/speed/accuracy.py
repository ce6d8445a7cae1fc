"""Accuracy targets of the servo agents, measured on test seeds, which no tuning has seen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from joblib import delayed

from servotrack.baselines.evaluation import seeds, statistics
from servotrack.baselines.evaluation.bench import suite_of
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.running.workers import in_workers
from servotrack.estimators.types import Array

ENV_ID = "UncalibServo-v0"
INFORMED = "informed"
UNSKILLED = {"random", "fixed-jacobian"}

Cells = Mapping[tuple[str, str], CellResults]


@dataclass(frozen=True)
class Task:
    """A setting of the environment and the targets there.

    Attributes:
        name: Name in the tables.
        setting: Arguments of the environment.
        ratios: Agent to the largest accepted mean steady error, as a multiple of the oracle's.
        successes: Agent to the smallest accepted lower end of Wilson's 95 % interval.
    """

    name: str
    setting: Mapping[str, Any]
    ratios: Mapping[str, float]
    successes: Mapping[str, float]

    @property
    def agents(self) -> tuple[str, ...]:
        """All agents that the tables need here."""
        return (*self.ratios, "oracle", *(a for a in self.successes if a != "oracle" and a not in self.ratios))


TASKS = (
    Task("level 0, 0.5 px", {"level": 0, "pixel_noise": 0.5}, {"kf": 2.5, "lifted-kf": 1.5}, {}),
    Task("level 3", {"level": 3}, {}, {"kf": 0.93, "lifted-kf": 0.96, "oracle": 0.97}),
    Task("level 5", {"level": 5}, {}, {"lifted-kf": 0.93}),
)


@lru_cache(maxsize=1)
def heavy_task() -> Task:
    """Return level 6 with all agents of the default suite that can act there: learned ones trained at that level."""
    setting = {"level": 6}
    agents = {cell.agent for cell in suite_of(ENV_ID, None, (setting["level"],))}
    return Task("level 6", setting, {}, {name: 0.0 for name in sorted({*agents, INFORMED} - UNSKILLED)})


def cells() -> list[tuple[Task, str]]:
    """Return all pairs of a task and an agent that the tables need."""
    return [(task, agent) for task in (*TASKS, heavy_task()) for agent in task.agents]


def run(count: int, jobs: int, on_cell: Callable[[], None]) -> Cells:
    """Evaluate every cell on the first `count` test seeds.

    Args:
        count: Number of test seeds.
        jobs: Processes.
        on_cell: Called after each cell.

    Returns:
        Results, keyed by names of task and agent.
    """
    episodes = seeds.take("test", count)
    calls = (delayed(evaluate)(ENV_ID, agent, episodes, dict(task.setting), timing=False) for task, agent in cells())
    results = in_workers(calls, jobs, ordered=True)
    found = {}
    for (task, agent), result in zip(cells(), results, strict=True):
        found[task.name, agent] = result
        on_cell()
    return found


def target_table(found: Cells) -> str:
    """Return the targets beside the measured values as a Markdown table."""
    lines = ["| setting | agent | quantity | measured | target | met |", "|---|---|---|---|---|---|"]
    for task in TASKS:
        for agent, limit in task.ratios.items():
            ratio = float(steady(found[task.name, agent]).mean() / steady(found[task.name, "oracle"]).mean())
            lines.append(
                f"| {task.name} | {agent} | mean steady error over the oracle's | {ratio:.3f} | at most {limit:g} | "
                f"{_yes(ratio <= limit)} |"
            )
        for agent, limit in task.successes.items():
            rate = success(found[task.name, agent])
            lines.append(
                f"| {task.name} | {agent} | success | {rate.value:.3f} ({rate.low:.3f} to {rate.high:.3f}) | "
                f"lower end at least {limit:g} | {_yes(rate.low >= limit)} |"
            )
    return "\n".join(lines)


def gap_table(found: Cells) -> str:
    """Return steady errors at level 6 and their gaps to the informed agent, paired by seed, as a Markdown table."""
    heavy = heavy_task()
    informed = found.get((heavy.name, INFORMED))
    lines = ["| agent | mean steady error, mm | gap to the informed agent, mm | success |", "|---|---|---|---|"]
    rows = [(agent, found[heavy.name, agent]) for agent in heavy.agents]
    for agent, cell in sorted(rows, key=lambda row: float(steady(row[1]).mean())):
        gap = "the informed agent did not run"
        if informed is not None:
            difference = statistics.paired_difference(steady(cell), steady(informed))
            gap = f"{1e3 * difference.value:.2f} ({1e3 * difference.low:.2f} to {1e3 * difference.high:.2f})"
        rate = success(cell)
        error = f"{1e3 * float(steady(cell).mean()):.2f}"
        lines.append(f"| {agent} | {error} | {gap} | {rate.value:.3f} ({rate.low:.3f} to {rate.high:.3f}) |")
    return "\n".join(lines)


def steady(cell: CellResults) -> Array:
    """Mean tracking error of every episode after 3 s, shape (episodes,), m."""
    return np.array([row["steady"] for row in cell.rows])


def success(cell: CellResults) -> statistics.Interval:
    """Return the success rate with Wilson's 95 % interval."""
    return statistics.wilson_interval(sum(bool(row["success"]) for row in cell.rows), len(cell.rows))


def _yes(met: bool) -> str:
    return "yes" if met else "no"
