"""Episodes as the page draws them: motions of arms and targets from action traces, packed per task."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.episodes import EpisodeRecorder
from servotrack.baselines.evaluation.evaluate import make_vector
from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.leaderboard.site.packing import ANGLE_STEP, PLACE_STEP, RATE_STEP, Packer
from servotrack.envs.servo.episode import draw_episode
from servotrack.envs.servo.targets import LEAD
from servotrack.envs.servo.world import ServoWorld
from servotrack.estimators.types import Array

SAME_ROW = 1e-6
"""Largest difference between the numbers of a replay and those of its row, as between mathematics libraries."""


@dataclass(frozen=True)
class Motion:
    """One episode of a servo agent.

    Attributes:
        joints: True joint angles at the reset and after every step, shape (length + 1, 2), rad.
        seen: Last sample at which a frame with the target arrived, per sample, shape (length + 1,).
    """

    joints: Array
    seen: Array


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


def can_replay(cell: CellResults) -> bool:
    """Return True if the page can draw the world of these results: one planar arm over a target."""
    return cell.kind == "servo"


@dataclass(frozen=True)
class Replay:
    """Episodes of an agent in one environment, stepped again from their actions.

    Attributes:
        motions: Motions by seed. Episodes that differ from their rows are left out.
        scenes: Scenes by seed.
        faithful: True if every row of the results was recomputed, each number to within `SAME_ROW`.
    """

    motions: dict[int, Motion]
    scenes: dict[int, Scene]
    faithful: bool


def replay(cell: CellResults, actions: Mapping[int, Array]) -> Replay:
    """Step the cell's environment with recorded actions; nothing of the agent is run.

    Args:
        cell: Results; names the environment. Its rows are compared with the replayed ones.
        actions: Actions by seed, each (length, 2).
    """
    seeds = [seed for seed in actions if len(actions[seed])]
    if not seeds:
        return Replay({}, {}, False)
    lengths = np.array([len(actions[seed]) for seed in seeds])
    commands = np.zeros((len(seeds), lengths.max(), 2))
    for row, seed in enumerate(seeds):
        commands[row, : lengths[row]] = actions[seed]
    env = make_vector(cell.env_id, len(seeds), cell.env_kwargs, privileged=False)
    try:
        observation, _ = env.reset(seed=seeds)
        world: ServoWorld = env.unwrapped.world
        recorder = EpisodeRecorder(seeds, env, observation)
        scenes = [_scene(world, row) for row in range(len(seeds))]
        joints = np.empty((len(seeds), lengths.max() + 1, 2))
        seen = np.zeros((len(seeds), lengths.max() + 1))
        joints[:, 0], seen[:, 0] = world.joints, world.visible
        for step in range(lengths.max()):
            observation, reward, terminated, truncated, info = env.step(commands[:, step])
            recorder.record(observation, reward, terminated | truncated, info)
            joints[:, step + 1], seen[:, step + 1] = world.joints, world.visible
        rows = recorder.rows()
    finally:
        env.close()
    given = {row["seed"]: row for row in cell.rows}
    same = {
        seed: Motion(joints[k, : row["length"] + 1], seen[k, : row["length"] + 1])
        for k, (seed, row) in enumerate(zip(seeds, rows, strict=True))
        if seed in given and row["length"] == lengths[k] and _is_same(row, given[seed])
    }
    kept = {seed: scene for seed, scene in zip(seeds, scenes, strict=True) if seed in same}
    return Replay(same, kept, set(same) == set(given))


def _is_same(row: Mapping[str, Any], given: Mapping[str, Any]) -> bool:
    return row.keys() == given.keys() and all(abs(row[name] - given[name]) <= SAME_ROW for name in row)


def _scene(world: ServoWorld, row: int) -> Scene:
    config = world.config
    path = world.paths[row, LEAD : LEAD + world.episode_steps + 1, :2].copy()
    links, camera, goal, gain = (part[row].copy() for part in (world.links, world.cameras, world.goal, world.gain))
    return Scene(links, camera, goal, gain, path, config.warmup, config.camera_size)


def chosen_seeds(values: Mapping[int, float], high_is_good: bool, shared: Sequence[int]) -> dict[int, list[str]]:
    """Return the seeds of an agent's replays with their labels: `best`, `median`, `worst`, or none for a shared seed.

    Args:
        values: Score or headline measure by seed, at least one.
        high_is_good: True if larger is better.
        shared: Seeds that all agents show.
    """
    order = sorted(values, key=lambda seed: (-values[seed] if high_is_good else values[seed], seed))
    labels: dict[int, list[str]] = {}
    for name, place in (("best", 0), ("median", (len(order) - 1) // 2), ("worst", len(order) - 1)):
        labels.setdefault(order[place], []).append(name)
    for seed in shared:
        if seed in values:
            labels.setdefault(seed, [])
    return labels


def pack(
    motions: Mapping[str, Mapping[int, Motion]],
    labels: Mapping[str, Mapping[int, list[str]]],
    scenes: Mapping[int, Scene],
    values: Mapping[str, Mapping[int, float]],
) -> dict[str, Any]:
    """Pack the replays of one task.

    Args:
        motions: Motions by agent and seed.
        labels: Labels of those to keep, by agent and seed, see `chosen_seeds`.
        scenes: Scenes by seed.
        values: Headline measure by agent and seed.

    Returns:
        A document for the page: `scenes`, `replays`, `curves` and their `samples`.
    """
    packer = Packer()
    kept = [
        (agent, seed, names)
        for agent, of_agent in labels.items()
        for seed, names in of_agent.items()
        if seed in motions.get(agent, {})
    ]
    needed = sorted({seed for _, seed, _ in kept})
    packed_scenes = {str(seed): _packed_scene(packer, scenes[seed]) for seed in needed}
    replays = [
        {
            "agent": agent,
            "seed": seed,
            "labels": names,
            "value": _short([values[agent][seed]])[0],
            "joints": _pair(packer, motions[agent][seed].joints, ANGLE_STEP),
            "unseen": _runs(motions[agent][seed].seen == 0.0),
        }
        for agent, seed, names in kept
    ]
    return {"scenes": packed_scenes, "replays": replays, "curves": packer.curves, "samples": packer.text()}


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
        packed[str(seed)] = _packed_scene(packer, scene)
        if len(noise[seed]):
            packed[str(seed)]["noise"] = _pair(packer, noise[seed], RATE_STEP)
    replays = [
        {
            "agent": agent,
            "seed": seed,
            "labels": [],
            "joints": _pair(packer, of_agent[seed].joints, ANGLE_STEP),
            "unseen": [],
        }
        for agent, of_agent in motions.items()
        for seed in scenes
    ]
    return {"scenes": packed, "replays": replays, "curves": packer.curves, "samples": packer.text()}


def _packed_scene(packer: Packer, scene: Scene) -> dict[str, Any]:
    return {
        "links": _short(scene.links),
        "camera": _short(scene.camera),
        "goal": _short(scene.goal),
        "gain": _short(scene.gain),
        "path": _pair(packer, scene.path, PLACE_STEP),
        "warmup": scene.warmup,
        "size": scene.size,
    }


def _pair(packer: Packer, values: Array, step: float) -> list[int]:
    return [packer.add(values[:, 0], step), packer.add(values[:, 1], step)]


def _runs(mask: Array) -> list[int]:
    """Starts and ends of the runs of True, alternating."""
    return np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))).tolist()


def _short(values: Iterable[float]) -> list[float]:
    return [float(f"{value:.8g}") for value in values]
