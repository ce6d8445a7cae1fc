"""Supervised training of a Jacobian estimator: it servos, and the analytic Jacobian of every step is the label."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from servotrack.baselines.agents.learned.jacobian import (
    ENTRIES,
    JACOBIAN_SCALE,
    LearnedJacobian,
    create_learned_servo,
    image_rotation,
    jacobian_encoding,
)
from servotrack.baselines.agents.registry import create_agent
from servotrack.baselines.training.export import exportable_policy
from servotrack.baselines.training.run import TrainingRun
from servotrack.baselines.training.supervised import (
    RecurrentNetwork,
    alternating_noise,
    descend,
    episode_seeds,
    explored,
    prepare,
    servo_environments,
    take_turns,
)
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import FloatArray


@dataclass(frozen=True)
class JacobianSettings:
    """Hyper-parameters of a Jacobian estimator.

    Attributes:
        hidden: Size of the recurrent layer's state.
        learning_rate: Learning rate of Adam; `lin_X` falls linearly from X to 0.
        n_epochs: Passes over the episodes of one iteration.
        batch_size: Number of episodes in a batch.
        exploration: Action noise in every other iteration, relative to the size of the action.
        guided: Initial share of episodes in which a Kalman filter servos; it falls linearly to 0.
        floor: Relative Jacobian error at which the loss changes from quadratic to logarithmic.
    """

    hidden: int = 64
    learning_rate: float | str = "lin_1e-3"
    n_epochs: int = 3
    batch_size: int = 64
    exploration: float = 0.3
    guided: float = 0.5
    floor: float = 0.05


class JacobianNetwork(RecurrentNetwork):
    """A recurrent network that maps rows to the entries of a Jacobian.

    Args:
        size: Length of a row.
        hidden: Size of the recurrent state.
    """

    def __init__(self, size: int, hidden: int) -> None:
        super().__init__(size, hidden, ENTRIES)

    def forward(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return entries (N, 6) and the next memory for rows (N, size) and memory (N, hidden), as exported."""
        answer, carried = self.answers(observation[:, None], memory[None])
        return answer[:, 0], carried[0]


class Records(NamedTuple):
    """Episodes, N of T steps.

    Attributes:
        rows: Inputs of the network. Shape (N, T, size).
        entries: True entries of the Jacobian. Shape (N, T, 6).
        counted: 1 until the episode ends, then 0. Shape (N, T).
    """

    rows: torch.Tensor
    entries: torch.Tensor
    counted: torch.Tensor


def train_jacobian(run: TrainingRun) -> None:
    """Train a Jacobian estimator from the newest checkpoint to the next.

    Each iteration lets the estimator servo in new episodes of the train range, then fits it to the analytic Jacobian of
    every step: DAgger (Ross et al. 2011) with the oracle's answer as the label. At first a Kalman filter servos in some
    episodes, because the Jacobian is observable only while the arm moves, and an untrained estimator hardly moves it.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: An environment that does not observe features of a servo, or an unknown hyper-parameter.
    """
    own = prepare(JacobianSettings, run)
    task, settings = run.task, run.task.settings
    env = servo_environments(task)
    encoding, law = jacobian_encoding(settings.encoding)
    network = JacobianNetwork(encoding.size, own.hidden)
    optimizer = torch.optim.Adam(network.parameters())
    explore = np.random.default_rng([task.seed, run.resume(network, optimizer)])
    servo = create_learned_servo(LearnedJacobian(_running(network), own.hidden, encoding), env, law)
    guide = create_agent("kf", env)
    noises = alternating_noise(run, own.exploration)

    def turn(steps: int) -> int:
        share = own.guided * (1.0 - steps / settings.n_timesteps)
        records = _servo(env, servo, guide, share, episode_seeds(task, steps), next(noises), explore)
        _learn(network, optimizer, records, own)
        return int(records.counted.sum())

    try:
        exported = exportable_policy(network, encoding.size, own.hidden)
        take_turns(run, network, optimizer, own.learning_rate, exported, turn)
    finally:
        env.close()


def _running(network: JacobianNetwork) -> Any:
    """Return the network with its present weights as a function of arrays."""

    def answer(rows: FloatArray, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
        with torch.no_grad():
            entries, carried = network(torch.from_numpy(rows), torch.from_numpy(memory))
        return entries.numpy(), carried.numpy()

    return answer


def _servo(
    env: Any, servo: Any, guide: Any, share: float, seeds: list[int], noise: float, explore: np.random.Generator
) -> Records:
    """Run one episode per seed and record the true Jacobians; `guide` acts in the first `share` of them."""
    world: ServoWorld = env.unwrapped.world
    count, length = len(seeds), world.config.warmup + world.config.horizon
    estimator: LearnedJacobian = servo.controller.estimator
    observation, _ = env.reset(seed=seeds)
    rows = np.zeros((count, length, estimator.encoding.size), np.float32)
    entries, counted = np.zeros((count, length, ENTRIES), np.float32), np.zeros((count, length), np.float32)
    alive, started = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    state, guiding, guided = None, None, np.arange(count) < share * count
    for k in range(length):
        true = world.privileged()["true_jacobian"]
        action, state = servo.predict(observation, state, started)
        if guided.any():
            better, guiding = guide.predict(observation, guiding, started)
            action = np.where(guided[:, None], better, action)
        learned = state.estimator
        rows[:, k], counted[:, k] = learned.rows, alive
        turned = image_rotation(learned.encoding, np.asarray(observation["joint_angles"], np.float64)) @ true
        entries[:, k] = (turned / JACOBIAN_SCALE).reshape(count, ENTRIES)
        observation, _, terminated, truncated, _ = env.step(explored(action, noise, explore))
        started = terminated | truncated
        alive &= ~started
    return Records(*(torch.from_numpy(part) for part in (rows, entries, counted)))


def _learn(network: JacobianNetwork, optimizer: torch.optim.Optimizer, records: Records, own: JacobianSettings) -> None:
    """Train for `n_epochs` passes over the episodes."""
    for _ in range(own.n_epochs):
        for batch in torch.randperm(len(records.rows)).split(own.batch_size):
            part = Records(*(tensor[batch] for tensor in records))
            answer, _ = network.answers(part.rows)
            # Errors of the joint columns and of the time column, each relative to the true size.
            wrong, true = ((x.unflatten(-1, (2, 3))) for x in (answer - part.entries, part.entries))
            by_joints = (wrong[..., :2] ** 2).sum((-2, -1)) / (true[..., :2] ** 2).sum((-2, -1)).clamp(min=0.01)
            by_time = (wrong[..., 2] ** 2).sum(-1) / (true[..., 2] ** 2).sum(-1).clamp(min=0.25)
            loss = torch.log1p(torch.stack([by_joints, by_time], -1) / own.floor**2).sum(-1)
            loss = (loss * part.counted).sum() / part.counted.sum()
            descend(network, optimizer, loss)
