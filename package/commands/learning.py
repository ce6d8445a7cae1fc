"""Commands for learned agents: train, export, agents and compare."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotrack.commands.terms import (
    DEFAULT_RESULTS,
    Backend,
    Episodes,
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
)


def train(
    env: Annotated[str, typer.Argument(help="Gymnasium id with a vector_entry_point.")],
    algo: Annotated[
        str,
        typer.Option(
            help="ppo, a2c, sac, td3, recurrent_ppo, tqc, student, jacobian, set, eyes, or a recipe of the file."
        ),
    ] = "ppo",
    level: Level = None,
    settings: Settings = None,
    seeds: Annotated[str, typer.Option(help="Seeds of the training runs, one run each, e.g. 0-2.")] = "0",
    steps: Annotated[
        int | None, typer.Option(min=1, help="Environment steps of a run. Default: those of the settings file.")
    ] = None,
    hyper_parameters: Annotated[
        Path | None,
        typer.Option("--settings", help="YAML file in the format of rl-zoo3. Default: the package's file for ENV."),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of runs. Interrupted runs in it are resumed.")
    ] = DEFAULT_RESULTS / "train",
    name: Annotated[str | None, typer.Option(help="Name of the trained agent. Default: the algorithm's name.")] = None,
    ship: Annotated[
        Path | None,
        typer.Option(help="Folder for the best run's network (ONNX) and card. Default: the folder of the runs."),
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Number of runs trained in parallel.")] = 1,
    backend: Backend = "processes",
    scheduler: Scheduler = None,
) -> None:
    """Train an agent (extra `rl`), evaluate it next to the classical agents, and write an ONNX file and its card."""
    from dataclasses import replace

    from servotrack.baselines.evaluation.provenance import code_version
    from servotrack.baselines.running.clusters import computing_on
    from servotrack.baselines.training.settings import load_settings

    find_user_modules(env)
    try:
        from servotrack.baselines.training.command import TrainingRequest, run_training
    except ModuleNotFoundError as error:
        raise ImportError(f"training needs {error.name}; install the extra: pip install 'servotrack[rl]'") from error
    chosen = load_settings(env, algo, level, hyper_parameters)
    if steps is not None:
        chosen = replace(chosen, n_timesteps=steps)
    kwargs = env_kwargs(level, settings)
    request = TrainingRequest(env, kwargs, chosen, tuple(levels_of(seeds)), output, jobs, name, ship)
    with computing_on(backend, scheduler, code_version):
        run_training(request, console())


def export(
    env: Annotated[str, typer.Argument(help="Gymnasium id that the model was trained in.")],
    model: Annotated[
        str,
        typer.Argument(
            help="Zip of Stable-Baselines3, .cleanrl_model, TorchScript (.pt), torch.export (.pt2), or module:callable "
            "that returns a torch module."
        ),
    ],
    algo: Annotated[
        str | None,
        typer.Option(help="Algorithm of a zip: ppo, a2c, sac, td3, ddpg, tqc, trpo or recurrent_ppo."),
    ] = None,
    level: Level = None,
    settings: Settings = None,
    wrapper: Annotated[
        list[str] | None,
        typer.Option(
            "--wrapper",
            "-w",
            help="Wrapper of the training, the innermost first: FlatSets, GoalObservation, FlattenObservation. "
            "Repeatable.",
        ),
    ] = None,
    normalization: Annotated[
        Path | None,
        typer.Option(
            help="Statistics of observations: .npz with mean and var, or VecNormalize's .pkl (needs --trust)."
        ),
    ] = None,
    trust: Annotated[
        bool, typer.Option("--trust", help="Load a zip, .pt, .pt2 or .pkl. Such a file can run code: only your own.")
    ] = False,
    name: Annotated[str, typer.Option(help="Name of the agent.")] = "exported",
    summary: Annotated[
        str, typer.Option(help="Description in one line. Default: library, algorithm, environment.")
    ] = "",
    information: Annotated[
        str,
        typer.Option(
            help="Information that the agent has: model-free, structure, prior, calibrated, privileged, undeclared."
        ),
    ] = "prior",
    steps: Annotated[
        int | None, typer.Option(min=0, help="Environment steps of the training. Default: the model's own count, or 0.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the network and its card.")
    ] = DEFAULT_RESULTS / "export",
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Largest accepted difference of actions, in halves of their range.")
    ] = 1e-5,
) -> None:
    """Export a trained model (extra `rl`) as ONNX file with a card, and check that it acts like the model."""
    from typing import cast

    from servotrack.baselines.agents.protocol import Information

    find_user_modules(env, model)
    try:
        from servotrack.baselines.training.export_command import ExportRequest, export_model
    except ModuleNotFoundError as error:
        raise ImportError(f"export needs {error.name}; install the extra: pip install 'servotrack[rl]'") from error
    request = ExportRequest(
        env, env_kwargs(level, settings), model, algo, tuple(wrapper or ()), normalization, name, summary,
        cast("Information", information), steps, output, tolerance, trust,
    )  # fmt: skip
    path, difference = export_model(request)
    screen = console()
    screen.print(
        f"{path}: actions differ from the model's by at most {difference:.1e} of half their range", soft_wrap=True
    )
    screen.print(f"servotrack evaluate {env} {path}", soft_wrap=True)


def agents(
    world: Annotated[str, typer.Option(help="servo, clutter, people, color, sonar or follow. Default: all.")] = "",
    into: Annotated[
        Path | None,
        typer.Option(
            help="Document for the table of learned agents, with <!-- agents:begin --> and <!-- agents:end -->."
        ),
    ] = None,
    table_format: TableFormat = "table",
) -> None:
    """List all agents, and the training cost of the learned ones."""
    from servotrack.baselines.leaderboard.agents_table import agents_grid, shipped_grid
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.grid import as_markdown
    from servotrack.baselines.reporting.terminal import command_line, print_tables

    learned = shipped_grid()
    print_tables(console(table_format), {"Agents": agents_grid(world), "Learned agents": learned})
    if into is not None:
        embed(f"{as_markdown(learned)}\nWritten by `{command_line()}`, from the agents' cards.", into, "agents")


def compare(
    runs: Annotated[Path, typer.Argument(help="Folder of an environment's training runs, e.g. results/train/ENV.")],
    recipe: Annotated[str, typer.Argument(help="Recipe whose runs are compared, e.g. ppo or hybrid.")],
    against: Annotated[str, typer.Argument(help="Agent to compare with.")],
    episodes: Episodes = 100,
    split: Split = "test",
    results: Results = DEFAULT_RESULTS / "compare",
    into: Annotated[
        Path | None,
        typer.Option(help="Document for the table, with <!-- compare:begin --> and <!-- compare:end -->."),
    ] = None,
    table_format: TableFormat = "table",
) -> None:
    """Compare all training runs of a recipe with one agent. The interval resamples training runs and episodes."""
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.terminal import command_line, print_tables, progress_bars
    from servotrack.baselines.running.stopping import GO_ON, keeping
    from servotrack.baselines.training.comparison import compare as run

    screen = console(table_format)
    find_user_modules(against)
    with progress_bars() as progress:
        bar = progress.add_task("agents", total=None)
        with keeping(lambda: f"{progress.tasks[bar].completed:.0f} evaluations finished; {GO_ON}"):
            found = run(
                runs, recipe, against, ResultsFolder(results), episodes, split, lambda: progress.update(bar, advance=1)
            )
    text = "\n".join(comparison.markdown() for comparison in found)
    if screen.table_format == "table":
        screen.print(text, soft_wrap=True)
    else:
        print_tables(screen, {comparison.environment: comparison.grid() for comparison in found})
    if into is not None:
        embed(f"{text}\nWritten by `{command_line()}`.", into, "compare")
