"""Episodes of a planar arm as the page draws them: joint angles, and the scene of the seed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from servotrack.baselines.leaderboard.site.packing import ANGLE_STEP, PLACE_STEP, RATE_STEP, Packer
from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Motion:
    """One episode of a servo agent.

    Attributes:
        joints: True joint angles at the reset and after every step, shape (length + 1, 2), rad.
        seen: Last sample at which a frame with the target arrived, per sample, shape (length + 1,).
    """

    joints: Array
    seen: Array

    def packed(self, packer: Packer) -> dict[str, Any]:
        """Return the motion for the page: `joints` and `unseen`, the runs of samples without a new frame."""
        return {"joints": _pair(packer, self.joints, ANGLE_STEP), "unseen": _runs(self.seen == 0.0)}


@dataclass(frozen=True)
class Scene:
    """Conditions of the episode of a seed, the same for all agents.

    Attributes:
        links: Link lengths, shape (2,), m.
        camera: Packed camera, see `pack_camera`.
        goal: Goal features, shape (2,), px.
        gain: Factors on the joint rates, shape (2,).
        path: Positions of the target from the reset on, shape (steps + 1, 2), m.
        warmup: Number of unscored steps at the start.
        size: Width and height of the camera's image, px.
    """

    links: Array
    camera: Array
    goal: Array
    gain: Array
    path: Array
    warmup: int
    size: int

    def packed(self, packer: Packer) -> dict[str, Any]:
        """Return the scene for the page."""
        return {
            "form": "arm",
            "links": _short(self.links),
            "camera": _short(self.camera),
            "goal": _short(self.goal),
            "gain": _short(self.gain),
            "path": _pair(packer, self.path, PLACE_STEP),
            "warmup": self.warmup,
            "size": self.size,
        }


class ArmWatcher:
    """Records the arms of a servo environment; see `servotrack.baselines.leaderboard.site.replays.Watcher`.

    Args:
        env: The vector environment, after its reset.
        steps: Largest number of steps.
    """

    def __init__(self, env: Any, steps: int) -> None:
        self._world: ServoWorld = env.unwrapped.world
        count = len(self._world.joints)
        self._scenes = [_scene(self._world, row) for row in range(count)]
        self._joints, self._seen = np.empty((count, steps + 1, 2)), np.zeros((count, steps + 1))

    def record(self, step: int, observation: Any) -> None:
        """Store the sample after `step` steps."""
        self._joints[:, step], self._seen[:, step] = self._world.joints, self._world.visible

    def scenes(self) -> list[Scene]:
        """Return the scene of each row."""
        return self._scenes

    def motion(self, row: int, length: int) -> Motion:
        """Return the motion of a row whose episode took `length` steps."""
        return Motion(self._joints[row, : length + 1], self._seen[row, : length + 1])


def _scene(world: ServoWorld, row: int) -> Scene:
    config = world.config
    path = world.paths[row, LEAD : LEAD + world.episode_steps + 1, :2].copy()
    links, camera, goal, gain = (part[row].copy() for part in (world.links, world.cameras, world.goal, world.gain))
    return Scene(links, camera, goal, gain, path, config.warmup, config.camera_size)


def rate_noise(env: Any, seed: int) -> Array:
    """Noise on the joint rates in the steps of a seed's episode, shape (steps or 0, 2), rad/s.

    Args:
        env: Environment of the arm.
        seed: Seed of the episode.
    """
    noise = draw_episode(env.unwrapped.config, seed).rate_noise
    return noise[LEAD : LEAD + env.unwrapped.world.episode_steps]


def pack_race(
    scenes: Mapping[int, Scene], motions: Mapping[str, Mapping[int, Motion]], noise: Mapping[int, Array]
) -> dict[str, Any]:
    """Pack the episodes of a race: scenes with what moves the visitor's arm, and the opponents' replays."""
    packer = Packer()
    packed = {}
    for seed, scene in scenes.items():
        packed[str(seed)] = scene.packed(packer)
        if len(noise[seed]):
            packed[str(seed)]["noise"] = _pair(packer, noise[seed], RATE_STEP)
    replays = [
        {"agent": agent, "seed": seed, "labels": [], **of_agent[seed].packed(packer)}
        for agent, of_agent in motions.items()
        for seed in scenes
    ]
    return {"scenes": packed, "replays": replays, "curves": packer.curves, "samples": packer.text()}


def _pair(packer: Packer, values: Array, step: float) -> list[int]:
    return [packer.add(values[:, 0], step), packer.add(values[:, 1], step)]


def _runs(mask: Array) -> list[int]:
    """Starts and ends of the runs of True, alternating."""
    return np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))).tolist()


def _short(values: Iterable[float]) -> list[float]:
    return [float(f"{value:.8g}") for value in values]
