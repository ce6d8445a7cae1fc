"""Wrappers of observations and actions as torch modules, so that an exported network reads what agents read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from servotrack.envs import FlatSets, GoalObservation

WRAPPERS: Mapping[str, Any] = {
    "FlatSets": FlatSets,
    "GoalObservation": GoalObservation,
    "FlattenObservation": gym.wrappers.FlattenObservation,
}
"""Wrappers of the training that an export can include, by name."""


def wrapped(env: Any, wrappers: Sequence[str]) -> Any:
    """Return an environment in wrappers, the innermost first.

    Raises:
        ValueError: An unknown wrapper, one given twice, or one that must come before another.
    """
    order = list(WRAPPERS)
    for name in wrappers:
        if name not in order:
            raise ValueError(f"--wrapper must be one of {', '.join(order)}, got {name!r}")
    places = [order.index(name) for name in wrappers]
    if places != sorted(set(places)) or {"FlatSets", "GoalObservation"} <= set(wrappers):
        raise ValueError(
            "--wrapper takes FlatSets or GoalObservation, then FlattenObservation, each once, "
            f"got {', '.join(wrappers)}"
        )
    for name in wrappers:
        env = WRAPPERS[name](env)
    return env


def encoding_kind(wrappers: Sequence[str]) -> str:
    """Return the encoding whose rows hold what the wrappers give: scaled by the bounds, or in physical units."""
    return "flat" if {"FlatSets", "GoalObservation"} & set(wrappers) else "raw"


class ObservationView(nn.Module):
    """Map rows of an encoding to observations of a wrapped environment.

    Args:
        env: The environment without wrappers.
        wrappers: Names of the wrappers, the innermost first.
    """

    def __init__(self, env: gym.Env[Any, Any], wrappers: Sequence[str]) -> None:
        super().__init__()
        space: Any = env.observation_space
        self._boxes: dict[str | None, Any] = (
            {key: space[key] for key in sorted(space.spaces)} if isinstance(space, spaces.Dict) else {None: space}
        )
        self._wrappers = tuple(wrappers)
        self.size = sum(int(np.prod(box.shape)) for box in self._boxes.values())
        if "FlatSets" in wrappers:
            view: Any = FlatSets(env).observation_space
            self._enlarged = {
                key: (view if key is None else view[key]).shape[0] // box.shape[0]
                for key, box in self._boxes.items()
                if _is_image(box)
            }
        if "GoalObservation" in wrappers:
            self._goals = {key: self._goal_scale(key) for key in ("features", "goal")}

    def forward(self, rows: torch.Tensor) -> Any:
        """Map rows (N, size) to a batch of observations: a tensor, or a dictionary of tensors."""
        parts, start = {}, 0
        for key, box in self._boxes.items():
            end = start + int(np.prod(box.shape))
            parts[key] = rows[:, start:end]
            start = end
        if "GoalObservation" in self._wrappers:
            seen: Any = self._goal_form(parts)
        elif "FlatSets" in self._wrappers:
            seen = {key: self._image(key, part) if key in self._enlarged else part for key, part in parts.items()}
        else:
            seen = {key: part.reshape(-1, *self._boxes[key].shape) for key, part in parts.items()}
        if None in seen:
            seen = seen[None]
        if "FlattenObservation" in self._wrappers:
            parts = {None: seen} if isinstance(seen, torch.Tensor) else seen
            seen = torch.cat([part.reshape(-1, int(np.prod(part.shape[1:]))) for part in parts.values()], dim=1)
        return seen

    def _image(self, key: str | None, part: torch.Tensor) -> torch.Tensor:
        """Return an image with its pixels of 0 to 255, enlarged, from entries in [-1, 1]."""
        height, width, channels = self._boxes[key].shape
        factor = self._enlarged[key]
        pixels = (127.5 * part + 128.0).to(torch.int32).to(torch.float32).reshape(-1, height, 1, width, 1, channels)
        if factor > 1:
            pixels = torch.cat([torch.cat([pixels] * factor, dim=2)] * factor, dim=4)
        return pixels.reshape(-1, height * factor, width * factor, channels)

    def _goal_scale(self, key: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Return factor and offset from an entry scaled to [-1, 1] to half widths of the image from its center."""
        box, features = self._boxes[key], self._boxes["features"]
        half_width = 0.5 * float(features.high[0])
        span, middle = 0.5 * (box.high - box.low), 0.5 * (box.high + box.low)
        return tuple(
            torch.as_tensor(value / half_width, dtype=torch.float32) for value in (span, middle - 0.5 * features.high)
        )  # type: ignore[return-value]

    def _goal_form(self, parts: Mapping[str | None, torch.Tensor]) -> dict[str, torch.Tensor]:
        achieved, desired = (factor * parts[key] + offset for key, (factor, offset) in self._goals.items())
        rest = torch.cat([part for key, part in parts.items() if key not in self._goals], dim=1)
        return {"achieved_goal": achieved, "desired_goal": desired, "observation": rest}


class ActionView(nn.Module):
    """Map actions for a wrapped environment to the flat actions of the environment itself.

    Args:
        env: The environment without wrappers.
        wrappers: Names of the wrappers.
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, env: gym.Env[Any, Any], wrappers: Sequence[str]) -> None:
        super().__init__()
        space: Any = env.action_space
        self.register_buffer("low", torch.as_tensor(space.low.ravel(), dtype=torch.float32))
        self.register_buffer("high", torch.as_tensor(space.high.ravel(), dtype=torch.float32))
        self._rescaled = "FlatSets" in wrappers
        self.size = int(np.prod(space.shape))

    def forward(self, actions: torch.Tensor) -> torch.Tensor:
        """Map actions (N, *shape) to rows (N, size)."""
        actions = actions.reshape(-1, self.size)
        if not self._rescaled:
            return actions
        return self.low + 0.5 * (torch.clamp(actions, -1.0, 1.0) + 1.0) * (self.high - self.low)


def _is_image(box: Any) -> bool:
    return box.dtype == np.uint8 and len(box.shape) == 3
