"""The Poisson multi-Bernoulli mixture filter against Bayes' rule by enumeration, and against its projection, PMB."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.rfs import (
    PMB,
    PMBM,
    Birth,
    MeasurementBirth,
    Reduction,
    constant_velocity,
    pairwise_structure,
)
from servotrack.estimators.rfs.assignment import best_assignments
from servotrack.estimators.rfs.hypotheses import empty_hypotheses
from servotrack.estimators.rfs.pmbm import PMBMState
from servotrack.estimators.stateful import Stateful

HMM = constant_velocity(5.0, 1.5)
S1 = pairwise_structure(HMM, "S1")
UNREDUCED = Reduction(prune=0.0, merge=0.0, components=64, existence=0.0, tracks=20_000, pool=200_000, candidates=1000)
NONE = np.zeros((0, 2))


def all_assignments(cost):
    n, m = cost.shape
    found = []
    for choice in itertools.product(range(-1, m), repeat=n):
        columns = [j for j in choice if j >= 0]
        if len(set(columns)) == len(columns):
            found.append((sum(cost[i, j] for i, j in enumerate(choice) if j >= 0), choice))
    return sorted(entry for entry in found if math.isfinite(entry[0]))


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 100_000),
    n=st.integers(0, 4),
    m=st.integers(0, 5),
    scale=st.sampled_from([0.1, 1.0, 30.0]),
    forbidden=st.sampled_from([0.0, 0.3, 0.7]),
    ties=st.booleans(),
)
def test_murty_ranks_all_assignments(seed, n, m, scale, forbidden, ties):
    rng = np.random.default_rng(seed)
    cost = scale * rng.normal(size=(n, m))
    cost[rng.random((n, m)) < forbidden] = np.inf
    cost = np.round(cost) if ties else cost
    wanted = all_assignments(cost)
    totals, choices = best_assignments(cost, 10**6, np.inf, np.inf)
    np.testing.assert_allclose(totals, [total for total, _ in wanted], atol=1e-9)
    assert {tuple(choice) for choice in choices.tolist()} == {choice for _, choice in wanted}
    few = int(rng.integers(1, 12))
    np.testing.assert_allclose(best_assignments(cost, few, np.inf, np.inf)[0], totals[:few], atol=1e-9)
    middle = 0.5 * (totals[0] + totals[-1]) + 1e-6
    below = totals[totals <= middle]
    np.testing.assert_allclose(best_assignments(cost, 10**6, np.inf, middle)[0], below, atol=1e-9)
    np.testing.assert_allclose(best_assignments(cost, 10**6, middle - totals[0], np.inf)[0], below, atol=1e-9)


class TooManyHistoriesError(Exception):
    """A scene has too many association histories to be enumerated."""


class Scene:
    """A model with constant probabilities, births at places, and measured scans."""

    def __init__(self, model, birth, scans, p_s, p_d, kappa):
        self.birth, self.scans, self.p_s, self.p_d, self.kappa = birth, scans, p_s, p_d, kappa
        packed = model.packed
        self.model, self.B, self.Sigma = model, packed.transition, packed.noise
        self.H, self.R = packed.observation, packed.measurement_noise

    def filter(self, **options):
        return PMBM(
            self.model,
            self.birth,
            clutter_intensity=self.kappa,
            survival=self.p_s,
            detection=self.p_d,
            gate_probability=1.0,
            **options,
        )


def unpruned(scene, histories):
    return scene.filter(
        reduction=UNREDUCED,
        assignments=10**18,
        hypotheses=2 * histories + 200,
        least_weight=0.0,
        recycle=0.0,
        targets=24,
        undetected=64,
    )


def pair_at_birth(scene, k):
    m, P, H = scene.birth.means[k], scene.birth.covariances[k], scene.H
    return np.concatenate([m, H @ m]), np.block([[P, P @ H.T], [H @ P, H @ P @ H.T + scene.R]])


def lives(scene, detections):
    """All lives of one target with these detections {scan: measurement}.

    Returns:
        Weight of the lives that ended; those that last: weight, mean and covariance of the state.
    """
    n, scans = scene.H.shape[1], len(scene.scans)
    ended, alive = 0.0, []
    last = max(detections, default=-1)
    for start in range(min(detections, default=scans - 1) + 1):
        for k, weight in enumerate(scene.birth.weights):
            mean, cov = pair_at_birth(scene, k)
            for t in range(start, scans):
                if t > start:
                    if t - 1 >= last:
                        ended += weight * (1.0 - scene.p_s)
                    weight = weight * scene.p_s
                    mean, cov = scene.B @ mean, scene.B @ cov @ scene.B.T + scene.Sigma
                if t in detections:
                    S, d = cov[n:, n:], scene.scans[t][detections[t]] - mean[n:]
                    density = math.exp(-0.5 * d @ np.linalg.solve(S, d)) / math.sqrt(np.linalg.det(2.0 * math.pi * S))
                    K = cov[:, n:] @ np.linalg.inv(S)
                    mean, cov = mean + K @ d, cov - K @ cov[n:]
                    weight = weight * scene.p_d * density
                else:
                    weight = weight * (1.0 - scene.p_d)
            alive.append((weight, mean[:n], cov[:n, :n]))
    return ended, alive


def histories(scene, most):
    """Bayes' rule by enumeration: all divisions of the measurements among sources, with their weights.

    A source is clutter or a target; with W its weight, a division has the product of the W of its sources.

    Returns:
        Weights that sum to one, those of divisions with the same possible targets added; by the first measurement
        (scan, index) of a source the probability that it is a target that lives now, with mean and covariance of its
        state; the expected number of targets that live now.
    """
    known = {}

    def source(detections):
        if detections not in known:
            ended, alive = lives(scene, dict(detections))
            total = ended + sum(weight for weight, _, _ in alive)
            known[detections] = total + (scene.kappa if len(detections) == 1 else 0.0), alive
        return known[detections]

    found = []

    def divide(t, j, sources):
        if t == len(scene.scans):
            weight = math.prod(source(detections)[0] for detections in sources)
            if weight > 0.0:
                found.append((weight, sources))
                if len(found) > most:
                    raise TooManyHistoriesError
        elif j == len(scene.scans[t]):
            divide(t + 1, 0, sources)
        else:
            divide(t, j + 1, (*sources, ((t, j),)))
            for i, detections in enumerate(sources):
                longer = (*detections, (t, j))
                if detections[-1][0] < t and source(longer)[0] > 0.0:
                    divide(t, j + 1, (*sources[:i], longer, *sources[i + 1 :]))

    divide(0, 0, ())
    total = sum(weight for weight, _ in found)
    living, together = {}, {}
    for weight, sources in found:
        possible = frozenset(d for d in sources if sum(part for part, _, _ in source(d)[1]) > 0.0)
        together[possible] = together.get(possible, 0.0) + weight / total
        for detections in possible:
            W, alive = source(detections)
            for part, mean, cov in alive:
                living.setdefault(detections[0], []).append((weight / total * part / W, mean, cov))
    unseen = sum(weight for weight, _, _ in lives(scene, {})[1])
    tracks = {first: moments(parts) for first, parts in living.items()}
    number = unseen + sum(existence for existence, _, _ in tracks.values())
    return np.array(list(together.values())), tracks, number


def moments(parts):
    weight = np.array([part for part, _, _ in parts])
    means, covs = np.array([mean for _, mean, _ in parts]), np.array([cov for _, _, cov in parts])
    mean = weight @ means / weight.sum()
    d = means - mean
    return weight.sum(), mean, np.einsum("i,ijk->jk", weight, covs + d[:, :, None] * d[:, None, :]) / weight.sum()


def tracks_of(tracks, pool):
    """Existence, mean and covariance of each track by its label."""
    found, row = {}, 0
    for i in range(int(tracks.number)):
        rows = range(row, row + int(tracks.size[i]))
        parts = [(pool.weight[c], pool.mean[c, :4], pool.covariance[c, :4, :4]) for c in rows]
        found[int(tracks.label[i])] = (float(tracks.existence[i]), *moments(parts)[1:])
        row += len(rows)
    return found


def draw_scene(rng, targets, most_measurements, scans):
    """Targets that are born at places, side by side or far apart, with clutter near them."""
    distance = rng.choice([6.0, 40.0, 2000.0])
    means = np.zeros((targets, 4))
    means[:, 0], means[:, 2] = distance * np.arange(targets), rng.normal(0.0, 3.0, targets)
    birth = Birth(rng.uniform(0.05, 0.9, targets), means, np.diag([25.0, 9.0, 25.0, 9.0]))
    measured = []
    for t in range(scans):
        seen = means[rng.random(targets) < 0.7][:, [0, 2]] + rng.normal(0.0, 3.0 + 3.0 * t, 2)
        false = means[rng.integers(targets, size=rng.poisson(0.5))][:, [0, 2]] + rng.normal(0.0, 30.0, 2)
        z = np.concatenate([seen, false])
        measured.append(rng.permutation(z)[:most_measurements])
    model = HMM if rng.random() < 0.5 else S1
    # At p_D = 1 a miss has the weight 1 - r, of which rounding leaves nothing for a sure target.
    p_s, p_d = rng.choice([0.7, 0.95, 1.0]), rng.choice([0.3, 0.9, 0.98])
    return Scene(model, birth, measured, p_s, p_d, 10.0 ** rng.uniform(-6.0, -3.0))


def check_against_enumeration(scene, most):
    weights, living, number = histories(scene, most)
    tracker = Stateful(unpruned(scene, len(weights)))
    with warnings.catch_warnings():
        # A cap that cuts is an error here.
        warnings.simplefilter("error")
        for z in scene.scans:
            estimate = tracker.step(z)
            assert float(tracker.state.cut) < 1e-12 and float(tracker.state.cut_undetected) < 1e-12
    state = tracker.state
    got = np.sort(state.hypotheses.weight[: int(state.hypotheses.number)])[::-1]
    assert got.sum() == pytest.approx(1.0, abs=1e-12)
    # Divisions of no weight may be missing on either side.
    both = np.zeros((2, max(len(got), len(weights))))
    both[0, : len(got)], both[1, : len(weights)] = got, np.sort(weights)[::-1]
    np.testing.assert_allclose(both[0], both[1], atol=1e-9)
    assert float(estimate.expected_number) == pytest.approx(number, abs=1e-9)
    base = np.concatenate([[0], np.cumsum([len(z) for z in scene.scans])])
    tracks = tracks_of(*tracker.estimator.project(state))
    for (t, j), (existence, mean, cov) in living.items():
        label = int(1 + base[t] + j)
        if label not in tracks:
            assert existence < 1e-9
            continue
        assert tracks[label][0] == pytest.approx(existence, abs=1e-9)
        if existence > 1e-6:
            np.testing.assert_allclose(tracks[label][1], mean, rtol=1e-9, atol=1e-8)
            np.testing.assert_allclose(tracks[label][2], cov, rtol=1e-8, atol=1e-8)
    return len(weights)


@pytest.mark.parametrize("seed", range(24))
def test_without_pruning_it_is_bayes_rule_over_all_histories(seed):
    rng = np.random.default_rng(seed)
    while True:
        scene = draw_scene(rng, int(rng.integers(1, 4)), int(rng.integers(1, 4)), int(rng.integers(1, 5)))
        try:
            check_against_enumeration(scene, 1500)
        except TooManyHistoriesError:
            continue
        return


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 140))
def test_without_pruning_it_is_bayes_rule_over_all_histories_of_large_scenes(seed):
    rng = np.random.default_rng(seed)
    while True:
        scene = draw_scene(rng, 4, 6, 4)
        if sum(map(len, scene.scans)) < 10:
            continue
        try:
            check_against_enumeration(scene, 100_000)
        except TooManyHistoriesError:
            continue
        return
