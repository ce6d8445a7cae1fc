"""The `train` command: train several runs with a progress display, then export the best one with its card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from joblib import delayed
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from servotrack.baselines.agents.learned.card import LearnedCard, digest, load_card
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.reporting.files import atomic_path
from servotrack.baselines.reporting.terminal import progress_bars
from servotrack.baselines.running.clusters import check_shared
from servotrack.baselines.running.stopping import GO_ON, keeping
from servotrack.baselines.running.workers import in_workers, on_cluster
from servotrack.baselines.training.checkpoint import load_checkpoint
from servotrack.baselines.training.curves import draw_curves
from servotrack.baselines.training.dispatch import train
from servotrack.baselines.training.export import write_card
from servotrack.baselines.training.progress import PeriodicEvaluation
from servotrack.baselines.training.run import AGENT, Entry, TrainingCurve, TrainingTask
from servotrack.baselines.training.settings import TrainingSettings
from servotrack.baselines.worlds import describe_environment


@dataclass(frozen=True)
class TrainingRequest:
    """Arguments of the `train` command.

    Attributes:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        settings: Hyper-parameters.
        seeds: Seeds of the runs, one run each.
        folder: Folder of runs, one subfolder each, and of the classical agents' results on the tune seeds.
        jobs: Number of runs trained in parallel.
        name: Name of the agent; None: the recipe's.
        ship: Folder for the best run's network and card; None: that of the runs.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    settings: TrainingSettings
    seeds: tuple[int, ...]
    folder: Path
    jobs: int = 1
    name: str | None = None
    ship: Path | None = None

    def __post_init__(self) -> None:
        """Check the seeds."""
        if not self.seeds or len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"seeds must be different whole numbers >= 0, at least one, got {list(self.seeds)}")

    @property
    def environment(self) -> Path:
        """Folder of all runs in this environment."""
        return self.folder / describe_environment(self.env_id, self.env_kwargs)

    def task(self, seed: int) -> TrainingTask:
        """Return the task of one run."""
        folder = self.environment / f"{self.settings.recipe}-seed{seed}"
        return TrainingTask(self.env_id, self.env_kwargs, self.settings, seed, folder)


def run_training(request: TrainingRequest, console: Console) -> Path:
    """Train all runs, resume interrupted ones, and write the agent that is best on the tune seeds.

    Returns:
        Path of the agent's card.
    """
    evaluation = _evaluation(request)
    beside = " · ".join(f"{name} {_text(values)}" for name, values in evaluation.beside.items())
    console.print(
        f"{request.environment.name}: {request.settings.recipe}, evaluated on tune seeds; for comparison {beside}"
    )
    with keeping(lambda: _kept(request)):
        curves = _trained(request, evaluation, console)
    best = 0
    for i, curve in enumerate(curves):
        if evaluation.better(curve.entries[-1], curves[best].entries[-1]):
            best = i
    path = _write_chosen(request, best, curves)
    figure = request.environment / f"{request.settings.recipe}.png"
    levels = "".join(f", {level}" for level in request.settings.levels if level != request.env_kwargs.get("level"))
    title = f"{request.settings.recipe}, {request.environment.name}{levels}"
    draw_curves(curves, evaluation.beside, title, figure)
    console.print(f"best: seed {request.seeds[best]}, {_text(curves[best].entries[-1])}")
    for written in (path, figure):
        console.print(str(written), soft_wrap=True)
    return path


def _trained(request: TrainingRequest, evaluation: PeriodicEvaluation, console: Console) -> list[TrainingCurve]:
    """Train all runs and return their learning curves, in the order of the seeds."""
    if request.jobs == 1 and not on_cluster():
        return [_shown(request.task(seed), evaluation, console) for seed in request.seeds]
    curves = []
    if on_cluster():
        request.environment.mkdir(parents=True, exist_ok=True)
        request = replace(request, folder=request.folder.resolve())
        check_shared(request.environment)
    runs = in_workers((delayed(_alone)(request, seed) for seed in request.seeds), request.jobs, ordered=True)
    for seed, curve in zip(request.seeds, runs, strict=True):
        console.print(f"seed {seed}: {_text(curve.entries[-1])} after {curve.entries[-1]['seconds']:.0f} s")
        curves.append(curve)
    return curves


def _kept(request: TrainingRequest) -> str:
    """Return the saved steps of all runs, in a few words."""
    saved = [load_checkpoint(request.task(seed).folder) for seed in request.seeds]
    steps = ", ".join(
        f"seed {seed}: {0 if checkpoint is None else checkpoint['steps']:,}"
        for seed, checkpoint in zip(request.seeds, saved, strict=True)
    )
    return f"saved steps of {request.settings.n_timesteps:,}: {steps}; {GO_ON}"


def _evaluation(request: TrainingRequest) -> PeriodicEvaluation:
    # Earlier runs may have evaluated the classical agents with other code, so results are kept by code version.
    folder = ResultsFolder(request.environment / "classical" / code_version())
    folder.check_writable()
    return PeriodicEvaluation(request.env_id, request.env_kwargs, folder, levels=request.settings.levels)


def _alone(request: TrainingRequest, seed: int) -> TrainingCurve:
    """Train one run in a worker process, which has to register the ids first."""
    import servotrack  # noqa: F401

    return train(request.task(seed), _evaluation(request))


def _shown(task: TrainingTask, evaluation: PeriodicEvaluation, console: Console) -> TrainingCurve:
    columns = (
        TextColumn("seed {task.fields[seed]}"), BarColumn(), TextColumn("{task.completed:,} of {task.total:,} steps"),
        TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}", markup=False),
    )  # fmt: skip
    with progress_bars(*columns, quiet=console.quiet) as progress:
        bar = progress.add_task("", total=task.settings.n_timesteps, seed=task.seed)

        def on_entry(entry: Entry) -> None:
            progress.update(bar, description=_text(entry))

        return train(task, evaluation, lambda steps: progress.update(bar, completed=steps), on_entry)


def _text(measured: Mapping[str, Any]) -> str:
    shown = [f"score {measured['score']:.3f}"] if "score" in measured else [f"return {measured['return']:.1f}"]
    return " ".join([*shown, *([f"success {measured['success']:.2f}"] if "success" in measured else [])])


def _write_chosen(request: TrainingRequest, best: int, curves: list[TrainingCurve]) -> Path:
    """Write the network of the best run, and a card with the results of all runs."""
    source = request.task(request.seeds[best]).folder / f"{AGENT}.json"
    card = load_card(source)
    network = (source.parent / card.network).read_bytes()
    name = request.name or card.name
    level = request.env_kwargs.get("level")
    folder = request.ship or request.environment
    file = "-".join([request.env_id, *([] if level is None else [f"level{level}"]), name]) + ".onnx"
    runs = [{"seed": seed, **curve.entries[-1]} for seed, curve in zip(request.seeds, curves, strict=True)]
    with atomic_path(folder / file) as temporary:
        temporary.write_bytes(network)
    chosen: LearnedCard = replace(
        card,
        name=name,
        network=file,
        sha256=digest(network),
        steps=sum(curve.steps for curve in curves),
        training={**card.training, "runs": runs, "curve": curves[best].entries},
    )
    write_card(chosen, folder)
    return (folder / file).with_suffix(".json")
