"""Supervised training of a marker detector: convolutions, and a soft-argmax over the score map."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import nn

from servotrack.baselines.agents.learned.marker_network import IMAGE, PLACE, SEEN
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.training.export import Exportable
from servotrack.baselines.training.run import TrainingRun, TrainingTask
from servotrack.baselines.training.supervised import descend, prepare, take_turns

STRIDE = 2
"""Image pixels per cell of the score map."""
DISTANCE_FLOOR = 0.1
"""Distance below which the loss is flat, px."""
EPISODE_STEPS = 10
"""Steps after which all arms are reset, with other cameras."""
REPLAY_STEPS = 30
"""Steps whose images a batch is drawn from. Raise it to make the images of a batch less correlated."""


@dataclass(frozen=True)
class MarkerSettings:
    """Hyper-parameters of a marker network.

    Attributes:
        channels: Channels of each convolution.
        batch_size: Number of images in a batch; every step of the environments is followed by one batch.
        learning_rate: Learning rate of Adam; `lin_X` falls linearly from X to 0.
    """

    channels: int = 12
    batch_size: int = 128
    learning_rate: float | str = "lin_2e-3"


class MarkerConvNet(nn.Module):
    """Three convolutions and a score map; the center of mass of its softmax is the marker's position.

    Args:
        channels: Channels of each convolution.
        image_size: Width and height of the images, px.
    """

    columns: torch.Tensor
    rows: torch.Tensor

    def __init__(self, channels: int, image_size: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(3, channels, 5, STRIDE, 2),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, 1, 1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, 1, 1),
            nn.ReLU(),
        )
        self.map = nn.Conv2d(channels, 1, 3, 1, 1)
        self.presence = nn.Linear(channels + 1, 1)
        cells = -(-image_size // STRIDE)
        centers = STRIDE * (torch.arange(cells, dtype=torch.float32) + 0.5)
        self.register_buffer("columns", centers.repeat(cells))
        self.register_buffer("rows", centers.repeat_interleave(cells))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions (N, 2), px, and logits of being in view (N,) for images (N, S, S, 3), uint8."""
        fired = self.body(image.permute(0, 3, 1, 2).float() / 255.0 - 0.5)
        scores = self.map(fired).flatten(1)
        weights = torch.softmax(scores, 1)
        place = torch.stack([(weights * self.columns).sum(1), (weights * self.rows).sum(1)], 1)
        strongest = torch.cat([fired.flatten(2).amax(2), scores.amax(1, keepdim=True)], 1)
        return place, self.presence(strongest)[:, 0]


def train_marker_network(run: TrainingRun) -> None:
    """Train a marker network from the newest checkpoint to the next.

    Arms move at random over episodes of the train range; the labels are the true positions of the marker.

    Raises:
        ResultsError: The checkpoint does not fit the hyper-parameters.
        ValueError: Another environment than UncalibServoPixels-v0, or an unknown hyper-parameter.
    """
    own = prepare(MarkerSettings, run)
    task, settings = run.task, run.task.settings
    if task.env_id != "UncalibServoPixels-v0":
        raise ValueError(f"marker training supports only UncalibServoPixels-v0, got {task.env_id}")
    # Features without noise are the marker's position in the newest image, shutter effects included.
    exact = {**task.env_kwargs, "pixel_noise": 0.0, "outlier_rate": 0.0, "dropout": 0.0}
    env: Any = gym.make_vec(task.env_id, num_envs=settings.n_envs, autoreset_mode=AutoresetMode.SAME_STEP, **exact)
    size = env.single_observation_space["image"].shape[0]
    network = MarkerConvNet(own.channels, size)
    optimizer = torch.optim.Adam(network.parameters())
    source = _Images(env, task, run.resume(network, optimizer))

    def turn(steps: int) -> int:
        images, places, seen = (torch.from_numpy(part) for part in source.batch(own.batch_size))
        place, logit = network(images)
        distance = torch.sqrt(((place - places) ** 2).sum(1) + DISTANCE_FLOOR**2)
        loss = (distance * seen).sum() / seen.sum().clamp(min=1.0)
        loss = loss + nn.functional.binary_cross_entropy_with_logits(logit, seen)
        descend(network, optimizer, loss, steepest=5.0)
        return settings.n_envs

    try:
        exported = Exportable(network, {IMAGE: torch.zeros(2, size, size, 3, dtype=torch.uint8)}, (PLACE, SEEN))
        take_turns(run, network, optimizer, own.learning_rate, exported, turn)
    finally:
        env.close()


class _Images:
    """Images of arms that move at random, with the marker's position in each."""

    def __init__(self, env: Any, task: TrainingTask, steps: int) -> None:
        self._env, self._first = env, 7919 * task.seed + steps
        self._random = np.random.default_rng([task.seed, steps])
        self._left = 0
        self._action = np.zeros((env.num_envs, 2))
        self._kept: deque[tuple[NDArray[Any], ...]] = deque(maxlen=REPLAY_STEPS)
        while len(self._kept) < REPLAY_STEPS:
            self._kept.append(self._step())

    def batch(self, size: int) -> tuple[NDArray[Any], ...]:
        """Return images (size, S, S, 3), positions (size, 2), px, and visibilities (size,), 1 in view, 0 outside."""
        self._kept.append(self._step())
        steps = self._random.integers(REPLAY_STEPS, size=size)
        rows = self._random.integers(self._env.num_envs, size=size)
        return tuple(
            np.stack([self._kept[step][part][row] for step, row in zip(steps, rows, strict=True)]) for part in range(3)
        )

    def _step(self) -> tuple[NDArray[Any], ...]:
        env, count = self._env, self._env.num_envs
        if self._left == 0:
            seeds = [seed_ranges.TRAIN[(self._first + i) % len(seed_ranges.TRAIN)] for i in range(count)]
            observation, _ = env.reset(seed=seeds)
            self._first, self._left = self._first + count, EPISODE_STEPS
        else:
            drift = 0.9 * self._action + 0.3 * self._random.normal(size=(count, 2))
            self._action = np.clip(drift, -1.0, 1.0)
            observation, *_ = env.step(self._action.astype(np.float32))
            self._left -= 1
        world = env.unwrapped.world
        images = observation["image"]
        places = world.features * (images.shape[1] / world.config.camera_size)
        return images, places.astype(np.float32), world.visible.astype(np.float32)
