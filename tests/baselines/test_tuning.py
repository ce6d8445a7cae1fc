"""The tuning protocol: the search, its count of steps, its seeds, its record, and the record that is shipped."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from servotrack.baselines.agents.hyper_parameters import value_at, with_values
from servotrack.baselines.agents.registry import AGENTS, agent_card
from servotrack.baselines.agents.servo.catalog import ESTIMATORS
from servotrack.baselines.agents.servo.tuning_grid import BORROWED, GRIDS, UNSTAMPED_GRIDS, UNTUNED
from servotrack.baselines.agents.tuning_record import SHIPPED, SHIPPED_UNSTAMPED, TunedAgent, TuningRecord, read_record
from servotrack.baselines.evaluation.evaluate import run_episodes
from servotrack.baselines.evaluation.seeds import TUNE
from servotrack.baselines.reporting.files import ResultsError
from servotrack.baselines.tuning import search as tuning
from servotrack.baselines.tuning.families import FAMILIES, TuningFamily, family_of
from servotrack.baselines.tuning.search import (
    Measured,
    TuningProtocol,
    coordinate_search,
    default_protocol,
    default_values,
    measure,
    tune,
)
from servotrack.baselines.tuning.table import markdown_tuning
from servotrack.baselines.worlds import WORLDS, kind_of_id

TOY = {"x": (0.0, 1.0, 2.0, 3.0), "y": (-1.0, 0.0, 1.0)}
SHORT = TuningProtocol(levels=(0, 1), seeds=(100_500, 100_501))


def bowl(values: dict[str, float]) -> Measured:
    """Least at x = 2, y = x - 1; the episodes differ from each other far more than the settings do."""
    offset = np.random.default_rng(0).normal(0.0, 100.0, 30)
    return Measured(offset + (values["x"] - 2.0) ** 2 + 0.9 * (values["y"] - values["x"] + 1.0) ** 2, 7)


def test_search_finds_the_optimum_and_measures_nothing_twice() -> None:
    asked: list[dict[str, float]] = []

    def evaluate(values: dict[str, float]) -> Measured:
        asked.append(values)
        return bowl(values)

    found = coordinate_search(evaluate, {"x": 0.0, "y": -1.0}, TOY, passes=5)
    assert found.chosen == {"x": 2.0, "y": 1.0}
    assert len({tuple(values.values()) for values in asked}) == len(asked) == len(found.candidates)
    assert found.environment_steps == 7 * len(asked)
    assert found.candidates[0].difference is None and found.candidates[0].values == found.start


def test_a_pass_without_a_change_is_the_last() -> None:
    found = coordinate_search(bowl, {"x": 2.0, "y": 1.0}, TOY, passes=9)
    assert found.chosen == found.start
    assert len(found.candidates) == tuning.candidate_count(TOY) == 6


def test_noise_and_gains_of_nothing_change_no_default() -> None:
    rng = np.random.default_rng(1)
    noise = {x: rng.normal(0.0, 1.0, 96) for x in TOY["x"]}
    grid = {"x": TOY["x"]}
    assert coordinate_search(lambda v: Measured(noise[v["x"]], 1), {"x": 1.0}, grid).chosen == {"x": 1.0}
    slope = {"x": 1.0}, grid
    assert coordinate_search(lambda v: Measured(np.full(9, -0.001 * v["x"]), 1), *slope).chosen == {"x": 1.0}
    assert coordinate_search(lambda v: Measured(np.full(9, -0.1 * v["x"]), 1), *slope).chosen == {"x": 3.0}


def test_a_start_off_the_grid_is_refused() -> None:
    with pytest.raises(ValueError, match=r"start must be on the grid, x = 0.5 is not"):
        coordinate_search(bowl, {"x": 0.5, "y": 0.0}, TOY)


def test_steps_are_those_that_the_episodes_took() -> None:
    values = {"rate": 1.0, "time_weight": 0.5, "damping": 0.0015}
    measured = measure("broyden", values, SHORT)
    rows = [
        row
        for level in SHORT.levels
        for row in run_episodes(SHORT.env_id, agent_card("broyden"), SHORT.seeds, {"level": level})[0]
    ]
    costs = [np.log(row["steady"]) + 3.0 * (not row["success"]) for row in rows]
    default = measure("broyden", default_values("broyden"), SHORT)
    assert np.array_equal(default.costs, costs)
    assert default.steps == sum(row["length"] for row in rows)
    assert not np.array_equal(measured.costs, default.costs), "the values did not reach the estimator"


@pytest.mark.parametrize("seeds", [(200_000,), (99_999, 100_000), (), (100_000, 100_000)])
def test_seeds_outside_the_tune_range_are_refused(seeds: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="seeds must be different ones, at least one, of the tune range"):
        TuningProtocol(seeds=seeds)


def test_no_episode_has_a_seed_outside_the_tune_range(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    used: set[int] = set()

    def spy(env_id: str, card: Any, seeds: Any, kwargs: Any) -> Any:
        used.update(seeds)
        return [{"seed": s, "steady": 0.01, "success": True, "length": 5} for s in seeds], 5

    monkeypatch.setattr(tuning, "run_episodes", spy)
    record = tune(["rls"], tmp_path / "tuning.json", TuningProtocol())
    assert used and all(seed in TUNE for seed in used)
    settings = tuning.candidate_count(GRIDS["rls"])
    assert record.agents["rls"].environment_steps == 5 * settings * 16 * 6


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Instead of episodes, a cost that does not depend on the values; the list tells who was measured."""
    calls: list[str] = []

    def fake(agent: str, values: dict[str, float], protocol: TuningProtocol) -> Measured:
        calls.append(agent)
        return Measured(np.zeros(4), 10)

    monkeypatch.setattr(tuning, "measure", fake)
    return calls


def test_finished_agents_are_not_searched_again(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "tuning.json"
    first = tune(["student-t-kf"], path, SHORT)
    assert quick == ["student-t-kf"] * 5
    both = tune(["student-t-kf", "correntropy-kf"], path, SHORT)
    assert quick[5:] == ["correntropy-kf"] * 5
    assert both == read_record(path) and both.agents["student-t-kf"] == first.agents["student-t-kf"]


def test_a_killed_search_keeps_the_agents_before_it(
    quick: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "tuning.json"

    def killed() -> None:
        if quick[-1] == "correntropy-kf":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(["student-t-kf", "correntropy-kf"], path, SHORT, on_candidate=killed)
    assert list(read_record(path).agents) == ["student-t-kf"]
    assert [file.name for file in tmp_path.glob("[!.]*")] == ["tuning.json"]


def test_borrowed_values_are_counted_and_unknown_ones_unknown(quick: list[str], tmp_path: Path) -> None:
    record = tune(["kf", "student-t-kf"], tmp_path / "tuning.json", SHORT)
    kf = 10 * tuning.candidate_count(GRIDS["kf"])
    expected = {"kf": kf, "ukf": kf, "latency-bank-kf": kf, "student-t-kf": kf + 50, "random": 0, "oracle": 0}
    expected |= {"broyden": None, "lifted-kf-swinging": None, "correntropy-kf": None, "mine:Agent": None}
    assert {name: record.tuning_steps(name) for name in expected} == expected


def test_two_processes_keep_each_other_s_agents(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "tuning.json"
    mine = tune(["student-t-kf"], path, SHORT)
    other = TuningRecord(mine.protocol, {"kf": mine.agents["student-t-kf"]})
    other.save(path)
    assert list(read_record(path).agents) == ["student-t-kf", "kf"] == list(other.agents)


def test_a_record_of_another_kind_is_refused_by_name(quick: list[str], tmp_path: Path) -> None:
    path = tmp_path / "tuning.json"
    tune(["student-t-kf"], path, SHORT)
    good = path.read_text()
    document = json.loads(good)

    def refused(text: str, message: str) -> None:
        path.write_text(text)
        with pytest.raises(ResultsError, match=message) as caught:
            tune(["student-t-kf"], path, SHORT)
        assert str(path) in str(caught.value)
        assert path.read_text() == text

    def changed(**fields: Any) -> str:
        return json.dumps({**document, "agents": {"student-t-kf": {**document["agents"]["student-t-kf"], **fields}}})

    refused(good[:-40], "is corrupt")
    refused("[]", "is no record of a tuning")
    refused(json.dumps({**document, "format_version": 99}), "format version 99")
    refused(changed(environment_steps=1), "environment_steps 1, but 50 by candidate")
    refused(changed(candidates=None), "is corrupt")
    refused(changed(chosen={"outliers.degrees_of_freedom": 3.0}), "was never measured")
    refused(changed(grid={"outliers.degrees_of_freedom": [4.0]}), "another grid")
    other = {**document["agents"]["student-t-kf"]["provenance"], "versions": {"servotrack": "0.0.0"}}
    refused(changed(provenance=other), "tuned with servotrack 0.0.0")
    refused(changed(provenance={**other, "versions": None}), "no versions")
    refused(changed(grid={"outliers.degrees_of_freedom": 4.0}), "a list per hyper-parameter")
    first = {**document["agents"]["student-t-kf"]["candidates"][0]}
    for field, value in (("objective", "low"), ("environment_steps", 1e9), ("values", {"outliers": []})):
        refused(changed(candidates=[{**first, field: value}]), "must be")
    refused(good.replace('"agents"', '"protocol": {}, "agents"'), "'protocol' appears twice")
    refused(good.replace("objective", "objective\\ud800", 1), "surrogates")
    path.write_text(good)
    with pytest.raises(ResultsError, match=r"another protocol \(different: seeds\)"):
        tune(["student-t-kf"], path, TuningProtocol(levels=(0, 1)))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["kff"], "did you mean 'kf'"),
        (["ukf"], "it uses the values of kf"),
        (["oracle"], "nothing of it can be tuned"),
        (["smc-phd"], "nothing of it can be tuned"),
        (["pmb-hmm"], "it uses the values of pmb"),
        (["phd-servo-told-jacobian"], "it uses the values of phd-servo"),
        (["pmb", "--env", "UncalibServo-v0"], "must be ClutterTracking-v0 or PedestrianTracking-v0 for agent 'pmb'"),
        (["kf", "pmb"], "run `servotrack tune` once for each environment"),
        (["kf", "--output", "bad.json"], "bad.json is corrupt"),
        (["kf", "-n", "99999"], "first + count at most"),
    ],
)
def test_the_command_explains_a_mistake_in_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from servotrack.__main__ import main

    (tmp_path / "bad.json").write_text("{")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["servotrack", "tune", *arguments])
    monkeypatch.setattr(sys, "path", sys.path[:])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error


def test_the_command_writes_record_and_table(
    quick: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from servotrack.__main__ import main

    document = tmp_path / "doc.md"
    document.write_text("before\n<!-- tuning:begin -->\n<!-- tuning:end -->\nafter\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["servotrack", "tune", "broyden", "-o", "t.json", "-n", "2", "--into", "doc.md"])
    monkeypatch.setattr(sys, "path", sys.path[:])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 0
    assert read_record(tmp_path / "t.json").protocol["seeds"] == [150_000, 150_001]
    assert "broyden" in capsys.readouterr().out
    assert "| broyden | `rate` | 0.25, 0.35, 0.5, 0.7, 1 | 0.5 |" in document.read_text()
    assert "| broyden | 130 |" in document.read_text() and "| kf | ? |" in document.read_text()


@pytest.mark.parametrize("agent", GRIDS)
def test_every_grid_fits_its_estimator_and_holds_the_default(agent: str) -> None:
    for path, default in default_values(agent).items():
        assert default in GRIDS[agent][path]
        for choice in GRIDS[agent][path]:
            assert value_at(with_values(ESTIMATORS[agent](), {path: choice}), path) == choice


@pytest.mark.parametrize(
    ("family", "agent"), [(f, name) for f in FAMILIES[1:] for name in f.grids], ids=lambda v: getattr(v, "env_id", v)
)
def test_grids_of_other_worlds_hold_the_defaults_and_reach_the_estimator(family: TuningFamily, agent: str) -> None:
    assert agent_card(agent).name == agent and kind_of_id(family.env_id) in agent_card(agent).worlds
    for path, default in default_values(agent, family.env_id).items():
        choices = family.grids[agent][path]
        assert default in choices and len(choices) == len(set(choices)) > 1
        for choice in choices:
            into = family.path(path)
            assert value_at(with_values(family.create(agent), {into: choice}), into) == choice


def test_every_kind_of_world_has_a_family_with_all_its_levels() -> None:
    # The agents of serial arms are calibrated anchors, which have nothing to tune.
    assert {kind_of_id(family.env_id) for family in FAMILIES} == set(WORLDS) - {"other", "servo3d"}
    for family in FAMILIES[1:]:
        with pytest.raises(ValueError, match=f"from 0 to {family.levels[-1]}, got"):
            gym.make(family.env_id, level=family.levels[-1] + 1)


CHANGED = (
    ("hmm-cell", "SonarTracking-v0", {"likelihood_rules.cell_amplitude": 2.0, "evidence": 5.0}, {"horizon": 30}),
    ("kalman-hungarian", "PedestrianTracking-v0", {"confirm": 1, "misses": 30}, {"horizon": 60, "empty_frames": 0}),
    ("pmb", "PedestrianTracking-v0", {"birth": 0.1, "memory": 4.0}, {"horizon": 60, "empty_frames": 0}),
    ("phd-servo", "PedestrianServo-v0", {"alike": 12.0, "position_noise": 2.5}, {"horizon": 40}),
    ("crowd-servo", "PedestrianServo-v0", {"detection": 0.88, "position_noise": 6.0}, {"horizon": 40}),
)


@pytest.mark.parametrize(("agent", "env_id", "values", "axes"), CHANGED, ids=lambda v: v if isinstance(v, str) else "")
def test_values_reach_the_observers_of_other_worlds(
    agent: str, env_id: str, values: dict[str, float], axes: dict[str, Any]
) -> None:
    family = family_of(agent, env_id)
    default, card = family.default_values(agent), agent_card(agent)
    kwargs = {"level": 2, **axes}
    plain, same, changed = (
        run_episodes(env_id, use, [150_000], kwargs)[0][0]["return"]
        for use in (card, family.insert(card, default), family.insert(card, {**default, **values}))
    )
    assert plain == same != changed


def test_clutter_observers_are_tuned_by_the_same_search(tmp_path: Path) -> None:
    protocol = default_protocol(["gnn"], [150_000, 150_001])
    assert protocol.env_id == "ClutterTracking-v0" and protocol.levels == tuple(range(8))
    protocol = replace(protocol, levels=(1,))
    default = measure("gnn", default_values("gnn"), protocol)
    rows, _ = run_episodes(protocol.env_id, agent_card("gnn"), protocol.seeds, {"level": 1})
    assert np.array_equal(default.costs, [np.log(row["ospa2"]) for row in rows])
    other = measure("gnn", {"gate_probability": 0.99, "misses": 8}, protocol)
    assert not np.array_equal(other.costs, default.costs), "the values did not reach the estimator"
    record = tune(["gnn"], tmp_path / "tuning.json", protocol)
    tuned = record.agents["gnn"]
    assert tuned.objective(tuned.chosen) <= tuned.objective(tuned.start) == pytest.approx(default.costs.mean())
    assert record.tuning_steps("gnn-hmm") == tuned.environment_steps > 0 and record.tuning_steps("pmb") is None
    text = markdown_tuning(record)
    assert "mean of ln(OSPA(2) m)" in text and "| gnn-hmm |" in text and "| kf |" not in text


def test_a_color_tracker_is_measured_by_its_metric() -> None:
    protocol = replace(default_protocol(["opencv-meanshift"], [150_000]), levels=(0,))
    assert protocol.env_id == "ColorTracking-v0"
    default = measure("opencv-meanshift", default_values("opencv-meanshift"), protocol)
    rows, _ = run_episodes(protocol.env_id, agent_card("opencv-meanshift"), protocol.seeds, {"level": 0})
    assert default.costs.tolist() == [-rows[0]["auc"]]


def test_agents_of_another_environment_are_refused(tmp_path: Path) -> None:
    remedy = "env_id must be ClutterTracking-v0 or PedestrianTracking-v0 for agent 'pmb', got 'UncalibServo-v0'"
    with pytest.raises(ValueError, match=remedy):
        tune(["pmb"], tmp_path / "tuning.json", SHORT)


@pytest.mark.parametrize(("path", "part"), [("walk.speed", "speed"), ("rate.x", "rate"), ("outliers.dof", "dof")])
def test_a_path_that_leads_nowhere_is_named(path: str, part: str) -> None:
    with pytest.raises(ValueError, match=f"values: '{path}' leads nowhere at '{part}'"):
        with_values(ESTIMATORS["kf"](), {path: 1.0})


def test_members_of_a_tuple_are_reached_by_their_number() -> None:
    old = ESTIMATORS["lifted-kf"]()
    new = with_values(old, {"models.1.jump": 7.0})
    assert new.models[1].jump == 7.0 and new.models[0] is old.models[0] and old.models[1].jump != 7.0
    with pytest.raises(ValueError, match="tuple has 7 members"):
        value_at(old, "models.9.jump")


def test_the_shipped_record_is_of_this_protocol_and_covers_every_agent() -> None:
    record = read_record(SHIPPED)
    assert record.protocol == TuningProtocol().as_record()
    assert set(record.agents) == set(GRIDS)
    servos = {name: card for name, card in AGENTS.items() if "servo" in card.worlds and card.trained_in is None}
    unstamped = read_record(SHIPPED_UNSTAMPED)
    assert set(unstamped.agents) == set(UNSTAMPED_GRIDS)
    assert (unstamped.protocol["levels"], len(unstamped.protocol["seeds"])) == ([6], 300)
    assert set(GRIDS) | set(UNSTAMPED_GRIDS) | set(BORROWED) | UNTUNED == set(servos)
    for name, card in servos.items():
        assert card.tuning_steps == (unstamped if name in UNSTAMPED_GRIDS else record).tuning_steps(name)
        assert card.tuning_steps is not None and (card.tuning_steps == 0) == (name in UNTUNED)


@pytest.mark.parametrize("agent", GRIDS)
def test_what_the_shipped_record_chose_is_the_default(agent: str) -> None:
    tuned: TunedAgent = read_record(SHIPPED).agents[agent]
    assert tuned.grid == {path: list(choices) for path, choices in GRIDS[agent].items()}
    assert tuned.chosen == default_values(agent)


@pytest.mark.parametrize("agent", UNSTAMPED_GRIDS)
def test_what_the_search_at_level_6_chose_is_the_default(agent: str) -> None:
    tuned: TunedAgent = read_record(SHIPPED_UNSTAMPED).agents[agent]
    assert tuned.grid == {path: list(choices) for path, choices in UNSTAMPED_GRIDS[agent].items()}
    assert tuned.chosen == default_values(agent)


TARGET_MODELS = {path for path in GRIDS["lifted-kf"] if path.startswith("models.")}
SHARED: list[tuple[str, str, str, set[str]]] = [
    ("fixed-jacobian", "kf", "learner.", set()),
    ("ukf", "kf", "", set()),
    ("student-t-kf", "kf", "", set()),
    ("correntropy-kf", "kf", "", set()),
    ("latency-bank-kf", "kf", "estimator.", set()),
    ("parametric-ukf", "parametric-ekf", "", set()),
    ("latency-bank-lifted-kf", "lifted-kf", "estimator.", set()),
    ("lifted-kf-swinging", "lifted-kf", "", TARGET_MODELS),
]
"""Borrower, lender, where in the borrower the lender's estimator lies, and what the borrower has of its own."""


@pytest.mark.parametrize(("borrower", "lender", "place", "own"), SHARED)
def test_borrowed_values_are_the_lender_s(borrower: str, lender: str, place: str, own: set[str]) -> None:
    estimator = ESTIMATORS[borrower]()
    for path, value in default_values(lender).items():
        assert path in own or value_at(estimator, place + path) == value


def test_every_borrower_is_compared_with_its_lender() -> None:
    assert BORROWED.items() <= {(borrower, lender) for borrower, lender, _, _ in SHARED}


def test_the_page_shows_the_shipped_record() -> None:
    page = (Path(__file__).parents[2] / "docs" / "tuning.md").read_text(encoding="utf-8")
    remedy = "run `servotrack tune --output baselines/agents/tuning.json --into docs/tuning.md`"
    assert markdown_tuning(read_record(SHIPPED)).strip() in page, remedy
    assert markdown_tuning(read_record(SHIPPED_UNSTAMPED)).strip() in page
