"""Separation of agents by the levels of the servo worlds, and their distance from the bound."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from servotrack.baselines.agents.registry import AGENTS
from servotrack.baselines.evaluation.bench import run_suite, suite_of
from servotrack.baselines.evaluation.results import CellResults, ResultsFolder
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.leaderboard.anchoring import bounds_of, column_of
from servotrack.baselines.leaderboard.ladder_axes import axes_text
from servotrack.baselines.leaderboard.summary import AgentSummary, TaskSummary, summarize
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.baselines.running.stopping import program
from servotrack.baselines.worlds import WORLDS

ENV_IDS = ("UncalibServo-v0", "UncalibServoReach-v0")
LEVELS = tuple(range(7))
NEAR_BEST = 0.98
"""Share of the best score from which on an agent counts as equal to the best."""
NEAR_ZERO = 0.02
"""Score up to which an agent counts as one without skill."""
PLACE = 10
"""Place whose distance from the best says whether a level separates."""
WIDTHS = 3.0
"""Least such distance, in half widths of the wider 95 % interval."""
INFORMED = "informed"


def ladder_cells(
    env_id: str, folder: Path, episodes: int, split: str, levels: Sequence[int] = LEVELS
) -> list[CellResults]:
    """Evaluate all agents at some levels of an id, as far as the folder lacks them."""
    with progress_bars() as progress:
        return run_suite(
            suite_of(env_id, None, levels), ResultsFolder(folder), episodes=episodes, split=split, jobs=1,
            progress=progress,
        )  # fmt: skip


def ranked(task: TaskSummary) -> list[AgentSummary]:
    """Agents without privilege that have skill, best first; of agents equal to the bit only the first."""
    rows: list[AgentSummary] = []
    for row in task.rows:
        if row.scores is None or row.privileged or row.agent == "random":
            continue
        if not any(other.scores is not None and np.array_equal(row.scores, other.scores) for other in rows):
            rows.append(row)
    return rows


def bound_line(task: TaskSummary, cells: Sequence[CellResults]) -> list[str]:
    """One level: the bound, the informed agent, the best agent without privilege, and the ratios of their errors."""
    bound = task.world.bound_of(task.env_id)
    random = next(cell for cell in cells if cell.environment == task.environment and cell.agent == "random")
    least = np.array(bounds_of(random, bound))
    mean = bootstrap_mean(least)
    of_agents = {cell.agent: column_of(cell, "steady") for cell in cells if cell.environment == task.environment}
    errors = {agent: found.mean() for agent, found in of_agents.items() if found is not None}
    best = min((row.agent for row in ranked(task)), key=lambda agent: errors[agent])
    informed = errors.get(INFORMED, np.nan)
    zero = mean.value < 1e-12

    def ratio(error: float) -> str:
        return "" if zero else f"{error / mean.value:.2f}"

    return [
        str(task.level),
        "0" if zero else f"{1e3 * mean.value:.2f} [{1e3 * mean.low:.2f}, {1e3 * mean.high:.2f}]",
        f"{1e3 * informed:.2f}",
        ratio(informed),
        best,
        f"{1e3 * errors[best]:.2f}",
        ratio(errors[best]),
    ]


def separation_line(task: TaskSummary) -> list[str]:
    """One level: best and tenth agent, their distance over the wider interval, and agents at both ends."""
    rows = ranked(task)
    best, tenth = rows[0], rows[min(PLACE, len(rows)) - 1]
    assert best.score is not None and tenth.score is not None
    half = max(0.5 * (row.score.high - row.score.low) for row in (best, tenth) if row.score is not None)
    apart = (best.score.value - tenth.score.value) / half if half > 1e-6 else np.inf
    scores = [row.score.value for row in rows if row.score is not None]
    near = sum(score >= NEAR_BEST * best.score.value for score in scores)
    without = sum(score <= NEAR_ZERO for score in scores)
    holds = apart > WIDTHS and near <= 3 and without <= 3
    return [
        str(task.level),
        best.agent,
        f"{best.score.value:.3f} ± {0.5 * (best.score.high - best.score.low):.3f}",
        tenth.agent,
        f"{tenth.score.value:.3f} ± {0.5 * (tenth.score.high - tenth.score.low):.3f}",
        "exact" if np.isinf(apart) else f"{apart:.1f}",
        str(near),
        str(without),
        "yes" if holds else "no",
    ]


def ladder_text(cells: Sequence[CellResults], episodes: int, source: str) -> str:
    """Both tables of all ids, as Markdown."""
    parts, near = [], f"within {100 * (1 - NEAR_BEST):.0f} %"
    for env_id in dict.fromkeys(cell.env_id for cell in cells):
        own = [cell for cell in cells if cell.env_id == env_id]
        tasks = summarize(own)
        bounds = Grid(
            ["level", "bound mm", f"{INFORMED} mm", "× bound", "best agent", "its mm", "its × bound"],
            [bound_line(task, own) for task in tasks],
            1,
        )
        separation = Grid(
            ["level", "best", "score", f"place {PLACE}", "its score", "apart", near, "at zero", "separates"],
            [separation_line(task) for task in tasks],
            1,
        )
        parts.append(f"### {env_id}\n\n{as_markdown(bounds)}\n\n{as_markdown(separation)}")
    count = sum(WORLDS["servo"].kind in card.worlds for card in AGENTS.values())
    parts.append(
        f"{count} agents, those of learned ones that were trained at a level; {episodes} episodes each. Upper tables: "
        "mean steady error, brackets 95 % intervals. The best agent is the one of least mean error without privilege. "
        "Lower tables: agents without privilege by mean score, agents equal to the bit counted once; ± half width of "
        f"the 95 % interval; apart: distance of best and place {PLACE} in half widths of the wider interval; {near}: "
        f"agents whose score is that near to the best, itself included; at zero: scores up to {NEAR_ZERO:g}. A level "
        f"separates with apart above {WIDTHS:g} and at most three agents at either end. Written by {source}."
    )
    return "\n\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> None:
    """Evaluate what is missing, print the tables, and put them into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/servo-ladder", description=__doc__)
    parser.add_argument("--episodes", type=int, default=100, help="seeds of each level (default 100)")
    parser.add_argument("--split", default="tune", choices=("tune", "test"), help="seed range (default tune)")
    parser.add_argument("--worlds", nargs="+", default=ENV_IDS, choices=ENV_IDS, help="ids (default both)")
    parser.add_argument("--levels", nargs="+", type=int, default=LEVELS, choices=LEVELS, help="levels (default all)")
    parser.add_argument("--results", type=Path, default=Path("results/ladder"), help="folder of the episodes")
    parser.add_argument("--tables", nargs="+", type=Path, help="only the tables, from what these folders hold")
    parser.add_argument("--axes", action="store_true", help="only the table of axes that no level has")
    parser.add_argument("--write", type=Path, help="page with the marks servo-ladder (or servo-axes) :begin and :end")
    given = parser.parse_args(arguments)
    if given.episodes < 2:
        parser.error(f"--episodes must be at least 2, got {given.episodes}")
    with program("finished episodes are kept; run the same command again"):
        if given.axes:
            show(axes_text(given.episodes, given.split), given.write, "servo-axes")
            return
        cells = []
        for env_id in given.worlds:
            if given.tables is None:
                cells += ladder_cells(env_id, given.results / env_id, given.episodes, given.split, given.levels)
            for folder in given.tables or ():
                loaded = ResultsFolder(folder / env_id).load_all()
                cells += [cell for cell in loaded if cell.env_kwargs.get("level", 0) in given.levels]
        chosen = "".join(
            f" --{name} {' '.join(map(str, values))}"
            for name, values, whole in (("worlds", given.worlds, ENV_IDS), ("levels", given.levels, LEVELS))
            if tuple(values) != whole
        )
        source = f"`scripts/servo-ladder{chosen} --episodes {given.episodes} --split {given.split}`"
        versions = ", ".join(sorted({f"servotrack {cell.provenance['versions']['servotrack']}" for cell in cells}))
        text = ladder_text(cells, given.episodes, f"{source}, episodes by {versions}")
        show(text, given.write, "servo-ladder")


if __name__ == "__main__":
    main()
