"""Histories of the servo world under given actions."""

from __future__ import annotations

from typing import Any

import numpy as np

from servotrack.envs.servo.levels import ServoConfig
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import Array

QUANTITIES = (
    "time", "joints", "joint_angles", "features", "visible", "frame_time", "tracking_error", "feature_error", "reward",
    "terminated", "truncated", "tool", "target",
)  # fmt: skip


def run(config: ServoConfig, actions: Array, seeds: Any = None) -> dict[str, Array]:
    """Histories (steps + 1, N, ...) of a world under given actions (steps, N, 2)."""
    count = actions.shape[1]
    world = ServoWorld(config, count)
    world.reset(range(count), range(count) if seeds is None else seeds)
    history: dict[str, list[Array]] = {name: [getattr(world, name).copy()] for name in QUANTITIES}
    for action in actions:
        world.step(action)
        for name in QUANTITIES:
            history[name].append(getattr(world, name).copy())
    return {name: np.array(values) for name, values in history.items()}


def wiggle(steps: int, count: int, size: float = 0.15, seed: int = 0) -> Array:
    """Actions that keep the arm where it is, more or less."""
    return np.random.default_rng(seed).uniform(-size, size, (steps, count, 2))
