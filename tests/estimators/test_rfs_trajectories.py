"""The trajectory PMB filter: smoothed states and existence against enumeration, and its online part against PMB."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.rfs import (
    PMB,
    Birth,
    HiddenMarkovModel,
    MeasurementBirth,
    RangeBearingModel,
    Reduction,
    TrajectoryPMB,
    constant_velocity,
    pairwise_structure,
    track_scans,
)
from servotrack.estimators.stateful import Stateful
from servotrack.estimators.testing import check_estimator

HMM = constant_velocity(5.0, 1.5)
S1 = pairwise_structure(HMM, "S1")
NONE = np.zeros((0, 2))
UNREDUCED = Reduction(prune=0.0, merge=0.0, components=200, existence=0.0, tracks=20, pool=2000, candidates=1000)


def joint_gaussian(model, mean, covariance, steps):
    """Mean and covariance of (x, y) of `steps` scans, stacked; the target begins at the first one."""
    packed = model.packed
    m, n = packed.observation.shape
    N, H, B = n + m, packed.observation, packed.transition
    first = np.block(
        [[covariance, covariance @ H.T], [H @ covariance, H @ covariance @ H.T + packed.measurement_noise]]
    )
    total, blocks = np.zeros((steps, N)), np.zeros((steps, steps, N, N))
    total[0], blocks[0, 0] = np.concatenate([mean, H @ mean]), first
    for k in range(1, steps):
        total[k] = B @ total[k - 1]
        for j in range(k):
            blocks[k, j] = B @ blocks[k - 1, j]
            blocks[j, k] = blocks[k, j].T
        blocks[k, k] = B @ blocks[k - 1, k - 1] @ B.T + packed.noise
    return total.reshape(-1), blocks.transpose(0, 2, 1, 3).reshape(steps * N, steps * N)


def condition(model, mean, covariance, steps, seen):
    """Density of the detections, {scan: z}, and the states' moments given them, by one dense Gaussian."""
    m, n = model.packed.observation.shape
    total, joint = joint_gaussian(model, mean, covariance, steps)
    x = np.concatenate([np.arange(k * (n + m), k * (n + m) + n) for k in range(steps)])
    y = np.concatenate([np.arange(k * (n + m) + n, (k + 1) * (n + m)) for k in seen])
    S = joint[np.ix_(y, y)]
    error = np.concatenate(list(seen.values())) - total[y]
    gain = np.linalg.solve(S, joint[np.ix_(y, x)]).T
    density = np.exp(-0.5 * error @ np.linalg.solve(S, error)) / np.sqrt(np.linalg.det(2.0 * np.pi * S))
    after = joint[np.ix_(x, x)] - gain @ joint[np.ix_(y, x)]
    states = (total[x] + gain @ error).reshape(steps, n)
    return density, states, np.array([after[k * n : k * n + n, k * n : k * n + n] for k in range(steps)])


def rauch_tung_striebel(model, mean, covariance, scans):
    """Smoothed states by the textbook's two passes."""
    F, Q, H, R = model.transition, model.process_noise, model.observation, model.measurement_noise
    filtered, predicted = [], []
    x, P = mean, covariance
    for k, z in enumerate(scans):
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        predicted.append((x, P))
        if len(z):
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            x, P = x + K @ (z[0] - H @ x), P - K @ H @ P
        filtered.append((x, P))
    smoothed = [filtered[-1]]
    for k in range(len(scans) - 2, -1, -1):
        (x, P), (x_next, P_next) = filtered[k], predicted[k + 1]
        G = P @ F.T @ np.linalg.inv(P_next)
        smoothed.append((x + G @ (smoothed[-1][0] - x_next), P + G @ (smoothed[-1][1] - P_next) @ G.T))
    return smoothed[::-1]


@pytest.mark.parametrize("model", [HMM, S1], ids=["hmm", "pmm"])
@pytest.mark.parametrize("lag", [1, 3, 6])
def test_states_equal_those_of_a_fixed_lag_smoother(model, lag):
    rng = np.random.default_rng(3)
    mean, covariance = np.array([0.0, 5.0, 0.0, -3.0]), np.diag([100.0, 25.0, 100.0, 25.0])
    total, joint = joint_gaussian(model, mean, covariance, 20)
    path = rng.multivariate_normal(total, joint).reshape(20, 6)
    missed = {4, 7, 8, 15}
    scans = [NONE if k in missed else path[k, None, 4:] for k in range(20)]
    tracker = Stateful(
        TrajectoryPMB(
            model, Birth([0.03], [mean], covariance), clutter_intensity=1e-9, detection=0.6, survival=0.999, lag=lag,
            reduction=Reduction(components=5, merge=0.0),
        )
    )  # fmt: skip
    for k, z in enumerate(scans):
        estimate = tracker.step(z)
        seen = {j: scans[j][0] for j in range(k + 1) if j not in missed}
        _, states, covariances = condition(model, mean, covariance, k + 1, seen)
        wanted = [(k - lag, estimate)] if k >= lag else []
        wanted += [(k - j, tracker.estimator.flush(tracker.state)[-1 - j]) for j in range(min(lag, k + 1))]
        for t, found in wanted:
            np.testing.assert_allclose(found.states[0], states[t], rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.covariances[0], covariances[t], rtol=0, atol=1e-9)
        if model is HMM and k >= lag:
            x, P = rauch_tung_striebel(model, mean, covariance, scans[: k + 1])[k - lag]
            np.testing.assert_allclose(estimate.states[0], x, rtol=0, atol=1e-9)
            np.testing.assert_allclose(estimate.covariances[0], P, rtol=0, atol=1e-9)


FAR_AWAY = Birth([0.01], [[1e6, 0.0, 1e6, 0.0]], np.eye(4))


def existence_by_enumeration(model, birth, scans, detection, survival, clutter):
    """P(the target of the first measurement exists at t | all scans), and its inverse cases.

    Every birth up to the first measurement, every death, and every set of later measurements that the target caused;
    the others are clutter.
    """
    last = len(scans) - 1
    first, *later = [k for k, z in enumerate(scans) if len(z)]
    total, present = clutter ** (1 + len(later)), np.zeros(last + 1)
    for start, end in itertools.product(range(first + 1), range(first, last + 1)):
        inside = [k for k in later if k <= end]
        for chosen in itertools.product((False, True), repeat=len(inside)):
            detected = [first, *(k for k, own in zip(inside, chosen, strict=True) if own)]
            own = {k - start: scans[k][0] for k in detected}
            density = sum(
                w * condition(model, mean, covariance, end - start + 1, own)[0]
                for w, mean, covariance in zip(birth.weights, birth.means, birth.covariances, strict=True)
            )
            share = density * survival ** (end - start) * (1.0 if end == last else 1.0 - survival)
            share *= detection ** len(detected) * (1.0 - detection) ** (end - start + 1 - len(detected))
            share *= clutter ** (1 + len(later) - len(detected))
            total += share
            present[start : end + 1] += share
    return present / total


@pytest.mark.parametrize("model", [HMM, S1], ids=["hmm", "pmm"])
@pytest.mark.parametrize("seen", [(0,), (2,), (0, 1), (1, 3, 5), (2, 5), (0, 1, 2, 3, 4, 5), (3, 4)])
@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 1000), detection=st.floats(0.2, 0.97), survival=st.floats(0.5, 0.99))
def test_existence_equals_enumeration_of_births_deaths_and_detections(model, seen, seed, detection, survival):
    rng = np.random.default_rng(seed)
    birth = Birth(rng.uniform(0.01, 0.2, 2), rng.normal(0, [10, 4, 10, 4], (2, 4)), np.diag([100.0, 25.0, 100.0, 25.0]))
    clutter = 10 ** rng.uniform(-6, -2)
    scans = [rng.normal(0.0, 12.0, (1, 2)) if k in seen else NONE for k in range(6)]
    estimator = TrajectoryPMB(
        model, birth, clutter_intensity=clutter, detection=detection, survival=survival, gate_loss=0.0,
        reduction=UNREDUCED, undetected=1000, lag=5,
    )  # fmt: skip
    state = estimator.initial(NONE)
    for k, z in enumerate(scans):
        state, _ = estimator.step(state, z)
        if k == seen[0]:
            # No other target may cause a later measurement: that is the one approximation of PMB, not of the lag.
            estimator = replace(estimator, birth=FAR_AWAY)
            state.undetected.weight[:] = 0.0
        if k < seen[0]:
            continue
        table = state.trajectories
        row = int(np.flatnonzero(table.label[: table.number] == 1)[0])
        found = (table.alive[row] * table.begun[row] + table.ended[row])[: k + 1][::-1]
        wanted = existence_by_enumeration(model, birth, scans[: k + 1], detection, survival, clutter)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


def test_number_of_undetected_targets_is_that_of_their_births_and_deaths():
    detection, survival, birth = 0.4, 0.9, Birth([0.1, 0.2], np.zeros((2, 4)), np.eye(4))
    estimator = TrajectoryPMB(
        HMM, birth, clutter_intensity=1e-3, detection=detection, survival=survival, reduction=UNREDUCED, lag=5
    )
    state = estimator.initial(NONE)
    for k in range(6):
        state, _ = estimator.step(state, NONE)
        wanted = [
            sum(
                0.3 * survival ** (end - start) * (1.0 if end == k else 1.0 - survival) * 0.6 ** (end - start + 1)
                for start in range(t + 1)
                for end in range(t, k + 1)
            )
            for t in range(k + 1)
        ]
        np.testing.assert_allclose(state.trajectories.hidden[: k + 1][::-1], wanted, rtol=0, atol=1e-12)


def test_merging_keeps_the_moments_of_past_states():
    # Without process noise a past state is a linear function of the newest one, through every merging.
    model = HiddenMarkovModel(HMM.transition, np.zeros((4, 4)), HMM.observation, HMM.measurement_noise)
    rng = np.random.default_rng(5)
    estimator = TrajectoryPMB(
        model, Birth([0.1], [np.zeros(4)], np.diag([100.0, 25.0, 100.0, 25.0])), clutter_intensity=1e-3,
        detection=0.7, lag=3, reduction=Reduction(components=5, merge=9.0),
    )  # fmt: skip
    state, merged = estimator.initial(NONE), 0
    for k in range(12):
        z = np.concatenate([[[2.0 * k, k]], rng.uniform(-20, 40, (6, 2))]) + rng.normal(0, 1.5, (7, 2))
        state, _ = estimator.step(state, z)
        for c in range(state.pool.number):
            back = np.eye(4)
            merged += 0.0 < state.past.begun[c, 0] < 1.0
            for past in range(3):
                back = back @ np.linalg.inv(model.transition)
                if state.past.begun[c, past] != 1.0:
                    continue
                P = state.pool.covariance[c, :4, :4]
                np.testing.assert_allclose(state.past.mean[c, past], back @ state.pool.mean[c, :4], atol=1e-7)
                np.testing.assert_allclose(state.past.cross[c, past, :, :4], back @ P, atol=1e-7)
                np.testing.assert_allclose(state.past.covariance[c, past], back @ P @ back.T, atol=1e-7)
    assert merged


def scenes(rng, steps, batch=None):
    for k in range(steps):
        scan = np.zeros((batch or 1, 12, 3))
        for b in range(batch or 1):
            number = rng.integers(3, 9)
            scan[b, :number, 0], scan[b, :number, 1:] = 1.0, rng.uniform(-60, 60, (number, 2))
            if rng.random() < 0.9:
                scan[b, number] = [1.0, 3.0 * k, 2.0 * k]
        yield scan if batch else scan[0, scan[0, :, 0] == 1.0, 1:]


@pytest.mark.parametrize(
    "model",
    [HMM, S1, RangeBearingModel(HMM.transition, HMM.process_noise, HMM.observation, np.diag([25.0, 1e-4]), (-900, 0))],
    ids=["hmm", "pmm", "range-bearing"],
)
def test_online_part_is_pmb_to_the_bit(model):
    arguments = {"clutter_intensity": 1e-4, "detection": 0.8}
    filters = [
        kind(model, MeasurementBirth(), **arguments, **more)
        for kind, more in ((PMB, {}), (TrajectoryPMB, {"lag": 4}), (TrajectoryPMB, {"lag": 0, "least_length": 0}))
    ]
    states = [f.initial(NONE) for f in filters]
    for z in scenes(np.random.default_rng(0), 30):
        scan = z if not isinstance(model, RangeBearingModel) else np.stack([900 + z[:, 0], z[:, 1] / 900], axis=1)
        results = [f.step(s, scan) for f, s in zip(filters, states, strict=True)]
        states, estimates = [r[0] for r in results], [r[1] for r in results]
        for state in states[1:]:
            for part in ("tracks", "pool", "undetected", "births"):
                for a, b in zip(getattr(states[0], part), getattr(state, part), strict=True):
                    np.testing.assert_array_equal(a, b)
        for name in ("states", "labels", "existence", "covariances", "held_labels"):
            np.testing.assert_array_equal(getattr(estimates[0], name), getattr(estimates[2], name))


def test_batch_equals_single_runs():
    estimator = TrajectoryPMB(S1, MeasurementBirth(), clutter_intensity=1e-4, detection=0.8, lag=3)
    steps = list(scenes(np.random.default_rng(1), 25, batch=3))
    state = estimator.initial(steps[0])
    alone = [estimator.initial(NONE) for _ in range(3)]
    for scan in steps:
        state, estimate = estimator.step(state, scan)
        for b in range(3):
            alone[b], own = estimator.step(alone[b], scan[b, scan[b, :, 0] == 1.0, 1:])
            k = len(own.labels)
            np.testing.assert_array_equal(estimate.labels[b, :k], own.labels)
            np.testing.assert_array_equal(estimate.states[b, :k], own.states)
    for b, whole in itertools.product(range(3), range(3)):
        own = estimator.flush(alone[b])[whole]
        k = len(own.labels)
        np.testing.assert_array_equal(estimator.flush(state)[whole].states[b, :k], own.states)


def test_targets_start_before_their_first_detection_and_end_where_they_disappeared():
    birth = Birth([0.05], [[0.0, 20.0, 0.0, 0.0]], np.diag([4.0, 1.0, 4.0, 1.0]))
    slow = constant_velocity(0.5, 1.5)
    estimator = TrajectoryPMB(slow, birth, clutter_intensity=1e-6, detection=0.6, survival=0.98, lag=8)
    tracker = Stateful(estimator)
    found = []
    for k in range(40):
        # The first detection is three scans of motion away from the place of birth.
        estimate = tracker.step(np.array([[20.0 * k, 0.0]]) if 3 <= k < 20 else NONE)
        if k >= 8:
            found.append((estimate.labels.tolist(), estimate.states))
    assert [t for t, (labels, _) in enumerate(found) if labels] == list(range(20))
    assert len({labels[0] for labels, _ in found if labels}) == 1
    np.testing.assert_allclose([states[0, 0] for _, states in found[:20]], 20.0 * np.arange(20), atol=3.0)


def test_short_trajectories_are_withheld():
    for least, wanted in ((0, 2), (3, 0)):
        estimator = TrajectoryPMB(
            HMM, Birth([0.2], [np.zeros(4)], 100.0 * np.eye(4)), clutter_intensity=1e-7, lag=6, least_length=least
        )
        tracker = Stateful(estimator)
        reported = [len(tracker.step(np.array([[5.0 * k, 0.0]]) if k < 2 else NONE).labels) for k in range(20)]
        assert sum(reported) == wanted


def test_invalid_arguments():
    for name, value in (("lag", -1), ("least_length", -1)):
        with pytest.raises(ValueError, match=name):
            TrajectoryPMB(HMM, MeasurementBirth(), clutter_intensity=1e-6, **{name: value})


def test_contract():
    check_estimator(TrajectoryPMB(S1, MeasurementBirth(), clutter_intensity=1e-5, lag=2))


def test_two_scans_of_one_instant_smooth_as_one_scan_of_both():
    # Independent sensors at one time are two updates: the past is that of one instant, not of two.
    moving = constant_velocity(2.0, 1.5)
    birth = Birth([0.05], [np.zeros(4)], np.diag([25.0, 4.0, 25.0, 4.0]))
    arguments = {"clutter_intensity": 1e-7, "detection": 0.9, "lag": 3, "reduction": Reduction(components=5, merge=0.0)}
    half = replace(moving, measurement_noise=moving.measurement_noise / 2.0)
    twice, once = TrajectoryPMB(moving, birth, **arguments), TrajectoryPMB(half, birth, **arguments)
    states = [twice.initial(NONE), once.initial(NONE)]
    rng, times = np.random.default_rng(2), np.cumsum([1.0, 1.0, 3.0, 0.5, 2.0, 1.0, 4.0, 1.0, 1.0])
    for last, time in zip((0.0, *times), times, strict=False):
        first, second = np.array([[2.0 * time, time]]) + rng.normal(0, 1.5, (2, 1, 2))
        states[0], _ = twice.step(states[0], first, time - last)
        states[0], both = twice.step(states[0], second, 0.0)
        states[1], mean = once.step(states[1], 0.5 * (first + second), time - last)
        assert len(both.labels) == len(mean.labels)
        np.testing.assert_allclose(both.states, mean.states, atol=1e-6)
        np.testing.assert_allclose(both.covariances, mean.covariances, atol=1e-6)
    assert len(both.labels) == 1


def test_a_target_born_at_a_measurement_starts_with_it():
    tracker = Stateful(TrajectoryPMB(S1, MeasurementBirth(), clutter_intensity=1e-6, detection=0.9, lag=4))
    starts = [k - 4 for k in range(12) if len(tracker.step(np.array([[5.0 * k, 3.0]])).labels) and k >= 4]
    assert starts[0] == 0


def test_maneuvers_are_the_heavier_of_all_sequences_of_noises():
    rng = np.random.default_rng(5)
    mean, covariance = np.array([0.0, 5.0, 0.0, -3.0]), np.diag([100.0, 25.0, 100.0, 25.0])
    F, Q, H, R = HMM.transition, HMM.process_noise, HMM.observation, HMM.measurement_noise
    probability, agility, scans, x = 0.2, 6.0, [], mean + np.array([0.0, 3.0, 0.0, 4.0])
    for k in range(5):
        scans.append((H @ x + 1.5 * rng.standard_normal(2))[None])
        x = F @ x + (40.0 * np.eye(4)[1] if k == 2 else 0.0)
    best, most = None, -np.inf
    for noises in itertools.product((1.0, agility), repeat=4):
        # Forward filter and backward pass under one sequence.
        weight, x, P, filtered, predicted = 0.0, mean, covariance, [], []
        for k, z in enumerate(scans):
            if k > 0:
                scale = noises[k - 1]
                x, P = F @ x, F @ P @ F.T + scale**2 * Q
                weight += np.log(probability if scale > 1.0 else 1.0 - probability)
            predicted.append((x, P))
            S = H @ P @ H.T + R
            error = z[0] - H @ x
            weight -= 0.5 * (error @ np.linalg.solve(S, error) + np.linalg.slogdet(S)[1])
            gain = P @ H.T @ np.linalg.inv(S)
            x, P = x + gain @ error, P - gain @ S @ gain.T
            filtered.append((x, P))
        states = [filtered[-1][0]]
        for k in range(3, -1, -1):
            (x, P), (ahead, spread) = filtered[k], predicted[k + 1]
            states.append(x + P @ F.T @ np.linalg.solve(spread, states[-1] - ahead))
        if weight > most:
            best, most = states[::-1], weight
    tracker = Stateful(
        TrajectoryPMB(
            HMM, Birth([0.03], [mean], covariance), clutter_intensity=1e-12, detection=0.999, lag=4,
            reduction=UNREDUCED, gate_probability=1.0, maneuver=probability, agility=agility,
        )
    )  # fmt: skip
    for z in scans:
        estimate = tracker.step(z)
    found = [estimate, *tracker.estimator.flush(tracker.state)]
    np.testing.assert_allclose([one.states[0] for one in found], best, rtol=0, atol=1e-6)


def test_a_sudden_stop_keeps_its_identity_with_maneuvers_only():
    rng = np.random.default_rng(2)
    where = np.concatenate([15.0 * np.arange(20), np.full(20, 285.0), 285.0 + 15.0 * np.arange(20)])
    scans = [np.array([[x, 0.5 * x]]) + rng.normal(0.0, 1.0, (1, 2)) for x in where]
    model, birth = constant_velocity(0.1, 1.0), Birth([0.1], [[200.0, 0.0, 100.0, 0.0]], np.diag([4e4, 200.0] * 2))
    labels = []
    for maneuver in (0.0, 0.05):
        tracker = TrajectoryPMB(model, birth, clutter_intensity=1e-5, detection=0.95, maneuver=maneuver, agility=100.0)
        labels.append(len(track_scans(tracker, scans, np.arange(60.0))))
    assert labels[0] > 1 and labels[1] == 1


def test_maneuvers_are_per_time():
    birth = MeasurementBirth()
    tracker = TrajectoryPMB(HMM, birth, clutter_intensity=1e-6, maneuver=0.1)
    assert tracker.at(2.0).maneuver == pytest.approx(1.0 - 0.9**2)
    assert tracker.at(0.0).maneuver == 0.0
    with pytest.raises(ValueError, match="maneuver must be 0 under a pairwise"):
        TrajectoryPMB(S1, birth, clutter_intensity=1e-6, maneuver=0.1)
    for name, value in (("maneuver", 1.5), ("maneuver", np.nan), ("agility", 0.5)):
        with pytest.raises(ValueError, match=f"{name} must be"):
            TrajectoryPMB(HMM, birth, clutter_intensity=1e-6, **{name: value})
