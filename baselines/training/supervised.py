"""The loop that all supervised trainings share: alternate data collection and updates, evaluate, checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import cycle, islice
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.training.export import Exportable
from servotrack.baselines.training.run import TrainingRun, TrainingTask
from servotrack.baselines.training.settings import schedule
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import FloatArray

Settings = TypeVar("Settings")


def prepare(kind: type[Settings], run: TrainingRun) -> Settings:
    """Set torch to one thread and this run's seed, and return the training's own hyper-parameters.

    Raises:
        ValueError: A hyper-parameter that this training does not take.
    """
    settings = run.task.settings
    torch.set_num_threads(1)
    torch.manual_seed(run.task.seed)
    try:
        return kind(**settings.hyper_parameters)
    except TypeError as error:
        raise ValueError(f"{settings.algorithm} does not take these hyper-parameters: {error}") from error


def servo_environments(task: TrainingTask) -> Any:
    """Create the vector environment of a training that reads a servo's simulated world.

    Raises:
        ValueError: An environment that does not observe features of a servo.
    """
    env = gym.make_vec(
        task.env_id,
        num_envs=task.settings.n_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
        **task.env_kwargs,
    )
    if type(getattr(env.unwrapped, "world", None)) is not ServoWorld:
        env.close()
        raise ValueError(
            f"{task.settings.algorithm} supports only servo environments that observe features, got {task.env_id}"
        )
    return env


def alternating_noise(run: TrainingRun, noise: float) -> Iterator[float]:
    """Return the exploration of each turn, no noise in every other one; a new segment goes on in step."""
    return islice(cycle((0.0, noise)), run.turns % 2, None)


def explored(action: FloatArray, noise: float, chance: np.random.Generator) -> FloatArray:
    """Add noise relative to the size of the actions and clip to [-1, 1]. Shape (N, n)."""
    if noise > 0.0:
        size = 0.1 + np.abs(action).max(axis=1, keepdims=True)
        action = action + (noise * size * chance.normal(size=action.shape)).astype(np.float32)
    return np.clip(action, -1.0, 1.0)


class RecurrentNetwork(nn.Module):
    """A gated recurrent layer, and a head that reads its state and the newest row.

    Args:
        size: Length of a row.
        hidden: Size of the recurrent state.
        answers: Length of an answer.
    """

    def __init__(self, size: int, hidden: int, answers: int) -> None:
        super().__init__()
        self.entry = nn.Sequential(nn.Linear(size, hidden), nn.ReLU())
        self.memory = nn.GRU(hidden, hidden, batch_first=True)
        self.head = nn.Sequential(nn.Linear(hidden + size, hidden), nn.ReLU(), nn.Linear(hidden, answers))

    def answers(self, rows: torch.Tensor, carried: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Return answers to whole sequences.

        Args:
            rows: Inputs, shape (N, T, size).
            carried: Recurrent state, shape (1, N, hidden); None at the beginning.

        Returns:
            Answers, shape (N, T, answers), and the recurrent state after them.
        """
        remembered, carried = self.memory(self.entry(rows), carried)
        return self.head(torch.cat([remembered, rows], -1)), carried


def episode_seeds(task: TrainingTask, steps: int) -> list[int]:
    """Return seeds of the train range that this run has not used recently, one per environment."""
    first = 7919 * task.seed + steps
    return [seed_ranges.TRAIN[(first + i) % len(seed_ranges.TRAIN)] for i in range(task.settings.n_envs)]


def take_turns(
    run: TrainingRun,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    learning_rate: float | str,
    exported: Exportable,
    turn: Callable[[int], int],
) -> None:
    """Train until the next evaluation, which writes a checkpoint.

    Args:
        run: Evaluates the policy and saves checkpoints.
        network: Network to train, restored from the checkpoint.
        optimizer: Optimizer of its weights.
        learning_rate: A number, or `lin_X`, which falls linearly from X to 0.
        exported: The network as it is exported to ONNX.
        turn: Collects data and updates once. Called with the environment steps done; returns the steps it added.
    """
    total, steps, rate = run.task.settings.n_timesteps, run.curve.steps, schedule(learning_rate)
    turns = run.turns
    while steps < total:
        for group in optimizer.param_groups:
            group["lr"] = rate(1.0 - steps / total) if callable(rate) else rate
        steps += turn(steps)
        turns += 1
        run.on_steps(steps)
        if run.overdue(steps) >= 0 or steps >= total:
            break
    saved: dict[str, Any] = {"network": network.state_dict(), "optimizer": optimizer.state_dict()}
    run.measure(steps, exported, {"parameters": saved, "turns": turns})


def descend(network: nn.Module, optimizer: torch.optim.Optimizer, loss: torch.Tensor, steepest: float = 1.0) -> None:
    """Take one optimizer step; gradients longer than `steepest` are scaled down to it."""
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), steepest)
    optimizer.step()
