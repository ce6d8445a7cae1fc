"""The unscented_jacobian experiments that do not depend on tuning, the table of papers, and the claims file."""

from __future__ import annotations

import importlib
import io
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest
from rich.console import Console

from servotrack.baselines.evaluation.statistics import PairedDifference
from servotrack.baselines.papers import reproduce
from servotrack.baselines.papers.claims import Claim, fill, judge_smaller, read_claims, write_claims
from servotrack.baselines.papers.unscented_jacobian import experiment, report
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


def test_the_shipped_claims_can_be_read_and_are_unique() -> None:
    claims = read_claims()
    assert len({claim.id for claim in claims}) == len(claims) >= 8
    assert all(claim.claim and claim.source and claim.paper for claim in claims)


def test_claims_are_filled_in_and_survive_a_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "claims.yaml"
    path.write_text("# A comment that stays.\n- {id: a, paper: unscented_jacobian, source: s, claim: c}\n")
    effect = {"value": -1.0, "low": -2.0, "high": -0.5, "unit": "mm"}
    filled = fill(read_claims(path), [Claim("a", "unscented_jacobian", "", "", "holds", effect, "tuning", "command")])
    write_claims(filled, path)
    assert path.read_text().startswith("# A comment that stays.\n")
    assert read_claims(path) == [Claim("a", "unscented_jacobian", "s", "c", "holds", effect, "tuning", "command")]
    with pytest.raises(ValueError, match="known claims, got b"):
        fill(filled, [Claim("b", "unscented_jacobian", "", "")])


@pytest.mark.parametrize("text", ["- {id: a}", "{", "- {id: a, paper: x, source: s, claim: c, verdict: perhaps}"])
def test_a_damaged_claims_file_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "claims.yaml"
    path.write_text(text)
    with pytest.raises(ResultsError, match=r"claims\.yaml"):
        read_claims(path)


@pytest.mark.parametrize(
    ("low", "high", "verdict"),
    [
        (-2.0, -1.0, "holds"),
        (1.0, 2.0, "does not hold"),
        (-1.0, 1.0, "no difference"),
        (-1e-9, -1e-12, "no difference"),
    ],
)
def test_verdicts_follow_the_interval(low: float, high: float, verdict: str) -> None:
    assert judge_smaller(PairedDifference((low + high) / 2, low, high, 0.5)) == verdict


def test_reproduction_fills_every_claim_of_its_paper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "AUDITED_EPISODES", 3)
    monkeypatch.setattr(report, "KAPPAS", (0.0,))
    output = io.StringIO()
    reproduce.reproduce_paper("unscented_jacobian", tmp_path, 1, Console(file=output, width=170))
    claims = {claim.id: claim for claim in read_claims(tmp_path / "claims.yaml") if claim.paper == "unscented_jacobian"}
    assert claims and all(claim.verdict != "open" and claim.command for claim in claims.values())
    assert claims["servo-ukf-beats-kf"].verdict == "no difference"
    assert claims["servo-ukf-as-printed-beats-kf"].verdict == "holds"
    text = (tmp_path / "unscented_jacobian.md").read_text()
    assert "0.0117" in text and "Table 1" in text and "Assumed" in text
    assert {path.name for path in tmp_path.glob("figure*")} == {
        "figure3.png", "figure3.svg", "figure4.png", "figure4.svg",
    }  # fmt: skip


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
        assert paper.name == "transfer" or (paper.name in module.split(".") and paper.name in claimed)
    assert {claim.command for claim in read_claims() if claim.command} <= {p.command for p in reproduce.PAPERS.values()}


def test_the_help_names_every_paper() -> None:
    text = get_type_hints(reproduce_command, include_extras=True)["paper"].__metadata__[0].help
    assert all(f"`{paper.name}`: {paper.summary}" in text for paper in reproduce.PAPERS.values())
