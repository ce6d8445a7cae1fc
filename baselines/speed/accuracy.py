"""Whether the agents reach the figures that were asked for, on test seeds that nothing was tuned on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import joblib
import numpy as np

from servotrack.baselines.evaluation import seeds, statistics
from servotrack.baselines.evaluation.bench import default_agents
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import CellResults

ENV_ID = "UncalibServo-v0"
BOUND = "informed-bound"
UNSKILLED = {"random", "fixed-jacobian"}

Cells = Mapping[tuple[str, str], CellResults]


@dataclass(frozen=True)
class Task:
    """A setting of the environment, and the figures wanted there.

    Attributes:
        name: As the tables show it.
        setting: Arguments of the environment.
        ratios: Agent to the largest mean steady error wanted, over the oracle's.
        successes: Agent to the lower end of Wilson's 95 % interval wanted.
    """

    name: str
    setting: Mapping[str, Any]
    ratios: Mapping[str, float]
    successes: Mapping[str, float]

    @property
    def agents(self) -> tuple[str, ...]:
        """Every agent that has to run here."""
        return (*self.ratios, "oracle", *(a for a in self.successes if a != "oracle" and a not in self.ratios))


TASKS = (
    Task("level 0, 0.5 px", {"level": 0, "pixel_noise": 0.5}, {"kf": 2.5, "lifted-kf": 1.5}, {}),
    Task("level 3", {"level": 3}, {}, {"kf": 0.93, "lifted-kf": 0.96, "oracle": 0.97}),
    Task("level 5", {"level": 5}, {}, {"lifted-kf": 0.93}),
)
HEAVY = Task("level 6", {"level": 6}, {}, {name: 0.0 for name in sorted({*default_agents(), BOUND} - UNSKILLED)})


def cells() -> list[tuple[Task, str]]:
    """Every pair of a task and an agent that the tables need."""
    return [(task, agent) for task in (*TASKS, HEAVY) for agent in task.agents]


def run(count: int, jobs: int, on_cell: Callable[[], None]) -> Cells:
    """Every cell over the first `count` test seeds, on `jobs` processes; `on_cell` is called after each."""
    episodes = seeds.take("test", count)
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator")
    results = parallel(
        joblib.delayed(evaluate)(ENV_ID, agent, episodes, dict(task.setting), timing=False) for task, agent in cells()
    )
    found = {}
    for (task, agent), result in zip(cells(), results, strict=True):
        found[task.name, agent] = result
        on_cell()
    return found


def wanted_table(found: Cells) -> str:
    """The figures wanted beside those measured, as Markdown."""
    lines = ["| setting | agent | figure | measured | wanted | reached |", "|---|---|---|---|---|---|"]
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
    """Every agent's steady error at level 6, and its gap to the informed bound, paired by seed, as Markdown."""
    bound = found.get((HEAVY.name, BOUND))
    lines = ["| agent | mean steady error, mm | gap to the informed bound, mm | success |", "|---|---|---|---|"]
    rows = [(agent, found[HEAVY.name, agent]) for agent in HEAVY.agents]
    for agent, cell in sorted(rows, key=lambda row: float(steady(row[1]).mean())):
        gap = "the bound did not run"
        if bound is not None:
            difference = statistics.paired_difference(steady(cell), steady(bound))
            gap = f"{1e3 * difference.value:.2f} ({1e3 * difference.low:.2f} to {1e3 * difference.high:.2f})"
        rate = success(cell)
        error = f"{1e3 * float(steady(cell).mean()):.2f}"
        lines.append(f"| {agent} | {error} | {gap} | {rate.value:.3f} ({rate.low:.3f} to {rate.high:.3f}) |")
    return "\n".join(lines)


def steady(cell: CellResults) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Mean tracking error of every episode after 3 s, m."""
    return np.array([row["steady"] for row in cell.rows])


def success(cell: CellResults) -> statistics.Interval:
    """Success rate with Wilson's 95 % interval."""
    return statistics.wilson_interval(sum(bool(row["success"]) for row in cell.rows), len(cell.rows))


def _yes(reached: bool) -> str:
    return "yes" if reached else "no"
