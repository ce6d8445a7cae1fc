"""The observer without a filter: what its rows hold, and what it makes of answers that are known."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import servotrack  # noqa: F401
from servotrack.baselines.agents.learned.set_prediction import (
    ANCHOR,
    LENGTH,
    NEIGHBOR,
    NEIGHBOR_DISTANCE,
    NEIGHBOR_LIMIT,
    NEIGHBOR_SPEED,
    ScanHistory,
    SetPredictor,
    SetWindow,
    in_plane,
    present_positions,
    query_measurements,
)
from servotrack.estimators.types import FloatArray

WINDOW = SetWindow()
CLEAN: dict[str, Any] = {
    "level": 1, "births": "anywhere", "detection_probability": 1.0, "clutter_rate": 0.0, "horizon": 30,
}  # fmt: skip


def newest_ones(rows: FloatArray) -> FloatArray:
    """Answers of who takes every measurement of the newest scan for a target that stands still."""
    answers = np.zeros((len(rows), 5), np.float32)
    answers[:, 0] = np.where(rows[:, WINDOW.neighbors * NEIGHBOR] == 0.0, 5.0, -5.0)
    return answers


def predictor(env: Any, network: Any = newest_ones) -> SetPredictor:
    space = getattr(env, "single_action_space", env.action_space)
    return SetPredictor(network, WINDOW, env.unwrapped.scene_model, space.shape[0], space.low, space.high)


def recent(rng: np.random.Generator, scans: int) -> ScanHistory:
    found = ScanHistory.none(WINDOW, 2, 9)
    for _ in range(scans):
        scan = np.zeros((2, 9, 3))
        for scene in range(2):
            count = rng.integers(0, 9)
            scan[scene, :count, 0] = 1.0
            scan[scene, :count, 1:] = rng.uniform(-300.0, 300.0, (count, 2))
        found = found.with_scan(scan, None)
    return found


def test_a_row_holds_the_nearest_measurements_of_other_scans() -> None:
    seen = recent(np.random.default_rng(3), 15)
    queries = query_measurements(WINDOW, seen, None, 0.0)
    assert len(queries.rows) == seen.number[:, : WINDOW.asked].sum()
    for i in range(0, len(queries.rows), 7):
        scene, age, place = queries.scene[i], queries.age[i], queries.places[i]
        around = []
        for other in range(WINDOW.scans):
            for j in range(seen.number[scene, other] if other != age else 0):
                apart = seen.places[scene, other, j] - place
                scale = NEIGHBOR_DISTANCE + NEIGHBOR_SPEED * abs(other - age)
                around.append((np.hypot(*apart) / scale, *(apart / scale), (age - other) / 6.0))
        around = [one for one in sorted(around) if one[0] <= NEIGHBOR_LIMIT][: WINDOW.neighbors]
        cells = queries.rows[i, : WINDOW.neighbors * NEIGHBOR].reshape(-1, NEIGHBOR)
        assert cells[:, 7].sum() == len(around)
        assert np.allclose(cells[: len(around), [0, 1, 6]], [one[1:] for one in around], atol=1e-5)
        assert not cells[len(around) :].any()
        assert queries.rows[i, -ANCHOR] == age / WINDOW.asked


def test_a_sensor_of_range_and_bearing_is_read_in_the_plane() -> None:
    sensor = np.array([-3000.0, 0.0])
    assert np.allclose(in_plane(np.array([[1000.0, np.pi / 2]]), sensor), [[-3000.0, 1000.0]])
    seen = ScanHistory.none(WINDOW, 1, 2).with_scan(np.array([[[1.0, 2000.0, 0.0], [0.0, 0.0, 0.0]]]), sensor)
    queries = query_measurements(WINDOW, seen, sensor, 0.005)
    assert queries.places.tolist() == [[-1000.0, 0.0]]
    assert np.allclose(queries.rows[0, -3:-1], [0.005 * 2000.0 / 25.0, 0.0])


def test_an_older_measurement_s_target_has_moved_on() -> None:
    seen = recent(np.random.default_rng(0), 4)
    queries = query_measurements(WINDOW, seen, None, 0.0)
    answers = np.zeros((len(queries.rows), 5))
    answers[:, 1], answers[:, 4] = 2.0, -0.5
    places, velocities = present_positions(queries, answers)
    assert np.allclose(
        places - queries.places, np.stack([queries.age * 2.0 * LENGTH, 0 * queries.age - 0.5 * LENGTH], 1)
    )
    assert np.allclose(velocities, [2.0 * LENGTH, 0.0])


def test_identities_stay_with_their_targets() -> None:
    env = gym.make("ClutterTracking-v0", **CLEAN)
    agent = predictor(env)
    observation, info = env.reset(seed=100_003)
    state, owner, identities, everybody = None, {}, 0, set()
    for _ in range(30):
        truth = info["truth"]
        answer, state = agent.predict(observation, state)
        there = np.flatnonzero(truth["exists"])
        everybody |= set(there.tolist())
        reported = np.flatnonzero(answer[:, 0] >= 0.5)
        # Two that are nearer than `merge` are one; nobody else is missed, and nobody is made up.
        assert len(there) - 1 <= len(reported) <= len(there)
        for row in reported.tolist():
            apart = np.hypot(*(truth["states"][there][:, [0, 2]] - answer[row, 1:]).T)
            assert apart.min() < 10.0
            identities += row not in owner
            assert owner.setdefault(row, there[apart.argmin()]) == there[apart.argmin()]
        # A row whose identity has ended is free for another.
        owner = {row: target for row, target in owner.items() if answer[row, 0] >= 0.05}
        observation, _, _, _, info = env.step(answer)
    assert identities == len(everybody) >= 3


def test_one_scene_or_many_and_no_memory_is_written_over() -> None:
    env: Any = gym.make_vec("ClutterTracking-v0", num_envs=3, vectorization_mode="vector_entry_point", level=2)
    agent = predictor(env)
    observation, _ = env.reset(seed=[100_000, 100_001, 100_002])
    together, alone = None, [None] * 3
    for _ in range(8):
        before = together
        kept = None if before is None else before.tracks.labels.copy()
        answer, together = agent.predict(observation, together)
        if before is not None:
            assert np.array_equal(before.tracks.labels, kept)
            again, _ = agent.predict(observation, before)
            assert np.array_equal(again, answer)
        for scene in range(3):
            one, alone[scene] = agent.predict(observation[scene], alone[scene])
            assert np.array_equal(one, answer[scene])
        observation, *_ = env.step(answer)
    fresh, _ = agent.predict(observation, together, np.array([True, False, False]))
    first, _ = agent.predict(observation[0])
    assert np.array_equal(fresh[0], first)


def test_answers_that_are_near_each_other_are_one_target() -> None:
    env = gym.make("ClutterTracking-v0", **CLEAN)
    agent = predictor(env, lambda rows: np.full((len(rows), 5), (3.0, 0, 0, 0, 0), np.float32))
    scan: NDArray[np.float64] = np.zeros(env.observation_space.shape)  # type: ignore[arg-type]
    scan[:3] = [[1, 100.0, 100.0], [1, 110.0, 100.0], [1, 500.0, 500.0]]
    answer, _ = agent.predict(scan)
    assert (answer[:, 0] >= 0.5).sum() == 2
    nothing, _ = agent.predict(np.zeros_like(scan))
    assert not (nothing[:, 0] >= 0.5).any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"asked": 13}, "`asked` <= scans"),
        ({"neighbors": 0}, "neighbors"),
        ({"merge": 0.0}, "merge"),
        ({"report": 1.0}, "report"),
        ({"filter": "pmb"}, "encoding.filter is not a known field"),
    ],
)
def test_windows_that_nobody_can_use_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SetWindow.of({"kind": "set", **fields})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scan: scan[:, :2], "must have shape"),
        (lambda scan: scan[0], "must have shape"),
        (lambda scan: np.where(scan == 1.0, 0.5, scan), "existence 0 or 1"),
        (lambda scan: np.where(np.arange(3) == 1, np.nan, scan), "must be finite"),
    ],
    ids=["columns", "one row", "half a measurement", "not a number"],
)
def test_scans_that_nobody_can_read_are_refused(change: Any, message: str) -> None:
    env = gym.make("ClutterTracking-v0", **CLEAN)
    scan, _ = env.reset(seed=100_000)
    with pytest.raises(ValueError, match=message):
        predictor(env).predict(change(scan))


def test_measurements_may_stand_in_any_row() -> None:
    env = gym.make("ClutterTracking-v0", **CLEAN)
    scan, _ = env.reset(seed=100_000)
    wanted, _ = predictor(env).predict(scan)
    found, _ = predictor(env).predict(scan[::-1])
    order = [np.lexsort(answer.T) for answer in (wanted, found)]
    assert wanted[:, 0].sum() >= 2
    np.testing.assert_allclose(found[order[1]], wanted[order[0]])
