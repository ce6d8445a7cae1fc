"""The labeled multi-Bernoulli filter against exact marginals of small scenes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from servotrack.estimators.rfs import LMB, PMB, Birth, MeasurementBirth, Reduction, Spawn, constant_velocity
from servotrack.estimators.stateful import Stateful

PLANE = constant_velocity(5.0, 1.5)
P0 = np.diag([9.0, 4.0, 9.0, 4.0])
UNREDUCED = Reduction(prune=0.0, merge=0.0, components=50, existence=0.0)


def exact_marginals(means, r, z, detection, kappa):
    """Existence of each target after one scan, by all assignments of measurements to targets."""
    H, S = PLANE.observation, PLANE.observation @ P0 @ PLANE.observation.T + PLANE.measurement_noise
    norm = 1.0 / math.sqrt(np.linalg.det(2.0 * np.pi * S))
    total, exists = 0.0, np.zeros(len(r))
    for choice in itertools.product(range(-2, len(z)), repeat=len(r)):
        # -2: absent, -1: missed.
        used = [j for j in choice if j >= 0]
        if len(set(used)) < len(used):
            continue
        weight = kappa ** (len(z) - len(used))
        for i, j in enumerate(choice):
            if j == -2:
                weight *= 1.0 - r[i]
            elif j == -1:
                weight *= r[i] * (1.0 - detection)
            else:
                d = z[j] - H @ means[i]
                weight *= r[i] * detection * norm * math.exp(-0.5 * d @ np.linalg.solve(S, d))
        total += weight
        exists[[j >= -1 for j in choice]] += weight
    return exists / total


@pytest.mark.parametrize(("distance", "tolerance"), [(200.0, 1e-9), (12.0, 0.05), (5.0, 0.1)])
@pytest.mark.parametrize("seed", range(4))
def test_existence_is_the_marginal_over_all_associations(distance, tolerance, seed):
    rng = np.random.default_rng(seed)
    r, kappa, detection = rng.uniform(0.1, 0.9, 3), 1e-4, 0.9
    means = np.zeros((3, 4))
    means[:, 0] = distance * np.arange(3)
    z = np.vstack([means[:2, [0, 2]] + rng.normal(0.0, 3.0, (2, 2)), rng.uniform(-20.0, 2.5 * distance, (1, 2))])
    filter = LMB(
        PLANE, Birth(r, means, P0), clutter_intensity=kappa, detection=detection, gate_probability=1.0,
        reduction=UNREDUCED,
    )  # fmt: skip
    state, estimate = filter.step(filter.initial(z), z)
    found = dict(zip(state.tracks.label.tolist(), state.tracks.existence.tolist(), strict=True))
    wanted = exact_marginals(means, r, z, detection, kappa)
    # Loopy belief propagation is exact where no two targets compete for two measurements, and approximate elsewhere.
    np.testing.assert_allclose([found[1 + i] for i in range(3)], wanted, atol=tolerance)
    assert estimate.expected_number == pytest.approx(wanted.sum(), abs=3.0 * tolerance)


def test_a_target_has_its_identity_before_its_first_detection():
    birth = Birth([0.4], np.zeros((1, 4)), P0)
    nowhere = Birth([1e-9], np.full((1, 4), 1e5), P0)
    first = LMB(PLANE, birth, clutter_intensity=1e-6, detection=0.6, survival=1.0)
    later = LMB(PLANE, nowhere, clutter_intensity=1e-6, detection=0.6, survival=1.0)
    state, _ = first.step(first.initial([]), [])
    (label,) = state.tracks.label[state.tracks.existence > 0.01]
    for _ in range(3):
        state, estimate = later.step(state, [])
    state, estimate = later.step(state, [[1.0, -1.0]])
    assert estimate.labels.tolist() == [label]


def test_it_tracks_as_pmb_does_in_clutter():
    rng = np.random.default_rng(100_000)
    birth = MeasurementBirth(0.2, 10.0)
    options = {"clutter_intensity": 10.0 / 1000.0**2, "detection": 0.9}
    lmb, pmb = Stateful(LMB(PLANE, birth, **options)), Stateful(PMB(PLANE, birth, **options))
    starts = np.array([[-300.0, 10.0, -200.0, 5.0], [300.0, -8.0, 100.0, -6.0], [0.0, 3.0, 300.0, -9.0]])
    near = {"lmb": 0, "pmb": 0}
    for k in range(40):
        true = starts[:, [0, 2]] + k * starts[:, [1, 3]]
        seen = true[rng.random(3) < 0.9]
        z = np.vstack([seen + rng.normal(0.0, 1.5, seen.shape), rng.uniform(-500.0, 500.0, (rng.poisson(10.0), 2))])
        for name, tracker in (("lmb", lmb), ("pmb", pmb)):
            estimate = tracker.step(z)
            if k >= 10:
                apart = np.linalg.norm(estimate.states[:, None, [0, 2]] - true[None], axis=2)
                near[name] += len(estimate.states) == 3 and apart.min(axis=0).max() < 10.0
    assert near["pmb"] >= 24
    assert abs(near["lmb"] - near["pmb"]) <= 2


def test_split_targets_get_identities_of_their_own():
    birth = Birth([0.2], np.zeros((1, 4)), P0)
    spawn = Spawn(0.2, np.diag([9.0, 100.0, 9.0, 100.0]))
    tracker = Stateful(LMB(PLANE, birth, spawn=(spawn,), clutter_intensity=1e-6, detection=0.98))
    for k in range(12):
        z = [[10.0 * k, 0.0]] + ([[10.0 * k, 12.0 * (k - 5)]] if k > 5 else [])
        estimate = tracker.step(z)
    assert len(set(estimate.labels.tolist())) == 2
    assert estimate.labels.min() >= 1
