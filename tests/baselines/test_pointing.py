"""A pointed sensor: what it sees, the filter behind it, and the policies that turn it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servotrack.baselines.training.pointing import __main__ as command
from servotrack.baselines.training.pointing import experiment
from servotrack.baselines.training.pointing.planning import NEW_VARIANCE, plan_center, relative_error, relative_errors
from servotrack.baselines.training.pointing.policies import (
    Belief,
    FixedScan,
    MyopicRule,
    OraclePointing,
    UnseenMap,
)
from servotrack.baselines.training.pointing.scene import PointedEpisode, PointedScene, pointed_filter
from servotrack.estimators.rfs.pmb import PMB
from servotrack.estimators.types import Array

ANYWHERE = {"births": "anywhere", "horizon": 30}
SQUARE = PointedScene("square", "square", 100.0, ANYWHERE)
STRIP = PointedScene("strip", "strip", 200.0, ANYWHERE)


@pytest.mark.parametrize("scene", [SQUARE, STRIP])
def test_the_field_of_view_covers_a_third_and_stays_in_the_region(scene: PointedScene) -> None:
    h = scene.config.half_width
    assert 4.0 * scene.half.prod() == pytest.approx(4.0 * h * h / 3.0)
    center = np.zeros(2)
    for _ in range(60):
        new = scene.moved(center, np.array([9e9, -9e9]))
        assert (np.abs(new - center) <= scene.rate + 1e-9).all()
        center = new
    np.testing.assert_allclose(np.abs(center) + scene.half, h)


def test_a_scan_holds_what_stands_in_the_field_of_view() -> None:
    episode, center = PointedEpisode(SQUARE, 3), np.array([500.0, -300.0])
    rows, source = episode.episode.measurements[5], episode.episode.source[5]
    expected = [
        row[1:]
        for row, cause in zip(rows, source, strict=True)
        if cause >= -1 and SQUARE.sees(center, episode.positions[5, cause] if cause >= 0 else row[1:])
    ]
    np.testing.assert_array_equal(episode.scan(5, center), expected)
    assert 0 < len(expected) < (source >= -1).sum()


def test_a_filter_that_sees_everything_is_the_plain_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = PointedScene("all", "square", 100.0, {"horizon": 30})
    monkeypatch.setitem(scene.__dict__, "half", np.full(2, 1e9))
    pointed, episode = pointed_filter(scene), PointedEpisode(scene, 1)
    names = ("clutter_intensity", "survival", "detection", "gate_probability", "reduction")
    plain = PMB(pointed.model, pointed.birth, **{name: getattr(pointed, name) for name in names})
    states = [tracker.initial(np.zeros((0, 2))) for tracker in (pointed, plain)]
    for k in range(15):
        scan = episode.scan(k, np.zeros(2))
        assert len(scan) == episode.episode.measurements[k, :, 0].sum()
        found = []
        for i, tracker in enumerate((pointed, plain)):
            states[i], estimate = tracker.step(states[i], scan)
            found.append(estimate.states)
        np.testing.assert_array_equal(*found)


def test_the_relative_error_is_the_expected_cut_distance() -> None:
    distance = np.hypot(*np.random.default_rng(0).normal(size=(2, 200_000)))
    for deviation in (5.0, 60.0, 300.0):
        expected = np.minimum(deviation * distance, 100.0).mean() / 100.0
        assert relative_error(deviation, 100.0) == pytest.approx(expected, rel=0.01)
        assert relative_errors(np.array([deviation]), 100.0)[0] == pytest.approx(relative_error(deviation, 100.0))


def _planned(center: Array, target: Array) -> Array:
    scans, config = 12, SQUARE.config
    numbers = (1.0, 25.0, 2.25, 0.98, 100.0, config.cutoff)
    places, spread = np.tile(target, (scans, 1, 1)), np.array([[NEW_VARIANCE, 0.0, 100.0]])
    weights, nothing = np.ones((scans, 1)), np.zeros(1)
    return np.asarray(
        plan_center(
            center, SQUARE.rates, SQUARE.limit, SQUARE.half, places, weights, nothing, spread, numbers, 6, 2
        )
    )  # fmt: skip


def test_a_plan_turns_toward_a_target_out_of_sight_and_rests_on_one_in_sight() -> None:
    assert _planned(np.zeros(2), np.array([1700.0, 0.0]))[0] == 100.0
    seen = _planned(np.zeros(2), np.array([300.0, 200.0]))
    assert SQUARE.sees(seen, np.array([300.0, 200.0]))


def test_a_fixed_scan_visits_its_places_and_dwells() -> None:
    policy, center, path = FixedScan(((-1.0, 0.0), (1.0, 0.0)), dwell=5), np.zeros(2), []
    nothing = Belief(np.zeros(0), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros((20, 20)))
    episode = PointedEpisode(STRIP, 0)
    for k in range(60):
        center = STRIP.moved(center, policy.center(STRIP, k, center, nothing, episode))
        path.append(center[0])
    limit = STRIP.limit[0]
    assert min(path) == -limit and max(path) == limit
    assert 5 <= np.sum(np.array(path[:25]) == -limit) <= 7


def test_a_myopic_rule_turns_toward_tracks_and_toward_unseen_targets() -> None:
    here, episode = np.zeros(2), PointedEpisode(STRIP, 0)
    track = Belief(
        np.ones(1), np.array([[1900.0, 0.0, 0.0, 0.0]]), np.array([[400.0, 10.0, 100.0]]), np.zeros((20, 20))
    )
    for rule in (
        MyopicRule(number=1.0, discount=0.9),
        MyopicRule(information=1.0, discount=0.9),
        MyopicRule(cost=1.0, discount=0.9),
    ):
        assert rule.center(STRIP, 1, here, track, episode)[0] > 500.0
    unseen = np.zeros((20, 20))
    unseen[0] = 1.0
    hidden = track._replace(existence=np.zeros(1), unseen=unseen)
    assert MyopicRule(number=1.0, discount=0.9).center(STRIP, 1, here, hidden, episode)[0] < -500.0


def test_the_map_forgets_what_was_seen_and_expects_it_where_nobody_looked() -> None:
    unseen = UnseenMap(STRIP)
    for _ in range(20):
        unseen.advance(np.zeros(2))
    assert unseen.weights[10].sum() < 0.1 * unseen.weights[2].sum()
    config = STRIP.config
    bound = config.initial_targets + 20 * config.birth_rate
    assert 0.3 * bound < unseen.weights.sum() < bound


def test_an_oracle_costs_less_than_a_sensor_at_rest() -> None:
    rest, oracle = (
        np.mean([experiment.run_episode(STRIP, policy, seed, pointed_filter(STRIP))["cost"] for seed in range(4)])
        for policy in (FixedScan(((0.0, 0.0),)), OraclePointing(6, 2))
    )
    assert oracle < 0.8 * rest


def test_the_command_writes_the_tables_and_keeps_outcomes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "SCENES", (STRIP,))
    monkeypatch.setattr(command, "KINDS", ("myopic rule", "oracle, future"))
    monkeypatch.setattr(experiment, "_FIRST", 1)
    monkeypatch.setattr(experiment, "_AGAIN", 1)
    chosen = {"myopic rule": [MyopicRule(number=1.0)], "oracle, future": [OraclePointing(2, 2)]}
    monkeypatch.setattr(experiment, "candidates", lambda kind, scene: chosen[kind])
    page = tmp_path / "page.md"
    page.write_text("<!-- pointing:begin -->\n<!-- pointing:end -->\n", encoding="utf-8")
    arguments = ["--episodes", "2", "--scenes", "0", "--results", str(tmp_path), "--write", str(page)]
    command.main(arguments)
    first = page.read_text(encoding="utf-8")
    monkeypatch.setattr(experiment, "run_episode", None)
    command.main(arguments)
    assert page.read_text(encoding="utf-8") == first
    assert "oracle, future" in first and "of the myopic rule" in first


@pytest.mark.parametrize(("arguments", "text"), [(["--episodes", "1"], "at least 2"), (["--scenes", "9"], "0 to 3")])
def test_bad_arguments_are_named(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.main(arguments)
    assert text in capsys.readouterr().err
