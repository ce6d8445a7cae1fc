"""A student of a teacher that knows the future: trained on its own mistakes, by where the target will be next."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
import torch

from servotrack.baselines.agents.learned.contract import Encoding
from servotrack.baselines.agents.learned.encoding import create_encoding
from servotrack.baselines.training.export import exportable_policy
from servotrack.baselines.training.run import TrainingRun
from servotrack.baselines.training.supervised import (
    RecurrentNetwork,
    descend,
    explored,
    episode_seeds,
    prepare,
    servo_environments,
    take_turns,
)
from servotrack.envs.servo.episode import LEAD
from servotrack.envs.servo.targets import PERIOD
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.stateful import select_rows

ERRORS = 2
"""Numbers of the turned error, with which a row begins."""
FLOOR = 1e-3
"""Distances are not told apart below this, m."""


@dataclass(frozen=True)
class StudentSettings:
    """Hyper-parameters of a student.

    Attributes:
        hidden: Numbers that its recurrent layer carries.
        learning_rate: Of Adam; `lin_X` falls from X to 0.
        n_epochs: Passes over the episodes of one iteration.
        batch_size: Episodes in a batch.
        exploration: Noise of every other iteration's actions, relative to the action's size.
        scale: Distance that costs ln 2, m: well below it the loss is linear, well above logarithmic.
    """

    hidden: int = 64
    learning_rate: float | str = "lin_1e-3"
    n_epochs: int = 3
    batch_size: int = 64
    exploration: float = 0.1
    scale: float = 0.005


class StudentNetwork(RecurrentNetwork):
    """A recurrent network whose answer is a matrix times the turned error and a feed-forward.

    For small errors it so answers in proportion, with a gain that depends on what it has seen.

    Args:
        size: Numbers in a row.
        hidden: Numbers that it carries.
        residual: Whether a row ends with what a classical servo does, which the network then corrects.
    """

    def __init__(self, size: int, hidden: int, residual: bool) -> None:
        super().__init__(size, hidden, 2 * ERRORS + 2)
        self.residual = residual
        last: Any = self.head[-1]
        with torch.no_grad():
            last.weight *= 0.01 if residual else 0.1
            last.bias.zero_()

    def actions(self, rows: torch.Tensor, carried: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions of whole sequences, limited in their direction.

        Args:
            rows: Shape (N, T, size).
            carried: Shape (1, N, hidden); None at the beginning.

        Returns:
            Shape (N, T, 2), and what is carried on.
        """
        answer, carried = self.answers(rows, carried)
        gain = answer[..., : 2 * ERRORS].unflatten(-1, (2, ERRORS))
        action = 2.0 * (gain * rows[..., None, :ERRORS]).sum(-1) + answer[..., 2 * ERRORS :]
        if self.residual:
            action = action + rows[..., -2:]
        return action / torch.clamp(action.abs().amax(-1, keepdim=True), min=1.0), carried

    def forward(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """One step, as it is exported: from rows (N, size) and memory (N, hidden) to corrections and memory."""
        action, carried = self.actions(observation[:, None], memory[None])
        base = observation[:, -2:] if self.residual else 0.0
        return action[:, 0] - base, carried[0]


class StudentEpisodes(NamedTuple):
    """Episodes of the student, and what the teacher knows of them; N episodes of T steps.

    Attributes:
        rows: What the student saw. Shape (N, T, size).
        joints: True joint angles, rad. Shape (N, T, 2).
        before: Actions of the step before. Shape (N, T, 2).
        following: Where the target is a period later, m. Shape (N, T, 2).
        counted: 1 while the episode lasted. Shape (N, T).
        links: Lengths, m. Shape (N, 2).
        gain: Of the motors. Shape (N, 2).
    """

    rows: torch.Tensor
    joints: torch.Tensor
    before: torch.Tensor
    following: torch.Tensor
    counted: torch.Tensor
    links: torch.Tensor
    gain: torch.Tensor


def train_student(run: TrainingRun) -> None:
    """Train a student, from the beginning or from where the course was saved.

    Each iteration lets the student act in new episodes of the train range and then improves every one of its actions by
    where the tool would have been a period later, and where the target was: DAgger (Ross et al. 2011) with the
    distance itself as the loss.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: The environment is no servo of features, or a hyper-parameter is unknown.
    """
    own = prepare(StudentSettings, run)
    task, settings = run.task, run.task.settings
    env = servo_environments(task)
    encoding = create_encoding(settings.encoding, env)
    network = StudentNetwork(encoding.size, own.hidden, residual="residual" in settings.encoding)
    optimizer = torch.optim.Adam(network.parameters())
    explore = np.random.default_rng([task.seed, run.resume(network, optimizer)])
    noises = cycle((0.0, own.exploration))

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
    """One episode of the student per seed, with what the teacher knows written down beside."""
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
            # These rows no longer count; their memory only has to stand the clock that starts anew.
            memory = select_rows(ended, encoding.initial(observation), memory)
        alive &= ~ended
    tensors = (torch.from_numpy(part) for part in (rows, joints, before, following, counted, links, gain))
    return StudentEpisodes(*tensors)


def _learn(
    network: StudentNetwork, optimizer: torch.optim.Optimizer, episodes: StudentEpisodes, own: StudentSettings, config: Any
) -> None:
    """Some passes over the episodes."""
    # A motor obeys one substep late.
    late = 1.0 / config.substeps
    for _ in range(own.n_epochs):
        for batch in torch.randperm(len(episodes.rows)).split(own.batch_size):
            part = StudentEpisodes(*(tensor[batch] for tensor in episodes))
            action, _ = network.actions(part.rows)
            rates = part.gain[:, None] * (late * part.before + (1.0 - late) * action)
            tool = _tool(part.joints + PERIOD * config.max_joint_rate * rates, part.links)
            distance = torch.sqrt(((tool - part.following) ** 2).sum(-1) + FLOOR**2)
            loss = (torch.log1p(distance / own.scale) * part.counted).sum() / part.counted.sum()
            descend(network, optimizer, loss)


def _tool(joints: torch.Tensor, links: torch.Tensor) -> torch.Tensor:
    """Where the tool is, m."""
    angles = torch.stack([joints[..., 0], joints.sum(-1)], -1)
    return torch.stack([(links[:, None] * f(angles)).sum(-1) for f in (torch.cos, torch.sin)], -1)
