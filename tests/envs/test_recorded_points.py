"""RecordedPoints-v0: scans and intervals are those of the file, scores need a truth, agents are set from the points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from test_points_rollouts import SCANS, write_points
from typer.testing import CliRunner

import servotrack  # noqa: F401
from servotrack.__main__ import app
from servotrack.baselines import evaluate
from servotrack.baselines.agents.registry import AGENTS, create_agent
from servotrack.envs.testing import check_vector_env, check_vector_matches_single
from servotrack.envs.track.files.points import read_point_truth, read_points
from servotrack.envs.track.files.recorded import SequenceError
from servotrack.estimators.metrics import ospa

ENV_ID = "RecordedPoints-v0"
CLASSICAL = sorted(name for name, card in AGENTS.items() if "clutter" in card.worlds and card.trained_in is None)


def play(env: Any, answer: Any = None) -> tuple[list[Any], list[Any]]:
    """Observations and infos of an episode; the answers are the action space's zeros, or those of a function."""
    seen, info = env.reset(seed=1)
    observations, infos, over = [seen], [info], False
    while not over:
        action = np.zeros(env.action_space.shape) if answer is None else answer(seen, info)
        seen, _, _, over, info = env.step(action)
        observations.append(seen)
        infos.append(info)
    return observations, infos


def test_scans_and_intervals_are_those_of_the_file(tmp_path: Path) -> None:
    files = write_points(tmp_path)
    points = read_points(Path(files["source"]))
    observations, _ = play(gym.make(ENV_ID, **files))
    assert len(observations) == SCANS + 1
    for k, scan in enumerate(points.scans):
        rows = observations[k]["observation"]
        np.testing.assert_array_equal(rows[: len(scan), 1:], scan)
        assert rows[: len(scan), 0].all() and not rows[len(scan) :].any()
    intervals = [seen["interval"][0] for seen in observations]
    between = np.diff(points.times)
    assert intervals[0] == np.median(between) and intervals[1:SCANS] == between.tolist()
    np.testing.assert_array_equal(observations[-1]["observation"], observations[-2]["observation"])


def test_answers_are_scored_against_the_truth_where_it_is_known(tmp_path: Path) -> None:
    files = write_points(tmp_path)
    points = read_points(Path(files["source"]))
    truth = read_point_truth(Path(files["truth"]), points)
    env = gym.make(ENV_ID, cutoff=20.0, **files)
    shift = np.array([1.0, 0.0, 0.0])

    def shifted(seen: Any, info: Any) -> Any:
        action = np.zeros(env.action_space.shape)
        there = info["truth"]["exists"]
        action[: len(there), 0] = there
        action[: len(there), 1:] = info["truth"]["positions"] + shift
        return action

    _, infos = play(env, shifted)
    for k, info in enumerate(infos[1:]):
        assert info["scored"] == truth.known[k]
        present = truth.tracks[:, k][~np.isnan(truth.tracks[:, k, 0])]
        assert info["ospa"] == pytest.approx(ospa(present, present + shift, 20.0) if info["scored"] else 0.0)
    assert infos[-1]["episode_scored"] and infos[-1]["ospa2"] == pytest.approx(1.0)


def test_with_a_lag_answers_are_for_earlier_scans_and_the_last_ones_are_not_scored() -> None:
    lag = 3
    env = gym.make(ENV_ID, lag=lag)
    truths: list[Any] = []

    def late(seen: Any, info: Any) -> Any:
        truths.append(info["truth"])
        action = np.zeros(env.action_space.shape)
        if len(truths) > lag:
            then = truths[-1 - lag]
            action[: len(then["exists"]), 0] = then["exists"]
            action[: len(then["exists"]), 1:] = then["positions"]
        return action

    _, infos = play(env, late)
    assert len(infos) == 61 and sum(info["scored"] for info in infos) == 60 - lag
    assert max(info["ospa"] for info in infos) == 0.0 and infos[-1]["ospa2"] == 0.0


def test_without_truth_nothing_is_scored_and_oracles_are_refused(tmp_path: Path) -> None:
    source = write_points(tmp_path)["source"]
    env = gym.make(ENV_ID, source=source, render_mode="rgb_array")
    agent = create_agent("pmb", env)
    seen, info = env.reset(seed=0)
    assert set(info) == {"truth", "scored"}
    state, start, over = None, True, False
    while not over:
        action, state = agent.predict(seen, state=state, episode_start=np.asarray(start))
        seen, reward, _, over, info = env.step(action)
        start = False
        assert reward == 0.0 and set(info) == {"truth", "scored"} and not info["scored"]
    frame: Any = env.render()
    assert frame.shape == (544, 800, 3)
    with pytest.raises(ValueError, match="truth is missing"):
        evaluate(ENV_ID, "pmb", [0], {"source": source}, timing=False)
    with pytest.raises(ValueError, match="truth is missing"):
        evaluate(ENV_ID, "association-oracle", [0], {"source": source}, timing=False)


@pytest.mark.parametrize("name", CLASSICAL)
def test_every_agent_of_the_clutter_world_runs_in_its_space(name: str) -> None:
    cell = evaluate(ENV_ID, name, [0], {"horizon": 15}, timing=False)
    assert np.isfinite([value for value in cell.rows[0].values() if isinstance(value, float)]).all()


def test_agents_know_the_interval() -> None:
    """Over intervals that vary a filter with the interval is nearer than one that takes them for equal."""
    env = gym.make(ENV_ID)
    agent = create_agent("pmb", env)
    scores = []
    for known in (True, False):
        seen, _ = env.reset(seed=0)
        state, total, over = None, 0.0, False
        while not over:
            given = seen if known else {**seen, "interval": np.ones(1)}
            action, state = agent.predict(given, state=state)
            seen, reward, _, over, _ = env.step(action)
            total += float(reward)
        scores.append(total)
    assert scores[0] > scores[1]


def test_rows_of_a_batch_may_have_intervals_of_their_own() -> None:
    vector = gym.make_vec(ENV_ID, num_envs=3)
    agent = create_agent("pmb", vector)
    single = gym.make(ENV_ID)
    scans = [single.reset(seed=0)[0]]
    for _ in range(9):
        scans.append(single.step(np.zeros(single.action_space.shape))[0])
    orders = [[0, 1, 2, 3, 4, 5], [3, 4, 5, 6, 7, 8], [2, 3, 4, 5, 6, 7]]
    batch: Any = None
    alone: list[Any] = [None] * 3
    for k in range(6):
        together = {key: np.stack([scans[order[k]][key] for order in orders]) for key in scans[0]}
        answers, batch = agent.predict(together, state=batch)
        for row, order in enumerate(orders):
            own, alone[row] = agent.predict(scans[order[k]], state=alone[row])
            np.testing.assert_allclose(answers[row], own, atol=1e-9)


@pytest.mark.parametrize("text", ["three axes", "covariances", "degrees"])
def test_agents_are_set_from_points_of_every_kind(tmp_path: Path, text: str) -> None:
    generator = np.random.default_rng(3)
    head = {"three axes": "time,x,y,z", "covariances": "time,x,y,cov_xx,cov_xy,cov_yy", "degrees": "time,lat,lon"}[text]
    lines, truth = [head], ["time,id," + head.partition("time,")[2].partition(",cov")[0]]
    for k in range(60):
        for name, side in (("a", -1.0), ("b", 1.0)):
            place = np.array([20.0 * k - 500.0, side * 200.0 + 3.0 * k, 50.0])[: 3 if text == "three axes" else 2]
            place = place * (1e-5 if text == "degrees" else 1.0)
            noise = generator.normal(0.0, 2.0 * (1e-5 if text == "degrees" else 1.0), place.shape)
            more = ",4,0,4" if text == "covariances" else ""
            lines.append(f"{2 * k}," + ",".join(f"{value:.8g}" for value in place + noise) + more)
            truth.append(f"{2 * k},{name}," + ",".join(f"{value:.8g}" for value in place))
    (tmp_path / "points.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "truth.csv").write_text("\n".join(truth) + "\n")
    files = {"source": str(tmp_path / "points.csv"), "truth": str(tmp_path / "truth.csv")}
    model: Any = gym.make(ENV_ID, **files).unwrapped.scene_model  # type: ignore[attr-defined]
    assert model.model.period == 2.0 and model.detection_probability > 0.9 and model.clutter_rate < 0.5
    for name in ("pmb", "robust-pmb", "gnn", "gm-phd"):
        row = evaluate(ENV_ID, name, [0], files, timing=False).rows[0]
        # gnn reports from the third scan on, and no filter knows the first.
        assert row["count_right"] > 0.9, name


def test_adaptive_agents_use_measured_maneuvers_and_the_map_of_clutter(tmp_path: Path) -> None:
    # Four targets that stop and go, and false points that come from one place.
    generator = np.random.default_rng(43)
    moves = (np.arange(90) // 15 % 2 == 0)[:, None, None] * generator.normal(0.0, 6.0, (4, 2))
    places = generator.uniform(-400.0, 400.0, (4, 2)) + np.cumsum(moves, axis=0)
    lines, truth = ["time,x,y"], ["time,id,x,y"]
    for k in range(90):
        seen = places[k][generator.random(4) < 0.9]
        false = np.array([450.0, 450.0]) + 20.0 * generator.standard_normal((generator.poisson(5), 2))
        lines += [f"{k},{x},{y}" for x, y in [*(seen + generator.normal(0.0, 1.0, seen.shape)), *false]]
        truth += [f"{k},{name},{x},{y}" for name, (x, y) in zip("abcd", places[k], strict=True)]
    (tmp_path / "points.csv").write_text("\n".join(lines))
    (tmp_path / "truth.csv").write_text("\n".join(truth))
    files = {"source": str(tmp_path / "points.csv"), "truth": str(tmp_path / "truth.csv")}
    for name, lag in (("robust-pmb", 0), ("robust-trajectory-pmb", 10)):
        row = evaluate(ENV_ID, name, [0], {**files, "cutoff": 10.0, "lag": lag}, timing=False).rows[0]
        assert row["count_right"] > 0.85 and row["ospa2"] < 5.0, (name, row)


def test_the_identities_of_the_source_can_be_the_truth(tmp_path: Path) -> None:
    path = tmp_path / "ais.csv"
    rows = [f"{k},{name},{10 * k + 100 * (name == 'b')},{5 * k}" for k in range(6) for name in ("a", "b", "")]
    path.write_text("time,mmsi,x,y\n" + "\n".join(rows) + "\n")
    _, infos = play(gym.make(ENV_ID, source=str(path), truth=str(path)))
    assert infos[0]["truth"]["exists"].sum() == 2
    assert infos[0]["truth"]["source"].tolist() == [0, 1, -1]


def test_the_command_evaluates_an_agent_on_files(tmp_path: Path) -> None:
    files = write_points(tmp_path)
    settings = [text for key, value in files.items() for text in ("--set", f"{key}={value}")]
    result = CliRunner().invoke(
        app, ["evaluate", ENV_ID, "pmb", "-n", "1", *settings, "--results", str(tmp_path / "results")]
    )
    assert result.exit_code == 0, result.output
    assert "OSPA(2)" in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"source": "video.avi"}, "source must be a file of points"),
        ({"source": 0}, "source must be a file of points"),
        ({"truth": "truth.csv"}, "truth needs a source"),
        ({"lag": -1}, "lag must lie"),
        ({"lag": 60}, "start must leave at least 61 of the 60 scans"),
        ({"start": 59}, "start must leave at least 2 of the 60 scans"),
        ({"horizon": 0}, "horizon must lie"),
        ({"cutoff": 0.0}, "cutoff must lie"),
        ({"max_estimates": 0}, "max_estimates must lie"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gym.make(ENV_ID, **arguments)


def test_a_truth_at_other_times_and_a_part_without_points_are_refused(tmp_path: Path) -> None:
    files = write_points(tmp_path)
    with pytest.raises(SequenceError, match="must overlap scans 0 to 1 "):
        gym.make(ENV_ID, **files, horizon=1)
    source = tmp_path / "gaps.csv"
    source.write_text("time,x,y\n0,1,1\n1,2,2\n2,,\n3,,\n4,3,3\n")
    with pytest.raises(SequenceError, match="has no points in its scans 2 to 3"):
        gym.make(ENV_ID, source=str(source), start=2, horizon=1)


def test_vector_environments_agree_with_single_ones() -> None:
    check_vector_env(ENV_ID, num_envs=2, horizon=6)
    check_vector_matches_single(ENV_ID, num_envs=2, horizon=6, lag=1)


def test_the_picture_shows_points_and_answers() -> None:
    env = gym.make(ENV_ID, render_mode="rgb_array")
    env.reset(seed=0)
    before: Any = env.render()
    action = np.zeros(env.action_space.shape)
    action[0] = [1.0, 100.0, 100.0]
    env.step(action)
    after: Any = env.render()
    assert before.shape == after.shape == (544, 800, 3) and (before != after).any()
