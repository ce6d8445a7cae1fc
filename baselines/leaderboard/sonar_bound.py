"""A bound on OSPA in the sonar world, by which the leaderboard's column "x bound" divides.

The agent of the bound knows who exists, what each target sounds like, and how its rate may change. It sees the spectra
at the elements and has to find the bearings alone. Their covariances are those of the posterior Cramer-Rao recursion
along the true paths, taken as Gaussian.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding

from servotrack.envs.streams import episode_seed
from servotrack.envs.track.sonar.config import SonarConfig, sonar_config
from servotrack.envs.track.sonar.scene import draw_scene
from servotrack.estimators.rfs.cramer_rao import cramer_rao_covariances
from servotrack.estimators.sonar.bearing_bound import bearing_information, expected_deviation
from servotrack.estimators.types import Array


def ospa_bound(config: SonarConfig, seed: int) -> float:
    """Smallest expected OSPA (order 1) of any agent in an episode, deg; 0 in an episode without targets.

    Args:
        config: Parameters of the environment.
        seed: Seed of the episode, as passed to the environment's `reset`.
    """
    # The episode that `env.reset(seed=seed)` plays.
    scene = draw_scene(config, episode_seed(seeding.np_random(seed)[0]))
    frequencies, T = config.band.frequencies, config.period
    F, push = np.array([[1.0, T], [0.0, 1.0]]), np.array([0.5 * T, 1.0])
    Q = config.rate_noise**2 * np.outer(push, push)
    total, number = np.zeros(len(scene.exists)), scene.exists.sum(axis=1)
    for target in np.flatnonzero(scene.exists.any(axis=0)):
        life = np.flatnonzero(scene.exists[:, target])
        information = np.zeros((len(life), 2, 2))
        information[:, 0, 0] = bearing_information(
            config.array,
            frequencies,
            scene.power[target] / config.ambient,
            scene.bearings[life, target],
            config.snapshots,
            bool(scene.tonal[target]),
        )
        covariance = cramer_rao_covariances(F, Q, _first_covariance(config), information, config.lag)
        total[life] += expected_deviation(covariance[:, 0, 0], config.cutoff)
    return float((total / np.maximum(number, 1))[: config.horizon].mean())


def episode_bounds(env_kwargs: Mapping[str, Any], seeds: Sequence[int]) -> list[float] | None:
    """`ospa_bound` of episodes of `SonarTracking-v0` with these arguments, deg; None without targets.

    Args:
        env_kwargs: Arguments of the environment.
        seeds: Seeds of the episodes.
    """
    axes = {name: value for name, value in env_kwargs.items() if name not in ("level", "render_mode")}
    found = [ospa_bound(sonar_config(env_kwargs.get("level", 0), **axes), seed) for seed in seeds]
    return found if any(found) else None


def _first_covariance(config: SonarConfig) -> Array:
    """Covariance of first bearing (deg) and rate (deg/s): of the scenario's jitter, or of all bearings and rates."""
    if config.variant in ("rates", "cross30"):
        spread = max(config.bearing_jitter, 1e-6), max(config.rate_jitter, 1e-6)
    else:
        spread = 90.0, max(config.max_rate, 1e-6)
    # Of a uniform distribution from -spread to spread.
    return np.diag(np.square(spread) / 3.0)
