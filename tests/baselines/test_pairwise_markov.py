"""The pairwise_markov experiment: scans of the environment, resuming, foreign files, and the expected ordering."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from rich.progress import Progress

import servotrack  # noqa: F401
from servotrack.baselines.papers.claims import read_claims
from servotrack.baselines.papers.pairwise_markov.experiment import (
    METHODS,
    PAPER_METHODS,
    Condition,
    Measures,
    draw_runs,
    run_condition,
    time_steps,
)
from servotrack.baselines.papers.pairwise_markov.findings import BOXED, PAPER_NAME, compared
from servotrack.baselines.papers.pairwise_markov.plan import (
    all_conditions,
    box_conditions,
    excess,
    recovery,
    run_means,
    shares,
)
from servotrack.baselines.papers.pairwise_markov.runs import run_all
from servotrack.baselines.reporting.files import ResultsError
from servotrack.estimators.metrics import ospa

SHORT = {"horizon": 30}
SEEDS = [100_000, 100_001, 100_002]


def test_runs_are_the_environments_episodes() -> None:
    condition = Condition("x", (), SHORT)
    env = gym.make("ClutterTracking-v0", **SHORT)
    for seed, episode in zip(SEEDS, draw_runs(condition.config, SEEDS), strict=True):
        scan, info = env.reset(seed=seed)
        assert np.array_equal(scan, episode.measurements[0])
        assert np.array_equal(info["truth"]["states"], episode.states[0])


def test_measures_are_what_the_metrics_say() -> None:
    condition = Condition("x", ("PMB-PMM",), SHORT, trajectories=True)
    together = run_condition(condition, SEEDS)["PMB-PMM"]
    alone = run_condition(condition, SEEDS[1:2])["PMB-PMM"]
    for whole, part in zip(together, alone, strict=True):
        assert np.array_equal(whole[1:2], part)
    assert together.ospa.shape == (3, 30)
    assert (together.ospa_narrow <= together.ospa + 1e-12).all()
    assert (together.trajectory_gospa > 0).all()
    assert ospa(np.zeros((1, 2)), np.zeros((0, 2)), 100.0) == 100.0 >= together.ospa.max()


def test_a_second_call_reads_what_the_first_one_kept(tmp_path, monkeypatch) -> None:
    condition = Condition("x", ("PHD-HMM",), SHORT)
    with Progress(disable=True) as progress:
        first = run_all([(condition, SEEDS)], tmp_path, progress, jobs=1)
        monkeypatch.setattr("servotrack.baselines.papers.pairwise_markov.runs._run_chunk", None)
        second = run_all([(condition, SEEDS)], tmp_path, progress, jobs=1)
    assert np.array_equal(first["x"]["PHD-HMM"].ospa, second["x"]["PHD-HMM"].ospa)
    other = Condition("x", ("PHD-HMM",), {**SHORT, "clutter_rate": 3.0})
    with Progress(disable=True) as progress, pytest.raises(ResultsError, match="another setting"):
        run_all([(other, SEEDS)], tmp_path, progress, jobs=1)
    next(tmp_path.glob("*/*.npz")).write_bytes(b"no archive")
    with Progress(disable=True) as progress, pytest.raises(ResultsError, match="delete it"):
        run_all([(condition, SEEDS)], tmp_path, progress, jobs=1)


def test_pairwise_models_gain_on_pairwise_data_and_pmb_beats_them_all() -> None:
    seeds = list(range(100_000, 100_012))
    found = run_condition(Condition("x", ("CBMeMBer-HMM", "CBMeMBer-PMM", "PMB-HMM", "PMB-PMM"), {}), seeds)
    for family in ("CBMeMBer", "PMB"):
        gain = run_means(found[f"{family}-HMM"]) - run_means(found[f"{family}-PMM"])
        assert gain.mean() > 3 * gain.std(ddof=1) / np.sqrt(len(gain))
    assert run_means(found["PMB-PMM"]).mean() < 2.3
    assert run_means(found["PMB-PMM"]).mean() < run_means(found["CBMeMBer-PMM"]).mean()
    assert abs(excess(found["PMB-PMM"], "expected").mean()) < 0.3


def test_conditions_have_names_of_their_own_and_known_methods() -> None:
    conditions = [condition for _, condition in all_conditions()]
    assert len({condition.name for condition in conditions}) == len(conditions)
    assert {name for condition in conditions for name in condition.methods} <= METHODS.keys()
    assert shares(500) == {"all": 500, "part": 100, "few": 50, "box": 25}
    # Structures without a covariance at the largest noise lack, all others are there at every p_D.
    assert len(box_conditions()) == 4 * (3 * 2 + 3 * 3)
    assert min(shares(1).values()) >= 1


def test_steps_are_timed_without_the_run_that_compiles() -> None:
    found = time_steps(["PHD-HMM"], Condition("x", (), SHORT), SEEDS)
    assert found["PHD-HMM"].shape == (2,)
    assert (found["PHD-HMM"] > 0).all()


def test_the_claims_are_on_the_list() -> None:
    tested = [claim for claim in read_claims() if claim.paper == PAPER_NAME and claim.verdict != "not tested"]
    assert len(tested) == 11 and set(BOXED) < {claim.id for claim in tested}


def test_recovery_is_the_mean_length_of_wrong_spells() -> None:
    nothing = np.zeros((3, 6))
    number = np.array([[2, 1, 1, 2, 3, 2], [2, 2, 2, 2, 2, 2], [1, 2, 2, 2, 2, 1]], float)
    measures = Measures(*[nothing] * 4, number, nothing, np.zeros(3), np.zeros(3))
    # Spells of two scans and of one; none; one at either end.
    assert recovery(measures, np.full(6, 2.0)).tolist() == [1.5, 1.0]


def test_effects_of_one_condition_are_those_of_the_claims() -> None:
    condition = Condition("x", (*PAPER_METHODS, "PMB-PMM"), {})
    seeds = list(range(100_000, 100_010))
    found = run_condition(condition, seeds)
    true = draw_runs(condition.config, seeds[:1])[0].exists[:-1].sum(axis=1)
    effects = compared(found, true, "clutter 20")
    assert set(BOXED.values()) == set(effects._fields)
    assert all(effect.runs <= 10 for group in effects for effect in group)
    expected = run_means(found["PHD-PMM"]) - run_means(found["PHD-HMM"])
    assert effects.models[0].value == pytest.approx(expected.mean(), rel=1e-2)
    assert all(effect.high < 0.0 for effect in effects.pmb)
