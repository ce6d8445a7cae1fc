"""Write a suite: `python -m servotrack.baselines.board.freeze NAME > NAME.yaml` measures anchors, behavior, forms."""

from __future__ import annotations

import sys
from collections.abc import Sequence
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

ANCHOR_EPISODES = 400
GRID = 32_767
WORLDS = (
    ("UncalibServo-v0", 25, (10, 20, 20, 35, 35, 35, 90)),
    ("UncalibServoReach-v0", 15, (10, 45, 70, 70, 70, 70, 70)),
)
"""Ids, public episodes of each level, and sealed episodes by level, about in proportion to the scores' spread there."""


def main(names: Sequence[str]) -> None:
    """Print the suite of a name."""
    cells = []
    for env_id, public, sealed in WORLDS:
        for level, episodes in enumerate(sealed):
            kwargs = {"level": level}
            behavior = behavior_of(env_id, kwargs)
            undivided = "0" * (FORMS * episodes)
            resolution, anchors = anchors_of(SuiteCell(env_id, kwargs, public, undivided, (1.0, 0.5), behavior))
            cell = SuiteCell(env_id, kwargs, public, undivided, (anchors[0], anchors[1]), behavior, resolution)
            suite = Suite(names[0], "", GRID, (cell,))
            forms = divided([pool_scores(suite, cell, agent) for agent in REFERENCES], FORMS)
            fields: dict[str, Any] = {"env_id": env_id, "env_kwargs": kwargs, "public": public, "forms": forms}
            fields |= {"anchors": anchors, "resolution": resolution, "behavior": behavior}
            cells.append(fields)
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "name": names[0]}
    summary = "an uncalibrated arm follows a target and reaches for one at rest, levels 0 to 6"
    print(
        yaml.safe_dump({**head, "summary": summary, "grid": GRID, "cells": cells}, sort_keys=False, width=120), end=""
    )


def anchors_of(cell: SuiteCell) -> tuple[float, list[float]]:
    """Return the resolution, and the errors at which the score is 0 and 1, to six digits.

    They are geometric means over the first test seeds: of the agent without skill, and of the bound, or where there is
    none of the agent that knows the system.
    """
    ends, bound = cell.world.anchors, cell.world.bound_of(cell.env_id)
    assert ends is not None
    upper = None
    if bound is not None and bound.column == ends.column:
        upper = load(bound.values)(dict(cell.env_kwargs), tuple(seed_ranges.take("test", bound.episodes)))
    resolution = 0.0 if upper is None else ends.resolution
    found = [_errors(cell, ends.lower), _errors(cell, ends.upper) if upper is None else np.array(upper)]
    means = [float(np.exp(np.log(errors + resolution).mean()) - resolution) for errors in found]
    # The logarithm's rounding must not make a bound of 0 negative.
    return resolution, [float(f"{max(mean, 0.0):.6g}") if mean > 1e-12 else 0.0 for mean in means]


def _errors(cell: SuiteCell, agent: str) -> Array:
    ends = cell.world.anchors
    assert ends is not None
    suite = Suite("anchors", "", GRID, (cell,))
    seeds = seed_ranges.take("test", ANCHOR_EPISODES)
    rows = replayed(suite, cell, AgentPlayer(agent_card(agent)).play(suite, cell, seeds))
    return np.array([row[ends.column] for row in rows if not isinstance(row, ReplayError)])


if __name__ == "__main__":
    main(sys.argv[1:])
