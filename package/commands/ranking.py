"""Commands that evaluate and rank agents: evaluate, bench, leaderboard, tune."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servotrack.commands.terms import (
    DEFAULT_RESULTS,
    Backend,
    Episodes,
    Jobs,
    Level,
    Results,
    Scheduler,
    Settings,
    Split,
    TableFormat,
    console,
    env_kwargs,
    find_user_modules,
    levels_of,
    words,
)

if TYPE_CHECKING:
    from servotrack.baselines.leaderboard.summary import TaskSummary
    from servotrack.baselines.reporting.terminal import Screen

FILMED_LEVEL = 3


def evaluate(
    env: Annotated[str, typer.Argument(help="Gymnasium id, such as UncalibServo-v0.")],
    agent: Annotated[str, typer.Argument(help="Name, name+law, a learned agent's file, or module:callable.")],
    level: Level = None,
    settings: Settings = None,
    episodes: Episodes = 100,
    split: Split = "test",
    results: Results = DEFAULT_RESULTS,
    table_format: TableFormat = "table",
) -> None:
    """Evaluate one agent in one environment. Prints its row next to the rows that the folder already holds."""
    from servotrack.baselines.evaluation import seeds
    from servotrack.baselines.evaluation.bench import check_cell
    from servotrack.baselines.evaluation.evaluate import evaluate as run
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.leaderboard.table import missing_agents, task_grid
    from servotrack.baselines.reporting.terminal import print_tables, progress_bars
    from servotrack.baselines.running.stopping import GO_ON, keeping
    from servotrack.baselines.worlds import describe_environment

    screen = console(table_format)
    find_user_modules(env, agent)
    kwargs = env_kwargs(level, settings)
    chosen = seeds.take(split, episodes)
    check_cell(env, agent, kwargs)
    folder = ResultsFolder(results)
    folder.check_writable()
    with progress_bars() as progress:
        bar = progress.add_task(agent, total=episodes)
        with keeping(lambda: f"{progress.tasks[bar].completed:.0f} of {episodes} episodes finished; {GO_ON}"):
            run(env, agent, chosen, kwargs, folder=folder, on_episodes=lambda count: progress.advance(bar, count))
    name = describe_environment(env, kwargs)
    tasks = [task for task in summarize(folder.load_all()) if task.environment == name]
    print_tables(screen, {task.environment: task_grid(task) for task in tasks})
    print_notes(tasks, screen)
    arguments = "".join(f" --set {key}={value}" for key, value in kwargs.items() if key != "level")
    arguments += "" if level is None else f" --level {level}"
    for task in tasks:
        if missing := missing_agents(task):
            screen.print(
                f"Columns without numbers need {' and '.join(missing)}: run `servotrack evaluate {env} {missing[0]}"
                f"{arguments} --episodes {episodes} --results {results}`" + (", and so on." if missing[1:] else "."),
                style="dim",
                soft_wrap=True,
                markup=False,
            )


def bench(
    results: Annotated[
        Path | None,
        typer.Option(
            "--results",
            "-o",
            help="Folder of results. Finished episodes in it are not run again. Default: results/bench/ENV.",
        ),
    ] = None,
    agents: Annotated[
        str, typer.Option("--agents", "-a", help="Comma-separated agents. Default: the suite of the kind of world.")
    ] = "",
    levels: Annotated[
        str,
        typer.Option("--levels", "-l", help="Levels, such as 0-5 or 0,3. Default: 0-5 where the world has levels."),
    ] = "",
    env: Annotated[
        str, typer.Option("--env", help="Gymnasium id, or several, comma-separated.")
    ] = "UncalibServo-v0,UncalibServoReach-v0",
    settings: Settings = None,
    episodes: Episodes = 100,
    split: Split = "test",
    jobs: Jobs = -1,
    backend: Backend = "processes",
    scheduler: Scheduler = None,
    video: Annotated[bool, typer.Option(help="Write a video of the best agent at level 3.")] = True,
    table_format: TableFormat = "table",
) -> None:
    """Evaluate agents on every level and seed, then write the leaderboard, a figure and a video.

    Finished cells are skipped.
    """
    from servotrack.baselines.evaluation.bench import run_suite, suite_of
    from servotrack.baselines.evaluation.provenance import code_version
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.leaderboard.index import write_index
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.reporting.terminal import progress_bars
    from servotrack.baselines.running.clusters import computing_on

    screen = console(table_format)
    ids = words(env)
    if not ids:
        raise ValueError(f"--env must name at least one Gymnasium id, got {env!r}")
    find_user_modules(*ids, *words(agents))
    chosen = levels_of(levels) if levels else None
    suite = suite_of(ids, words(agents), chosen, env_kwargs(None, settings))
    output = results or DEFAULT_RESULTS / "bench" / ids[0].rpartition(":")[2].replace("/", "-")
    folder = ResultsFolder(output)
    folder.check_writable()
    with computing_on(backend, scheduler, code_version), progress_bars() as progress:
        cells = run_suite(suite, folder, episodes=episodes, split=split, jobs=jobs, progress=progress)
    tasks = summarize(cells)
    film = _film_best(tasks, output) if video else None
    _show(tasks, output, film, screen)
    if results is None:
        screen.print(str(write_index(output.parent)), soft_wrap=True)


def leaderboard(
    results: Annotated[Path, typer.Argument(help="Folder of results.")],
    output: Annotated[Path | None, typer.Option("--output", help="Output folder. Default: RESULTS.")] = None,
    details: Annotated[
        bool, typer.Option(help="Also print every environment's own table, and write it into the document.")
    ] = False,
    into: Annotated[
        Path | None,
        typer.Option(help="Document to update between <!-- leaderboard:begin --> and <!-- leaderboard:end -->."),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Also write the figure of scores against level to this file (.png, .svg).")
    ] = None,
    site: Annotated[
        Path | None,
        typer.Option(help="Write a static site with replays into this folder instead. Submissions are replayed."),
    ] = None,
    verdicts: Annotated[
        Path | None,
        typer.Option(help="With --site: file of `servotrack verify --output`. Default: verdicts.json in the folder."),
    ] = None,
    every_seed: Annotated[
        bool, typer.Option("--every-seed", help="With --site: replays of all seeds, however large the site becomes.")
    ] = False,
    table_format: TableFormat = "table",
) -> None:
    """Write tables, figure and page from a folder of results, or a site from results or submissions (SUITE/AGENT)."""
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.leaderboard.figure import draw_levels, level_tasks
    from servotrack.baselines.leaderboard.summary import stamp, summarize
    from servotrack.baselines.leaderboard.table import markdown_overview
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.figure import save_figure
    from servotrack.baselines.reporting.terminal import command_line

    if site is not None:
        if any(option is not None for option in (output, into, figure)) or details:
            raise ValueError(
                "--site writes the site alone; run the command again without --site for tables and figures"
            )
        _write_site(results, verdicts, site, every_seed, console(table_format))
        return
    if verdicts is not None:
        raise ValueError("--verdicts needs --site: only the site shows badges")
    if every_seed:
        raise ValueError("--every-seed needs --site: only the site has replays")
    cells = ResultsFolder(results).load_all()
    tasks = summarize(cells)
    film = results / "best.webm"
    film_shown = film if output is None and film.exists() else None
    _show(tasks, output or results, film_shown, console(table_format), details)
    if figure is not None:
        save_figure(draw_levels(level_tasks(tasks)), figure, stamp(cells))
    if into is not None:
        embed(markdown_overview(tasks, command_line(), details, stamp(cells)), into, "leaderboard")


def tune(
    agents: Annotated[
        list[str] | None, typer.Argument(help="Agents of one world. Default: all servo agents with tunable parameters.")
    ] = None,
    env: Annotated[
        str | None,
        typer.Option(help="World to tune in. Default: the first in which all agents are tuned; pmb has two."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Record to write. Agents that an earlier record holds are skipped. Default: results/tuning.json, or "
            "results/structure.json with a budget.",
        ),
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", "-n", min=1, help="Tune seeds per level.")] = 16,
    budget: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Search the structure of a classical agent in one world and level with so many environment steps.",
        ),
    ] = None,
    level: Annotated[int, typer.Option(min=0, help="Level of the search with a budget.")] = 3,
    run: Annotated[int, typer.Option(min=0, help="Number of the run with a budget; its seeds derive from it.")] = 0,
    jobs: Jobs = 1,
    backend: Backend = "processes",
    scheduler: Scheduler = None,
    into: Annotated[
        Path | None,
        typer.Option(
            help="Document to update between <!-- tuning:begin --> and <!-- tuning:end -->, or the name of --output."
        ),
    ] = None,
    table_format: TableFormat = "table",
) -> None:
    """Search the hyper-parameters of agents of one world on tune seeds, and count the environment steps.

    With --budget, the search draws whole agents: filter, target models, latency hypotheses, law, probing, all numbers.
    """
    if budget is not None:
        if agents or into is not None:
            raise typer.BadParameter("--budget draws agents by itself; leave out the names of agents and --into")
        _tune_structure(env or "UncalibServo-v0", level, budget, run, output or DEFAULT_RESULTS / "structure.json")
        return
    output = output or DEFAULT_RESULTS / "tuning.json"
    from servotrack.baselines.agents.servo.tuning_grid import GRIDS
    from servotrack.baselines.evaluation import seeds
    from servotrack.baselines.evaluation.provenance import code_version
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.terminal import print_tables, progress_bars
    from servotrack.baselines.running.clusters import computing_on
    from servotrack.baselines.running.stopping import GO_ON, keeping
    from servotrack.baselines.tuning.search import FIRST_SEED, default_protocol
    from servotrack.baselines.tuning.search import tune as search
    from servotrack.baselines.tuning.table import markdown_tuning, tuning_grid

    screen = console(table_format)
    names = agents or list(GRIDS)
    protocol = default_protocol(names, seeds.take("tune", episodes, FIRST_SEED), env)
    with computing_on(backend, scheduler, code_version), progress_bars() as progress:
        bars: list[Any] = []

        def on_agent(name: str, candidates: int) -> None:
            bars.append(progress.add_task(name, total=candidates, visible=candidates > 0))

        # The newest bar is that of the agent whose search was interrupted.
        with keeping(lambda: f"{max(len(bars) - 1, 0)} of {len(names)} agents searched; {GO_ON}"):
            record = search(
                names,
                output,
                protocol,
                jobs=jobs,
                on_agent=on_agent,
                on_candidate=lambda: progress.advance(bars[-1]),
            )
    print_tables(screen, {str(output): tuning_grid(record)})
    if into is not None:
        own = f"<!-- {output.stem}:begin -->" in into.read_text(encoding="utf-8")
        embed(markdown_tuning(record), into, output.stem if own else "tuning")


def _tune_structure(env_id: str, level: int, budget: int, run: int, output: Path) -> None:
    """Search a structure, print the chosen one and write the record."""
    from servotrack.baselines.reporting.terminal import progress_bars
    from servotrack.baselines.tuning.racing import search_cell, write_search

    find_user_modules(env_id)
    if output.exists():
        raise ValueError(f"output must be a new file, got {output}; choose another --output or move it away")
    screen = console()
    with progress_bars() as progress:
        bar = progress.add_task(f"{env_id}, level {level}", total=budget)
        found = search_cell(env_id, level, budget, run, lambda taken: progress.update(bar, completed=taken))
    write_search(found, output, {"env_id": env_id, "level": level, "budget": budget, "run": run})
    screen.print(f"{found.steps:,} environment steps; cost {min(found.races[-1].costs):.3f}: {found.chosen}")
    screen.print(str(output), soft_wrap=True)


def _write_site(source: Path, verdicts: Path | None, folder: Path, every_seed: bool, screen: Screen) -> None:
    from servotrack.baselines.leaderboard.site.entries import entries_of
    from servotrack.baselines.leaderboard.site.write import write_site
    from servotrack.baselines.reporting.terminal import command_line, progress_bars

    entries = entries_of(source, verdicts)
    with progress_bars() as progress:
        bar = progress.add_task("episodes", total=len(entries))
        paths = write_site(entries, folder, command_line(), lambda name: progress.advance(bar), every_seed)
    size = sum(path.stat().st_size for path in paths)
    screen.print(f"{paths[0]} ({len(paths)} files, {size / 1e6:.2f} MB)", soft_wrap=True)


def _show(
    tasks: list[TaskSummary],
    output: Path,
    film: Path | None,
    screen: Screen,
    details: bool = False,
) -> None:
    from servotrack.baselines.leaderboard.report import write_report
    from servotrack.baselines.leaderboard.table import headline_grids, note_of, overview_grids, task_grid
    from servotrack.baselines.reporting.terminal import command_line, print_tables

    overviews: Mapping[str, Any] = dict([*overview_grids(tasks), *headline_grids(tasks)])
    own = {task.environment: task_grid(task) for task in tasks} if details or not overviews else {}
    print_tables(screen, {**overviews, **own})
    print_notes(tasks, screen)
    screen.print(note_of(tasks), style="dim", soft_wrap=True, markup=False)
    paths = [*write_report(tasks, output, command_line(), film), *([film] if film else [])]
    for path in paths:
        screen.print(str(path), soft_wrap=True)


def print_notes(tasks: list[TaskSummary], screen: Screen) -> None:
    """Print why scores are missing, and other reservations."""
    for task in tasks:
        for note in task.notes:
            screen.print(f"{task.environment}: {note}", style="yellow", soft_wrap=True)


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
