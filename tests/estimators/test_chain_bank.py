"""Bank of chains in one compiled step: the bits of an `EstimatorBank`, batches, and refusals."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from estimator_zoo import UnseenInputs
from test_chain import PERIOD, ChainWorld, measure, walk

from servotrack.estimators.jacobian import (
    AdaptiveKalmanJacobian,
    Alignment,
    ChainBank,
    ChainJacobian,
    EstimatorBank,
    KalmanJacobian,
)
from servotrack.estimators.testing import check_estimator

PLAYS = (0.0, 0.01, 0.02)


def bank_of_members(**chain):
    members = []
    for play in PLAYS:
        alignment = Alignment(play=play)
        linear = AdaptiveKalmanJacobian(alignment=alignment)
        members.append(ChainJacobian(linear=linear, alignment=alignment, **chain))
    return EstimatorBank(tuple(members))


def in_turn(state):
    """State of a bank of members that are fitted one after the other by the clock of the first, as in a `ChainBank`."""
    members, time = [], state.members[0].chain.clock[..., 0]
    for k, one in enumerate(state.members):
        clock = one.chain.clock.copy()
        clock[..., 0] = time + k * ChainJacobian().refit / len(PLAYS)
        members.append(one._replace(chain=one.chain._replace(clock=clock)))
    return state._replace(members=tuple(members))


def assert_equal(first, second):
    for field in fields(first):
        np.testing.assert_array_equal(getattr(first, field.name), getattr(second, field.name), err_msg=field.name)


def member(tree, k, axis):
    """State of one chain."""
    if isinstance(tree, tuple):
        return type(tree)(*(member(leaf, k, axis) for leaf in tree))
    return np.take(tree, k, axis)


def assert_equal_trees(first, second):
    if isinstance(first, tuple):
        for name, a, b in zip(first._fields, first, second, strict=True):
            assert_equal_trees(a, b) if isinstance(a, tuple) else np.testing.assert_array_equal(a, b, err_msg=name)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("batch", [(), (2,), (2, 1)])
def test_it_gives_the_bits_of_a_bank_of_members(batch, late):
    """Points hidden one by one, frames lost, outliers; `late`: encoder readings have stamps of their own."""
    rng = np.random.default_rng(3)
    rows, joints = int(np.prod(batch, dtype=np.int64)), 5
    worlds = [ChainWorld(rng, joints, "hand") for _ in range(rows)]
    paths = [walk(rng, joints, 60) for _ in range(rows)]
    together = ChainBank(ChainJacobian(keyframes=12, eager=30.0), PLAYS)
    apart = bank_of_members(keyframes=12, eager=30.0)
    state, expected_state, best = None, None, set()
    for t in range(60):
        seen = np.array([w.features(np.clip(p[t], p[t] - 0.01, p[t])) for w, p in zip(worlds, paths, strict=True)])
        seen += rng.normal(0.0, 1.0, seen.shape) + 40.0 * (rng.random(seen.shape) < 0.02)
        visible = rng.random((rows, 4)) < (0.0 if t % 9 == 4 else 0.8)
        angles = np.array([path[t] for path in paths])
        measurement = measure(angles.reshape(*batch, joints), seen.reshape(*batch, 8), t)
        measurement = measurement._replace(visible=visible.reshape(*batch, 4))
        if late:
            measurement = measurement._replace(joint_time=measurement.time - 0.4 * PERIOD)
        if state is None:
            state, expected_state = together.initial(measurement), in_turn(apart.initial(measurement))
        state, estimate = together.step(state, measurement)
        expected_state, expected = apart.step(expected_state, measurement)
        expected_state = in_turn(expected_state)
        assert_equal(estimate, expected)
        np.testing.assert_array_equal(state.log_weight, expected_state.log_weight)
        for k, one in enumerate(expected_state.members):
            assert_equal_trees(member(state.members, k, len(batch)), one)
        best |= set(np.ravel(state.log_weight.argmax(axis=-1)))
        if t == 40:
            state, expected_state = together.forget(state), apart.forget(expected_state)
    assert len(best) > 1


def test_check_estimator_passes():
    check_estimator(ChainBank(ChainJacobian(keyframes=8), PLAYS), UnseenInputs(joints=3, features=4, batch=(2,)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ChainBank(plays=()), "plays must have at least one"),
        (lambda: ChainBank(plays=(-0.1,)), "play must be a finite number >= 0"),
        (lambda: ChainBank(ChainJacobian(linear=KalmanJacobian())), "use EstimatorBank instead"),
        (lambda: ChainBank(forgetting=0.0), "forgetting"),
    ],
)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_bad_measurements_are_refused():
    rng = np.random.default_rng(0)
    world, bank = ChainWorld(rng, 3, "hand"), ChainBank(plays=PLAYS)
    first = measure(np.zeros(3), world.features(np.zeros(3)), 1)
    state, _ = bank.step(bank.initial(first), first)
    with pytest.raises(ValueError, match="time must not go backwards"):
        bank.step(state, measure(np.zeros(3), world.features(np.zeros(3)), 0))
    with pytest.raises(ValueError, match=r"joint_angles must have the shape \(3,\)"):
        bank.step(state, measure(np.zeros(4), world.features(np.zeros(3)), 2))
    with pytest.raises(ValueError, match="make a new state"):
        bank.step(state, measure(np.zeros((2, 3)), np.zeros((2, 8)), 2))
    with pytest.raises(ValueError, match="joint_time must be given at every step or at none"):
        bank.step(state, first._replace(joint_time=first.time))
