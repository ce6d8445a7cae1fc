"""What all trainings from known answers share: turns of collecting and learning, measured and saved as they go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import nn

from servotrack.baselines import seeds as seed_ranges
from servotrack.baselines.learned.course import Course, TrainingTask
from servotrack.baselines.learned.export import Exportable
from servotrack.baselines.learned.settings import schedule

Settings = TypeVar("Settings")


def own_settings(kind: type[Settings], course: Course) -> Settings:
    """Hyper-parameters of a training, and torch as it needs it: one thread, random numbers of its own.

    Raises:
        ValueError: A hyper-parameter that this training does not take.
    """
    settings = course.task.settings
    torch.set_num_threads(1)
    torch.manual_seed(course.task.seed + course.curve.steps)
    try:
        return kind(**settings.hyper_parameters)
    except TypeError as error:
        raise ValueError(f"{settings.algorithm} does not take these hyper-parameters: {error}") from error


def lesson_seeds(task: TrainingTask, steps: int) -> list[int]:
    """Seeds of the train range that this run has not had lately, one per environment."""
    first = 7919 * task.seed + steps
    return [seed_ranges.TRAIN[(first + i) % len(seed_ranges.TRAIN)] for i in range(task.settings.n_envs)]


def take_turns(
    course: Course,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    learning_rate: float | str,
    exported: Exportable,
    turn: Callable[[int], int],
) -> None:
    """Train until all steps are done.

    Args:
        course: Measures and saves.
        network: That learns, as it was where the course was saved.
        optimizer: Of its weights.
        learning_rate: A number, or `lin_X`, which falls from X to 0.
        exported: The network as it is shipped.
        turn: Collects and learns once; environment steps before in, those that it took out.
    """
    total, steps, rate = course.task.settings.n_timesteps, course.curve.steps, schedule(learning_rate)
    while steps < total:
        for group in optimizer.param_groups:
            group["lr"] = rate(1.0 - steps / total) if callable(rate) else rate
        steps += turn(steps)
        course.on_steps(steps)
        if course.is_due(steps) or steps >= total:
            saved: dict[str, Any] = {"network": network.state_dict(), "optimizer": optimizer.state_dict()}
            course.measure(steps, exported, {"parameters": saved})


def descend(network: nn.Module, optimizer: torch.optim.Optimizer, loss: torch.Tensor, steepest: float = 1.0) -> None:
    """One step down a loss, of gradients no longer than `steepest`."""
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), steepest)
    optimizer.step()
