"""The monte_carlo_color reproduction keeps its films, refuses foreign files, and derives verdicts from the numbers."""

from __future__ import annotations

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

import servotrack  # noqa: F401
from servotrack.baselines.agents.color.catalog import color_tracker
from servotrack.baselines.agents.color.tuning_grid import EPISODES, GRIDS, tuning_steps
from servotrack.baselines.papers.claims import fill, read_claims
from servotrack.baselines.papers.monte_carlo_color import experiment, report
from servotrack.baselines.papers.monte_carlo_color.experiment import (
    MEAN_SHIFT,
    METHODS,
    ONE_SCALE,
    PAPER,
    PARTICLES,
    PLUS,
    Measures,
    plan,
    run_all,
)
from servotrack.baselines.papers.monte_carlo_color.findings import (
    COMMAND,
    auc_grid,
    findings,
    quality_grid,
    sensitivity_grid,
)
from servotrack.baselines.papers.reproduce import reproduce_paper
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.tuning.color_search import mean_auc, search
from servotrack.envs.track.color.config import PAPER_SCENARIOS

SMALL = {"horizon": 5, "width": 160, "height": 120, "head_height": 30.0}
SECONDS = dict.fromkeys(METHODS, 0.001)
STEPS = {name: np.full(12, 0.001) for name in (PAPER, PARTICLES, MEAN_SHIFT)} | {ONE_SCALE: np.full(12, 0.0004)}


def invented(quality: dict[str, float], films: int = 12) -> dict[str, dict[str, Measures]]:
    """Measures of trackers whose overlap is the same in every frame, with little differences between films."""
    found = {}
    for scenario in PAPER_SCENARIOS:
        found[scenario] = {}
        for name in METHODS:
            level = quality.get(name if name in experiment.TRACKERS else PAPER, 0.4) + 0.002 * np.arange(films)[:, None]
            iou = np.clip(np.broadcast_to(level, (films, 40)), 0.0, 1.0)
            found[scenario][name] = Measures(iou, 30.0 * (1.0 - iou), np.sqrt(iou))
    return found


def test_films_are_kept_and_foreign_ones_refused(tmp_path, monkeypatch) -> None:
    films = [(0, 100_000, (PAPER, MEAN_SHIFT)), (3, 100_001, (PAPER, MEAN_SHIFT))]
    with Progress(disable=True) as progress:
        first = run_all(films, tmp_path, progress, jobs=1, env_kwargs=SMALL)
        monkeypatch.setattr(experiment, "_run", None)
        again = run_all(films, tmp_path, progress, jobs=1, env_kwargs=SMALL)
    assert first.keys() == {"irregular", "scale"}
    measures = first["irregular"][PAPER]
    assert measures.iou.shape == (1, 5)
    assert measures.iou[0, 0] == measures.size[0, 0] == 1.0
    assert np.array_equal(measures.iou, again["irregular"][PAPER].iou)
    with Progress(disable=True) as progress, pytest.raises(ResultsError, match="another setting"):
        run_all(films, tmp_path, progress, jobs=1, env_kwargs={**SMALL, "speed": 1.0})
    (tmp_path / "scale" / "100001.npz").write_bytes(b"no archive")
    with Progress(disable=True) as progress, pytest.raises(ResultsError, match="delete it"):
        run_all(films, tmp_path, progress, jobs=1, env_kwargs=SMALL)


def test_the_plan_gives_slow_trackers_fewer_films_on_test_seeds() -> None:
    films = plan(20)
    assert len(films) == 6 * 20
    # Seed 200000 was looked at while the trackers were made.
    assert {seed for _, seed, _ in films} == set(range(200_001, 200_021))
    assert sum("MIL" in methods for *_, methods in films) == 6 * 2
    assert any("MIL" in methods for *_, methods in plan(1))
    assert all(color_tracker(name, **parameters) for name, parameters in METHODS.values())


def verdicts(quality: dict[str, float], steps: dict[str, np.ndarray] = STEPS) -> dict[str, str]:
    found = invented(quality)
    findings_of = findings(found, found["irregular"], steps)
    return {claim.id: claim.verdict for claim in fill(read_claims(), findings_of, COMMAND)}


def test_verdicts_follow_from_the_numbers() -> None:
    good = verdicts({PAPER: 0.7, PLUS: 0.9, MEAN_SHIFT: 0.5, PARTICLES: 0.5})
    bad = verdicts({PAPER: 0.3, PLUS: 0.4, MEAN_SHIFT: 0.5, PARTICLES: 0.5})
    for claim in (
        "color-irregular", "color-deformation", "color-scale-beats-mean-shift", "color-no-resampling",
        "color-plus-beats-both",
    ):  # fmt: skip
        assert good[claim] == "holds"
        assert bad[claim] == "does not hold"
    # Updating or not makes no difference in invented films, which is within the margin.
    assert good["color-update-light"] == "no difference"
    assert good["color-real-time"] == good["color-mean-shift-scale-cost"] == "holds"
    assert verdicts({}, {name: np.full(12, 0.1) for name in STEPS})["color-real-time"] == "does not hold"


def test_tables_hold_every_tracker_and_every_value() -> None:
    found = invented({})
    assert len(auc_grid(found).rows) == len(quality_grid(found, SECONDS).rows) == 7
    assert len(sensitivity_grid(found).rows) == len(experiment.VARIANTS)
    assert all(len(row) == 8 for row in auc_grid(found).rows)


def test_the_claims_are_on_the_list() -> None:
    ours = {c.id for c in read_claims() if c.paper == "monte_carlo_color" and c.verdict != "not tested"}
    found = invented({})
    assert {claim.id for claim in findings(found, found["irregular"], STEPS)} == ours
    assert all(claim.command in (None, COMMAND) for claim in read_claims() if claim.paper == "monte_carlo_color")


def test_figures_draw() -> None:
    pytest.importorskip("matplotlib")
    from servotrack.baselines.papers.monte_carlo_color.figures import draw_sensitivity, draw_success

    found = invented({PLUS: 0.8})
    assert len(draw_success(found).axes) == 6
    assert len(draw_sensitivity(found).axes) == 3


def test_steps_are_timed_by_film_and_one_scale_is_cheaper() -> None:
    found = experiment.film_steps([100_000, 100_001], repetitions=1)
    assert set(found) == set(STEPS)
    assert all(times.shape == (2,) and (times > 0.0).all() for times in found.values())
    assert (found[ONE_SCALE] < found[MEAN_SHIFT]).all()


def test_tuning_tries_every_value_on_the_same_tune_films(monkeypatch) -> None:
    seen = []

    def on_film(name, settings, level, seed):
        seen.append(seed)
        return [float(setting["scale_mixing"]) for setting in settings]

    monkeypatch.setattr("servotrack.baselines.tuning.color_search._on_film", on_film)
    scores = mean_auc("kernel-mean-shift", [{"scale_mixing": v} for v in (0.1, 0.3)], 2, jobs=1)
    assert scores.shape == (2, 6)
    assert (scores[1] > scores[0]).all()
    assert set(seen) == {100_000, 100_001}
    seen.clear()
    monkeypatch.setitem(GRIDS, "kernel-mean-shift", {"scale_mixing": (0.1, 0.3, 0.2)})
    found = search("kernel-mean-shift", EPISODES, jobs=1)
    assert found["parameters"] == {"scale_mixing": 0.3}
    # What the table of agents says that a search takes is what it takes.
    assert len(seen) * found["trials"] * 200 == tuning_steps("kernel-mean-shift")
    for name, grid in GRIDS.items():
        for parameter, values in grid.items():
            assert all(color_tracker(name, **{parameter: value}) for value in values)


def test_the_report_is_written_and_put_into_a_document(tmp_path, monkeypatch) -> None:
    from matplotlib.figure import Figure

    monkeypatch.setattr(report, "run_all", lambda *_, **__: invented({PLUS: 0.8}))
    monkeypatch.setattr(report, "median_steps", lambda *_: SECONDS)
    monkeypatch.setattr(report, "film_steps", lambda *_: STEPS)
    monkeypatch.setattr(report, "draw_tracked", lambda *_: Figure())
    document = tmp_path / "page.md"
    marks = "<!-- monte_carlo_color:begin -->\nstale\n<!-- monte_carlo_color:end -->"
    document.write_text(f"# Page\n{marks}\n", encoding="utf-8")
    reproduce_paper("monte-carlo-color", tmp_path / "out", 2, Console(quiet=True), into=document)
    page = document.read_text(encoding="utf-8")
    alone = (tmp_path / "out" / "monte_carlo_color.md").read_text(encoding="utf-8")
    assert "stale" not in page
    assert "### AUC by scenario" in page
    assert "\n## AUC by scenario" in alone
    assert {f"{name}.png" for name in ("success", "figure4", "sensitivity")} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }
    filled = {claim.id: claim.verdict for claim in read_claims(tmp_path / "out" / "claims.yaml")}
    assert filled["color-plus-beats-both"] == "holds"
