"""Agents answer as they always did: rows of results that version 0.1.0 wrote come out again.

The rows are those of the code before its modules were moved. A difference means that a world, an agent or a score has
changed; then the rows are wrong, or the id needs a new version. The rows of `pmb` on people are those of its second
version, which reports detected people only.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from servotrack.baselines.agents.registry import agent_card
from servotrack.baselines.evaluation.evaluate import run_episodes

CELLS: list[dict[str, Any]] = json.loads(Path(__file__).with_name("stored_rows.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: "-".join([cell["env_id"], cell["agent"]]))
def test_rows_are_those_of_the_first_version(cell: dict[str, Any]) -> None:
    seeds = [row["seed"] for row in cell["rows"]]
    rows, max_steps = run_episodes(cell["env_id"], agent_card(cell["agent"]), seeds, cell["env_kwargs"])
    assert max_steps == cell["max_steps"]
    assert [set(row) for row in rows] == [set(row) for row in cell["rows"]]
    for row, stored in zip(rows, cell["rows"], strict=True):
        # Other machines and library versions may differ in the last bits.
        assert row == pytest.approx(stored, rel=1e-6, abs=1e-9)
