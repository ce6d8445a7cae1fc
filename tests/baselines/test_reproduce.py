"""The unscented_jacobian experiments that do not depend on tuning, the table of papers, and the claims file."""

from __future__ import annotations

import importlib
import io
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from rich.console import Console

from servotrack.baselines.papers import audit, reproduce
from servotrack.baselines.papers.boxes import Effect, Point, Rule, judge_box, read_assumptions, summarize_box
from servotrack.baselines.papers.claims import Claim, Finding, box_grids, claims_grid, fill, read_claims, write_claims
from servotrack.baselines.papers.unscented_jacobian import box, experiment, report
from servotrack.baselines.reporting.files import ResultsError
from servotrack.commands.papers import reproduce as reproduce_command

SEED = 100_000


def test_open_loop_the_unscented_filter_is_the_kalman_filter() -> None:
    differences = experiment.open_loop_difference((-5.0, 0.0, 3.0), SEED, steps=300)
    assert set(differences) == {-5.0, 0.0, 3.0}
    assert all(difference < 1e-12 for difference in differences.values())


def test_closed_loop_the_two_take_the_same_path() -> None:
    assert experiment.closed_loop_difference(SEED, steps=150) < 1e-8


def test_the_experiment_would_see_a_difference() -> None:
    honest, printed = (
        experiment.run(experiment.TRACKING, experiment.estimator(name), SEED) for name in ("UKF", "UKF as printed")
    )
    assert np.abs(honest.tool - printed.tool).max() > 1e-3


def test_the_initial_jacobian_is_the_analytic_one() -> None:
    found = np.array(experiment.initial_jacobian(experiment.POSITIONING, experiment.WORLD, SEED))
    # -alpha F R(theta1 + theta2)^T S [p_target, p_target - p_elbow]: target at (0.6, 0.6) m, elbow at (0.5, 0) m.
    expected = 160.0 / 0.35 * np.array([[-0.6, -0.1], [0.6, 0.6]])
    assert np.allclose(found[:, :2], expected, rtol=0.03, atol=8.0)
    assert np.array_equal(found[:, 2], [0.0, 0.0])


def test_positioning_arrives_and_stays() -> None:
    run = experiment.run(experiment.POSITIONING, experiment.estimator("UKF"), SEED)
    assert run.arrival < 1.0
    assert run.error[-1] < 1e-3
    assert run.tool.shape == run.target.shape == (run.error.size + 1, 2)


def test_an_unknown_algorithm_is_refused() -> None:
    with pytest.raises(ValueError, match="got 'EKF'"):
        experiment.estimator("EKF")


def effect(low: float, high: float, runs: int = 20) -> Effect:
    return Effect((low + high) / 2.0, low, high, "mm", "error", runs)


def test_the_shipped_claims_say_whose_they_are_and_what_the_paper_leaves_open() -> None:
    claims = read_claims()
    assert len({claim.id for claim in claims}) == len(claims) >= 90
    assert all(claim.claim and claim.source and claim.paper for claim in claims)
    known = read_assumptions()
    assert all(name in known[claim.paper] for claim in claims for name in claim.open)
    # What is not tested says why, and what is tested says when it holds.
    assert all(claim.finding if claim.verdict == "not tested" else claim.holds_if for claim in claims)
    assert {assumption for found in known.values() for assumption in found} <= {
        name for claim in claims for name in claim.open
    }
    # A question of the project is in no reading, everything else in one of them.
    assert all(bool(claim.listed_by) == (claim.whose != "project") for claim in claims)
    assert all(assumption.listed_by for found in known.values() for assumption in found.values())


def test_claims_are_filled_in_and_survive_a_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "claims.yaml"
    row = "{id: a, paper: unscented_jacobian, whose: paper, source: s, claim: c, open: [gain, window], "
    path.write_text(f"# A comment that stays.\n- {row} holds_if: {{below: 0.0}}}}\n")
    points = tuple(Point({"window": w}, (effect(-2.0, -0.5),)) for w in ("first period", "after 3 s"))
    filled = fill(read_claims(path), [Finding("a", (effect(-2.0, -0.5),), "tuning", points)], "command")
    write_claims(filled, path)
    assert path.read_text().startswith("# A comment that stays.\n")
    (claim,) = read_claims(path)
    assert claim == filled[0]
    assert (claim.verdict, claim.agreement, claim.command) == ("holds", "2 of 2", "command")
    assert claim.box is not None and claim.box["by"] == {"window": {"first period": 1.0, "after 3 s": 1.0}}
    with pytest.raises(ValueError, match="known claims, got b"):
        fill(filled, [Finding("b", (), "")], "command")
    path.write_text(path.read_text().replace("verdict: holds", "verdict: does not hold"))
    with pytest.raises(ResultsError, match="must be 'holds' by its effects and box"):
        read_claims(path)
    # Results that are about to be replaced need not fit.
    assert read_claims(path, {"a"}) == [
        replace(claim, verdict="open", effects=(), box=None, finding=None, command=None)
    ]


HEAD = "id: a, paper: unscented_jacobian, whose: paper, source: s, claim: c"


@pytest.mark.parametrize(
    "text",
    [
        "- {id: a}",
        "{",
        f"- {{{HEAD}, verdict: perhaps, holds_if: {{below: 0.0}}}}",
        f"- {{{HEAD}}}",
        f"- {{{HEAD}, holds_if: {{below: 0.0, above: 1.0}}}}",
        f"- {{{HEAD}, holds_if: {{below: 0.0}}, open: [weather]}}",
        f"- {{{HEAD.replace('whose: paper', 'whose: nobody')}, holds_if: {{below: 0.0}}}}",
        f"- {{{HEAD}, verdict: not tested}}",
        f"- {{{HEAD}, verdict: not tested, finding: f, listed_by: [third]}}",
        f"- {{{HEAD}, verdict: not tested, finding: f, listed_by: [second], mended: m}}",
        f"- {{{HEAD.replace('whose: paper', 'whose: project')}, verdict: not tested, finding: f, listed_by: [first]}}",
        f"- {{{HEAD}, holds_if: {{below: 0.0}}, effects: "
        "[{value: 1.0, low: 2.0, high: 3.0, unit: m, measured: x, runs: 20}]}",
        # One run decides nothing, whatever its interval.
        f"- {{{HEAD}, holds_if: {{below: 0.0}}, verdict: holds, effects: "
        "[{value: -1.0, low: -1.0, high: -1.0, unit: m, measured: x, runs: 1}]}",
        # Without its box a claim with open assumptions is not decided.
        f"- {{{HEAD}, holds_if: {{below: 0.0}}, open: [window], verdict: holds, effects: "
        "[{value: -1.0, low: -1.5, high: -0.5, unit: m, measured: x, runs: 20}]}",
    ],
)
def test_a_damaged_claims_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "claims.yaml"
    path.write_text(text)
    with pytest.raises(ResultsError, match=r"claims\.yaml"):
        read_claims(path)


@pytest.mark.parametrize(
    ("rule", "low", "high", "runs", "verdict"),
    [
        (Rule(below=0.0), -2.0, -1.0, 20, "holds"),
        (Rule(below=0.0), 1.0, 2.0, 20, "does not hold"),
        (Rule(below=0.0), -1.0, 1.0, 20, "open"),
        (Rule(below=0.0), -2.0, -1.0, 9, "open"),
        (Rule(below=0.0, margin=0.5), -0.4, 0.3, 20, "no difference"),
        (Rule(below=0.0, margin=0.5), -0.4, -0.3, 20, "no difference"),
        (Rule(above=0.9), 0.91, 0.99, 20, "holds"),
        (Rule(above=0.9), 0.2, 0.89, 20, "does not hold"),
        (Rule(within=0.1), -0.05, 0.09, 20, "holds"),
        (Rule(within=0.1), -0.2, 0.09, 20, "open"),
        (Rule(within=0.1), 0.11, 0.2, 20, "does not hold"),
    ],
)
def test_verdicts_follow_the_interval(rule: Rule, low: float, high: float, runs: int, verdict: str) -> None:
    assert rule.judge(effect(low, high, runs)) == verdict


def test_a_verdict_holds_only_if_the_whole_box_agrees() -> None:
    rule = Rule(below=0.0)
    signs = {("a", 1): -1.0, ("a", 2): -1.0, ("b", 1): -1.0, ("b", 2): 1.0}

    def points(signs: dict[tuple[str, int], float], width: float = 0.5) -> list[Point]:
        return [
            Point({"kind": kind, "size": size}, (effect(sign - width, sign + width),))
            for (kind, size), sign in signs.items()
        ]

    summary, reasons = summarize_box("holds", points(signs), rule)
    assert (summary["points"], summary["share"], summary["runs"]) == (4, 0.75, 20)
    assert summary["verdicts"] == {"does not hold": 1, "holds": 3}
    assert summary["by"] == {"kind": {"a": 1.0, "b": 0.5}, "size": {"1": 1.0, "2": 0.5}}
    assert sorted(reasons) == ["kind", "size"]
    assert judge_box("holds", summary) == "depends"
    agreeing = points(dict.fromkeys(signs, -1.0))
    assert judge_box("holds", summarize_box("holds", agreeing, rule)[0]) == "holds"
    # Points that too wide intervals leave open are no dependence, but no agreement either.
    wide = [*agreeing[1:], Point({"kind": "b", "size": 2}, (effect(-3.0, 1.0),))]
    assert judge_box("holds", summarize_box("holds", wide, rule)[0]) == "open"
    # Where only the kind matters, only the kind is named.
    by_kind = {key: (1.0 if key[0] == "b" else -1.0) for key in signs}
    assert summarize_box("holds", points(by_kind), rule)[1] == ["kind"]
    with pytest.raises(ValueError, match="must be 'depends'"):
        Claim("a", "p", "paper", "s", "c", ("kind",), rule, "holds", (), (effect(-2.0, -1.0),), summary)


def test_tables_show_whose_claim_it_is_the_share_of_the_box_and_every_point() -> None:
    rule = Rule(below=0.0, margin=0.1)
    points = tuple(
        Point({"window": w}, (effect(low, low + 1.0),)) for w, low in (("first period", -2.0), ("after 3 s", 0.5))
    )
    open_one = Claim("a", "unscented_jacobian", "project", "table 2", "c", ("window",), rule)
    finding = Finding("a", (effect(-2.0, -1.0),), "tuning", points)
    (claim,) = fill([open_one], [finding], "command")
    assert (claim.verdict, claim.depends_on) == ("depends", ("window",))
    (row,) = claims_grid([claim]).rows
    assert row[1:4] == ["project: table 2", "depends on window", "1 of 2"]
    assert row[5] == "< 0, none within ±0.1"
    ((title, grid),) = box_grids([claim], [finding]).items()
    assert title == "The box of window"
    assert grid.rows == [["first period", "+ -1.5 [-2, -1]"], ["after 3 s", "− 1 [0.5, 1.5]"]]


def test_the_audit_counts_all_claims_and_names_what_they_depend_on(tmp_path: Path) -> None:
    output = io.StringIO()
    reproduce.reproduce_paper("audit", tmp_path, None, Console(file=output, width=250))
    claims = read_claims()
    last = audit.verdicts_grid(claims).rows[-1]
    assert sum(map(int, last[2:])) == len(claims)
    dependents = [claim for claim in claims if claim.verdict == "depends"]
    assert len(audit.dependents_grid(claims).rows) == len(dependents)
    text = (tmp_path / "audit.md").read_text().replace("\\", "")
    assert all(claim.depends_on[0] in text for claim in dependents)
    read = [claim for claim in claims if claim.listed_by]
    counts = {tuple(row[:2]): list(map(int, row[2:])) for row in audit.readings_grid(claims, []).rows}
    assert sum(counts["claims", "all"]) == len(read)
    assert counts["claims", "all"][1:] == [
        sum(claim.listed_by == (one,) for claim in read) for one in ("first", "second")
    ]
    assert len(audit.single_readings_grid(claims).rows) == sum(counts["claims", "all"][1:])
    assert all(claim.mended in text for claim in claims if claim.mended)
    assert len(audit.untested_grid(claims).rows) == sum(claim.verdict == "not tested" for claim in claims)


def test_reproduction_fills_every_claim_of_its_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "AUDITED_EPISODES", 3)
    monkeypatch.setattr(report, "KAPPAS", (0.0,))
    monkeypatch.setattr(box, "EPISODES", 1)
    monkeypatch.setattr(report, "Box", lambda folder, progress: box.Box(folder, progress, 1))
    output = io.StringIO()
    reproduce.reproduce_paper("unscented_jacobian", tmp_path, 1, Console(file=output, width=170))
    claims = {claim.id: claim for claim in read_claims(tmp_path / "claims.yaml") if claim.paper == "unscented_jacobian"}
    tested = [claim for claim in claims.values() if claim.verdict != "not tested"]
    assert len(tested) >= 14 and all(claim.effects and claim.command for claim in tested)
    # One run decides nothing, whatever it shows.
    assert {claim.verdict for claim in tested} == {"open"}
    printed = claims["servo-ukf-as-printed-beats-kf"]
    assert printed.effects[0].runs == 3 and printed.effects[0].high < -1.0
    assert printed.box is not None and printed.box["points"] == 36
    text = (tmp_path / "unscented_jacobian.md").read_text()
    assert "0.0117" in text and "Table 1" in text and "Assumed" in text and "The box of" in text
    assert {path.name for path in tmp_path.glob("figure*")} == {
        "figure3.png", "figure3.svg", "figure4.png", "figure4.svg",
    }  # fmt: skip


def test_an_online_estimate_and_a_learned_jacobian_arrive_alike_at_rest() -> None:
    found = box._at_rest(SEED)
    assert found["KF/end"] < 1e-3 and found["fixed/end"] < 1e-3
    assert abs(found["KF"] - found["fixed"]) < 1e-3


def test_jacobians_are_compared_on_one_stream() -> None:
    world = {**box.RANDOM_ELLIPSES, "horizon": 60}
    errors = experiment.jacobian_errors(("KF", "UKF", "UKF as printed"), experiment.Variances(), SEED, world)
    assert np.allclose(errors["KF"], errors["UKF"], rtol=1e-9)
    assert (errors["UKF as printed"] < errors["KF"]).all()


def test_papers_are_found_by_folder_with_hyphens_and_by_their_old_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce.find_paper("gm-phd-video").name == "gm_phd_video"
    assert capsys.readouterr().err == ""
    for old, new in reproduce.OLD_NAMES.items():
        assert reproduce.find_paper(old) == reproduce.PAPERS[new]
        assert capsys.readouterr().err == f"servotrack: {old!r} is now called {new!r}\n"
    with pytest.raises(ValueError, match=r"got 'sonr'; did you mean 'hmm_sonar'\?"):
        reproduce.find_paper("sonr")


def test_every_paper_has_a_folder_a_reproduction_and_claims() -> None:
    claimed = {claim.paper for claim in read_claims()}
    for paper in reproduce.PAPERS.values():
        module, _, function = paper.run.partition(":")
        assert callable(getattr(importlib.import_module(module), function))
        named = paper.name in module.split(".") and paper.name in claimed
        assert named or paper.name in ("transfer", "audit", "hmm_sonar_readings", "gm_phd_video_readings")
    assert {claim.command for claim in read_claims() if claim.command} <= {p.command for p in reproduce.PAPERS.values()}


def test_the_help_names_every_paper() -> None:
    text = get_type_hints(reproduce_command, include_extras=True)["paper"].__metadata__[0].help
    assert all(f"`{paper.name}`: {paper.summary}" in text for paper in reproduce.PAPERS.values())
