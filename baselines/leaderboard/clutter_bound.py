"""A bound on OSPA in the clutter world, and how far agents are from it.

`scripts/clutter-bound` runs this module, and the leaderboard's column "x bound" divides by it.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.leaderboard.exact_filter import ENV_ID
from servotrack.baselines.reporting.embed import show
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.envs.streams import episode_seed
from servotrack.envs.track.clutter.config import LEVEL_NAMES, ClutterConfig, clutter_config
from servotrack.envs.track.clutter.episode import draw_episode, turn_angles
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.estimators.rfs.bounds import expected_distance, known_covariances
from servotrack.estimators.rfs.cramer_rao import cramer_rao_covariances
from servotrack.estimators.types import Array, Mask

LEVELS = tuple(range(len(LEVEL_NAMES)))
FIRST = 80_000
"""Offset of the seeds in the tune range."""


def ospa_bound(config: ClutterConfig, seed: int, lag: int = 0) -> float:
    """Smallest expected OSPA (order 1) of any agent in an episode, over its births, deaths and detections, m.

    The agent of the bound knows the motion and all turns, who exists, which measurement is whose, and at which site a
    target appeared; of a target that appears anywhere, that it is normal over the region. Then all posteriors are
    Gaussian but those of a range-bearing sensor. There the covariances are those of the Cramer-Rao recursion along the
    true paths (`cramer_rao_covariances`), which bound the mean square of the error, and are taken as Gaussian.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, as passed to the environment's `reset`.
        lag: Number of later scans that an answer may use.

    Raises:
        ValueError: The paths are not drawn by the scene model's motion.
    """
    if not has_bound(config):
        raise ValueError(
            f"the bound needs paths that the scene model's motion draws from a birth on; those of the scenario "
            f"{config.scenario!r} are not"
        )
    # The episode that `env.reset(seed=seed)` plays.
    drawn = episode_seed(seeding.np_random(seed)[0])
    episode, turns = draw_episode(config, drawn), turn_angles(config, drawn)
    birth = scene_model_of(config).birth_covariance.copy()
    if config.draws_lives and config.births == "anywhere":
        birth[[0, 2], [0, 2]] = config.half_width**2 / 3.0
    total, number = np.zeros(len(episode.exists)), episode.exists.sum(axis=1)
    for target in np.flatnonzero(episode.exists.any(axis=0)):
        life = np.flatnonzero(episode.exists[:, target])
        detected = (episode.source[life] == target).any(axis=1)
        path = episode.states[life, target]
        covariance = _covariances(config, path, turns[life, target], detected, birth, lag)
        total[life] += expected_distance(covariance[:, [0, 2]][:, :, [0, 2]], config.cutoff)
    return float((total / np.maximum(number, 1))[: config.horizon].mean())


def has_bound(config: ClutterConfig) -> bool:
    """Return True if the paths of targets are drawn by the scene model's motion, from a birth on."""
    return config.published.middle is None and config.published.wanders


def _covariances(config: ClutterConfig, path: Array, turns: Array, detected: Mask, birth: Array, lag: int) -> Array:
    """Covariances of the state of a target at each scan of its life. Shape (S, 4, 4)."""
    packed = config.motion.packed
    if config.sensor != "position":
        x, y = config.sensor_position
        dx, dy, zero = path[:, 0] - x, path[:, 2] - y, np.zeros(len(path))
        distance = np.hypot(dx, dy)
        slope = np.array(
            [[dx / distance, zero, dy / distance, zero], [-dy / distance**2, zero, dx / distance**2, zero]]
        )
        scaled = slope / np.array([config.range_noise, config.bearing_noise])[:, None, None]
        information = np.einsum("mrk,mck->krc", scaled, scaled) * detected[:, None, None]
        return cramer_rao_covariances(packed.transition[:4, :4], packed.noise[:4, :4], birth, information, lag)
    if not turns.any():
        return known_covariances(config.motion, birth, detected, lag)
    turned = np.tile(np.eye(6), (len(turns), 1, 1))
    turned[:, 1, 1] = turned[:, 3, 3] = np.cos(turns)
    turned[:, 3, 1] = np.sin(turns)
    turned[:, 1, 3] = -turned[:, 3, 1]
    return known_covariances(config.motion, birth, detected, lag, packed.transition @ turned)


def episode_bounds(env_kwargs: Mapping[str, Any], seeds: Sequence[int]) -> list[float] | None:
    """`ospa_bound` of episodes of `ClutterTracking-v0` with these arguments, m; None if they have none.

    Args:
        env_kwargs: Arguments of the environment.
        seeds: Seeds of the episodes.
    """
    axes = {name: value for name, value in env_kwargs.items() if name not in ("level", "render_mode")}
    config = clutter_config(env_kwargs.get("level", 0), **axes)
    return [ospa_bound(config, seed, config.lag) for seed in seeds] if has_bound(config) else None


def rows(level: int, agents: Sequence[str], seeds: Sequence[int]) -> tuple[Mapping[str, Any], Any]:
    """Mean OSPA of agents on a level, and the bound's on the same seeds, one value per seed."""
    bound = np.array([ospa_bound(clutter_config(level), seed) for seed in seeds])
    cells = {agent: evaluate(ENV_ID, agent, seeds, env_kwargs={"level": level}) for agent in agents}
    values = {agent: {row["seed"]: row["ospa"] for row in cell.rows} for agent, cell in cells.items()}
    return {agent: np.array([values[agent][seed] for seed in seeds]) for agent in agents}, bound


def table(agents: Sequence[str], seeds: Sequence[int]) -> Grid:
    """Bound of each level, and OSPA of the agents over it."""
    lines = []
    for level in LEVELS:
        found, bound = rows(level, agents, seeds)
        ratios = [f"{found[agent].mean():.2f} · {found[agent].mean() / bound.mean():.1f}" for agent in agents]
        lines.append([f"{level} {LEVEL_NAMES[level]}", f"{bound.mean():.2f}", *ratios])
    return Grid(["level", "bound, m", *agents], lines, words=1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and put it into the page `--write`."""
    parser = argparse.ArgumentParser(prog="scripts/clutter-bound", description=__doc__)
    parser.add_argument("--episodes", type=int, default=50, help="tune seeds of each level (default 50)")
    parser.add_argument("--agents", default="association-oracle,pmbm,pmb,robust-pmb,gm-phd", help="agents, by commas")
    parser.add_argument("--write", type=Path, help="page with the marks clutter-bound:begin and :end")
    given = parser.parse_args(arguments)
    if given.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {given.episodes}")
    with program("nothing is written; run the same command again"):
        seeds = take("tune", given.episodes, FIRST)
        source = f"`scripts/clutter-bound --episodes {given.episodes}`, servotrack {code_version()}"
        note = f"OSPA in m · times the bound; {given.episodes} tune seeds each. Written by {source}."
        text = f"{as_markdown(table(given.agents.split(','), seeds))}\n\n{note}"
        show(text, given.write, "clutter-bound")


if __name__ == "__main__":
    main()
