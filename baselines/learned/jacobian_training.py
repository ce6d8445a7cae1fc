"""Supervised training of a Jacobian estimator: it servos, and is told afterwards what the Jacobian had been."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

from servotrack.baselines.learned.contract import Rows
from servotrack.baselines.learned.course import Course, TrainingTask
from servotrack.baselines.learned.export import exportable_policy
from servotrack.baselines.learned.jacobian import (
    ENTRIES,
    USUAL,
    LearnedJacobian,
    create_learned_servo,
    jacobian_encoding,
    turning,
)
from servotrack.baselines.learned.settings import schedule
from servotrack.baselines.learned.student import lesson_seeds
from servotrack.envs.servo.world import ServoWorld


@dataclass(frozen=True)
class JacobianSettings:
    """Hyper-parameters of a Jacobian estimator.

    Attributes:
        hidden: Numbers that its recurrent layer carries.
        learning_rate: Of Adam; `lin_X` falls from X to 0.
        n_epochs: Passes over the episodes of one iteration.
        batch_size: Episodes in a batch.
        exploration: Noise of every other iteration's actions, relative to the action's size.
        floor: Errors well above this share of the Jacobian count logarithmically.
    """

    hidden: int = 64
    learning_rate: float | str = "lin_1e-3"
    n_epochs: int = 3
    batch_size: int = 64
    exploration: float = 0.3
    floor: float = 0.05


class JacobianNetwork(nn.Module):
    """A recurrent network from rows to the entries of a Jacobian.

    Args:
        size: Numbers in a row.
        hidden: Numbers that it carries.
    """

    def __init__(self, size: int, hidden: int) -> None:
        super().__init__()
        self.entry = nn.Sequential(nn.Linear(size, hidden), nn.ReLU())
        self.memory = nn.GRU(hidden, hidden, batch_first=True)
        self.head = nn.Sequential(nn.Linear(hidden + size, hidden), nn.ReLU(), nn.Linear(hidden, ENTRIES))

    def entries(self, rows: torch.Tensor, carried: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Of whole sequences.

        Args:
            rows: Shape (N, T, size).
            carried: Shape (1, N, hidden); None at the beginning.

        Returns:
            Shape (N, T, 6), and what is carried on.
        """
        remembered, carried = self.memory(self.entry(rows), carried)
        return self.head(torch.cat([remembered, rows], -1)), carried

    def forward(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """One step, as it is exported: from rows (N, size) and memory (N, hidden) to entries and memory."""
        answer, carried = self.entries(observation[:, None], memory[None])
        return answer[:, 0], carried[0]


class Records(NamedTuple):
    """Episodes, N of T steps.

    Attributes:
        rows: What the network saw. Shape (N, T, size).
        entries: What it should have answered. Shape (N, T, 6).
        counted: 1 while the episode lasted. Shape (N, T).
    """

    rows: torch.Tensor
    entries: torch.Tensor
    counted: torch.Tensor


def teach_jacobian(course: Course) -> None:
    """Train an estimator, from the beginning or from where the course was saved.

    Each iteration lets it servo in new episodes of the train range, and then shows it the analytic Jacobian of every
    step: DAgger (Ross et al. 2011) with the oracle's answer as the label.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: The environment is no servo of features, or a hyper-parameter is unknown.
    """
    task, settings = course.task, course.task.settings
    try:
        own = JacobianSettings(**settings.hyper_parameters)
    except TypeError as error:
        raise ValueError(f"jacobian does not take these hyper-parameters: {error}") from error
    torch.set_num_threads(1)
    torch.manual_seed(task.seed + course.curve.steps)
    env: Any = gym.make_vec(
        task.env_id,
        num_envs=settings.n_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
        **task.env_kwargs,
    )
    if type(getattr(env.unwrapped, "world", None)) is not ServoWorld:
        raise ValueError(f"a Jacobian is learned in servo worlds with features only, got {task.env_id}")
    encoding, law = jacobian_encoding(settings.encoding)
    network = JacobianNetwork(encoding.size, own.hidden)
    optimizer = torch.optim.Adam(network.parameters())
    steps = course.resume(network, optimizer)
    rate = schedule(own.learning_rate)
    explore = np.random.default_rng([task.seed, steps])
    servo = create_learned_servo(LearnedJacobian(_running(network), own.hidden, encoding), env, law)
    iteration = 0
    try:
        while steps < settings.n_timesteps:
            noise = own.exploration if iteration % 2 else 0.0
            records = _servo(env, servo, task, steps, noise, explore)
            remaining = 1.0 - steps / settings.n_timesteps
            for group in optimizer.param_groups:
                group["lr"] = rate(remaining) if callable(rate) else rate
            _learn(network, optimizer, records, own)
            steps, iteration = steps + int(records.counted.sum()), iteration + 1
            course.on_steps(steps)
            if course.is_due(steps) or steps >= settings.n_timesteps:
                saved = {"parameters": {"network": network.state_dict(), "optimizer": optimizer.state_dict()}}
                course.measure(steps, exportable_policy(network, encoding.size, own.hidden), saved)
    finally:
        env.close()


def _running(network: JacobianNetwork) -> Any:
    """The network as it is now, as a function of arrays."""

    def answer(rows: Rows, memory: Rows) -> tuple[Rows, Rows]:
        with torch.no_grad():
            entries, carried = network(torch.from_numpy(rows), torch.from_numpy(memory))
        return entries.numpy(), carried.numpy()

    return answer


def _servo(
    env: Any, servo: Any, task: TrainingTask, steps: int, noise: float, explore: np.random.Generator
) -> Records:
    """One episode per environment, with what the Jacobian was written down beside."""
    world: ServoWorld = env.unwrapped.world
    count, length = task.settings.n_envs, world.config.warmup + world.config.horizon
    estimator: LearnedJacobian = servo.controller.estimator
    observation, _ = env.reset(seed=lesson_seeds(task, steps))
    rows = np.zeros((count, length, estimator.encoding.size), np.float32)
    entries, counted = np.zeros((count, length, ENTRIES), np.float32), np.zeros((count, length), np.float32)
    alive, state, started = np.ones(count, np.bool_), None, np.zeros(count, np.bool_)
    for k in range(length):
        true = world.privileged()["true_jacobian"]
        action, state = servo.predict(observation, state, started)
        learned = state.estimator
        rows[:, k], counted[:, k] = learned.rows, alive
        turned = turning(learned.encoding, np.asarray(observation["joint_angles"], np.float64)) @ true
        entries[:, k] = (turned / USUAL).reshape(count, ENTRIES)
        if noise > 0.0:
            size = 0.1 + np.abs(action).max(axis=1, keepdims=True)
            action = action + (noise * size * explore.normal(size=action.shape)).astype(np.float32)
        observation, _, terminated, truncated, _ = env.step(np.clip(action, -1.0, 1.0))
        started = terminated | truncated
        alive &= ~started
    return Records(*(torch.from_numpy(part) for part in (rows, entries, counted)))


def _learn(network: JacobianNetwork, optimizer: torch.optim.Optimizer, records: Records, own: JacobianSettings) -> None:
    """Some passes over the episodes."""
    for _ in range(own.n_epochs):
        for batch in torch.randperm(len(records.rows)).split(own.batch_size):
            part = Records(*(tensor[batch] for tensor in records))
            answer, _ = network.entries(part.rows)
            # By joints and by time each, relative to how large they are.
            wrong, true = ((x.unflatten(-1, (2, 3))) for x in (answer - part.entries, part.entries))
            by_joints = (wrong[..., :2] ** 2).sum((-2, -1)) / (true[..., :2] ** 2).sum((-2, -1)).clamp(min=0.01)
            by_time = (wrong[..., 2] ** 2).sum(-1) / (true[..., 2] ** 2).sum(-1).clamp(min=0.25)
            loss = torch.log1p(torch.stack([by_joints, by_time], -1) / own.floor**2).sum(-1)
            loss = (loss * part.counted).sum() / part.counted.sum()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
