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

    def __init__(self, model, birth, scans, p_s, p_d, kappa, noises=None):
        self.noises = noises
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
                    if scene.noises is not None:
                        S = S - scene.R + scene.noises[t][detections[t]]
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
    pmbm, state = unpruned(scene, len(weights)), None
    with warnings.catch_warnings():
        # A cap that cuts is an error here.
        warnings.simplefilter("error")
        for z, noise in zip(scene.scans, scene.noises or [None] * len(scene.scans), strict=True):
            state, estimate = pmbm.step(pmbm.initial(z) if state is None else state, z, noise=noise)
            assert float(state.cut) < 1e-12 and float(state.cut_undetected) < 1e-12
    got = np.sort(state.hypotheses.weight[: int(state.hypotheses.number)])[::-1]
    assert got.sum() == pytest.approx(1.0, abs=1e-12)
    # Divisions of no weight may be missing on either side.
    both = np.zeros((2, max(len(got), len(weights))))
    both[0, : len(got)], both[1, : len(weights)] = got, np.sort(weights)[::-1]
    np.testing.assert_allclose(both[0], both[1], atol=1e-9)
    assert float(estimate.expected_number) == pytest.approx(number, abs=1e-9)
    base = np.concatenate([[0], np.cumsum([len(z) for z in scene.scans])])
    tracks = tracks_of(*pmbm.project(state))
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


def draw_noises(rng, scans):
    roots = [rng.normal(0.0, 2.0, (len(z), 2, 2)) for z in scans]
    return [root @ np.swapaxes(root, 1, 2) + 0.2 * np.eye(2) for root in roots]


@pytest.mark.parametrize("seed", range(200, 212))
def test_with_a_noise_for_each_measurement_it_is_bayes_rule_over_all_histories(seed):
    rng = np.random.default_rng(seed)
    while True:
        scene = draw_scene(rng, int(rng.integers(1, 4)), int(rng.integers(1, 4)), int(rng.integers(1, 5)))
        if scene.model is not HMM:
            continue
        scene.noises = draw_noises(rng, scene.scans)
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


def as_mixture(mixture, state):
    """Posterior of a PMB as a PMBM: one global hypothesis that contains all tracks, in order of their labels."""
    empty = mixture.initial(NONE)
    T = int(state.tracks.number)
    order = np.argsort(state.tracks.label[:T])
    starts = np.concatenate([[0], np.cumsum(state.tracks.size[:T])])
    rows = [row for i in order for row in range(starts[i], starts[i + 1])]

    def placed(array, into, chosen):
        into = into.copy()
        into[: len(chosen)] = array[chosen]
        return into

    hypotheses = empty.hypotheses._replace(size=empty.hypotheses.size.copy(), member=empty.hypotheses.member.copy())
    hypotheses.size[0], hypotheses.member[0, :T] = T, np.arange(T)
    table = [placed(a, b, order) for a, b in zip(state.tracks[1:], empty.tracks[1:], strict=True)]
    pool = [placed(a, b, rows) for a, b in zip(state.pool[1:], empty.pool[1:], strict=True)]
    share = empty.share.copy()
    share[:T] = 1.0
    return PMBMState(
        hypotheses,
        type(empty.tracks)(state.tracks.number, *table),
        table[1],
        share,
        type(empty.pool)(np.asarray(len(rows)), *pool),
        state.undetected,
        state.births,
        state.next_label,
        empty.cut,
        empty.cut_undetected,
    )


def both_filters(model, birth):
    options = {"clutter_intensity": 1e-5, "survival": 0.95, "detection": 0.8, "gate_probability": 1.0, "undetected": 64}
    rules = Reduction(prune=0.0, merge=0.0, components=64, existence=0.0, tracks=100, pool=2000, candidates=1000)
    exact = {"assignments": 10**6, "hypotheses": 5000, "least_weight": 0.0, "recycle": 0.0, "targets": 30}
    return PMB(model, birth, reduction=rules, **options), PMBM(model, birth, reduction=rules, **options, **exact)


@pytest.mark.parametrize("model", [HMM, S1])
@pytest.mark.parametrize("distance", [12.0, 5000.0])
def test_pmb_is_the_moment_projection_of_one_scan(model, distance):
    means = np.zeros((2, 4))
    means[1, 0] = distance
    pmb, pmbm = both_filters(model, Birth([0.5, 0.6], means, np.diag([25.0, 9.0, 25.0, 9.0])))
    rng = np.random.default_rng(3)
    state = pmb.initial(NONE)
    # Far apart the graph of association has no loop; near each other one measurement has none either.
    counts = (2, 2, 2) if distance > 100.0 else (1, 1, 1)
    for count in counts:
        z = means[:count][:, [0, 2]] + rng.normal(0.0, 3.0, (count, 2))
        mixture, _ = pmbm.step(as_mixture(pmbm, state), z)
        state, _ = pmb.step(state, z)
        wanted, got = tracks_of(*pmbm.project(mixture)), tracks_of(state.tracks, state.pool)
        for label, (existence, mean, cov) in wanted.items():
            if existence < 1e-7:
                continue
            assert got[label][0] == pytest.approx(existence, abs=2e-6)
            np.testing.assert_allclose(got[label][1], mean, rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(got[label][2], cov, rtol=1e-3, atol=1e-3)
        unseen, left = int(state.undetected.number), int(mixture.undetected.number)
        assert state.undetected.weight[:unseen].sum() == pytest.approx(
            mixture.undetected.weight[:left].sum(), abs=1e-12
        )


@pytest.mark.parametrize("seed", range(5))
def test_belief_propagation_is_near_the_projection_where_targets_are_close(seed):
    rng = np.random.default_rng(seed)
    means = np.zeros((3, 4))
    means[:, 0] = 12.0 * np.arange(3)
    pmb, pmbm = both_filters(HMM, Birth([0.5, 0.5, 0.5], means, np.diag([25.0, 9.0, 25.0, 9.0])))
    state = pmb.initial(NONE)
    for _ in range(2):
        z = means[:, [0, 2]] + rng.normal(0.0, 3.0, (3, 2))
        mixture, exact = pmbm.step(as_mixture(pmbm, state), z)
        state, approximate = pmb.step(state, z)
        assert approximate.expected_number == pytest.approx(float(exact.expected_number), abs=0.1)
    marginals = [tracks_of(*pmbm.project(mixture)), tracks_of(state.tracks, state.pool)]
    for label in marginals[0]:
        assert marginals[0][label][0] == pytest.approx(marginals[1].get(label, (0.0,))[0], abs=0.15)


def follow(filter_, scans):
    tracker = Stateful(filter_)
    return [tracker.step(z) for z in scans], tracker.state


def crossing(seed, steps=15):
    """Two targets that come within 2 m of each other, in clutter."""
    rng = np.random.default_rng(seed)
    scans = []
    for k in range(steps):
        offset = abs(k - steps // 2) * 4.0 + 1.0
        targets = np.array([[10.0 * k, offset], [10.0 * k, -offset]]) + rng.normal(0.0, 1.5, (2, 2))
        seen = targets[rng.random(2) < 0.9]
        scans.append(rng.permutation(np.concatenate([seen, rng.uniform(-50.0, 200.0, (rng.poisson(3), 2))])))
    return scans


@pytest.mark.parametrize("report", ["tracks", "hypothesis"])
@pytest.mark.parametrize("birth", [MeasurementBirth(), Birth([0.1], np.zeros((1, 4)), 400.0 * np.eye(4))])
def test_it_is_deterministic_and_empty_scans_end_it(report, birth):
    filter_ = PMBM(S1, birth, clutter_intensity=5e-5, detection=0.9, report=report)
    scans = [*crossing(0), *[NONE] * 40]
    (one, last), (two, _) = follow(filter_, scans), follow(filter_, scans)
    for a, b in zip(one, two, strict=True):
        assert np.array_equal(a.states, b.states) and np.array_equal(a.labels, b.labels)
        assert a.expected_number == b.expected_number
    assert len(one[14].states) >= 2 and len(one[-1].states) == 0
    assert int(last.hypotheses.number) == 1 and last.hypotheses.weight[0] == 1.0
    nothing, state = follow(filter_, [[], NONE])
    assert len(nothing[-1].labels) == 0 and int(state.tracks.number) == 0


def test_hypotheses_of_a_posterior_are_ordered_distinct_and_pruned():
    filter_ = PMBM(HMM, MeasurementBirth(), clutter_intensity=5e-5, detection=0.9, hypotheses=20)
    tracker = Stateful(filter_)
    for z in crossing(1):
        tracker.step(z)
        state = tracker.state
        G, T = int(state.hypotheses.number), int(state.tracks.number)
        weight = state.hypotheses.weight[:G]
        assert 1 <= G <= 20 and weight.sum() == pytest.approx(1.0, abs=1e-12) and np.all(np.diff(weight) <= 0.0)
        members = [tuple(state.hypotheses.member[g, : state.hypotheses.size[g]]) for g in range(G)]
        assert len(set(members)) == G
        share = np.zeros(T)
        for g, rows in enumerate(members):
            assert np.all(np.diff(rows) > 0) and len({int(state.tracks.label[row]) for row in rows}) == len(rows)
            share[list(rows)] += weight[g]
        np.testing.assert_allclose(state.share[:T], share, atol=1e-12)
        assert np.all(share > 0.0) and np.all(state.tracks.existence[:T] >= filter_.recycle)
        assert np.all(np.diff(state.tracks.label[:T]) >= 0)


def test_recycling_keeps_the_expected_number():
    scans = crossing(2, steps=8)
    options = {"clutter_intensity": 5e-5, "detection": 0.6, "least_weight": 0.0, "assignments": 10**6}
    options |= {"reduction": UNREDUCED, "hypotheses": 5000}
    birth = Birth([0.3], np.zeros((1, 4)), 400.0 * np.eye(4))
    for z in (scans[:1], scans[:2]):
        kept, _ = follow(PMBM(HMM, birth, recycle=0.0, **options), z)
        recycled, state = follow(PMBM(HMM, birth, recycle=0.5, **options), z)
        assert float(kept[-1].expected_number) == pytest.approx(float(recycled[-1].expected_number), rel=0.05)
        # One scan after the first the same targets are described by the other part.
        assert len(z) > 1 or float(kept[-1].expected_number) == pytest.approx(recycled[-1].expected_number, abs=1e-12)
        assert np.all(state.tracks.existence[: int(state.tracks.number)] >= 0.5)


def test_caps_warn_and_say_how_much_they_removed():
    scans = crossing(3)
    small = {"hypotheses": 1, "targets": 1}
    for name, value in small.items():
        filter_ = PMBM(HMM, MeasurementBirth(), clutter_intensity=5e-5, detection=0.9, **{name: value})
        with pytest.warns(UserWarning, match="caps removed a probability of"):
            _, state = follow(filter_, scans)
        assert state.hypotheses.weight[: int(state.hypotheses.number)].sum() == pytest.approx(1.0)
    few = PMBM(HMM, MeasurementBirth(), clutter_intensity=5e-5, detection=0.9, reduction=Reduction(tracks=1))
    with pytest.warns(UserWarning, match="tracks and pool of reduction"):
        follow(few, scans)
    four = Birth([0.5] * 4, 1000.0 * np.arange(4.0)[:, None] * np.eye(4)[:1], np.eye(4))
    with pytest.warns(UserWarning, match="the cap on undetected removed"):
        follow(PMBM(HMM, four, clutter_intensity=5e-5, detection=0.5, undetected=2), scans[:3])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        follow(PMBM(HMM, MeasurementBirth(), clutter_intensity=5e-5, detection=0.9), scans)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"assignments": 0}, "assignments must be at least 1, got 0"),
        ({"hypotheses": 0}, "hypotheses must be at least 1, got 0"),
        ({"targets": 0}, "targets must be at least 1, got 0"),
        ({"undetected": 0}, "undetected must be at least 1, got 0"),
        ({"least_weight": 1.0}, "least_weight must be at least 0 and below 1, got 1.0"),
        ({"recycle": -0.1}, "recycle must be at least 0 and below 1, got -0.1"),
        ({"report": "best"}, "report must be .tracks. or .hypothesis., got 'best'"),
        ({"tolerated_cut": float("nan")}, "tolerated_cut must be at least 0, got nan"),
    ],
)
def test_bad_parameters_are_refused_by_name(options, message):
    with pytest.raises(ValueError, match=message):
        PMBM(HMM, MeasurementBirth(), clutter_intensity=1e-4, **options)


def test_initial_hypotheses_are_one_empty_one():
    start = empty_hypotheses(2, 3, 4)
    assert start.number.tolist() == [1, 1] and start.weight.tolist() == [[1.0, 0.0, 0.0]] * 2


def test_a_recycled_target_keeps_its_identity():
    birth = Birth([0.1], np.zeros((1, 4)), np.diag([25.0, 100.0, 25.0, 100.0]))
    tracker = Stateful(PMBM(HMM, birth, clutter_intensity=1e-7, detection=0.9))
    path = [np.array([[12.0 * k, 0.0]]) for k in range(30)]
    for z in path[:15]:
        estimate = tracker.step(z)
    (label,) = estimate.labels
    k = 15
    while int(tracker.state.tracks.number) > 0:
        tracker.step(NONE)
        k += 1
    assert 16 <= k <= 20 and label in tracker.state.undetected.label
    labels = [tracker.step(z).labels.tolist() for z in path[k : k + 3]]
    assert labels[-1] == [label]


@pytest.mark.parametrize("kind", [PMB, PMBM])
def test_the_expected_number_counts_targets_that_were_never_detected(kind):
    runs, scans, births, p_s, p_d = 60, 31, 0.5, 0.95, 0.3
    rng = np.random.default_rng(5)
    spread = np.diag([400.0, 1.0, 400.0, 1.0])
    model = constant_velocity(process_noise=0.5, measurement_noise=1.0)
    places = Birth(np.array([births]), np.zeros((1, 4)), spread[None])
    tracker = kind(model, places, clutter_intensity=1e-6, survival=p_s, detection=p_d)
    move = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
    state = tracker.initial(np.zeros((runs, 1, 3)))
    targets = [np.zeros((0, 4)) for _ in range(runs)]
    for _ in range(scans):
        found = []
        for b in range(runs):
            kept = targets[b][rng.random(len(targets[b])) < p_s] @ move.T
            kept = kept + rng.normal(0.0, 0.3, kept.shape)
            new = rng.multivariate_normal(np.zeros(4), spread, rng.poisson(births))
            targets[b] = np.concatenate([kept, new])
            seen = targets[b][rng.random(len(targets[b])) < p_d]
            found.append(seen[:, [0, 2]] + rng.normal(0.0, 1.0, (len(seen), 2)))
        batch = np.zeros((runs, max(1, *map(len, found)), 3))
        for b, z in enumerate(found):
            batch[b, : len(z)] = np.column_stack([np.ones(len(z)), z])
        state, estimate = tracker.step(state, batch)
    number = np.array([len(one) for one in targets])
    assert births * (1.0 - p_s**scans) / (1.0 - p_s) == pytest.approx(7.96, abs=0.01)
    # The error of each run is the spread of the posterior; their mean has an interval of three standard errors.
    error = estimate.expected_number - number
    assert abs(error.mean()) < 3.0 * error.std() / np.sqrt(runs)
    # Without the undetected ones two targets of eight would be missing.
    tracks = estimate.expected_number.mean() - state.undetected.weight.sum(axis=1).mean()
    assert tracks < number.mean() - 1.0
