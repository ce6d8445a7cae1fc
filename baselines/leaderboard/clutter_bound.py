"""A bound on OSPA in the clutter world, and how far agents are from it.

`scripts/clutter-bound` runs this module. Levels 3 and 4 have none: a target that turns at a random rate, and a sensor
of range and bearing, leave no Gaussian posterior.
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
from servotrack.baselines.reporting.embed import embed
from servotrack.baselines.reporting.grid import Grid, as_markdown
from servotrack.baselines.running.stopping import program
from servotrack.envs.streams import episode_seed
from servotrack.envs.track.clutter.config import LEVEL_NAMES, ClutterConfig, clutter_config
from servotrack.envs.track.clutter.episode import draw_episode
from servotrack.envs.track.clutter.scene_model import scene_model_of
from servotrack.estimators.rfs.bounds import expected_distance, known_covariances

LEVELS = (0, 1, 2, 5, 6, 7)
FIRST = 80_000
"""Offset of the seeds in the tune range."""


def ospa_bound(config: ClutterConfig, seed: int, lag: int = 0) -> float:
    """Smallest expected OSPA (order 1) of any agent in an episode, over its births, deaths and detections, m.

    The agent of the bound knows the motion, who exists, which measurement is whose, and at which site a target
    appeared; of a target that appears anywhere, that it is normal over the region.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, as passed to the environment's `reset`.
        lag: Number of later scans that an answer may use.

    Raises:
        ValueError: The targets' posteriors are not Gaussian or not those of the scene model: maneuvers, a range-bearing
            sensor, or paths that are drawn in another way.
    """
    if config.sensor != "position" or (config.maneuver_rate > 0.0 and config.max_turn_rate > 0.0):
        raise ValueError("the bound needs linear Gaussian targets: sensor='position' and no maneuvers")
    if config.published.middle is not None or not config.published.wanders:
        raise ValueError(
            f"the bound needs paths that the scene model's motion draws from a birth on; those of the scenario "
            f"{config.scenario!r} are not"
        )
    # The episode that `env.reset(seed=seed)` plays.
    episode = draw_episode(config, episode_seed(seeding.np_random(seed)[0]))
    birth = scene_model_of(config).birth_covariance.copy()
    if config.draws_lives and config.births == "anywhere":
        birth[[0, 2], [0, 2]] = config.half_width**2 / 3.0
    total, number = np.zeros(config.horizon + 1), episode.exists.sum(axis=1)
    for target in np.flatnonzero(episode.exists.any(axis=0)):
        life = np.flatnonzero(episode.exists[:, target])
        detected = (episode.source[life] == target).any(axis=1)
        covariance = known_covariances(config.motion, birth, detected, lag)
        total[life] += expected_distance(covariance[:, [0, 2]][:, :, [0, 2]], config.cutoff)
    return float((total / np.maximum(number, 1))[: config.horizon].mean())


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
        print(text)
        if given.write:
            embed(text, given.write, "clutter-bound")


if __name__ == "__main__":
    main()
