"""The duel: rows within their budget, scores from rows, tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("optuna")
pytest.importorskip("stable_baselines3")

from servotrack.baselines.leaderboard.servo_bound import reach_bounds
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.training.duel import cells
from servotrack.baselines.training.duel.__main__ import main
from servotrack.baselines.training.duel.methods import CLASSICAL, LEARNED
from servotrack.baselines.training.duel.report import (
    aggregate_grid,
    cell_grid,
    crossover_grid,
    markdown,
    winners_grid,
)
from servotrack.baselines.training.duel.rows import DuelRow, load_rows, path_of, save
from servotrack.baselines.training.duel.running import DuelPlan, cells_of, run_duel, run_row
from servotrack.baselines.training.duel.scoring import entries_of

REACH = cells.Cell("UncalibServoReach-v0", 2)


@pytest.fixture
def few_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells, "TEST_EPISODES", 3)
    monkeypatch.setattr(cells, "HELD_OUT_EPISODES", 2)


@pytest.mark.parametrize("method", ["ppo-fixed", "ppo-identified", "recurrent-ppo", "student"])
def test_a_learned_row_stays_within_its_budget(method: str, tmp_path: Path, few_episodes: None) -> None:
    budget = 50_000
    row = run_row(REACH, method, budget, 0, tmp_path / "files")
    assert 0.5 * budget < sum(row.steps.values()) <= budget
    assert len(row.search) == (0 if LEARNED[method].fixed else 4)
    assert sum(trial["steps"] for trial in row.search) == row.steps["search"]
    assert len(row.test["steady"]) == 3
    assert len(row.held_out["success"]) == 2
    assert not (tmp_path / "files").exists()


def test_off_policy_learning_stays_within_its_budget(tmp_path: Path, few_episodes: None) -> None:
    row = run_row(REACH, "sac", 4_000, 0, tmp_path / "files")
    assert 2_000 < sum(row.steps.values()) <= 4_000


def test_a_budget_below_one_rollout_is_refused(tmp_path: Path, few_episodes: None) -> None:
    with pytest.raises(ValueError, match="budget must be at least 4096 steps for ppo, got 1000"):
        run_row(REACH, "ppo-fixed", 1_000, 0, tmp_path / "files")


def test_finished_rows_are_kept(tmp_path: Path, few_episodes: None) -> None:
    plan = DuelPlan((REACH,), ("random", "oracle", CLASSICAL), (22_000,), (0,))
    seen: list[tuple[str, bool]] = []
    for _ in range(2):
        run_duel(plan, tmp_path, lambda path, new: seen.append((path.name, new)))
    names = ["random-0-0.json", "oracle-0-0.json", "classical-22000-0.json"]
    assert seen == [*((name, True) for name in names), *((name, False) for name in names)]
    scored = {entry.method: float(entry.scores.mean()) for entry in entries_of(load_rows(tmp_path))}
    assert scored["random"] == pytest.approx(0.0, abs=1e-9)
    assert 0.2 < scored[CLASSICAL] < 1.0


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"methods": ("magic",)}, "methods must be of classical"),
        ({"budgets": ()}, "budgets must be"),
        ({"runs": (-1,)}, "runs must be"),
    ],
)
def test_a_bad_plan_is_refused(changes: dict[str, Any], text: str) -> None:
    good = DuelPlan((REACH,), ("random",), (1000,), (0,))
    with pytest.raises(ValueError, match=text):
        replace(good, **changes)


def test_cells_are_read_from_text() -> None:
    assert cells_of(["UncalibServo-v0:6"]) == (cells.Cell("UncalibServo-v0", 6),)
    with pytest.raises(ValueError, match="a cell must be ID:LEVEL"):
        cells_of(["UncalibServo-v0"])


def _row(method: str, budget: int, run: int, error: float) -> DuelRow:
    """A row whose errors scatter about one value; seeds are as difficult for all methods."""
    rng, own = np.random.default_rng(0), np.random.default_rng([run, budget])

    def columns(count: int) -> dict[str, list[float]]:
        errors = error * np.exp(0.2 * rng.normal(size=count) + 0.05 * own.normal())
        return {
            "return": errors.tolist(), "length": [100] * count, "success": (errors < 0.01).tolist(),
            "steady": errors.tolist(),
        }  # fmt: skip

    information = LEARNED[method].information if method in LEARNED else "observations"
    steps = {"search": budget // 2, "training": budget // 2}
    return DuelRow(
        REACH.env_id, REACH.level, method, information, budget, run, steps, 1.0, [], {}, columns(20), columns(10), {}
    )


@pytest.fixture
def rows(tmp_path: Path) -> Path:
    """Ten runs of three methods: learning is behind with the small budget and ahead with the large one."""
    anchors = [_row("random", 0, 0, 0.5), _row("oracle", 0, 0, 0.005)]
    for row in anchors:
        save(tmp_path, row)
    for run in range(10):
        for budget, classical, learned in ((100_000, 0.008, 0.05), (1_000_000, 0.007, 0.006)):
            save(tmp_path, _row(CLASSICAL, budget, run, classical))
            save(tmp_path, _row("ppo", budget, run, learned))
    save(tmp_path, _row("student", 100_000, 0, 0.004))
    return tmp_path


def test_winners_need_ten_runs_and_an_interval_beside_zero(rows: Path) -> None:
    grid = winners_grid(entries_of(load_rows(rows)))
    winners = {(row[1], row[2]): row[-1] for row in grid.rows}
    assert winners == {
        ("100,000", "ppo"): CLASSICAL,
        ("100,000", "student"): "open: fewer than 10 runs",
        ("1,000,000", "ppo"): "ppo",
    }


def test_curves_cross_between_the_budgets(rows: Path) -> None:
    grid = crossover_grid(entries_of(load_rows(rows)))
    crossing = {row[1]: row[2] for row in grid.rows}
    assert 600_000 < float(crossing["ppo"].replace(",", "")) < 1_000_000
    assert crossing["student"] == "100,000 or less (open)"


def test_aggregates_and_tables_hold_every_method(rows: Path) -> None:
    entries = entries_of(load_rows(rows))
    shares = {(row[0], row[1]): row[-1] for row in aggregate_grid(entries).rows}
    assert shares["ppo", "100,000"] == "0.00 [0.00, 0.00]"
    assert shares["student", "100,000"] == "1.00 (open)"
    assert float(shares["ppo", "1,000,000"].split()[0]) > 0.9
    assert len(cell_grid(entries).rows) == len(entries)
    assert "### Who wins" in markdown(entries, "command", "0")


def test_report_writes_page_and_figures(rows: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- duel:begin -->\n<!-- duel:end -->\n", encoding="utf-8")
    main(["report", str(rows), "--write", str(page), "--figures", str(tmp_path)])
    assert "Where the curves cross" in page.read_text(encoding="utf-8")
    assert "Who wins" in capsys.readouterr().out
    for name in ("duel-budgets.png", "duel-profiles.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_a_damaged_row_is_named(rows: Path) -> None:
    path = path_of(rows, REACH, "ppo", 100_000, 3)
    path.rename(path.with_name("ppo-100000-77.json"))
    with pytest.raises(ResultsError, match="its name is that of another row"):
        load_rows(rows)


def test_a_cell_without_its_lower_anchor_has_no_scores(rows: Path) -> None:
    path_of(rows, REACH, "random", 0, 0).unlink()
    with pytest.raises(ResultsError, match="no rows of random; run"):
        entries_of(load_rows(rows))


def test_the_score_is_one_at_the_bound_of_the_same_episodes(tmp_path: Path) -> None:
    seeds = cells.test_seeds(20)
    least, widened = (reach_bounds(kwargs, seeds) for kwargs in (REACH.env_kwargs, REACH.held_out_kwargs))
    assert least is not None and widened is not None
    ideal = _row("oracle", 0, 0, 0.5)
    ideal = replace(ideal, test={**ideal.test, "steady": least}, held_out={**ideal.held_out, "steady": widened[:10]})
    for row in (_row("random", 0, 0, 0.5), ideal):
        save(tmp_path, row)
    for entry in entries_of(load_rows(tmp_path)):
        expected = 1.0 if entry.method == "oracle" else 0.0
        assert entry.scores.mean() == pytest.approx(expected, abs=1e-9)
        assert entry.held_out_scores.mean() == pytest.approx(expected, abs=1e-9)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="holds no rows of a duel"):
        load_rows(tmp_path)


def test_methods_take_part_where_they_are_supported() -> None:
    follow = cells.Cell("PedestrianServo-v0", 2)
    plan = DuelPlan((REACH, follow), ("oracle", "phd-servo", CLASSICAL, "ppo", "student"), (1000,), (0,))
    assert [(cell.env_id == REACH.env_id, method) for cell, method, _, _ in plan.rows()] == [
        (True, "oracle"), (False, "phd-servo"),
        (True, CLASSICAL), (True, "ppo"), (True, "student"), (False, CLASSICAL), (False, "ppo"),
    ]  # fmt: skip
