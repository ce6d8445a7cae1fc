"""The command line. Nothing else imports `servotrack.baselines`, and each command imports only what it needs."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from servotrack.baselines.leaderboard.summary import TaskSummary

DEFAULT_RESULTS = Path("results")
PIPED_WIDTH = 190
FILMED_LEVEL = 3

app = typer.Typer(
    name="servotrack",
    help="Servo what you cannot calibrate, track what you cannot count.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)

Results = Annotated[Path, typer.Option("--results", "-o", help="Folder of results; an earlier run there is resumed.")]
Episodes = Annotated[int, typer.Option("--episodes", "-n", min=1, help="Episodes per agent and environment.")]
Split = Annotated[str, typer.Option(help="Seeds: `test` to report, `tune` while anything is still being chosen.")]
Level = Annotated[int | None, typer.Option("--level", "-l", help="Level of a servo, 0 to 6.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", "-s", metavar="KEY=VALUE", help="Argument of the environment; repeatable.")
]
Jobs = Annotated[int, typer.Option("--jobs", "-j", help="Processes; -1 for all processors.")]


@app.command()
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
    from servotrack.baselines import seeds
    from servotrack.baselines.bench import progress_bars
    from servotrack.baselines.evaluate import evaluate as run
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.leaderboard.table import as_rich, task_grid
    from servotrack.baselines.results import ResultsFolder, describe_environment

    kwargs = _env_kwargs(level, settings)
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
        _console().print(as_rich(task_grid(task), task.environment))


@app.command()
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
    from servotrack.baselines.bench import progress_bars, run_suite, suite_of
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.results import ResultsFolder

    suite = suite_of(env, _words(agents), _levels(levels) if levels else None, _env_kwargs(None, settings))
    folder = ResultsFolder(results)
    with progress_bars() as progress:
        cells = run_suite(suite, folder, episodes=episodes, split=split, jobs=jobs, progress=progress)
    tasks = summarize(cells)
    film = _film_best(tasks, results) if video else None
    _show(tasks, results, film)


@app.command()
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
    from servotrack.baselines.leaderboard.embed import embed
    from servotrack.baselines.leaderboard.summary import summarize
    from servotrack.baselines.leaderboard.table import markdown_overview
    from servotrack.baselines.results import ResultsFolder

    tasks = summarize(ResultsFolder(results).load_all())
    film = results / "best.webm"
    _show(tasks, output or results, film if output is None and film.exists() else None, details)
    if into is not None:
        embed(markdown_overview(tasks, _command(), details), into, "leaderboard")


@app.command()
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
    from servotrack.baselines import seeds
    from servotrack.baselines.bench import progress_bars
    from servotrack.baselines.leaderboard.embed import embed
    from servotrack.baselines.leaderboard.table import as_rich
    from servotrack.baselines.leaderboard.tuning_table import markdown_tuning, tuning_grid
    from servotrack.baselines.tuning import FIRST_SEED, TuningProtocol
    from servotrack.baselines.tuning import tune as run
    from servotrack.baselines.tuning_grids import GRIDS

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
    _console().print(as_rich(tuning_grid(record), str(output)))
    if into is not None:
        embed(markdown_tuning(record), into, "tuning")


@app.command()
def reproduce(
    paper: Annotated[
        str,
        typer.Argument(
            help="`servo`: paper 002, the UKF of the image Jacobian; `phd`: paper 000, GM-PHD on video; `color`: paper "
            "001, Monte-Carlo color tracking; `sonar`: paper 003, bearing-time records; `pmm`: paper 004, set filters; "
            "`transfer`: do rankings on rendered people predict those on your sequences?"
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables, figures and claims.")] = Path(
        "results/reproduce"
    ),
    runs: Annotated[int | None, typer.Option(min=1, help="Runs per algorithm; default: as many as the paper.")] = None,
    claims: Annotated[Path | None, typer.Option(help="Claims file to fill in; default: a copy in OUTPUT.")] = None,
    source: Annotated[
        list[str] | None,
        typer.Option("--source", "-s", help="For `phd` and `transfer`: your video or MOTChallenge folder; repeatable."),
    ] = None,
    truth: Annotated[
        list[str] | None,
        typer.Option("--truth", "-t", help="CAVIAR XML or MOTChallenge gt.txt of each SOURCE, in their order."),
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            help="For `phd`, `color`, `sonar`, `transfer`: also put the tables between the marks of a Markdown file."
        ),
    ] = None,
) -> None:
    """A paper's tables and figures, ours beside the paper's, and its claims with a verdict each."""
    from servotrack.baselines.reproduce import Recording, reproduce_paper

    sources = source or []
    truths: list[str | None] = [*truth] if truth else [None] * len(sources)
    if len(truths) != len(sources):
        raise ValueError(f"--truth goes with every --source or with none, got {len(truths)} for {len(sources)}")
    recordings = [Recording(s, t) for s, t in zip(sources, truths, strict=True)]
    reproduce_paper(paper, output, runs, _console(), claims, recordings, into)


@app.command()
def train(
    env: Annotated[str, typer.Argument(help="Gymnasium id with a vector environment of its own.")],
    algo: Annotated[
        str, typer.Option(help="ppo, a2c, sac, td3, recurrent_ppo, tqc, student, or a recipe's name in the file.")
    ] = "ppo",
    level: Level = None,
    settings: Settings = None,
    seeds: Annotated[str, typer.Option(help="One training run each, such as 0-2.")] = "0",
    steps: Annotated[int | None, typer.Option(min=1, help="Environment steps of a run; default: the file's.")] = None,
    hyper_parameters: Annotated[
        Path | None, typer.Option("--settings", help="YAML in rl-zoo3's form; default: the package's for ENV.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of runs; those that were interrupted there are resumed.")
    ] = DEFAULT_RESULTS / "train",
    name: Annotated[str | None, typer.Option(help="Of the agent; default: the algorithm's.")] = None,
    ship: Annotated[Path | None, typer.Option(help="Folder for the best run's network and card.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Runs at a time.")] = 1,
) -> None:
    """Train with Stable-Baselines3 (extra `rl`), measured beside the classical agents; writes ONNX and a card."""
    from dataclasses import replace

    from servotrack.baselines.learned.settings import load_settings

    try:
        from servotrack.baselines.learned.command import TrainingRequest, run_training
    except ModuleNotFoundError as error:
        raise ImportError(f"training needs {error.name}; install the extra: pip install 'servotrack[rl]'") from error
    chosen = load_settings(env, algo, level, hyper_parameters)
    if steps is not None:
        chosen = replace(chosen, n_timesteps=steps)
    kwargs = _env_kwargs(level, settings)
    run_training(TrainingRequest(env, kwargs, chosen, tuple(_levels(seeds)), output, jobs, name, ship), _console())


@app.command()
def agents(
    world: Annotated[str, typer.Option(help="servo, clutter, video, color, sonar or follow; default: all.")] = "",
    into: Annotated[
        Path | None,
        typer.Option(help="A document for the learned ones, with <!-- agents:begin --> and <!-- agents:end -->."),
    ] = None,
) -> None:
    """All agents by name, and what the learned ones among them cost to train."""
    from servotrack.baselines.leaderboard.embed import embed
    from servotrack.baselines.leaderboard.table import as_markdown, as_rich
    from servotrack.baselines.learned.listing import agents_grid, shipped_grid

    learned = shipped_grid()
    _console().print(as_rich(agents_grid(world), "Agents"))
    _console().print(as_rich(learned, "Learned agents"))
    if into is not None:
        embed(f"{as_markdown(learned)}\nWritten by `{_command()}`, from the agents' cards.", into, "agents")


@app.command()
def compare(
    runs: Annotated[Path, typer.Argument(help="An environment's folder of training runs, results/train/ENV.")],
    recipe: Annotated[str, typer.Argument(help="Whose runs: ppo, hybrid, ...")],
    against: Annotated[str, typer.Argument(help="The agent to compare with.")],
    episodes: Episodes = 100,
    split: Split = "test",
    results: Results = DEFAULT_RESULTS / "compare",
    into: Annotated[
        Path | None,
        typer.Option(help="A document that has the marks <!-- compare:begin --> and <!-- compare:end -->."),
    ] = None,
) -> None:
    """Whether training wins: all runs of a recipe against an agent, runs and episodes resampled, crossed."""
    from servotrack.baselines.bench import progress_bars
    from servotrack.baselines.leaderboard.embed import embed
    from servotrack.baselines.learned.comparison import compare as run
    from servotrack.baselines.results import ResultsFolder

    with progress_bars() as progress:
        bar = progress.add_task("agents", total=None)
        found = run(
            runs, recipe, against, ResultsFolder(results), episodes, split, lambda: progress.update(bar, advance=1)
        )
    _console().print(found.markdown(), soft_wrap=True)
    if into is not None:
        embed(f"{found.markdown()}\nWritten by `{_command()}`.", into, "compare")


@app.command()
def track(
    source: Annotated[
        str, typer.Argument(help="Video file, folder of images, MOTChallenge sequence, or a camera's index.")
    ],
    detector: Annotated[
        str,
        typer.Option(
            "--detector",
            "-d",
            help="masked, masked-paper, mog2, knn; `file`: a MOTChallenge sequence's det.txt; auto: that if any.",
        ),
    ] = "auto",
    tracker: Annotated[
        str,
        typer.Option(
            "--tracker", "-t", help="pmb, gm-phd, gm-phd-paper, gm-cbmember, kalman-hungarian, no-filter, ..."
        ),
    ] = "pmb",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder; default: results/track/NAME.")] = None,
    size: Annotated[
        str, typer.Option(help="What the detector sees: WxH, `source`, or `fit`: within 384x288 px.")
    ] = "fit",
    truth: Annotated[
        Path | None, typer.Option(help="MOTChallenge's gt.txt or CAVIAR's XML; a MOTChallenge folder's own is found.")
    ] = None,
    match: Annotated[str, typer.Option(help="`iou`: at least 0.5; `centroid`: within 0.6 of the true height.")] = "iou",
    start: Annotated[int, typer.Option(min=0, help="First frame, from 0.")] = 0,
    frames: Annotated[int | None, typer.Option(min=1, help="Most frames.")] = None,
    stride: Annotated[int, typer.Option(min=1, help="Every so manieth frame.")] = 1,
    background: Annotated[
        int,
        typer.Option(min=0, help="Frames of a first pass over a file for the background; 0: none, strictly online."),
    ] = 40,
    offline: Annotated[bool, typer.Option("--offline", help="Also fill gaps after the fact, in a file apart.")] = False,
    video: Annotated[bool, typer.Option(help="Write the annotated film.")] = True,
    show_truth: Annotated[bool, typer.Option("--show-truth", help="Draw true boxes, too.")] = False,
) -> None:
    """Real data in; MOTChallenge tracks, an annotated film and, where there is truth, scores out."""
    from servotrack.baselines.tracking.command import TrackRequest, run_command

    request = TrackRequest(
        source,
        out,
        detector,
        tracker,
        size,
        truth,
        match,
        start,
        frames,
        stride,
        background,
        offline,
        video,
        show_truth,
    )
    code = run_command(request, _console())
    if code:
        raise typer.Exit(code)


@app.command()
def render(
    out: Annotated[Path, typer.Argument(help="Folder of the sequence, to be made.")],
    level: Annotated[int, typer.Option("--level", "-l", help="Level of PedestrianTracking-v0, 0 to 5.")] = 0,
    settings: Settings = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the episode.")] = 0,
) -> None:
    """A rendered crowd as a MOTChallenge sequence: images and exact truth, for `track` and any other tracker."""
    from servotrack.baselines.bench import progress_bars
    from servotrack.baselines.tracking.rendered import render_sequence

    with progress_bars() as progress:
        bar = progress.add_task(out.name)

        def advance(left: int) -> None:
            progress.update(bar, total=progress.tasks[bar].completed + 1 + left, advance=1)

        frames = render_sequence(out, _env_kwargs(level, settings), seed, advance)
    _console().print(f"{out}: {frames} frames", soft_wrap=True)


@app.command()
def play(
    env: Annotated[str, typer.Argument(help="Gymnasium id.")] = "UncalibServo-v0",
    agent: Annotated[str | None, typer.Option("--agent", "-a", help="Whom to watch; none: drive by keyboard.")] = None,
    level: Level = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(help="Of the first episode.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Write a film (.webm, .mp4, .avi) instead of opening a window.")
    ] = None,
) -> None:
    """Watch an agent, or drive the arm by keyboard (arrow keys; escape ends)."""
    from servotrack.baselines.play import drive, watch

    kwargs = _env_kwargs(level, settings)
    if video is not None:
        from servotrack.baselines.leaderboard.video import film_episode

        if agent is None:
            raise ValueError("--video needs an agent to film; add --agent lifted-kf")
        frames = film_episode(env, agent, video, kwargs, seed)
        _console().print(f"{video}: {frames} frames")
    elif agent is None:
        drive(env, kwargs, seed)
    else:
        watch(env, agent, kwargs, seed)


def main() -> None:
    """Run the command line; what a user can mend is told in one line, without a traceback."""
    import gymnasium as gym

    import servotrack  # noqa: F401
    from servotrack.baselines.results import ResultsError

    # Agents of the user's own ("module:callable") lie where the user stands.
    sys.path.insert(0, "")
    try:
        app()
    except (ResultsError, ValueError, TypeError, gym.error.Error, ImportError) as error:
        typer.secho(f"servotrack: {error}", fg="red", err=True)
        raise SystemExit(2) from error


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PIPED_WIDTH)


def _show(tasks: list[TaskSummary], output: Path, film: Path | None, details: bool = False) -> None:
    from servotrack.baselines.leaderboard.report import write_report
    from servotrack.baselines.leaderboard.table import NOTE, as_rich, headline_grids, overview_grid, task_grid

    console = _console()
    overviews = [("Mean score · success in percent", overview_grid(tasks)), *headline_grids(tasks)]
    overviews = [(title, grid) for title, grid in overviews if grid.rows]
    for title, grid in overviews:
        console.print(as_rich(grid, title))
    for task in tasks if details or not overviews else []:
        console.print(as_rich(task_grid(task), task.environment))
    console.print(NOTE, style="dim")
    for path in [*write_report(tasks, output, _command(), film), *([film] if film else [])]:
        console.print(str(path), soft_wrap=True)


def _film_best(tasks: list[TaskSummary], folder: Path) -> Path | None:
    from servotrack.baselines import seeds
    from servotrack.baselines.leaderboard.video import film_episode

    task = next((task for task in tasks if task.level == FILMED_LEVEL), None)
    best = next((row for row in task.rows if not row.privileged), None) if task else None
    if task is None or best is None:
        return None
    path = folder / "best.webm"
    film_episode(task.env_id, best.agent, path, {"level": task.level}, seeds.TEST[0])
    return path


def _command() -> str:
    import shlex

    return shlex.join(["servotrack", *sys.argv[1:]])


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


def _levels(text: str) -> list[int]:
    levels: list[int] = []
    for word in _words(text):
        first, dash, last = word.partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise ValueError(f"levels must look like 0-5 or 0,3, got {text!r}")
        levels.extend(range(int(first), int(last or first) + 1))
    return levels


def _env_kwargs(level: int | None, settings: list[str] | None) -> dict[str, Any]:
    kwargs: dict[str, Any] = {} if level is None else {"level": level}
    for setting in settings or []:
        key, equals, value = setting.partition("=")
        if not equals or not key.isidentifier():
            raise ValueError(f"--set takes KEY=VALUE, got {setting!r}; for example --set pixel_noise=2")
        if key in kwargs:
            raise ValueError(f"{key} is given twice, got {setting!r} after {kwargs[key]!r}")
        try:
            kwargs[key] = ast.literal_eval({"true": "True", "false": "False", "none": "None"}.get(value, value))
        except (ValueError, SyntaxError):
            kwargs[key] = value
    return kwargs


if __name__ == "__main__":
    main()
