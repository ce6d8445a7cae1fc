"""The tables of the ladder: bound and separation of levels."""

from __future__ import annotations

from pathlib import Path

from servotrack.baselines.evaluation.bench import run_suite, suite_of
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.leaderboard.ladder import main

SERVO = "UncalibServo-v0"


def test_tables_of_chosen_levels_name_their_command(tmp_path: Path) -> None:
    cells = suite_of(SERVO, ["random", "kf"], (0, 1))
    run_suite(cells, ResultsFolder(tmp_path / SERVO), episodes=2, split="tune", jobs=1)
    page = tmp_path / "page.md"
    page.write_text("<!-- servo-ladder:begin -->\n<!-- servo-ladder:end -->\n", encoding="utf-8")
    main(["--tables", str(tmp_path), "--worlds", SERVO, "--levels", "1", "--episodes", "2", "--write", str(page)])
    text = page.read_text(encoding="utf-8")
    levels = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")]
    assert [level for level in levels if level.isdigit()] == ["1", "1"]
    assert f"`scripts/servo-ladder --worlds {SERVO} --levels 1 --episodes 2 --split tune`" in text
