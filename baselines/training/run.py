"""The course of a training, whatever is trained: measured, saved and exported as it goes, resumed after a kill."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import nn

from servotrack.baselines.agents.learned.card import LearnedCard
from servotrack.baselines.agents.learned.shipped import agent_in_file
from servotrack.baselines.evaluation.provenance import provenance
from servotrack.baselines.reporting.files import ResultsError, atomic_path
from servotrack.baselines.training.export import Exportable, write_agent
from servotrack.baselines.training.progress import PeriodicEvaluation
from servotrack.baselines.training.settings import TrainingSettings
from servotrack.baselines.worlds import describe_environment, kind_of_id, plain

AGENT, CHECKPOINT, TASK = "agent", "checkpoint.pt", "task.json"

Entry = dict[str, Any]


@dataclass(frozen=True)
class TrainingTask:
    """One run of a training.

    Attributes:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        settings: Hyper-parameters.
        seed: Of weights, exploration and the environments, which take their seeds from the train range.
        folder: Where everything of the run lies.
        tensorboard: Whether to write TensorBoard's events beside it.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    settings: TrainingSettings
    seed: int
    folder: Path
    tensorboard: bool = True

    def as_record(self) -> dict[str, Any]:
        """What decides the run's course."""
        return {
            "env_id": self.env_id,
            "env_kwargs": plain(self.env_kwargs),
            "settings": plain(self.settings.as_record()),
            "seed": self.seed,
        }


@dataclass
class TrainingCurve:
    """What a run reached on tune seeds, and when.

    Attributes:
        entries: One per evaluation: `steps`, `seconds` of training without the evaluations, and the numbers of
            `PeriodicEvaluation`.
        provenance: Versions, machine, command, creation time (UTC).
        interruptions: How often the run was resumed.
    """

    entries: list[Entry] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=provenance)
    interruptions: int = 0

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.entries[-1]["steps"]) if self.entries else 0


class TrainingRun:
    """What is known of a run so far, and where it is written down.

    Args:
        task: What to do.
        evaluation: Measures the policy as it goes.
        on_steps: Called with the environment steps so far.
        on_entry: Called with every measurement, those before an interruption included.

    Attributes:
        checkpoint: What `save` wrote last; None where nothing was saved yet.
        curve: The measurements.

    Raises:
        ResultsError: The task's folder holds another training, or a checkpoint that cannot be read.
    """

    def __init__(
        self,
        task: TrainingTask,
        evaluation: PeriodicEvaluation,
        on_steps: Callable[[int], None] = lambda steps: None,
        on_entry: Callable[[Entry], None] = lambda entry: None,
    ) -> None:
        _claim(task)
        self.task, self.on_steps = task, on_steps
        self._evaluation, self._on_entry = evaluation, on_entry
        self.checkpoint = load_checkpoint(task.folder)
        self.curve = TrainingCurve()
        if self.checkpoint is not None:
            self.curve = TrainingCurve(**json.loads(self.checkpoint["curve"]))
            self.curve.interruptions += not self.finished
        for entry in self.curve.entries:
            on_entry(entry)
        on_steps(self.curve.steps)
        self._seconds = float(self.curve.entries[-1]["seconds"]) if self.curve.entries else 0.0
        self._since = time.perf_counter()

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.curve.steps >= self.task.settings.n_timesteps

    def resume(self, network: nn.Module, optimizer: torch.optim.Optimizer) -> int:
        """Give a network and its optimizer back what the checkpoint holds of them, and return the steps that were done.

        Raises:
            ResultsError: The checkpoint is that of another network.
        """
        if self.checkpoint is None:
            return 0
        try:
            parameters: Mapping[str, Any] = self.checkpoint["parameters"]
            network.load_state_dict(parameters["network"])
            optimizer.load_state_dict(parameters["optimizer"])
        except Exception as error:
            raise ResultsError(
                f"{self.task.folder / CHECKPOINT} does not fit this training ({error}); move its folder away"
            ) from error
        return int(self.checkpoint["steps"])

    def is_due(self, steps: int) -> bool:
        """Whether it is time to measure and to save."""
        return steps >= self.curve.steps + max(1, self.task.settings.n_timesteps // self.task.settings.measurements)

    def measure(self, steps: int, policy: Exportable, saved: Mapping[str, Any]) -> Entry:
        """Export, measure and save a policy; what is measured is what would be shipped.

        Args:
            steps: Environment steps so far.
            policy: What was learned.
            saved: What it takes to go on: tensors and numbers.

        Returns:
            The measurement.
        """
        self._seconds += time.perf_counter() - self._since
        task, folder = self.task, self.task.folder
        name = task.settings.recipe.replace("_", "-")
        card = LearnedCard(
            name=name,
            summary=task.settings.summary or f"{name} on {describe_environment(task.env_id, task.env_kwargs)}",
            env_id=task.env_id,
            env_kwargs=plain(task.env_kwargs),
            encoding=plain(task.settings.encoding),
            network=f"{AGENT}.onnx",
            sha256="",
            # Points in clutter come with what their filters are told.
            information="calibrated" if kind_of_id(task.env_id) == "clutter" else "prior",
            levels=list(task.settings.levels),
            steps=steps,
            training={**task.as_record(), "curve": self.curve.entries, "provenance": self.curve.provenance},
        )
        write_agent(policy, card, folder)
        entry: Entry = {"steps": steps, "seconds": round(self._seconds, 1)}
        entry |= self._evaluation.measure(agent_in_file(folder / f"{AGENT}.json"))
        self.curve.entries.append(entry)
        with atomic_path(folder / CHECKPOINT) as temporary:
            torch.save({**saved, "steps": steps, "curve": json.dumps(vars(self.curve))}, temporary)
        self._on_entry(entry)
        self._since = time.perf_counter()
        return entry


def _claim(task: TrainingTask) -> None:
    """Say in the folder which training it holds; refuse one that holds another."""
    path, mine = task.folder / TASK, task.as_record()
    if path.exists():
        if json.loads(path.read_text(encoding="utf-8")) != mine:
            raise ResultsError(
                f"{task.folder} holds a training with other settings; choose another folder or move it away"
            )
        return
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(mine, indent=1), encoding="utf-8")


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The last checkpoint: tensors, numbers and text only, nothing is unpickled."""
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        saved: dict[str, Any] = torch.load(path, weights_only=True)
        if {"parameters", "curve"} <= set(saved):
            return saved
        reason = "it lacks parameters or curve"
    except Exception as error:  # torch raises what its readers raise
        reason = str(error).splitlines()[0]
    raise ResultsError(f"{path} is no checkpoint ({reason}); move its folder away to begin anew")
