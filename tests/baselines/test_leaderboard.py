"""The leaderboard from rows whose answers are known."""

from __future__ import annotations

import csv
import io
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from servotrack.baselines.evaluation.results import CellResults
from servotrack.baselines.evaluation.watch import CAPTION_HEIGHT, film_episode
from servotrack.baselines.leaderboard.figure import draw_levels, level_tasks
from servotrack.baselines.leaderboard.index import write_index
from servotrack.baselines.leaderboard.report import write_report
from servotrack.baselines.leaderboard.servo_bound import episode_bounds
from servotrack.baselines.leaderboard.summary import TaskSummary, overall, stamp, summarize
from servotrack.baselines.leaderboard.table import (
    caveat,
    markdown_overview,
    markdown_report,
    missing_agents,
    overview_grid,
    task_grid,
)
from servotrack.baselines.reporting.figure import save_figure
from servotrack.baselines.reporting.files import ResultsError, atomic_path
from servotrack.baselines.reporting.film import write_film
from servotrack.baselines.reporting.grid import as_csv, as_json, as_markdown

ERRORS = {"random": 0.5, "ukf": 0.005, "lifted-kf": 0.002, "oracle": 0.001}


SCALED_BY_AGENT, SCALED_BY_BOUND = "UncalibServoPixels-v0", "UncalibServo-v0"


def make_cells(
    levels: tuple[int, ...] = (0, 3), episodes: int = 20, spread: float = 0.1, env_id: str = SCALED_BY_AGENT
) -> list[CellResults]:
    cells = []
    for level in levels:
        for agent, error in ERRORS.items():
            # The same episodes are hard for everybody: what pairing is for.
            difficulty = np.random.default_rng(level).normal(0.0, spread, episodes)
            own = np.random.default_rng([level, len(agent)]).normal(0.0, spread / 10, episodes)
            steady = error * np.exp(difficulty + own)
            rows = [
                {"seed": i, "return": float(-e), "length": 252, "steady": float(e), "success": bool(e < 0.01)}
                for i, e in enumerate(steady)
            ]
            card = {"information": "model-free", "requires": [], "tuning_steps": 1000, "summary": agent}
            if agent == "oracle":
                card |= {"information": "privileged", "requires": ["truth"]}
            cells.append(CellResults(env_id, {"level": level}, agent, card, 252, rows))
    return cells


def test_agents_are_ranked_by_score_between_their_anchors() -> None:
    task = summarize(make_cells())[0]
    assert [row.agent for row in task.rows] == ["oracle", "lifted-kf", "ukf", "random"]
    assert task.rows[0].score is not None and task.rows[0].score.value == pytest.approx(1.0)
    assert task.rows[-1].score is not None and task.rows[-1].score.value == pytest.approx(0.0, abs=1e-12)
    lifted = task.row("lifted-kf")
    assert lifted is not None and lifted.score is not None and lifted.worst_score is not None
    assert lifted.score.value == pytest.approx(np.log(0.5 / 0.002) / np.log(0.5 / 0.001), abs=0.01)
    assert lifted.worst_score < lifted.score.low
    assert lifted.success is not None and lifted.success.value == 1.0
    assert [row.privileged for row in task.rows] == [True, False, False, False]


def test_a_task_with_a_bound_is_scaled_by_it() -> None:
    cells = make_cells((0, 3), env_id=SCALED_BY_BOUND)
    kept = [cell for cell in cells if cell.agent != "oracle"]
    fixed, drawn = summarize(kept)
    for task, floor in ((fixed, 0.0), (drawn, np.array(episode_bounds({"level": 3}, range(20))))):
        lifted, random = task.row("lifted-kf"), task.row("random")
        assert lifted is not None and lifted.score is not None and random is not None and random.score is not None
        assert random.score.value == pytest.approx(0.0, abs=1e-12)
        # A tenth of a millimeter is added to every error before its logarithm.
        scale = np.log(0.5001 / np.exp(np.log(floor + 1e-4).mean()))
        assert lifted.score.value == pytest.approx(np.log(0.5001 / 0.0021) / scale, abs=0.02)
        assert lifted.score.value < 1.0
        assert missing_agents(task) == []
    assert fixed.row("lifted-kf").over_bound is None  # type: ignore[union-attr]
    assert drawn.row("lifted-kf").over_bound == pytest.approx(0.002 / np.mean(floor), rel=0.1)  # type: ignore[union-attr]
    # Agents that know the system are rows like others.
    assert scores_of(summarize(cells)[1])["lifted-kf"] == scores_of(drawn)["lifted-kf"]
    shown = task_grid(drawn)
    assert "× bound" in shown.headings
    note = markdown_overview(summarize(cells), "servotrack leaderboard x")
    assert "1 is the bound" in note and "more is possible" not in note and "the law of the target" in note


def test_differences_are_paired_against_the_reference_and_corrected() -> None:
    task = summarize(make_cells())[0]
    lifted, reference = task.row("lifted-kf"), task.row("ukf")
    assert lifted is not None and lifted.difference is not None and lifted.steady is not None
    assert lifted.difference.value == pytest.approx(-0.003, abs=5e-4)
    assert lifted.difference.high - lifted.difference.low < lifted.steady.high - lifted.steady.low + 5e-4
    assert lifted.adjusted_p is not None and lifted.difference.p_value <= lifted.adjusted_p < 0.05
    assert reference is not None and reference.difference is None


def test_only_common_seeds_are_compared() -> None:
    cells = make_cells((3,))
    lifted = next(cell for cell in cells if cell.agent == "lifted-kf")
    lifted.rows = [*lifted.rows[10:], {**lifted.rows[0], "seed": 99, "steady": 5.0}]
    row = summarize(cells)[0].row("lifted-kf")
    assert row is not None and row.difference is not None
    assert row.episodes == 11
    assert row.difference.value < 0.0, "the stranger's seed was compared with somebody else's"


def test_without_anchors_there_is_no_score() -> None:
    cells = [cell for cell in make_cells() if cell.agent != "oracle"]
    tasks = summarize(cells)
    assert all(row.score is None for task in tasks for row in task.rows)
    assert [row.agent for row in tasks[0].rows] == ["lifted-kf", "ukf", "random"]
    assert overall(tasks) == []
    assert overview_grid(tasks).rows == []


def changed(cells: list[CellResults], agent: str, level: int, change: Any) -> list[CellResults]:
    """Apply `change` to one agent's cell in one level."""
    (cell,) = [cell for cell in cells if (cell.agent, cell.env_kwargs["level"]) == (agent, level)]
    change(cell)
    return cells


def scores_of(task: TaskSummary) -> dict[str, Any]:
    return {row.agent: None if row.scores is None else row.scores.tolist() for row in task.rows}


def _twin_of_random(cell: CellResults) -> None:
    cell.rows = [{**row, "steady": 0.5} for row in cell.rows]


@pytest.mark.parametrize(
    ("agent", "change", "note"),
    [
        ("oracle", lambda cell: cell.rows.__delitem__(slice(5, None)), "lack 15 of its 20 episodes"),
        (
            "random",
            lambda cell: cell.rows.pop(7),
            "without gaps, and have 19 in common of 19 and 20",
        ),
        ("random", lambda cell: [row.update(seed=row["seed"] + 50) for row in cell.rows], "have 0 in common"),
        (
            "oracle",
            lambda cell: cell.card.update(requires=[]),
            "oracle received nothing beyond the observation, the package's agent of this name truth",
        ),
        ("random", lambda cell: cell.card.update(requires=["truth"]), "random received truth"),
        ("random", lambda cell: cell.rows[3].pop("steady"), "episodes of random have no steady"),
        ("random", lambda cell: [row.update(steady=1e-4) for row in cell.rows], "random is not worse than oracle here"),
    ],
    ids=["few episodes", "gap", "other seeds", "no truth", "truth", "no errors", "better than oracle"],
)
def test_anchors_that_cannot_be_trusted_cost_the_scores_of_their_task_alone(agent: str, change: Any, note: str) -> None:
    sound, broken = make_cells(), changed(make_cells(), agent, 0, change)
    expected, tasks = summarize(sound), summarize(broken)
    assert any(note in sentence for sentence in tasks[0].notes), tasks[0].notes
    assert all(row.score is None for row in tasks[0].rows if len(row.seeds) == 20 or agent == "random")
    assert scores_of(tasks[1]) == scores_of(expected[1]) and tasks[1].notes == ()
    assert note in caveat(tasks[0]) and note in markdown_report(tasks, "a command").replace("\\", "")
    grid = overview_grid(tasks)
    assert "level 3" in grid.headings


def test_a_world_where_random_equals_oracle_leaves_the_others_their_scores() -> None:
    cells = make_cells()
    for agent in ("random", "oracle"):
        changed(cells, agent, 0, _twin_of_random)
    tasks = summarize(cells)
    assert "random is not worse than oracle here" in caveat(tasks[0])
    assert {row.agent: row.score for row in tasks[0].rows} == dict.fromkeys(ERRORS)
    assert [row.agent for row in overall(tasks)] == ["oracle", "lifted-kf", "ukf", "random"]


def test_more_episodes_of_one_agent_cost_its_own_score_alone() -> None:
    cells = changed(make_cells((3,)), "ukf", 3, lambda cell: cell.rows.append({**cell.rows[0], "seed": 20}))
    (task,) = summarize(cells)
    assert {row.agent: row.score is None for row in task.rows} == {
        "oracle": False, "lifted-kf": False, "random": False, "ukf": True,
    }  # fmt: skip
    assert task.notes == ("No score for ukf: random and oracle lack 1 of its 21 episodes; evaluate them on as many.",)


def test_extra_seeds_of_one_anchor_do_not_move_the_scores() -> None:
    def extended(cell: CellResults) -> None:
        cell.rows += [{**cell.rows[0], "seed": seed, "steady": 1e-9} for seed in range(20, 60)]

    (task,) = summarize(changed(make_cells((3,)), "oracle", 3, extended))
    (expected,) = summarize(make_cells((3,)))
    assert scores_of(task) == {**scores_of(expected), "oracle": None}


@pytest.mark.parametrize("error", [1e-300, 5e-324, 1e-12])
def test_one_tiny_error_does_not_take_the_top(error: float) -> None:
    cells = changed(make_cells((3,)), "lifted-kf", 3, lambda cell: cell.rows[0].update(steady=error))
    (task,), (honest,) = summarize(cells), summarize(make_cells((3,)))
    row, before = task.row("lifted-kf"), honest.row("lifted-kf")
    assert row is not None and row.score is not None and before is not None and before.score is not None
    assert task.rows[0].agent == "oracle"
    assert row.score.value - before.score.value < 0.1


@pytest.mark.parametrize("level", ["hard", None, [3], 1.5, True])
def test_a_level_that_is_no_whole_number_is_an_argument_like_others(level: Any) -> None:
    cells = make_cells((3,))
    for cell in cells:
        cell.env_kwargs = {"level": level}
    (task,) = summarize(cells)
    assert task.level is None and overview_grid([task]).rows


def test_files_without_digests_are_named() -> None:
    cells = make_cells((3,))
    cells[1].has_digests = False
    (task,) = summarize(cells)
    assert task.notes == ("Files of servotrack 0.1.0 have no digests that would show later changes: ukf.",)


def test_names_are_no_formulas_and_no_addresses(tmp_path: Path) -> None:
    cells = make_cells()
    for cell in cells:
        if cell.agent == "ukf":
            cell.agent = "$\\frac{$"
    save_figure(draw_levels(level_tasks(summarize(cells))), tmp_path / "levels.svg")
    (tmp_path / "javascript:alert(1)").mkdir()
    (tmp_path / "javascript:alert(1)" / "leaderboard.html").write_text("")
    assert 'href="javascript%3Aalert%281%29/leaderboard.html"' in write_index(tmp_path).read_text(encoding="utf-8")


def test_overall_needs_every_task() -> None:
    cells = [cell for cell in make_cells() if (cell.agent, cell.env_kwargs["level"]) != ("ukf", 3)]
    names = [summary.agent for summary in overall(summarize(cells))]
    assert names == ["oracle", "lifted-kf", "random"]


def test_who_took_part_in_some_tasks_is_shown_without_a_mean() -> None:
    cells = [cell for cell in make_cells() if (cell.agent, cell.env_kwargs["level"]) != ("ukf", 3)]
    *_, last = overview_grid(summarize(cells)).rows
    assert last[0] == "ukf" and "" in last[2:-1] and last[-1] == "" and any(last[2:-1])


def test_a_world_without_chance_gets_a_caveat() -> None:
    cells = make_cells((0,), spread=0.0)
    assert "one and the same" in caveat(summarize(cells)[0])
    assert caveat(summarize(make_cells((0,)))[0]) == ""


def test_a_world_without_score_has_an_overview_of_its_headline() -> None:
    card = {"information": "structure", "requires": [], "tuning_steps": 0, "summary": ""}
    cells = [
        CellResults("PedestrianTracking-v0", {"level": level}, name, card, 300, [
            {"seed": seed, "return": -1.0, "length": 300, "ospa2": ospa2 + 0.01 * seed} for seed in range(3)
        ])
        for level in (0, 1) for name, ospa2 in (("bad", 0.8), ("good", 0.2), ("at one level", 0.1))
        if level == 1 or name != "at one level"
    ]  # fmt: skip
    text = markdown_overview(summarize(cells), "servotrack leaderboard")
    shown = ["| good | structure | 0.210 | 0.210 |", "| bad | structure | 0.810 | 0.810 |", "| structure |  | 0.110 |"]
    assert sorted(shown, key=text.index) == shown
    assert "PedestrianTracking-v0: mean OSPA(2), up to 3 episodes each" in text
    assert "`servotrack leaderboard`" in text


def test_generic_environments_are_ranked_by_return() -> None:
    card = {"information": "undeclared", "requires": [], "tuning_steps": 0, "summary": ""}
    cells = [
        CellResults("CartPole-v1", {}, name, card, 500, [{"seed": 1, "return": value, "length": 9}])
        for name, value in (("bad", 1.0), ("good", 2.0))
    ]
    task = summarize(cells)[0]
    assert [row.agent for row in task.rows] == ["good", "bad"]
    assert "return" in task_grid(task).headings


def test_markdown_has_one_line_per_agent_and_marks_the_privileged() -> None:
    tasks = summarize(make_cells())
    text = as_markdown(task_grid(tasks[0]))
    lines = text.splitlines()
    assert len(lines) == 2 + len(ERRORS)
    assert len({line.count("|") for line in lines}) == 1
    assert "oracle †" in text and "ukf †" not in text
    report = markdown_report(tasks, "servotrack bench")
    assert "Written by `servotrack bench`" in report
    assert report.count("\n## ") == 3


def test_the_figure_shows_every_level_and_every_agent_but_the_anchor_at_zero() -> None:
    tasks = level_tasks(summarize(make_cells((5, 0, 3))))
    assert [task.level for task in tasks] == [0, 3, 5]
    figure = draw_levels(tasks)
    scores, success = figure.axes
    curves = [line for line in scores.get_lines() if len(line.get_xdata()) == 3]  # type: ignore[arg-type]
    assert len(curves) == 3
    assert [label.get_text() for label in success.get_yticklabels()] == ["oracle", "lifted-kf", "ukf"]
    with pytest.raises(ValueError, match="servotrack bench"):
        draw_levels([])


def test_the_report_is_written_whole(tmp_path: Path) -> None:
    tasks = summarize(make_cells())
    written = write_report(tasks, tmp_path, "servotrack bench <all>", tmp_path / "best.webm")
    assert {path.name for path in written} == {
        "levels.png", "levels.svg", "levels.pdf", "leaderboard.md", "leaderboard.html",
    }  # fmt: skip
    assert all(path.stat().st_size > 500 for path in written)
    page = (tmp_path / "leaderboard.html").read_text()
    assert "servotrack bench &lt;all&gt;" in page and 'src="best.webm"' in page and "<td>lifted-kf</td>" in page
    assert "<code>servotrack tune</code>" in page and "`" not in page
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in written}


def frames(count: int, height: int, width: int) -> Any:
    for i in range(count):
        frame = np.zeros((height, width, 3), np.uint8)
        frame[:, : width // 2] = (255, 0, 0)
        frame[i : i + 8] = 255
        yield frame


@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".avi"])
def test_a_film_can_be_read_back(tmp_path: Path, suffix: str) -> None:
    import cv2

    path = tmp_path / f"film{suffix}"
    assert write_film(frames(12, 61, 81), path, 20.0) == 12
    capture = cv2.VideoCapture(str(path))
    read = []
    while (answer := capture.read())[0]:
        read.append(answer[1])
    assert len(read) == 12
    assert read[0].shape == (62, 82, 3)
    blue, _, red = read[-1][40, 10]
    assert red > 180 > 80 > blue, "colors are swapped"
    assert list(tmp_path.iterdir()) == [path]


def test_an_episode_is_filmed(tmp_path: Path) -> None:
    kwargs = {"level": 0, "horizon": 10, "warmup": 0}
    assert film_episode("UncalibServo-v0", "kf", tmp_path / "a.mp4", kwargs, 100_000) == 11


def test_films_that_cannot_be_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"video must end in \.webm"):
        film_episode("UncalibServo-v0", "kf", tmp_path / "a.mov")
    with pytest.raises(ValueError, match="at least one frame"):
        write_film(iter(()), tmp_path / "a.mp4", 20.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be a folder"), atomic_path(tmp_path / "file" / "a.mp4"):
        pass
    assert not (tmp_path / "a.mp4").exists()


def _with_twin(shift: float) -> list[CellResults]:
    """Cells with an agent whose steady errors are those of `ukf`, times exp(shift) or its inverse by turns."""
    cells = make_cells()
    for cell in [cell for cell in cells if cell.agent == "ukf"]:
        rows = [
            {**row, "steady": row["steady"] * float(np.exp(shift if i % 2 else -shift))}
            for i, row in enumerate(cell.rows)
        ]
        cells.append(CellResults(cell.env_id, cell.env_kwargs, "ukf-twin", cell.card, 252, rows[::-1]))
    return cells


@pytest.mark.parametrize(("shift", "folds"), [(0.0, True), (0.01, True), (0.5, False)])
def test_equivalent_agents_share_a_row(shift: float, folds: bool) -> None:
    tasks = summarize(_with_twin(shift))
    names = [row[0] for row in overview_grid(tasks).rows]
    assert ("ukf (same: ukf-twin)" in names) == folds
    assert ("ukf-twin" in names) != folds


def test_the_overview_shows_the_worst_tenth() -> None:
    grid = overview_grid(summarize(make_cells()))
    column = grid.headings.index("worst tenth")
    lifted = next(row for row in overall(summarize(make_cells())) if row.agent == "lifted-kf")
    shown = next(row for row in grid.rows if row[0] == "lifted-kf")
    assert shown[column] == f"{lifted.worst_score:.2f}"
    assert lifted.worst_score < lifted.score.low


def test_the_stamp_follows_the_rows_alone() -> None:
    cells = make_cells()
    assert stamp(cells) == stamp(cells[::-1])
    cells[0].provenance = {"command": "another"}
    assert stamp(cells) == stamp(make_cells())
    cells[0].rows[0]["steady"] *= 1.0 + 1e-12
    assert stamp(cells) != stamp(make_cells())


def test_a_table_names_the_agents_that_its_empty_columns_need() -> None:
    task = summarize([cell for cell in make_cells((3,)) if cell.agent == "lifted-kf"])[0]
    assert missing_agents(task) == ["random", "oracle", "ukf"]


def test_tables_for_programs_hold_what_the_tables_for_people_hold() -> None:
    grid = overview_grid(summarize(make_cells()))
    assert [list(row.values()) for row in json.loads(as_json({"all": grid}))["all"]] == grid.rows
    read = list(csv.reader(io.StringIO(as_csv({"all": grid, "again": grid}))))
    assert read[0] == ["table", *grid.headings]
    assert read[1:] == [["all", *row] for row in grid.rows] + [["again", *row] for row in grid.rows]


def test_the_index_links_to_the_page_of_every_world(tmp_path: Path) -> None:
    for world in ("UncalibServo-v0", "ClutterTracking-v0"):
        write_report(summarize(make_cells()), tmp_path / world, "a command")
    text = write_index(tmp_path).read_text(encoding="utf-8")
    links = re.findall(r'href="([^"]+)"', text)
    assert links == ["ClutterTracking-v0/leaderboard.html", "UncalibServo-v0/leaderboard.html"]
    assert all((tmp_path / link).is_file() for link in links)


def test_a_film_names_agent_level_and_seed(tmp_path: Path) -> None:
    films = []
    for agent, seed in (("kf", 200_000), ("kf", 200_001), ("fixed-jacobian", 200_000)):
        film_episode("UncalibServo-v0", agent, tmp_path / "film.avi", {"level": 2, "horizon": 70}, seed)
        read, frame = cv2.VideoCapture(str(tmp_path / "film.avi")).read()
        assert read
        films.append(frame[-CAPTION_HEIGHT:].astype(int))
    dark = [(film < 128).any(axis=2).sum() for film in films]
    assert min(dark) > 100
    # The strips differ, so they say more than that there is an agent.
    assert np.abs(films[0] - films[1]).max() > 100 and np.abs(films[0] - films[2]).max() > 100
