"""Supervised training of a set predictor on simulated scenes of the train range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from torch import nn

from servotrack.baselines.agents.learned.set_prediction import (
    ANCHOR,
    ANSWERS,
    LENGTH,
    NEIGHBOR,
    ScanHistory,
    SetWindow,
    query_measurements,
    sensor_of,
)
from servotrack.baselines.training.export import exportable_policy
from servotrack.baselines.training.run import TrainingRun
from servotrack.baselines.training.supervised import descend, episode_seeds, prepare, take_turns
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scene_model import SceneModel
from servotrack.estimators.types import Array, FloatArray


@dataclass(frozen=True)
class SetSettings:
    """Hyper-parameters of a set predictor.

    Attributes:
        hidden: Width of the layers.
        learning_rate: Learning rate of Adam; `lin_X` falls linearly from X to 0.
        n_epochs: Passes over the measurements of one iteration.
        batch_size: Number of measurements in a batch.
        false_share: Share of the clutter, and of the measurements of vanished targets, that is trained on.
    """

    hidden: int = 48
    learning_rate: float | str = "lin_2e-3"
    n_epochs: int = 1
    batch_size: int = 1024
    false_share: float = 0.1


class SetNetwork(nn.Module):
    """Classifies a measurement by its neighbors and regresses its target's position and velocity.

    The neighbors are a set: one layer of self-attention, then pooling.

    Args:
        neighbors: Number of neighbors of a measurement.
        hidden: Width of the layers.
    """

    def __init__(self, neighbors: int, hidden: int) -> None:
        super().__init__()
        self.neighbors, self.hidden = neighbors, hidden
        self.entry = nn.Sequential(nn.Linear(NEIGHBOR + ANCHOR, hidden), nn.ReLU(), nn.Linear(hidden, hidden))
        self.look = nn.Linear(hidden, 3 * hidden)
        self.settle = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, hidden))
        self.head = nn.Sequential(
            nn.Linear(2 * hidden + ANCHOR, 2 * hidden), nn.ReLU(), nn.Linear(2 * hidden, hidden), nn.ReLU(),
            nn.Linear(hidden, ANSWERS),
        )  # fmt: skip

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Return answers (A, 5) to rows (A, size)."""
        around = observation[:, : self.neighbors * NEIGHBOR].reshape(-1, self.neighbors, NEIGHBOR)
        own = observation[:, self.neighbors * NEIGHBOR :]
        there = around[..., NEIGHBOR - 1 :]
        each = self.entry(torch.cat([around, own[:, None].expand(-1, self.neighbors, -1)], -1))
        query, key, value = self.look(torch.relu(each)).split(self.hidden, -1)
        weight = query @ key.transpose(1, 2) / self.hidden**0.5 + 1e4 * (there.transpose(1, 2) - 1.0)
        each = each + torch.softmax(weight, -1) @ value
        each = torch.relu(each + self.settle(torch.relu(each))) * there
        mean = each.sum(1) / there.sum(1).clamp(min=1.0)
        return self.head(torch.cat([each.amax(1), mean, own], -1))


class Examples(NamedTuple):
    """Measurements with labels, A of them.

    Attributes:
        rows: Inputs of the network. Shape (A, size).
        true: 1 if the measurement's target still exists, else 0. Shape (A,).
        weight: Number of measurements that each stands for, 1 / `false_share` where only a share is kept. Shape (A,).
        offsets: Present position of the target minus the measurement, shape (A, 2), m.
        velocities: Velocity of the target, shape (A, 2), m/s.
        age: Age of the measurement, scans. Shape (A,).
    """

    rows: torch.Tensor
    true: torch.Tensor
    weight: torch.Tensor
    offsets: torch.Tensor
    velocities: torch.Tensor
    age: torch.Tensor


def train_set_predictor(run: TrainingRun) -> None:
    """Train a set predictor from the newest checkpoint to the next; one step is one scan.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: An environment without points in clutter, or an unknown hyper-parameter.
    """
    own = prepare(SetSettings, run)
    task, settings = run.task, run.task.settings
    env: Any = gym.make(task.env_id, **task.env_kwargs).unwrapped
    if not isinstance(getattr(env, "scene_model", None), SceneModel):
        raise ValueError(f"set prediction needs an environment whose `scene_model` is a SceneModel, got {task.env_id}")
    window = SetWindow.of(settings.encoding)
    network = SetNetwork(window.neighbors, own.hidden)
    optimizer = torch.optim.Adam(network.parameters())
    chance = np.random.default_rng([task.seed, run.resume(network, optimizer)])

    def turn(steps: int) -> int:
        scenes = [draw_episode(env.config, seed) for seed in episode_seeds(task, steps)]
        _learn(network, optimizer, _examples(window, scenes, env.scene_model, own.false_share, chance), own)
        return len(scenes) * int(env.config.horizon)

    take_turns(run, network, optimizer, own.learning_rate, exportable_policy(network, window.size), turn)


def _examples(
    window: SetWindow, scenes: list[Any], scene_model: SceneModel, false_share: float, chance: np.random.Generator
) -> Examples:
    """Return all measurements of targets, and a share of the others, of every scan of some scenes."""
    sensor, bearing_noise = sensor_of(scene_model)
    measured = np.stack([scene.measurements for scene in scenes])
    source = np.stack([scene.source for scene in scenes])
    states, exists = np.stack([scene.states for scene in scenes]), np.stack([scene.exists for scene in scenes])
    recent = ScanHistory.none(window, len(scenes), measured.shape[2])
    parts: list[tuple[FloatArray | Array, ...]] = []
    for k in range(measured.shape[1] - 1):
        recent = recent.with_scan(measured[:, k], sensor)
        queries = query_measurements(window, recent, sensor, bearing_noise)
        whose = source[queries.scene, k - queries.age, queries.row]
        known = whose >= 0
        there = known & exists[queries.scene, k, whose * known]
        kept = there | (chance.random(len(there)) < false_share)
        now = states[queries.scene, k, whose * known] * there[:, None]
        offsets = (now[:, [0, 2]] - queries.places) * there[:, None]
        weight = np.where(there, 1.0, 1.0 / false_share)
        found = (queries.rows, there, weight, offsets, now[:, [1, 3]], queries.age)
        parts.append(tuple(column[kept] for column in found))
    columns = (np.concatenate(column).astype(np.float32) for column in zip(*parts, strict=True))
    return Examples(*(torch.from_numpy(column) for column in columns))


def _learn(network: SetNetwork, optimizer: torch.optim.Optimizer, examples: Examples, own: SetSettings) -> None:
    """Train for `n_epochs` passes over the measurements."""
    for _ in range(own.n_epochs):
        for batch in torch.randperm(len(examples.rows)).split(own.batch_size):
            part = Examples(*(tensor[batch] for tensor in examples))
            answer = network(part.rows)
            existence = nn.functional.binary_cross_entropy_with_logits(answer[:, 0], part.true, part.weight)
            velocity, correction = LENGTH * answer[:, 1:3], LENGTH * answer[:, 3:5]
            wrong = part.age[:, None] * velocity + correction - part.offsets
            located = nn.functional.smooth_l1_loss(wrong / LENGTH, torch.zeros_like(wrong), reduction="none").sum(-1)
            moving = nn.functional.smooth_l1_loss(velocity / LENGTH, part.velocities / LENGTH, reduction="none").sum(-1)
            loss = existence + ((located + 0.3 * moving) * part.true).sum() / part.true.sum().clamp(min=1.0)
            descend(network, optimizer, loss)
