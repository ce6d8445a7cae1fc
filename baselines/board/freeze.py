"""Write a suite: `python -m servotrack.baselines.board.freeze NAME > NAME.yaml` measures anchors, behavior, forms."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.equal_forms import FORMS, REFERENCES, divided, pool_scores
from servotrack.baselines.board.recording import AgentPlayer
from servotrack.baselines.board.replay import ReplayError, replayed
from servotrack.baselines.board.suites import FORMAT, FORMAT_VERSION, Suite, SuiteCell, behavior_of
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.worlds import load
from servotrack.estimators.types import Array


@dataclass(frozen=True)
class Plan:
    """Content of a suite before anything is measured.

    Attributes:
        summary: Description in one line.
        worlds: Ids, public episodes of each level, and sealed episodes by level, about in proportion to the scores'
            spread there.
        anchor_episodes: Episodes that anchors are measured on. Raising it takes time.
        grid: Steps of the action grid from the middle of the action space to its bound. Raising it makes traces larger.
    """

    summary: str
    worlds: tuple[tuple[str, int, tuple[int, ...]], ...]
    anchor_episodes: int
    grid: int


PLANS = {
    "2027a": Plan(
        "an uncalibrated arm follows a target and reaches for one at rest, levels 0 to 6",
        (
            ("UncalibServo-v0", 25, (10, 20, 20, 35, 35, 35, 90)),
            ("UncalibServoReach-v0", 15, (10, 45, 70, 70, 70, 70, 70)),
        ),
        400,
        32_767,
    ),
    "2027a-clutter": Plan(
        "an observer tracks an unknown number of points in clutter, levels 0 to 7",
        (("ClutterTracking-v0", 10, (10,) * 8),),
        100,
        4095,
    ),
}
"""Suites by name."""


def main(names: Sequence[str]) -> None:
    """Print the suite of a name."""
    cells, plan = [], PLANS[names[0]]
    for env_id, public, sealed in plan.worlds:
        for level, episodes in enumerate(sealed):
            kwargs = {"level": level}
            behavior = behavior_of(env_id, kwargs)
            undivided = "0" * (FORMS * episodes)
            resolution, anchors = anchors_of(SuiteCell(env_id, kwargs, public, undivided, (1.0, 0.5), behavior), plan)
            cell = SuiteCell(env_id, kwargs, public, undivided, (anchors[0], anchors[1]), behavior, resolution)
            suite = Suite(names[0], "", plan.grid, (cell,))
            forms = divided([pool_scores(suite, cell, agent) for agent in REFERENCES[cell.world.kind]], FORMS)
            fields: dict[str, Any] = {"env_id": env_id, "env_kwargs": kwargs, "public": public, "forms": forms}
            fields |= {"anchors": anchors, "resolution": resolution, "behavior": behavior}
            cells.append(fields)
            print(cell.name, file=sys.stderr, flush=True)
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "name": names[0]}
    document = {**head, "summary": plan.summary, "grid": plan.grid, "cells": cells}
    print(yaml.safe_dump(document, sort_keys=False, width=120), end="")


def anchors_of(cell: SuiteCell, plan: Plan) -> tuple[float, list[float]]:
    """Return the resolution, and the errors at which the score is 0 and 1, to six digits.

    They are geometric means over the first test seeds: of the agent without skill, and of the bound, or where there is
    none of the agent that knows the system.

    Args:
        cell: The cell.
        plan: Plan of the suite.
    """
    ends, bound = cell.ends, cell.world.bound_of(cell.env_id)
    upper = None
    if bound is not None and bound.column == ends.column:
        upper = load(bound.values)(dict(cell.env_kwargs), tuple(seed_ranges.take("test", bound.episodes)))
    resolution = 0.0 if upper is None else ends.resolution
    found = [
        _errors(cell, ends.lower, plan),
        _errors(cell, ends.upper, plan) if upper is None else np.array(upper),
    ]
    means = [float(np.exp(np.log(errors + resolution).mean()) - resolution) for errors in found]
    # The logarithm's rounding must not make a bound of 0 negative.
    return resolution, [float(f"{max(mean, 0.0):.6g}") if mean > 1e-12 else 0.0 for mean in means]


def _errors(cell: SuiteCell, agent: str, plan: Plan) -> Array:
    suite = Suite("anchors", "", plan.grid, (cell,))
    seeds = seed_ranges.take("test", plan.anchor_episodes)
    rows = replayed(suite, cell, AgentPlayer(agent_card(agent)).play(suite, cell, seeds))
    return np.array([row[cell.ends.column] for row in rows if not isinstance(row, ReplayError)])


if __name__ == "__main__":
    main(sys.argv[1:])
