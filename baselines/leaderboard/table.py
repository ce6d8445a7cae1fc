"""Tables of the leaderboard, for the terminal, for documents and for programs."""

from __future__ import annotations

from collections.abc import Sequence

from servotrack.baselines.evaluation.statistics import Interval
from servotrack.baselines.leaderboard.anchoring import Anchoring
from servotrack.baselines.leaderboard.summary import (
    EQUAL_SCORE,
    AgentSummary,
    OverallSummary,
    TaskSummary,
    fold_equal,
    overall,
)
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.reporting.plain_text import markdown_code, markdown_text
from servotrack.baselines.worlds import EpisodeBound, RankingMetric

SIGNIFICANCE = 0.05
PRIVILEGED_MARK = "†"
BOUND_MARK = "× bound"
SAME_NOTE = (
    "Agents behind `same` are equivalent to the row's agent at every level: equal to the bit, or with the 95 % "
    f"interval of the paired difference within ±{EQUAL_SCORE:g}."
)
_COMMON_NOTE = (
    f"{PRIVILEGED_MARK} sees the truth. Brackets: 95 % intervals. Differences are paired by seed against the agent "
    "that their column names; * marks those below p = 0.05 after Holm's correction. Tuning steps: environment steps of "
    "`servotrack tune` or of training, on seeds of their own, excluding earlier manual trials; ? = not recorded."
)


def note_of(tasks: Sequence[TaskSummary]) -> str:
    """Explain the columns of the tables of these tasks."""
    bounds = dict.fromkeys(
        bound
        for task in tasks
        if (bound := task.world.bound_of(task.env_id)) and any(row.over_bound is not None for row in task.rows)
    )
    # Bounds of several ids of one world may mean the same.
    notes = dict.fromkeys(map(_bound_note, bounds))
    scales = {(task.anchoring.ends, task.anchoring.bound is None): task for task in tasks if task.anchoring}
    parts = [*(_score_note(task.anchoring) for task in scales.values() if task.anchoring), *notes]
    parts += [_divisor_note(task) for task in list(scales.values())[:1] if task.bound is not None]
    return " ".join([*dict.fromkeys(parts), _COMMON_NOTE])


def _score_note(anchoring: Anchoring) -> str:
    ends = anchoring.ends
    if anchoring.bound is None:
        high, one, more = ends.upper, f"{ends.upper} (the {ends.upper_knows})", ", more is possible"
        resolution = ""
    else:
        high, one, more = "bound", "the bound", ""
        resolution = f" + {1e3 * anchoring.resolution:g} mm" if anchoring.resolution else ""
    return (
        f"Score: ln(e_{ends.lower}/e) / ln(e_{ends.lower}/e_{high}), with e the mean steady error{resolution}: 0 is "
        f"{ends.lower}, 1 is {one}{more}. Worst tenth: mean score of the worst tenth of the episodes."
    )


def _divisor_note(task: TaskSummary) -> str:
    assert task.bound is not None
    return f"{BOUND_MARK}: mean steady error over that of {task.bound.agent}."


def _bound_note(bound: EpisodeBound) -> str:
    return (
        f"{BOUND_MARK}: mean {bound.heading} over the least that is possible for {bound.meaning}; up to "
        f"{bound.episodes} episodes."
    )


def missing_agents(task: TaskSummary) -> list[str]:
    """Agents without which columns of a task's table stay empty: anchors of the score, bound, reference."""
    anchors = task.world.anchors
    needed = [] if anchors is None else [anchors.lower]
    if anchors is not None and task.world.bound_of(task.env_id) is None:
        needed += [anchors.upper, *([anchors.bound] if anchors.bound else [])]
    present = {row.agent for row in task.rows}
    return [name for name in dict.fromkeys([*needed, task.world.reference]) if name not in present]


def overview_grid(tasks: Sequence[TaskSummary]) -> Grid:
    """Agents against tasks: mean score and success rate in every cell; last the worst tenth and the mean over tasks.

    Equivalent agents share a row. Below those that took part in all tasks come those that took part in
    some, such as learned ones, without a mean.
    """
    scored = [task for task in tasks if any(row.score for row in task.rows)]
    headings = ["agent", "information", *(_short_name(task) for task in scored), "worst tenth", "all (IQM)"]
    complete = fold_equal(scored, overall(tasks))
    ranked = {name for kept, names in complete for name in (kept.agent, *names)}
    partial = {row.agent: row for task in scored for row in task.rows if row.score and row.agent not in ranked}
    rows = []
    for kept, names in complete:
        name = _agent(kept) + (f" (same: {', '.join(names)})" if names else "")
        cells = [_score_and_success(task.row(kept.agent)) for task in scored]
        rows.append([name, kept.information, *cells, f"{kept.worst_score:.2f}", _interval(kept.score, 2)])
    for agent in sorted(partial):
        cells = [_score_and_success(task.row(agent)) for task in scored]
        rows.append([_agent(partial[agent]), partial[agent].information, *cells, "", ""])
    return Grid(headings, rows, 2)


def overview_grids(tasks: Sequence[TaskSummary]) -> list[tuple[str, Grid]]:
    """A title and an overview for each id that has scores; ids are not mixed, because their levels differ."""
    by_id: dict[str, list[TaskSummary]] = {}
    for task in tasks:
        if any(row.score for row in task.rows):
            by_id.setdefault(task.env_id, []).append(task)
    title = "mean score · success in percent"
    if len(by_id) == 1:
        return [(title.capitalize(), overview_grid(tasks))]
    return [(f"{env_id}: {title}", overview_grid(of_id)) for env_id, of_id in by_id.items()]


def headline_grid(tasks: Sequence[TaskSummary]) -> Grid:
    """Agents against the levels of one world that has no score: the mean of what ranks them in every cell.

    Below those that took part in all levels come those that did in some.
    """
    headline = tasks[0].world.headline
    means: dict[str, list[Interval | None]] = {}
    summaries: dict[str, AgentSummary] = {}
    for column, task in enumerate(tasks):
        for row in task.rows:
            summaries[row.agent] = row
            means.setdefault(row.agent, [None] * len(tasks))[column] = row.measures.get(headline.column)
    total = {agent: sum(m.value for m in row if m is not None) for agent, row in means.items() if None not in row}
    order = sorted(total, key=lambda agent: total[agent], reverse=headline.high_is_good)
    rows = [
        [_agent(summaries[agent]), summaries[agent].information]
        + ["" if m is None else f"{m.value * headline.factor:.{headline.digits}f}" for m in means[agent]]
        for agent in [*order, *sorted(means.keys() - total)]
    ]
    return Grid(["agent", "information", *(_short_name(task) for task in tasks)], rows, 2)


def headline_grids(tasks: Sequence[TaskSummary]) -> list[tuple[str, Grid]]:
    """A title and an overview for each world without a score that was run on several levels."""
    by_id: dict[str, list[TaskSummary]] = {}
    for task in tasks:
        if task.level is not None and not any(row.score for row in task.rows):
            by_id.setdefault(task.env_id, []).append(task)
    return [
        (f"{env_id}: mean {of_id[0].world.headline.title}", headline_grid(sorted(of_id, key=lambda t: t.level or 0)))
        for env_id, of_id in by_id.items()
        if len(of_id) > 1
    ]


def task_grid(task: TaskSummary) -> Grid:
    """One task in full."""
    servo = any(row.steady for row in task.rows)
    world = task.world
    shown = (
        []
        if servo
        else [m for m in world.shown if m.column != "return" and any(m.column in row.measures for row in task.rows)]
    )
    against = f"− {world.reference} {world.headline.unit}".strip()
    succeeds = servo or any(row.success for row in task.rows)
    headings = ["agent", "information", "n", *(["success %"] if succeeds else [])]
    headings += ["score", "worst tenth", "steady mm", against] if servo else ["return"]
    headings += [*(measure.title for measure in shown), against] if shown else []
    ratios = {row.agent: _over_bound(task, row) for row in task.rows}
    bounded = any(ratios.values())
    headings += [BOUND_MARK] if bounded else []
    headings += ["µs/step", "tuning steps"]
    rows = []
    for row in task.rows:
        cells = [_agent(row), row.information, str(row.episodes)]
        if succeeds:
            cells.append(_interval(row.success, 0, 100.0) if row.success else "")
        if servo:
            cells.append(_interval(row.score, 2) if row.score else "")
            cells.append("" if row.worst_score is None else f"{row.worst_score:.2f}")
            cells.append(_interval(row.steady, 1, 1e3) if row.steady else "")
            cells.append(_difference(row, world.headline))
        else:
            cells.append(_interval(row.mean_return, 2))
        if shown:
            cells += [
                _interval(row.measures[m.column], m.digits, m.factor) if m.column in row.measures else "" for m in shown
            ]
            cells.append(_difference(row, world.headline))
        if bounded:
            cells.append(ratios[row.agent])
        cells.append("" if row.step_seconds is None else f"{row.step_seconds * 1e6:.0f}")
        cells.append("?" if row.tuning_steps is None else f"{row.tuning_steps:,}")
        rows.append(cells)
    return Grid(headings, rows, 2)


def _over_bound(task: TaskSummary, row: AgentSummary) -> str:
    """Mean error over the bound's, "" without a bound."""
    bound = task.bound
    if bound is not None and bound.steady and row.steady:
        return f"{row.steady.value / bound.steady.value:.2f}"
    return "" if row.over_bound is None else f"{row.over_bound:.2f}"


def markdown_overview(
    tasks: Sequence[TaskSummary], command: str, details: bool = False, results_stamp: str = ""
) -> str:
    """The overviews for a document of another kind, with the command that wrote them; "" where there are none.

    Args:
        tasks: From `summarize`.
        command: Command that the tables name as their origin.
        details: True to append every task's own table, under a heading of the third level.
        results_stamp: Digest of the results (`summary.stamp`), which the figure of the same results carries too.
    """
    parts = [f"<!-- results {results_stamp} -->\n"] if results_stamp else []
    for title, overview in overview_grids(tasks):
        parts.append(
            f"{as_markdown(overview)}\n{markdown_text(title)}, up to {_most_episodes(tasks)} episodes each. "
            f"{SAME_NOTE} "
            f"Written by {markdown_code(command)}. {note_of(tasks)}\n"
        )
    for title, grid in headline_grids(tasks):
        parts.append(
            f"{as_markdown(grid)}\n{markdown_text(title)}, up to {_most_episodes(tasks)} episodes each; "
            f"{PRIVILEGED_MARK} sees the truth. Written by {markdown_code(command)}.\n"
        )
    if details:
        parts += [f"### {markdown_text(task.environment)}\n\n{as_markdown(task_grid(task))}" for task in tasks]
        parts.append(f"Written by {markdown_code(command)}. {note_of(tasks)}\n")
    return "\n".join(parts)


def _most_episodes(tasks: Sequence[TaskSummary]) -> int:
    return max(row.episodes for task in tasks for row in task.rows)


def markdown_report(tasks: Sequence[TaskSummary], command: str) -> str:
    """The whole leaderboard: the overview where there are scores, then every task."""
    parts = ["# Leaderboard\n", f"Written by {markdown_code(command)}. {note_of(tasks)}\n"]
    for title, overview in overview_grids(tasks):
        parts.append(f"## Overview\n\n{markdown_text(title)}. {SAME_NOTE}\n\n{as_markdown(overview)}")
    for title, grid in headline_grids(tasks):
        parts.append(f"## {markdown_text(title)}\n\n{as_markdown(grid)}")
    for task in tasks:
        remark = f"{markdown_text(caveat(task))}\n\n" if caveat(task) else ""
        parts.append(f"## {markdown_text(task.environment)}\n\n{remark}{as_markdown(task_grid(task))}")
    return "\n".join(parts)


def caveat(task: TaskSummary) -> str:
    """Return the reservations that stand above a task's table, "" for none."""
    parts = list(task.notes)
    if task.deterministic:
        parts.append(
            "Nothing in this world is random: all episodes of a deterministic agent are one and the same, "
            "and its intervals say nothing about others."
        )
    return " ".join(parts)


def _agent(row: AgentSummary | OverallSummary) -> str:
    return f"{row.agent} {PRIVILEGED_MARK}" if row.privileged else row.agent


def _short_name(task: TaskSummary) -> str:
    return task.environment if task.level is None else f"level {task.level}"


def _score_and_success(row: AgentSummary | None) -> str:
    if row is None or row.score is None:
        return ""
    return f"{round(row.score.value, 2) + 0.0:.2f}" + (f" · {100 * row.success.value:.0f}" if row.success else "")


def _interval(interval: Interval, digits: int, factor: float = 1.0) -> str:
    # Adding zero turns a rounded -0.0 into 0.0.
    value, low, high = (f"{round(end * factor, digits) + 0.0:.{digits}f}" for end in interval)
    return f"{value} [{low}, {high}]"


def _difference(row: AgentSummary, measure: RankingMetric) -> str:
    if row.difference is None or row.adjusted_p is None:
        return ""
    mark = "*" if row.adjusted_p < SIGNIFICANCE else ""
    value, low, high = (f"{end * measure.factor:+.{measure.digits}f}" for end in row.difference[:3])
    return f"{value} [{low}, {high}]{mark}"
