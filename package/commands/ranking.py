"""Agents against worlds: episodes, leaderboards, tuning."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servotrack.commands.terms import (
    DEFAULT_RESULTS,
    Episodes,
    Jobs,
    Level,
    Results,
    Settings,
    Split,
    console,
    env_kwargs,
    levels_of,
    words,
)

if TYPE_CHECKING:
    from servotrack.baselines.leaderboard.summary import TaskSummary

FILMED_LEVEL = 3


def evaluate(
    env: Annotated[str, typer.Argument(help="Gymnasium id, such as UncalibServo-v0.")],
    agent: Annotated[str, typer.Argument(help="Name, name+law, or module:callable.")],
    level: Level = None,
    settings: Settings = None,
    episodes: Episodes = 100,
    split: Split = "test",
    results: Results = DEFAULT_RESULTS,
) -> None:
    """Run one agent in one environment, and print its row beside those that the folder holds already."""
    from servotrack.baselines.evaluation import seeds
    from servotrack.baselines.evaluation.evaluate import evaluate as run
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.leaderboard.table import task_grid
    from servotrack.baselines.reporting.grid import as_rich
    from servotrack.baselines.reporting.terminal import progress_bars
    from servotrack.baselines.worlds import describe_environment

    kwargs = env_kwargs(level, settings)
    folder = ResultsFolder(results)
    folder.check_writable()
    with progress_bars() as progress:
        bar = progress.add_task(agent, total=episodes)
        run(
            env,
            agent,
            seeds.take(split, episodes),
            kwargs,
            folder=folder,
            on_episodes=lambda count: progress.advance(bar, count),
        )
    name = describe_environment(env, kwargs)
    tasks = [task for task in summarize(folder.load_all()) if task.environment == name]
    for task in tasks:
        console().print(as_rich(task_grid(task), task.environment))


def bench(
    results: Results = DEFAULT_RESULTS / "bench",
    agents: Annotated[str, typer.Option("--agents", "-a", help="Comma-separated; default: all.")] = "",
    levels: Annotated[
        str, typer.Option("--levels", "-l", help="Such as 0-5 or 0,3; default: 0-5 where the world has levels.")
    ] = "",
    env: Annotated[str, typer.Option("--env", help="Servo or tracking id.")] = "UncalibServo-v0",
    settings: Settings = None,
    episodes: Episodes = 100,
    split: Split = "test",
    jobs: Jobs = -1,
    video: Annotated[bool, typer.Option(help="Film the best agent at level 3.")] = True,
) -> None:
    """The main job: agents x levels x seeds, then the leaderboard, a figure and a film. Resumes what was finished."""
    from servotrack.baselines.evaluation.bench import run_suite, suite_of
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.reporting.terminal import progress_bars

    suite = suite_of(env, words(agents), levels_of(levels) if levels else None, env_kwargs(None, settings))
    folder = ResultsFolder(results)
    with progress_bars() as progress:
        cells = run_suite(suite, folder, episodes=episodes, split=split, jobs=jobs, progress=progress)
    tasks = summarize(cells)
    film = _film_best(tasks, results) if video else None
    _show(tasks, results, film)


def leaderboard(
    results: Annotated[Path, typer.Argument(help="Folder of results.")],
    output: Annotated[Path | None, typer.Option("--output", help="Where to write; default: into RESULTS.")] = None,
    details: Annotated[bool, typer.Option(help="Every environment's own table, too, also in the document.")] = False,
    into: Annotated[
        Path | None,
        typer.Option(help="A document that has the marks <!-- leaderboard:begin --> and <!-- leaderboard:end -->."),
    ] = None,
) -> None:
    """Tables, figure and page from a folder of results."""
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.leaderboard.table import markdown_overview
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.terminal import command_line

    tasks = summarize(ResultsFolder(results).load_all())
    film = results / "best.webm"
    _show(tasks, output or results, film if output is None and film.exists() else None, details)
    if into is not None:
        embed(markdown_overview(tasks, command_line(), details), into, "leaderboard")


def tune(
    agents: Annotated[list[str] | None, typer.Argument(help="Names; default: all with values of their own.")] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The record; agents that an earlier one holds are skipped.")
    ] = DEFAULT_RESULTS / "tuning.json",
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Tune seeds per level.")] = 16,
    into: Annotated[
        Path | None,
        typer.Option(help="A document that has the marks <!-- tuning:begin --> and <!-- tuning:end -->."),
    ] = None,
) -> None:
    """Search the servo agents' hyper-parameters on tune seeds, and count the environment steps that it takes."""
    from servotrack.baselines.agents.servo.tuning_grid import GRIDS
    from servotrack.baselines.evaluation import seeds
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.grid import as_rich
    from servotrack.baselines.reporting.terminal import progress_bars
    from servotrack.baselines.tuning.search import FIRST_SEED, TuningProtocol
    from servotrack.baselines.tuning.search import tune as run
    from servotrack.baselines.tuning.table import markdown_tuning, tuning_grid

    protocol = TuningProtocol(seeds=tuple(seeds.take("tune", episodes, FIRST_SEED)))
    with progress_bars() as progress:
        bars: list[Any] = []
        record = run(
            agents or list(GRIDS),
            output,
            protocol,
            on_agent=lambda name, settings: bars.append(progress.add_task(name, total=settings)) if settings else None,
            on_candidate=lambda: progress.advance(bars[-1]),
        )
    console().print(as_rich(tuning_grid(record), str(output)))
    if into is not None:
        embed(markdown_tuning(record), into, "tuning")


def _show(tasks: list[TaskSummary], output: Path, film: Path | None, details: bool = False) -> None:
    from servotrack.baselines.leaderboard.report import write_report
    from servotrack.baselines.leaderboard.table import NOTE, headline_grids, overview_grid, task_grid
    from servotrack.baselines.reporting.grid import as_rich
    from servotrack.baselines.reporting.terminal import command_line

    screen = console()
    overviews = [("Mean score · success in percent", overview_grid(tasks)), *headline_grids(tasks)]
    overviews = [(title, grid) for title, grid in overviews if grid.rows]
    for title, grid in overviews:
        screen.print(as_rich(grid, title))
    for task in tasks if details or not overviews else []:
        screen.print(as_rich(task_grid(task), task.environment))
    screen.print(NOTE, style="dim")
    for path in [*write_report(tasks, output, command_line(), film), *([film] if film else [])]:
        screen.print(str(path), soft_wrap=True)


def _film_best(tasks: list[TaskSummary], folder: Path) -> Path | None:
    from servotrack.baselines.evaluation import seeds
    from servotrack.baselines.evaluation.watch import film_episode

    task = next((task for task in tasks if task.level == FILMED_LEVEL), None)
    best = next((row for row in task.rows if not row.privileged), None) if task else None
    if task is None or best is None:
        return None
    path = folder / "best.webm"
    film_episode(task.env_id, best.agent, path, {"level": task.level}, seeds.TEST[0])
    return path
