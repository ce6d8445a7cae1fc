"""Set metrics: axioms, empty sets, agreement with an enumeration of all assignments, and trajectories."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment, linprog

from servotrack.estimators.metrics import (
    Track,
    box_distances,
    centroid_distances,
    gospa,
    members_by_step,
    mot_scores,
    ospa,
    ospa2,
    score_distances,
    score_points,
    stack_tracks,
    tracks_from_rows,
    trajectory_gospa,
    wrapped_distances,
)
from servotrack.estimators.metrics.assignment import assign

C = 10.0
ORDERS = (1.0, 2.0)
EMPTY = np.zeros((0, 2))


@st.composite
def point_sets(draw, most=4):
    count = draw(st.integers(0, most))
    values = draw(st.lists(st.integers(-12, 12), min_size=2 * count, max_size=2 * count))
    return np.array(values, dtype=np.float64).reshape(count, 2)


def enumerated_ospa(a, b, order):
    small, large = (a, b) if len(a) <= len(b) else (b, a)
    if len(large) == 0:
        return 0.0
    costs = [
        sum(min(C, np.linalg.norm(x - large[j])) ** order for x, j in zip(small, chosen, strict=True))
        for chosen in itertools.permutations(range(len(large)), len(small))
    ]
    return ((min(costs) + C**order * (len(large) - len(small))) / len(large)) ** (1 / order)


def enumerated_gospa(a, b, order):
    best = np.inf
    for size in range(min(len(a), len(b)) + 1):
        for rows in itertools.combinations(range(len(a)), size):
            for columns in itertools.permutations(range(len(b)), size):
                located = sum(np.linalg.norm(a[i] - b[j]) ** order for i, j in zip(rows, columns, strict=True))
                best = min(best, located + C**order / 2 * (len(a) + len(b) - 2 * size))
    return best ** (1 / order)


@pytest.mark.parametrize("order", ORDERS)
@settings(max_examples=60, deadline=None)
@given(a=point_sets(), b=point_sets())
def test_sets_agree_with_an_enumeration(order, a, b):
    scores = score_points(a, b, C, order)
    assert scores.ospa == pytest.approx(enumerated_ospa(a, b, order), abs=1e-9)
    assert scores.gospa.total == pytest.approx(enumerated_gospa(a, b, order), abs=1e-9)
    parts = scores.gospa
    assert parts.total**order == pytest.approx(parts.location + parts.missed + parts.false, abs=1e-9)
    assert scores.cardinality_error == len(b) - len(a)


@pytest.mark.parametrize("order", ORDERS)
@settings(max_examples=60, deadline=None)
@given(a=point_sets(), b=point_sets(), c=point_sets())
def test_set_metrics_satisfy_the_axioms(order, a, b, c):
    for metric in (lambda x, y: ospa(x, y, C, order), lambda x, y: gospa(x, y, C, order).total):
        assert metric(a, a) == 0.0
        assert metric(a, b) == pytest.approx(metric(b, a), abs=1e-12)
        assert metric(a, c) <= metric(a, b) + metric(b, c) + 1e-9
        if metric(a, b) == 0.0:
            assert sorted(map(tuple, a)) == sorted(map(tuple, b))


def test_empty_sets():
    points = np.array([[0.0, 0.0], [3.0, 4.0]])
    assert ospa(EMPTY, EMPTY, C) == 0.0
    assert gospa(EMPTY, EMPTY, C).total == 0.0
    assert ospa(points, EMPTY, C) == ospa(EMPTY, points, C) == C
    assert gospa(points, EMPTY, C).missed == gospa(EMPTY, points, C).false == C


def test_assignment_agrees_with_scipy_on_large_problems():
    rng = np.random.default_rng(0)
    for rows, columns in ((1, 1), (7, 7), (20, 60), (100, 100), (60, 110)):
        # Cut costs have many ties, as the metrics' do.
        cost = np.minimum(rng.random((rows, columns)) * 3, 1.0)
        chosen = assign(cost, rows, columns)
        assert len(set(chosen.tolist())) == rows
        i, j = linear_sum_assignment(cost)
        assert cost[np.arange(rows), chosen].sum() == pytest.approx(cost[i, j].sum(), abs=1e-9)


def test_a_batch_gives_the_bits_of_its_rows():
    rng = np.random.default_rng(1)
    truth, estimate = rng.uniform(-20, 20, (5, 3, 6, 2)), rng.uniform(-20, 20, (5, 3, 9, 2))
    there, here = rng.random((5, 3, 6)) < 0.7, rng.random((5, 3, 9)) < 0.5
    batch = score_points(truth, estimate, C, 1.0, there, here)
    for i, j in np.ndindex(5, 3):
        one = score_points(truth[i, j][there[i, j]], estimate[i, j][here[i, j]], C)
        assert batch.ospa[i, j] == one.ospa
        assert batch.gospa.total[i, j] == one.gospa.total
        assert batch.cardinality_error[i, j] == one.cardinality_error


def test_what_does_not_exist_does_not_count():
    truth, estimate = np.array([[0.0, 0.0], [np.nan, np.nan]]), np.array([[1.0, 0.0], [np.inf, 0.0]])
    scores = score_points(truth, estimate, C, 1.0, [True, False], [True, False])
    assert scores.ospa == 1.0


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: ospa(EMPTY, EMPTY, 0.0), "cutoff must be positive"),
        (lambda: ospa(EMPTY, EMPTY, C, 0.5), "order must be finite and at least 1"),
        (lambda: ospa(np.zeros(2), EMPTY, C), r"shapes \(\*batch, n, d\)"),
        (lambda: ospa(np.zeros((1, 3)), EMPTY, C), "of one dimension"),
        (lambda: ospa(np.full((1, 2), np.nan), np.zeros((1, 2)), C), "must not be NaN"),
        (lambda: score_distances(np.zeros((2, 3)), np.ones(3, bool), np.ones(3, bool), C), "must have shapes"),
        (lambda: box_distances(np.zeros((1, 2)), np.zeros((1, 2))), "boxes must be"),
        (lambda: wrapped_distances(np.zeros((1, 1)), np.zeros((1, 1)), 0.0), "period must be positive"),
        (lambda: ospa2(np.zeros((1, 2)), np.zeros((1, 2)), C), r"shapes \(n, T, d\)"),
        (lambda: trajectory_gospa(np.zeros((1, 2, 2)), np.zeros((1, 2, 2)), C, 0.0), "switch_cost"),
        (lambda: stack_tracks([Track(np.array([5]), np.zeros((1, 2)))], 5, 2), "raise length"),
        (lambda: tracks_from_rows([[1, 1]], np.zeros((1, 2, 2))), "unique in every step"),
    ],
)
def test_bad_input_is_named(call, match):
    with pytest.raises(ValueError, match=match):
        call()


def test_boxes_and_bearings():
    boxes = np.array([[0.0, 0.0, 2.0, 2.0], [1.0, 0.0, 2.0, 2.0], [9.0, 9.0, 0.0, 0.0]])
    distances = box_distances(boxes, boxes)
    assert distances[0].tolist() == pytest.approx([0.0, 1 - 2 / 6, 1.0])
    assert distances[2, 2] == 1.0
    assert wrapped_distances([[359.0]], [[2.0]], 360.0)[0, 0] == pytest.approx(3.0)


def straight(start, velocity, steps, length=20):
    track = np.full((length, 2), np.nan)
    track[steps] = np.asarray(start) + np.arange(length)[steps, None] * np.asarray(velocity)
    return track


def test_ospa2_counts_identity():
    whole = straight((0.0, 0.0), (1.0, 0.0), slice(0, 20))
    truth = whole[None]
    halves = np.stack([straight((0.0, 0.0), (1.0, 0.0), slice(0, 10)), straight((0.0, 0.0), (1.0, 0.0), slice(10, 20))])
    assert ospa2(truth, truth, C) == 0.0
    # Of two halves one is assigned, wrong for half the time; the other is a false track.
    assert ospa2(truth, halves, C) == pytest.approx((C / 2 + C) / 2)
    assert ospa2(truth, np.zeros((0, 20, 2)), C) == C
    assert ospa2(np.zeros((0, 20, 2)), np.zeros((0, 20, 2)), C) == 0.0
    never = np.full((1, 20, 2), np.nan)
    assert ospa2(truth, np.concatenate([truth, never]), C) == 0.0


def test_trajectory_gospa_of_a_switch_and_a_gap():
    truth = straight((0.0, 0.0), (1.0, 0.0), slice(0, 20))[None]
    halves = np.stack([straight((0.0, 0.0), (1.0, 0.0), slice(0, 10)), straight((0.0, 0.0), (1.0, 0.0), slice(10, 20))])
    parts = trajectory_gospa(truth, halves, C, 3.0)
    assert parts.switches == pytest.approx(3.0, abs=1e-6)
    assert parts.missed == pytest.approx(0.0, abs=1e-6)
    gap = truth.copy()
    gap[0, 8:10] = np.nan
    parts = trajectory_gospa(truth, gap, C, 3.0)
    assert (parts.missed, parts.false, parts.switches) == pytest.approx((C, 0.0, 0.0), abs=1e-6)


def dense_program(truth, estimate, order, switch_cost):
    """The whole linear program, nothing left out."""
    n, k, steps = len(truth), len(estimate), truth.shape[1]
    there, here = ~np.isnan(truth[..., 0]), ~np.isnan(estimate[..., 0])
    price = np.zeros((steps, n + 1, k + 1))
    for t, i, j in np.ndindex(steps, n + 1, k + 1):
        x, y = i < n and there[i, t], j < k and here[j, t]
        if x and y:
            price[t, i, j] = min(C, np.linalg.norm(truth[i, t] - estimate[j, t])) ** order
        elif x or y:
            price[t, i, j] = C**order / 2
    size, changes = price.size, (steps - 1) * n * k
    index = np.arange(size).reshape(price.shape)
    equal, unequal = [], []
    for t in range(steps):
        for i in range(n):
            equal.append(index[t, i])
        for j in range(k):
            equal.append(index[t, :, j])
    left = np.zeros((len(equal), size + changes))
    for row, members in enumerate(equal):
        left[row, members] = 1.0
    for number, (t, i, j) in enumerate(np.ndindex(steps - 1, n, k)):
        for sign in (1.0, -1.0):
            row = np.zeros(size + changes)
            row[index[t + 1, i, j]], row[index[t, i, j]], row[size + number] = sign, -sign, -1.0
            unequal.append(row)
    cost = np.concatenate([price.ravel(), np.full(changes, switch_cost**order / 2)])
    found = linprog(cost, np.array(unequal), np.zeros(len(unequal)), left, np.ones(len(equal)), method="highs")
    return found.fun ** (1 / order)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seed", range(6))
def test_trajectory_gospa_is_the_whole_program(seed, order):
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-8, 8, (3, 1, 2)) + np.cumsum(rng.normal(0, 1.5, (3, 7, 2)), axis=1)
    estimate = rng.uniform(-8, 8, (4, 1, 2)) + np.cumsum(rng.normal(0, 1.5, (4, 7, 2)), axis=1)
    truth[rng.random((3, 7)) < 0.2] = np.nan
    estimate[rng.random((4, 7)) < 0.3] = np.nan
    parts = trajectory_gospa(truth, estimate, C, 2.0, order)
    assert parts.total == pytest.approx(dense_program(truth, estimate, order, 2.0), abs=1e-6)
    back = trajectory_gospa(estimate, truth, C, 2.0, order)
    assert back.total == pytest.approx(parts.total, abs=1e-6)


def test_tracks_from_rows_follow_labels_across_rows():
    labels = np.array([[4, -1], [-1, 4], [7, 4]])
    states = np.arange(12.0).reshape(3, 2, 2)
    first, second = tracks_from_rows(labels, states)
    assert first.steps.tolist() == [0, 1, 2]
    assert first.states.tolist() == [[0.0, 1.0], [6.0, 7.0], [10.0, 11.0]]
    assert second.steps.tolist() == [2]


def test_mot_scores_of_a_perfect_and_a_switched_tracker():
    steps = np.arange(10)
    boxes = np.column_stack([steps * 1.0, steps * 0.0, np.full(10, 5.0), np.full(10, 5.0)])
    truth = [Track(steps, boxes), Track(steps, boxes + np.array([0.0, 50.0, 0.0, 0.0]))]
    perfect = mot_scores(truth, truth)
    assert (perfect.hota, perfect.idf1, perfect.mota) == pytest.approx((1.0, 1.0, 1.0))
    a, b = truth
    switched = [
        Track(steps, np.concatenate([a.states[:5], b.states[5:]])),
        Track(steps, np.concatenate([b.states[:5], a.states[5:]])),
    ]
    scores = mot_scores(truth, switched)
    assert scores.identity_switches == 2
    assert scores.idf1 == pytest.approx(0.5)
    nothing = mot_scores(truth, [])
    assert (nothing.hota, nothing.misses, nothing.false_positives) == (0.0, 20, 0)


def test_centers_are_apart_in_heights_of_the_true_box() -> None:
    truth = np.array([[0.0, 0.0, 10.0, 20.0], [5.0, 5.0, 4.0, 0.0]])
    found = np.array([[0.0, 10.0, 10.0, 20.0], [30.0, 0.0, 10.0, 20.0]])
    apart = centroid_distances(truth, found)
    assert apart[0].tolist() == [0.5, 1.5]
    assert np.isinf(apart[1]).all(), "a box without a height matches nothing"
    assert centroid_distances(truth[:0], found).shape == (0, 2)
    with pytest.raises(ValueError, match="left, top, width, height"):
        centroid_distances(truth[:, :2], found[:, :2])


def test_members_of_a_step_are_the_rows_of_the_stack():
    rng = np.random.default_rng(0)
    tracks = [Track(np.sort(rng.choice(9, k, replace=False)), rng.standard_normal((k, 2))) for k in (5, 0, 9, 1)]
    tracks[2].states[4] = np.nan
    stacked = stack_tracks(tracks, 10, 2)
    members = members_by_step(tracks, 10, 2)
    assert len(members) == 10 and len(members[9].rows) == 0
    for step, (rows, states) in enumerate(members):
        assert np.array_equal(rows, np.flatnonzero(~np.isnan(stacked[:, step, 0])))
        assert np.array_equal(states, stacked[rows, step])
    with pytest.raises(ValueError, match="raise length"):
        members_by_step(tracks, 4, 2)
    assert [member.states.shape for member in members_by_step([], 2, 4)] == [(0, 4), (0, 4)]
