"""Paper 002: the experiments that do not hang on tuning, and the claims file."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from servotrack.baselines.evaluation.results import ResultsError
from servotrack.baselines.evaluation.statistics import PairedDifference
from servotrack.baselines.papers import reproduce
from servotrack.baselines.papers.claims import Claim, fill, judge_smaller, read_claims, write_claims
from servotrack.baselines.papers.unscented_jacobian import experiment as paper002
from servotrack.baselines.papers.unscented_jacobian import report

SEED = 100_000


def test_open_loop_the_unscented_filter_is_the_kalman_filter() -> None:
    differences = paper002.open_loop_difference((-5.0, 0.0, 3.0), SEED, steps=300)
    assert set(differences) == {-5.0, 0.0, 3.0}
    assert all(difference < 1e-12 for difference in differences.values())


def test_closed_loop_the_two_take_the_same_path() -> None:
    assert paper002.closed_loop_difference(SEED, steps=150) < 1e-8


def test_the_experiment_would_see_a_difference() -> None:
    honest, printed = (
        paper002.run(paper002.TRACKING, paper002.estimator(name), SEED) for name in ("UKF", "UKF as printed")
    )
    assert np.abs(honest.tool - printed.tool).max() > 1e-3


def test_the_initial_jacobian_is_the_analytic_one() -> None:
    found = np.array(paper002.initial_jacobian(paper002.POSITIONING, paper002.WORLD, SEED))
    # -alpha F R(theta1 + theta2)^T S [p_target, p_target - p_elbow]: target at (0.6, 0.6) m, elbow at (0.5, 0) m.
    expected = 160.0 / 0.35 * np.array([[-0.6, -0.1], [0.6, 0.6]])
    assert np.allclose(found[:, :2], expected, rtol=0.03, atol=8.0)
    assert np.array_equal(found[:, 2], [0.0, 0.0])


def test_positioning_arrives_and_stays() -> None:
    run = paper002.run(paper002.POSITIONING, paper002.estimator("UKF"), SEED)
    assert run.arrival < 1.0
    assert run.error[-1] < 1e-3
    assert run.tool.shape == run.target.shape == (run.error.size + 1, 2)


def test_an_unknown_algorithm_is_refused() -> None:
    with pytest.raises(ValueError, match="got 'EKF'"):
        paper002.estimator("EKF")


def test_the_shipped_claims_can_be_read_and_are_unique() -> None:
    claims = read_claims()
    assert len({claim.id for claim in claims}) == len(claims) >= 8
    assert all(claim.claim and claim.source and claim.paper for claim in claims)


def test_claims_are_filled_in_and_survive_a_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "claims.yaml"
    path.write_text("# A comment that stays.\n- {id: a, paper: '002', source: s, claim: c}\n")
    effect = {"value": -1.0, "low": -2.0, "high": -0.5, "unit": "mm"}
    filled = fill(read_claims(path), [Claim("a", "002", "", "", "holds", effect, "tuning", "command")])
    write_claims(filled, path)
    assert path.read_text().startswith("# A comment that stays.\n")
    assert read_claims(path) == [Claim("a", "002", "s", "c", "holds", effect, "tuning", "command")]
    with pytest.raises(ValueError, match="known claims, got b"):
        fill(filled, [Claim("b", "002", "", "")])


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
    reproduce.reproduce_paper("servo", tmp_path, 1, Console(file=output, width=170))
    claims = {claim.id: claim for claim in read_claims(tmp_path / "claims.yaml") if claim.paper == "002"}
    assert claims and all(claim.verdict != "open" and claim.command for claim in claims.values())
    assert claims["servo-ukf-beats-kf"].verdict == "no difference"
    assert claims["servo-ukf-as-printed-beats-kf"].verdict == "holds"
    text = (tmp_path / "paper002.md").read_text()
    assert "0.0117" in text and "Table 1" in text and "Assumed" in text
    assert {path.name for path in tmp_path.glob("figure*")} == {
        "figure3.png", "figure3.svg", "figure4.png", "figure4.svg",
    }  # fmt: skip
