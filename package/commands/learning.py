"""Agents that learn: training them, listing them, and asking whether training wins."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from servotrack.commands.terms import (
    DEFAULT_RESULTS,
    Episodes,
    Level,
    Results,
    Settings,
    Split,
    console,
    env_kwargs,
    levels_of,
)


def train(
    env: Annotated[str, typer.Argument(help="Gymnasium id with a vector environment of its own.")],
    algo: Annotated[
        str,
        typer.Option(
            help="ppo, a2c, sac, td3, recurrent_ppo, tqc, student, jacobian, set, or a recipe's name in the file."
        ),
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

    from servotrack.baselines.training.settings import load_settings

    try:
        from servotrack.baselines.training.command import TrainingRequest, run_training
    except ModuleNotFoundError as error:
        raise ImportError(f"training needs {error.name}; install the extra: pip install 'servotrack[rl]'") from error
    chosen = load_settings(env, algo, level, hyper_parameters)
    if steps is not None:
        chosen = replace(chosen, n_timesteps=steps)
    kwargs = env_kwargs(level, settings)
    run_training(TrainingRequest(env, kwargs, chosen, tuple(levels_of(seeds)), output, jobs, name, ship), console())


def agents(
    world: Annotated[str, typer.Option(help="servo, clutter, video, color, sonar or follow; default: all.")] = "",
    into: Annotated[
        Path | None,
        typer.Option(help="A document for the learned ones, with <!-- agents:begin --> and <!-- agents:end -->."),
    ] = None,
) -> None:
    """All agents by name, and what the learned ones among them cost to train."""
    from servotrack.baselines.leaderboard.agents_table import agents_grid, shipped_grid
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.grid import as_markdown, as_rich
    from servotrack.baselines.reporting.terminal import command_line

    learned = shipped_grid()
    console().print(as_rich(agents_grid(world), "Agents"))
    console().print(as_rich(learned, "Learned agents"))
    if into is not None:
        embed(f"{as_markdown(learned)}\nWritten by `{command_line()}`, from the agents' cards.", into, "agents")


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
    from servotrack.baselines.evaluation.results import ResultsFolder
    from servotrack.baselines.reporting.embed import embed
    from servotrack.baselines.reporting.terminal import command_line, progress_bars
    from servotrack.baselines.training.comparison import compare as run

    with progress_bars() as progress:
        bar = progress.add_task("agents", total=None)
        found = run(
            runs, recipe, against, ResultsFolder(results), episodes, split, lambda: progress.update(bar, advance=1)
        )
    text = "\n".join(comparison.markdown() for comparison in found)
    console().print(text, soft_wrap=True)
    if into is not None:
        embed(f"{text}\nWritten by `{command_line()}`.", into, "compare")
