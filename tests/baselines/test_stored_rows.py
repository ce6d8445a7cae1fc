"""Agents answer as they did: stored rows of results come out again.

A difference means that a world, an agent or a score has changed. Where an agent was changed on purpose,
`python tests/baselines/test_stored_rows.py AGENT` stores its rows anew; a changed world needs a new version of its id.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.evaluation.evaluate import run_episodes

STORED = Path(__file__).with_name("stored_rows.json")
CELLS: list[dict[str, Any]] = json.loads(STORED.read_text(encoding="utf-8"))


def rows_of(cell: dict[str, Any]) -> tuple[list[dict[str, Any]], int]:
    """Play the episodes of a cell: rows and the largest number of steps."""
    seeds = [row["seed"] for row in cell["rows"]]
    return run_episodes(cell["env_id"], agent_card(cell["agent"]), seeds, cell["env_kwargs"])


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: "-".join([cell["env_id"], cell["agent"]]))
def test_rows_come_out_again(cell: dict[str, Any]) -> None:
    rows, max_steps = rows_of(cell)
    assert max_steps == cell["max_steps"]
    assert [set(row) for row in rows] == [set(row) for row in cell["rows"]]
    for row, stored in zip(rows, cell["rows"], strict=True):
        # Other machines and library versions may differ in the last bits.
        assert row == pytest.approx(stored, rel=1e-6, abs=1e-9)


def store(agents: list[str]) -> None:
    """Store the rows of some agents anew."""
    for cell in CELLS:
        if cell["agent"] in agents:
            cell["rows"] = rows_of(cell)[0]
    STORED.write_text("[\n" + ",\n".join(map(json.dumps, CELLS)) + "\n]\n", encoding="utf-8")


if __name__ == "__main__":
    store(sys.argv[1:])
