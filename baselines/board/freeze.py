"""Write a suite: `python -m servotrack.baselines.board.freeze NAME > NAME.yaml` measures anchors and behavior."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import yaml

import servotrack  # noqa: F401
from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.board.recording import AgentPlayer
from servotrack.baselines.board.replay import ReplayError, replayed
from servotrack.baselines.board.suites import FORMAT, FORMAT_VERSION, Suite, SuiteCell, behavior_of
from servotrack.baselines.evaluation import seeds as seed_ranges
from servotrack.baselines.worlds import world_of_id

ANCHOR_EPISODES = 400
GRID = 32_767
WORLDS = (("UncalibServo-v0", 25, 25), ("UncalibServoReach-v0", 15, 15))
LEVELS = range(7)


def main(names: Sequence[str]) -> None:
    """Print the suite of a name."""
    cells = []
    for env_id, public, sealed in WORLDS:
        for level in LEVELS:
            kwargs = {"level": level}
            behavior = behavior_of(env_id, kwargs)
            cell = SuiteCell(env_id, kwargs, public, sealed, (1.0, 0.5), behavior)
            fields: dict[str, Any] = {"env_id": env_id, "env_kwargs": kwargs, "public": public, "sealed": sealed}
            fields |= {"anchors": [anchor(cell, agent) for agent in _ends(cell)], "behavior": behavior}
            cells.append(fields)
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "name": names[0]}
    summary = "an uncalibrated arm follows a target and reaches for one at rest, levels 0 to 6"
    print(
        yaml.safe_dump({**head, "summary": summary, "grid": GRID, "cells": cells}, sort_keys=False, width=120), end=""
    )


def anchor(cell: SuiteCell, agent: str) -> float:
    """Return the geometric mean of an agent's errors over the first test seeds, to six digits."""
    ends = cell.world.anchors
    assert ends is not None
    suite = Suite("anchors", "", GRID, (cell,))
    seeds = seed_ranges.take("test", ANCHOR_EPISODES)
    rows = replayed(suite, cell, AgentPlayer(agent_card(agent)).play(suite, cell, seeds))
    errors = [row[ends.column] for row in rows if not isinstance(row, ReplayError)]
    return float(f"{np.exp(np.log(errors).mean()):.6g}")


def _ends(cell: SuiteCell) -> tuple[str, str]:
    ends = world_of_id(cell.env_id).anchors
    assert ends is not None
    return ends.lower, ends.upper


if __name__ == "__main__":
    main(sys.argv[1:])
