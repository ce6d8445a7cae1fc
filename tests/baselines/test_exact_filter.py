"""The comparison of PMB with PMBM: paired rows, and a table in a page."""

from __future__ import annotations

from pathlib import Path

import pytest

from servotrack.baselines.leaderboard import exact_filter


def test_rows_are_paired_by_seed() -> None:
    found = exact_filter.compare({"level": 0, "horizon": 10}, [160_000, 160_001])
    assert set(found) == {"OSPA", "OSPA(2)"}
    assert all(len(values) == 2 for metric in found.values() for values in metric.values())


def test_table_has_the_difference_and_its_interval() -> None:
    values = {"OSPA": {"pmb": [3.0, 5.0], "pmbm": [2.0, 3.0]}}
    grid = exact_filter.table({"level 2": values})
    assert grid.rows == [["level 2", "OSPA", "4.00", "2.50", "+1.50 [+1.00, +2.00]"]]


def test_the_command_writes_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- exact-filter:begin -->\n<!-- exact-filter:end -->\nafter\n", encoding="utf-8")
    monkeypatch.setattr(exact_filter, "SCENES", {"short": {"level": 0, "horizon": 5}})
    exact_filter.main(["--episodes", "2", "--write", str(page)])
    text = page.read_text(encoding="utf-8")
    assert "| short | OSPA |" in text and "2 tune seeds each (160000 to 160001)" in text
    with pytest.raises(SystemExit):
        exact_filter.main(["--episodes", "0"])
