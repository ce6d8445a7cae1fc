"""The evaluator: what it counts, what it hands out, and how it resumes."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import servotrack  # noqa: F401
from servotrack.baselines.evaluation import seeds
from servotrack.baselines.evaluation.bench import Cell, run_suite, suite_of
from servotrack.baselines.evaluation.episodes import EpisodeRecorder
from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.evaluation.results import ResultsFolder
from servotrack.baselines.evaluation.servo_scores import servo_errors

SERVO = "UncalibServo-v0"
TUNE = seeds.take("tune", 6)
SHORT = {"level": 1, "horizon": 80}


class Spy:
    """An agent that turns its joints one way and remembers what it was given."""

    seen: list[Any] = []  # noqa: RUF012

    def __init__(self, env: Any) -> None:
        self.space = getattr(env, "single_action_space", env.action_space)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        Spy.seen.append((observation, episode_start))
        batch = observation["time"].shape[:-1]
        return np.full((*batch, *self.space.shape), 0.6, dtype=np.float32), None


def test_errors_are_counted_as_documented() -> None:
    # Warm-up of 8 steps, then 100: the errors say at which instant they were taken.
    time_axis = 0.05 * np.arange(-7, 101)
    error = np.where(time_axis <= 0.0, 9.0, time_axis / 1000.0)
    row = servo_errors(time_axis, error, -0.4, 108)
    scored = 0.05 * np.arange(1, 101)
    assert row["transient"] == pytest.approx(scored.mean() / 1000.0)
    assert row["steady"] == pytest.approx(scored[60:].mean() / 1000.0)
    assert row["p95"] == pytest.approx(np.percentile(scored[60:], 95) / 1000.0)
    assert row["success"] is True


@pytest.mark.parametrize(("last", "counted"), [(0.01, 0.3), (0.8, 0.8)])
def test_steps_after_an_early_end_count_as_lost(last: float, counted: float) -> None:
    row = servo_errors(0.05 * np.arange(1, 71), np.full(70, last), 0.0, 100)
    assert row["steady"] == pytest.approx((10 * last + 30 * counted) / 40)
    assert row["success"] is False


def test_success_needs_the_mean_and_the_tail() -> None:
    time_axis = 0.05 * np.arange(1, 101)
    error = np.full(100, 0.005)
    assert servo_errors(time_axis, error, 0.0, 100)["success"]
    error[-3:] = 0.05
    assert servo_errors(time_axis, error, 0.0, 100)["steady"] < 0.01
    assert not servo_errors(time_axis, error, 0.0, 100)["success"]


def test_an_episode_without_a_steady_part_is_refused() -> None:
    with pytest.raises(ValueError, match="raise `horizon`"):
        evaluate(SERVO, "random", TUNE[:1], {"level": 0, "horizon": 20})


def test_rows_are_those_of_single_episodes() -> None:
    cell = evaluate(SERVO, "kf", TUNE, SHORT, timing=False)
    assert cell.seeds == TUNE
    assert cell.max_steps == 88
    for row in (cell.rows[0], cell.rows[-1]):
        alone = evaluate(SERVO, "kf", [row["seed"]], SHORT, timing=False).rows[0]
        assert alone["length"] == row["length"]
        assert alone["steady"] == pytest.approx(row["steady"], rel=1e-6)
        assert alone["return"] == pytest.approx(row["return"], rel=1e-6)


def test_an_agent_that_lets_the_target_go_ends_early_and_pays() -> None:
    rows = evaluate(SERVO, "random", seeds.take("tune", 12), {"level": 3}, timing=False).rows
    early = [row for row in rows if row["length"] < 252]
    assert early, "some random arm loses its target"
    # Most of such an episode is made of steps that never happened.
    assert all(row["steady"] > 0.25 and not row["success"] for row in early)


def test_agents_get_observations_and_nothing_else() -> None:
    Spy.seen.clear()
    evaluate(SERVO, f"{__name__}:Spy", TUNE[:2], SHORT, timing=False)
    observation, starts = Spy.seen[0]
    assert set(observation) == {"joint_angles", "features", "goal", "visible", "frame_time", "time"}
    assert starts.tolist() == [True, True]
    assert not Spy.seen[1][1].any()


def test_episode_starts_follow_the_next_step_reset() -> None:
    Spy.seen.clear()
    # Whoever turns away loses the target at different times, and rows that are done begin anew.
    cell = evaluate(SERVO, f"{__name__}:Spy", seeds.take("tune", 12), {"level": 3}, timing=False)
    lengths = [row["length"] for row in cell.rows]
    assert len(set(lengths)) > 1
    row = int(np.argmin(lengths))
    starts = [bool(start[row]) for _, start in Spy.seen]
    times = [observation["time"][row, 0] for observation, _ in Spy.seen]
    assert starts[1:] == [later < sooner for sooner, later in itertools.pairwise(times)]


def test_foreign_environments_have_generic_columns() -> None:
    cell = evaluate("CartPole-v1", "random", TUNE[:3], timing=False)
    assert all(set(row) == {"seed", "return", "length"} for row in cell.rows)
    assert all(row["return"] == row["length"] for row in cell.rows)
    assert cell.max_steps == 500


def test_compute_time_is_of_single_steps() -> None:
    cell = evaluate(SERVO, "kf", TUNE[:1], SHORT)
    assert len(cell.step_seconds) > 100
    assert 1e-6 < np.median(cell.step_seconds) < 0.1


@pytest.mark.parametrize("bad", [[], [1, 1], [-1]])
def test_bad_seeds_are_refused(bad: list[int]) -> None:
    with pytest.raises(ValueError, match="seeds must be different"):
        evaluate(SERVO, "random", bad)


def test_an_evaluation_resumes_and_repeats_nothing(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    whole = evaluate(SERVO, "kf", TUNE, SHORT, chunk=2, timing=False)
    evaluate(SERVO, "kf", TUNE[:2], SHORT, folder=folder, timing=False)
    stored = folder.load(SERVO, SHORT, "kf")
    assert stored is not None
    stored.rows[0]["return"] = -1.0
    folder.file_of(SERVO, SHORT, "kf").unlink()
    folder.save(stored)
    counted: list[int] = []
    resumed = evaluate(SERVO, "kf", TUNE, SHORT, folder=folder, chunk=2, timing=False, on_episodes=counted.append)
    assert counted == [2, 2, 2]
    assert resumed.rows[0]["return"] == -1.0, "a finished row was run again"
    assert resumed.rows[1:] == whole.rows[1:]


def test_a_killed_bench_loses_nothing_that_was_finished(tmp_path: Path) -> None:
    arguments = [
        "bench",
        "-o",
        str(tmp_path),
        "-a",
        "kf,ukf,random,oracle",
        "-l",
        "0-2",
        "-n",
        "30",
        "-j",
        "1",
        "--split",
        "tune",
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "servotrack", *arguments, "--no-video"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60.0
    while len(list(tmp_path.glob("*/[a-z]*.json"))) < 2 and time.monotonic() < deadline:
        assert process.poll() is None, "the bench ended by itself"
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    folder = ResultsFolder(tmp_path)
    finished = {path: path.read_bytes() for path in tmp_path.glob("*/[a-z]*.json")}
    assert 2 <= len(finished) < 12
    assert len(folder.load_all()) == len(finished)

    suite = suite_of("UncalibServo-v0", ["kf", "ukf", "random", "oracle"], (0, 1, 2))
    cells = run_suite(suite, folder, episodes=30, split="tune", jobs=1)
    assert len(cells) == 12
    assert all(len(cell.rows) == 30 for cell in cells)
    for path, before in finished.items():
        assert json.loads(path.read_bytes())["rows"] == json.loads(before)["rows"]


def test_a_suite_in_processes_gives_the_same_rows(tmp_path: Path) -> None:
    suite = [Cell(SERVO, agent, SHORT) for agent in ("kf", "random")]
    one = run_suite(suite, ResultsFolder(tmp_path / "one"), episodes=4, split="tune", jobs=1)
    two = run_suite(suite, ResultsFolder(tmp_path / "two"), episodes=4, split="tune", jobs=2)
    assert [cell.rows for cell in one] == [cell.rows for cell in two]


def test_a_suite_refuses_a_damaged_file_before_it_starts(tmp_path: Path) -> None:
    folder = ResultsFolder(tmp_path)
    suite = suite_of("UncalibServo-v0", ["random", "kf"], (0,))
    path = folder.file_of(SERVO, {"level": 0}, "kf")
    path.parent.mkdir(parents=True)
    path.write_text("{")
    with pytest.raises(Exception, match="is corrupt"):
        run_suite(suite, folder, episodes=2, split="tune", jobs=1)
    assert not folder.file_of(SERVO, {"level": 0}, "random").exists()


def test_recorder_needs_a_limit_of_steps() -> None:
    env = gym.make_vec("CartPole-v1", num_envs=1, vectorization_mode="sync")
    env.spec.max_episode_steps = None
    env.metadata = {"servotrack_kind": "servo"}
    with pytest.raises(ValueError, match="limit of steps"):
        EpisodeRecorder([0], env, {"time": np.zeros((1, 1))})
