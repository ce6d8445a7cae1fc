"""One training run, whatever the algorithm: periodic evaluation, checkpoints, export, resuming after a kill.

A run is a sequence of segments, each from one checkpoint to the next. A segment begins with new environments and with
everything else that the checkpoint holds, in a run that was never interrupted, too. So a run that was killed, however
often, ends with the same network.
"""

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
from servotrack.baselines.reporting.files import LARGEST_DOCUMENT, ResultsError, atomic_path, read_strict_json
from servotrack.baselines.reporting.strict import parse_json
from servotrack.baselines.training.checkpoint import (
    CHECKPOINT,
    load_checkpoint,
    random_states,
    restore_random_states,
    write_checkpoint,
)
from servotrack.baselines.training.export import Exportable, write_agent
from servotrack.baselines.training.progress import Evaluation
from servotrack.baselines.training.settings import TrainingSettings
from servotrack.baselines.worlds import describe_environment, kind_of_id, plain

AGENT, TASK = "agent", "task.json"

Entry = dict[str, Any]


@dataclass(frozen=True)
class TrainingTask:
    """One run of a training.

    Attributes:
        env_id: Gymnasium id.
        env_kwargs: Arguments of the environment.
        settings: Hyper-parameters.
        seed: Seed of weights and exploration. The environments' seeds are derived from it in the train range.
        folder: Folder of all files of the run.
        tensorboard: True also writes TensorBoard events.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    settings: TrainingSettings
    seed: int
    folder: Path
    tensorboard: bool = True

    def as_record(self) -> dict[str, Any]:
        """Return everything that determines the run."""
        return {
            "env_id": self.env_id,
            "env_kwargs": plain(self.env_kwargs),
            "settings": plain(self.settings.as_record()),
            "seed": self.seed,
        }


@dataclass
class TrainingCurve:
    """Learning curve of a run on tune seeds.

    Attributes:
        entries: One per evaluation: `steps`, `seconds` of training without the evaluations, and the numbers of
            `Evaluation`.
        provenance: Versions, machine, command, creation time (UTC).
        interruptions: Number of times that the run was resumed.
    """

    entries: list[Entry] = field(default_factory=list)
    provenance: dict[str, Any] = field(default_factory=provenance)
    interruptions: int = 0

    @property
    def steps(self) -> int:
        """Environment steps at the last evaluation."""
        return int(self.entries[-1]["steps"]) if self.entries else 0


class TrainingRun:
    """Progress of a run: its learning curve and its checkpoint on disk.

    Args:
        task: Environment, settings and seed of the run.
        evaluation: Evaluates the policy during training.
        on_steps: Called with the number of environment steps done.
        on_entry: Called with every evaluation, those before an interruption included.

    Attributes:
        checkpoint: Newest checkpoint; None before the first.
        curve: The learning curve.

    Raises:
        ResultsError: The task's folder holds another training, or a checkpoint that cannot be read.
    """

    def __init__(
        self,
        task: TrainingTask,
        evaluation: Evaluation,
        on_steps: Callable[[int], None] = lambda steps: None,
        on_entry: Callable[[Entry], None] = lambda entry: None,
    ) -> None:
        _claim(task)
        self.task, self.on_steps = task, on_steps
        self._evaluation, self._on_entry = evaluation, on_entry
        self.checkpoint = load_checkpoint(task.folder)
        self.curve = TrainingCurve()
        if self.checkpoint is not None:
            try:
                self.curve = TrainingCurve(**parse_json(self.checkpoint["curve"].encode()))
            except (ValueError, TypeError, AttributeError) as error:
                raise ResultsError(
                    f"{task.folder / CHECKPOINT} has no learning curve ({error}); move its folder away to start again"
                ) from error
            self.curve.interruptions += not self.finished
        for entry in self.curve.entries:
            on_entry(entry)
        on_steps(self.curve.steps)
        self._seconds = float(self.curve.entries[-1]["seconds"]) if self.curve.entries else 0.0
        self._since = time.perf_counter()

    @property
    def finished(self) -> bool:
        """True if all steps are done."""
        return self.curve.steps >= self.task.settings.n_timesteps

    @property
    def turns(self) -> int:
        """Turns of a supervised training that are done."""
        return 0 if self.checkpoint is None else int(self.checkpoint.get("turns", 0))

    def resume(self, network: nn.Module, optimizer: torch.optim.Optimizer) -> int:
        """Restore a network, its optimizer and the random states from the checkpoint, and return the steps done.

        Raises:
            ResultsError: A checkpoint of another network.
        """
        if self.checkpoint is None:
            return 0
        try:
            parameters: Mapping[str, Any] = self.checkpoint["parameters"]
            network.load_state_dict(parameters["network"])
            optimizer.load_state_dict(parameters["optimizer"])
            restore_random_states(self.checkpoint["random"])
        except Exception as error:
            raise ResultsError(
                f"{self.task.folder / CHECKPOINT} does not fit this training ({error}); move its folder away"
            ) from error
        return int(self.checkpoint["steps"])

    @property
    def interval(self) -> int:
        """Environment steps from one evaluation to the next."""
        return max(1, self.task.settings.n_timesteps // self.task.settings.measurements)

    def overdue(self, steps: int) -> int:
        """Return the environment steps since the next evaluation and checkpoint were due; negative before that."""
        return steps - self.curve.steps - self.interval

    def measure(self, steps: int, policy: Exportable, saved: Mapping[str, Any]) -> Entry:
        """Export a policy, evaluate the exported file and write a checkpoint.

        Args:
            steps: Environment steps done.
            policy: The policy.
            saved: Content of the checkpoint besides steps, curve and random states; see `write_checkpoint`.

        Returns:
            The evaluation.
        """
        self._seconds += time.perf_counter() - self._since
        task, folder = self.task, self.task.folder
        name = task.settings.recipe.replace("_", "-")
        card = LearnedCard(
            name=name,
            summary=task.settings.summary or f"{name} on {describe_environment(task.env_id, task.env_kwargs)}",
            # Cards name no module; "module:id" is for users to type.
            env_id=task.env_id.rpartition(":")[2],
            env_kwargs=plain(task.env_kwargs),
            encoding=plain(task.settings.encoding),
            network=f"{AGENT}.onnx",
            sha256="",
            # Points in clutter come with the parameters that filters receive, in `scene_model`.
            information="calibrated" if kind_of_id(task.env_id) == "clutter" else "prior",
            levels=list(task.settings.levels),
            steps=steps,
            training={**task.as_record(), "curve": self.curve.entries, "provenance": self.curve.provenance},
        )
        write_agent(policy, card, folder)
        entry: Entry = {"steps": steps, "seconds": round(self._seconds, 1)}
        entry |= self._evaluation.measure(agent_in_file(folder / f"{AGENT}.json"))
        self.curve.entries.append(entry)
        content = {**saved, "steps": steps, "curve": json.dumps(vars(self.curve)), "random": random_states()}
        write_checkpoint(folder, content)
        # The next segment starts from the file, as after a kill.
        self.checkpoint = load_checkpoint(folder)
        self._on_entry(entry)
        self._since = time.perf_counter()
        return entry


def _claim(task: TrainingTask) -> None:
    """Write the task into its folder; raise if the folder holds another one."""
    path, mine = task.folder / TASK, task.as_record()
    if path.exists():
        if read_strict_json(path, LARGEST_DOCUMENT) != mine:
            raise ResultsError(
                f"{task.folder} holds a training with other settings; choose another folder or move it away"
            )
        return
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(mine, indent=1), encoding="utf-8")
