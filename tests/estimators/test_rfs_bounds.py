"""The bound on OSPA: its integral, its covariances, and that no agent passes it."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.utils import seeding
from scipy.special import erf

from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.leaderboard.clutter_bound import LEVELS, ospa_bound
from servotrack.envs.streams import episode_seed
from servotrack.envs.track.clutter.config import clutter_config
from servotrack.envs.track.clutter.episode import draw_episode, turn_angles
from servotrack.estimators.rfs import RangeBearingModel, constant_velocity, pairwise_structure
from servotrack.estimators.rfs.bounds import expected_distance, known_covariances

PLANE = constant_velocity(5.0, 1.5)
BIRTH = np.diag([100.0, 25.0, 100.0, 25.0])


SHAPES = {"round": [[1.0, 0.0], [0.0, 1.0]], "tilted": [[4.0, 1.0], [1.0, 2.0]], "long": [[400.0, 0.0], [0.0, 0.25]]}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("cutoff", [0.5, 3.0, 100.0])
def test_expected_distance_is_the_integral_of_its_tail(shape, cutoff):
    # E min(c, |x|) is the integral of P(|x| > r) over r below c; P(|x| <= r) by slices of the disk.
    small, large = np.sqrt(np.linalg.eigvalsh(np.array(SHAPES[shape])))
    nodes, weights = np.polynomial.legendre.leggauss(400)
    angle, weight = 0.25 * np.pi * (nodes + 1.0), 0.25 * np.pi * weights
    r = 0.5 * cutoff * (nodes + 1.0)
    across = r[:, None] * np.sin(angle)
    inside = erf(r[:, None] * np.cos(angle) / (large * np.sqrt(2.0)))
    slices = np.exp(-0.5 * (across / small) ** 2) / (small * np.sqrt(2.0 * np.pi)) * inside
    within = 2.0 * (slices * r[:, None] * np.cos(angle) * weight).sum(axis=1)
    expected = (0.5 * cutoff * weights * (1.0 - within)).sum()
    assert expected_distance(np.array(SHAPES[shape]), cutoff) == pytest.approx(expected, rel=1e-5)


def test_certain_and_hopeless_positions():
    assert expected_distance(np.zeros((2, 2)), 5.0) == pytest.approx(0.0, abs=1e-200)
    assert expected_distance(1e18 * np.eye(2), 5.0) == pytest.approx(5.0)
    assert expected_distance(np.tile(np.eye(2), (3, 4, 1, 1)), 5.0).shape == (3, 4)
    with pytest.raises(ValueError, match="cutoff must be > 0, got 0"):
        expected_distance(np.eye(2), 0)
    with pytest.raises(ValueError, match=r"covariance must have shape \(\.\.\., 2, 2\), got \(3, 3\)"):
        expected_distance(np.eye(3), 1.0)


@pytest.mark.parametrize("model", [PLANE, pairwise_structure(PLANE, "S1")], ids=["hidden", "pairwise"])
@pytest.mark.parametrize("lag", [0, 2, 7])
def test_covariances_are_those_of_the_joint_gaussian(model, lag):
    packed, n, m = model.packed, 4, 2
    detected = np.array([True, False, True, True, False, True, True])
    S, N = len(detected), n + m
    birth = np.diag([100.0, 25.0, 100.0, 25.0])
    H = packed.observation
    start = np.vstack([np.eye(n), H])
    first = start @ birth @ start.T
    first[n:, n:] += packed.measurement_noise
    # The whole trajectory is a linear map of independent noises.
    mapping = np.zeros((S * N, S * N))
    for k in range(S):
        for j in range(k + 1):
            power = np.linalg.matrix_power(packed.transition, k - j)
            mapping[k * N : (k + 1) * N, j * N : (j + 1) * N] = power
    noise = np.kron(np.eye(S), packed.noise)
    noise[:N, :N] = first
    joint = mapping @ noise @ mapping.T
    found = known_covariances(model, birth, detected, lag)
    for k in range(S):
        seen = [j * N + n + i for j in range(min(k + lag, S - 1) + 1) if detected[j] for i in range(m)]
        wanted = [k * N + i for i in range(n)]
        cross = joint[np.ix_(wanted, seen)]
        expected = joint[np.ix_(wanted, wanted)] - cross @ np.linalg.solve(joint[np.ix_(seen, seen)], cross.T)
        np.testing.assert_allclose(found[k], expected, rtol=1e-7, atol=1e-7)


def test_covariances_follow_given_transitions():
    rng = np.random.default_rng(8)
    detected, n = np.array([True, False, True, True, False, True]), 4
    H, R, Q = PLANE.observation, PLANE.measurement_noise, PLANE.process_noise
    moves = np.zeros((6, 6, 6))
    moves[:, :n, :n] = PLANE.transition + 0.3 * rng.standard_normal((6, n, n))
    moves[:, n:, :n] = H @ moves[:, :n, :n]
    found = known_covariances(PLANE, BIRTH, detected, 0, moves)
    P = BIRTH
    for k in range(6):
        if k:
            P = moves[k, :n, :n] @ P @ moves[k, :n, :n].T + Q
        if detected[k]:
            P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        np.testing.assert_allclose(found[k], P, rtol=1e-8, atol=1e-8)
    same = np.tile(PLANE.packed.transition, (6, 1, 1))
    np.testing.assert_array_equal(
        known_covariances(PLANE, BIRTH, detected, 2, same), known_covariances(PLANE, BIRTH, detected, 2)
    )
    with pytest.raises(ValueError, match=r"transitions must have shape \(6, 6, 6\), one per scan, got \(6, 6\)"):
        known_covariances(PLANE, BIRTH, detected, 0, moves[0])


def test_turn_angles_are_those_of_the_paths():
    config = clutter_config(3, structure="HMM", acceleration_noise=1e-3, birth_speed=5.0)
    seed = episode_seed(seeding.np_random(180_000)[0])
    episode, turns = draw_episode(config, seed), turn_angles(config, seed)
    together = episode.exists[1:] & episode.exists[:-1]
    velocity = episode.states[:, :, 1] + 1j * episode.states[:, :, 3]
    expected = velocity[:-1] * np.exp(1j * turns[1:])
    assert np.abs(turns).max() > 0.1
    np.testing.assert_allclose(velocity[1:][together], expected[together], atol=0.01)


def test_bad_input_is_refused_by_name():
    model = RangeBearingModel(PLANE.transition, PLANE.process_noise, PLANE.observation, np.eye(2))
    with pytest.raises(ValueError, match="model must be linear, got RangeBearingModel"):
        known_covariances(model, np.eye(4), np.ones(3, bool))
    with pytest.raises(ValueError, match="lag must be at least 0, got -1"):
        known_covariances(PLANE, np.eye(4), np.ones(3, bool), -1)


def assert_not_below(level, agents, seeds):
    bound = np.array([ospa_bound(clutter_config(level), seed) for seed in seeds])
    for agent in agents:
        cell = evaluate("ClutterTracking-v0", agent, seeds, env_kwargs={"level": level})
        ospa = {row["seed"]: row["ospa"] for row in cell.rows}
        excess = np.array([ospa[seed] for seed in seeds]) - bound
        assert excess.mean() > -1.96 * excess.std(ddof=1) / np.sqrt(len(seeds)), (level, agent, excess.mean())


def test_no_agent_passes_the_bound():
    seeds = list(range(180_000, 180_006))
    for level in (0, 2, 3, 4):
        assert_not_below(level, ["association-oracle", "pmb"], seeds)


@pytest.mark.slow
@pytest.mark.parametrize("level", LEVELS)
def test_no_agent_passes_the_bound_in_many_episodes(level):
    assert_not_below(level, ["pmb", "pmbm", "gm-phd"], list(range(180_000, 181_000)))
