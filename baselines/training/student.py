"""Supervised training of a servo policy by the distance to the target's next position, which the simulator knows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from servotrack.baselines.agents.learned.contract import Encoding
from servotrack.baselines.agents.learned.encoding import create_encoding
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
from servotrack.envs.servo.targets import LEAD, PERIOD
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.stateful import select_rows

ERRORS = 2
"""Entries of the rotated image error, with which a row begins."""
DISTANCE_FLOOR = 1e-3
"""Distance below which the loss is flat, m."""


@dataclass(frozen=True)
class StudentSettings:
    """Hyper-parameters of a student.

    Attributes:
        hidden: Size of the recurrent layer's state.
        learning_rate: Learning rate of Adam; `lin_X` falls linearly from X to 0.
        n_epochs: Passes over the episodes of one iteration.
        batch_size: Number of episodes in a batch.
        exploration: Action noise in every other iteration, relative to the size of the action.
        scale: Distance that costs ln 2, m: well below it the loss is linear, well above logarithmic.
    """

    hidden: int = 64
    learning_rate: float | str = "lin_1e-3"
    n_epochs: int = 3
    batch_size: int = 64
    exploration: float = 0.1
    scale: float = 0.005


class StudentNetwork(RecurrentNetwork):
    """A recurrent network whose action is a gain matrix times the rotated error, plus a feed-forward term.

    For small errors the action is proportional to the error, with a gain that depends on the history.

    Args:
        size: Length of a row.
        hidden: Size of the recurrent state.
        residual: True if a row ends with the action of a classical servo, to which the network adds a correction.
    """

    def __init__(self, size: int, hidden: int, residual: bool) -> None:
        super().__init__(size, hidden, 2 * ERRORS + 2)
        self.residual = residual
        last: Any = self.head[-1]
        with torch.no_grad():
            last.weight *= 0.01 if residual else 0.1
            last.bias.zero_()

    def actions(self, rows: torch.Tensor, carried: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Return actions of whole sequences, scaled down to the limits with their direction kept.

        Args:
            rows: Inputs, shape (N, T, size).
            carried: Recurrent state, shape (1, N, hidden); None at the beginning.

        Returns:
            Actions, shape (N, T, 2), and the recurrent state after them.
        """
        answer, carried = self.answers(rows, carried)
        gain = answer[..., : 2 * ERRORS].unflatten(-1, (2, ERRORS))
        action = 2.0 * (gain * rows[..., None, :ERRORS]).sum(-1) + answer[..., 2 * ERRORS :]
        if self.residual:
            action = action + rows[..., -2:]
        return action / torch.clamp(action.abs().amax(-1, keepdim=True), min=1.0), carried

    def forward(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return corrections and the next memory for rows (N, size) and memory (N, hidden), as exported."""
        action, carried = self.actions(observation[:, None], memory[None])
        base = observation[:, -2:] if self.residual else 0.0
        return action[:, 0] - base, carried[0]


class StudentEpisodes(NamedTuple):
    """Episodes of the student with the true state of the simulator; N episodes of T steps.

    Attributes:
        rows: Inputs of the student. Shape (N, T, size).
        joints: True joint angles, rad. Shape (N, T, 2).
        before: Actions of the step before. Shape (N, T, 2).
        following: Position of the target one period later, m. Shape (N, T, 2).
        counted: 1 until the episode ends, then 0. Shape (N, T).
        links: Link lengths, m. Shape (N, 2).
        gain: Gains of the motors. Shape (N, 2).
    """

    rows: torch.Tensor
    joints: torch.Tensor
    before: torch.Tensor
    following: torch.Tensor
    counted: torch.Tensor
    links: torch.Tensor
    gain: torch.Tensor


def train_student(run: TrainingRun) -> None:
    """Train a student from the newest checkpoint to the next.

    Each iteration lets the student act in new episodes of the train range. Then it improves every action by the
    distance between tool and target one period later: DAgger (Ross et al. 2011) with the distance itself as the loss.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: An environment that does not observe features of a servo, or an unknown hyper-parameter.
    """
    own = prepare(StudentSettings, run)
    task, settings = run.task, run.task.settings
    env = servo_environments(task)
    encoding = create_encoding(settings.encoding, env)
    network = StudentNetwork(encoding.size, own.hidden, residual="residual" in settings.encoding)
    optimizer = torch.optim.Adam(network.parameters())
    explore = np.random.default_rng([task.seed, run.resume(network, optimizer)])
    noises = alternating_noise(run, own.exploration)

    def turn(steps: int) -> int:
        episodes = _act(env, encoding, network, episode_seeds(task, steps), next(noises), explore)
        _learn(network, optimizer, episodes, own, env.unwrapped.config)
        return int(episodes.counted.sum())

    try:
        exported = exportable_policy(network, encoding.size, own.hidden)
        take_turns(run, network, optimizer, own.learning_rate, exported, turn)
    finally:
        env.close()


def _act(
    env: Any,
    encoding: Encoding,
    network: StudentNetwork,
    seeds: list[int],
    noise: float,
    explore: np.random.Generator,
) -> StudentEpisodes:
    """Run one episode of the student per seed and record the true state of the simulator."""
    world: ServoWorld = env.unwrapped.world
    count, length = len(seeds), world.config.warmup + world.config.horizon
    observation, _ = env.reset(seed=seeds)
    memory, action = encoding.initial(observation), np.zeros((count, 2), np.float32)
    rows = np.zeros((count, length, encoding.size), np.float32)
    joints, before, following = (np.zeros((count, length, 2), np.float32) for _ in range(3))
    counted = np.zeros((count, length), np.float32)
    links, gain = world.links.astype(np.float32), world.gain.astype(np.float32)
    alive, carried = np.ones(count, np.bool_), None
    for k in range(length):
        memory, rows[:, k] = encoding.step(memory, observation, action)
        joints[:, k], before[:, k], counted[:, k] = world.joints, action, alive
        later = np.minimum(world.steps + LEAD + 1, world.paths.shape[1] - 1)
        following[:, k] = world.paths[np.arange(count), later, :2]
        with torch.no_grad():
            chosen, carried = network.actions(torch.from_numpy(rows[:, k : k + 1]), carried)
        action = chosen[:, 0].numpy()
        action = explored(action, noise, explore)
        observation, _, terminated, truncated, _ = env.step(action)
        ended = terminated | truncated
        if ended.any():
            # These rows no longer count; their memory is reset because the clock starts anew.
            memory = select_rows(ended, encoding.initial(observation), memory)
        alive &= ~ended
    tensors = (torch.from_numpy(part) for part in (rows, joints, before, following, counted, links, gain))
    return StudentEpisodes(*tensors)


def _learn(
    network: StudentNetwork,
    optimizer: torch.optim.Optimizer,
    episodes: StudentEpisodes,
    own: StudentSettings,
    config: Any,
) -> None:
    """Train for `n_epochs` passes over the episodes."""
    # A motor takes up its command one substep late.
    late = 1.0 / config.substeps
    for _ in range(own.n_epochs):
        for batch in torch.randperm(len(episodes.rows)).split(own.batch_size):
            part = StudentEpisodes(*(tensor[batch] for tensor in episodes))
            action, _ = network.actions(part.rows)
            rates = part.gain[:, None] * (late * part.before + (1.0 - late) * action)
            tool = _tool(part.joints + PERIOD * config.max_joint_rate * rates, part.links)
            distance = torch.sqrt(((tool - part.following) ** 2).sum(-1) + DISTANCE_FLOOR**2)
            loss = (torch.log1p(distance / own.scale) * part.counted).sum() / part.counted.sum()
            descend(network, optimizer, loss)


def _tool(joints: torch.Tensor, links: torch.Tensor) -> torch.Tensor:
    """Return the position of the tool, m."""
    angles = torch.stack([joints[..., 0], joints.sum(-1)], -1)
    return torch.stack([(links[:, None] * f(angles)).sum(-1) for f in (torch.cos, torch.sin)], -1)
