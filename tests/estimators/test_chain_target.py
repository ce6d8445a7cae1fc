"""A board that moves by itself: it is noticed, its velocity is found, and bad numbers do no harm."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from test_chain import FOCAL, PERIOD, ChainWorld, measure, walk

from servotrack.estimators.jacobian import ChainBank, ChainJacobian
from servotrack.estimators.jacobian.chain_keyframes import noise_of
from servotrack.estimators.jacobian.chain_target import correct_target, forecast_target


@pytest.mark.parametrize("speed", [0.0, 0.01])
def test_a_bank_notices_a_board_that_moves_and_finds_its_velocity(speed):
    """The arm looks around while the board glides sideways at `speed`, m/s, or rests."""
    rng = np.random.default_rng(5)
    world, path, state = ChainWorld(rng, 4, "hand"), walk(rng, 4, 240, 0.02), None
    bank = ChainBank(plays=(0.0, 0.02), moving=(0.0,))
    for t, angles in enumerate(path):
        seen = world.features(angles) + rng.normal(0.0, 0.2, 8)
        state = bank.initial(measure(angles, seen, t)) if state is None else state
        state, estimate = bank.step(state, measure(angles, seen, t))
        world.board[:, 0] += PERIOD * speed
    # Points on the board glide by some f v / z.
    expected = FOCAL * speed / 0.5
    assert np.linalg.norm(estimate.jacobian[:, -1].reshape(4, 2), axis=1) == pytest.approx(expected, rel=0.4, abs=1e-12)


@pytest.mark.parametrize("uncertain", [1e-8, 1.0, 1e6])
def test_variances_stay_finite_and_positive_whatever_is_seen(uncertain):
    """Exact and hopeless frames, outliers, parameters known or not, and a pause of an hour."""
    rng = np.random.default_rng(0)
    settings = ChainJacobian().settings(3)
    memory = SimpleNamespace(
        motion=np.zeros((1, 12)),
        motion_covariance=np.diag([0.0] * 6 + [1.0] * 6)[None],
        white=np.array([settings.least_noise**2]),
        offset_variance=np.zeros((1, 8)),
    )
    for step in range(200):
        forecast_target.py_func(memory, 3600.0 if step == 100 else PERIOD, settings, 0)
        rows, columns = 600.0 * rng.normal(size=(8, 6)), uncertain * rng.normal(size=(20, 8))
        innovations = rng.normal(size=8) * rng.choice([0.0, 1.0, 1e6])
        used = rng.random(8) < 0.8
        used[0] = True
        correct_target.py_func(memory, innovations, used, rows, columns, settings, 0)
        covariance = memory.motion_covariance[0]
        assert np.isfinite(memory.motion).all() and np.isfinite(covariance).all()
        assert (np.diagonal(covariance) >= 0.0).all()


@pytest.mark.parametrize("weight", [1e-300, 1e-12, 0.2, 0.5])
def test_frames_of_little_weight_leave_the_noise_as_it_was_expected(weight):
    settings = ChainJacobian().settings(3)
    parameters = np.zeros(6 * 3 + 3 * 4 + 3)
    parameters[6 * 3 + 2 : -3 : 3] = 1.0
    store = np.zeros((5, 3)), np.full((5, 8), 0.3), np.full((5, 8), weight)
    known = np.zeros((5, 8)), np.full((5, 3), np.nan)
    found = noise_of(parameters, False, store, 0.0, 1.0, settings, known)
    assert 0.3 * settings.noise**2 < found < 3.0 * settings.noise**2
