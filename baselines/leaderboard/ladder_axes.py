"""Errors of a few agents under the single axes that no level of the servo worlds has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.provenance import code_version
from servotrack.baselines.evaluation.seeds import take
from servotrack.baselines.evaluation.statistics import bootstrap_mean
from servotrack.baselines.leaderboard.servo_bound import episode_bounds
from servotrack.baselines.reporting.grid import Grid, as_markdown

ENV_ID, LEVEL = "UncalibServo-v0", 5
AGENTS_SHOWN = ("informed", "latency-bank-lifted-kf", "latency-bank-agile-kf", "kf", "ppo")
AXES_SHOWN: Mapping[str, dict[str, Any]] = {
    "none": {},
    "encoder age": {"encoder_age": (0, 2)},
    "actuator lag": {"actuator_lag": 0.08},
    "backlash": {"backlash": 0.02},
    "occlusion": {"occlusion": 0.5, "occlusion_length": (0.3, 1.0)},
    "knock": {"knock": 0.6},
    "zoom": {"zoom": 0.3},
}
"""Arguments of each row. Each is large enough to be seen, and small enough that the task can be solved."""


def axes_text(episodes: int, split: str) -> str:
    """Evaluate the agents under each axis and return the table as Markdown.

    Args:
        episodes: Number of episodes of each cell. Raising it narrows the intervals and takes time in proportion.
        split: Seed range, `tune` or `test`.
    """
    seeds = take(split, episodes)
    rows = []
    for name, axes in AXES_SHOWN.items():
        kwargs = {"level": LEVEL, **axes}
        least = episode_bounds(kwargs, seeds)
        assert least is not None
        row = [name, ", ".join(f"{key}={value}" for key, value in axes.items()), f"{1e3 * np.mean(least):.2f}"]
        for agent in AGENTS_SHOWN:
            episode_rows = evaluate(ENV_ID, agent, seeds, kwargs, timing=False).select(seeds)
            error = bootstrap_mean(1e3 * np.array([one["steady"] for one in episode_rows]))
            success = 100.0 * np.mean([one["success"] for one in episode_rows])
            row.append(f"{error.value:.1f} [{error.low:.1f}, {error.high:.1f}] · {success:.0f}")
        rows.append(row)
    table = as_markdown(Grid(["axis", "arguments", "bound mm", *AGENTS_SHOWN], rows, 2))
    return (
        f"{table}\n\n{ENV_ID}, level {LEVEL}, {episodes} episodes ({split} seeds): mean steady error in mm with its "
        "95 % interval · success in percent. Written by "
        f"`scripts/servo-ladder --axes --episodes {episodes} --split {split}`, servotrack {code_version()}."
    )
