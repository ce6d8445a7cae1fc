"""Trackers of bearings: what they find, what must not matter to them, and what they refuse."""

import numpy as np
import pytest
from bearing_records import BEAMS, CROSSING, SETTINGS, noise, record
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.hmm import smooth
from servotrack.estimators.sonar import HMMBearings, PeakKalmanHungarian, PeakNearestNeighbor, ViterbiNulling
from servotrack.estimators.sonar.joint_smoothing import JointSmoother
from servotrack.estimators.sonar.likelihood import known_power, unknown_power
from servotrack.estimators.sonar.rules import LikelihoodRules, SearchRules
from servotrack.estimators.stateful import Stateful

ROW = HMMBearings(**SETTINGS)
CELL = HMMBearings("cell", **SETTINGS)
PLAIN = {"beams": BEAMS, "averages": ROW.averages}
BASELINES = [
    PeakNearestNeighbor(**PLAIN),
    PeakKalmanHungarian(**PLAIN),
    ViterbiNulling(**PLAIN, rates=SETTINGS["rates"], acceleration=0.5),
]
ALL = [ROW, CELL, *BASELINES]
IDS = ["row", "cell", "neighbor", "kalman", "viterbi"]


def by_start(tracks):
    return sorted(tracks, key=lambda track: track.bearings[0])


def test_rows_track_two_targets_through_a_crossing():
    tracks = by_start(ROW.track(record(50, CROSSING)))
    assert [(track.first, track.last) for track in tracks] == [(8, 40), (8, 36)]
    for track, (first, last, bearing, rate, _, _) in zip(tracks, CROSSING, strict=True):
        truth = bearing + rate * np.arange(first, last + 1)
        assert np.sqrt(np.mean((track.bearings - truth) ** 2)) < 0.25
        assert np.median(track.rates) == pytest.approx(rate, abs=0.3)


def test_a_weak_target_is_found_that_no_peak_shows():
    weak = record(60, [(10, 50, 60.0, 0.5, 2.2, None)], seed=3)
    (track,) = ROW.track(weak)
    assert abs(track.first - 10) <= 4 and abs(track.last - 50) <= 4
    truth = 60.0 + 0.5 * np.arange(track.first, track.last + 1)
    assert np.sqrt(np.mean((track.bearings - truth) ** 2)) < 1.5
    assert PeakKalmanHungarian(**PLAIN, threshold=5.0).track(weak) == []


@pytest.mark.parametrize("tracker", ALL, ids=IDS)
def test_noise_has_no_tracks(tracker):
    assert tracker.track(noise(120, seed=1)) == []


@pytest.mark.parametrize("tracker", ALL, ids=IDS)
def test_one_strong_target_is_found_by_all(tracker):
    found = tracker.track(record(30, [(5, 24, 80.0, 0.5, 8.0, None)], seed=2))
    covered = [
        k
        for k in range(5, 25)
        if any(t.first <= k <= t.last and abs(t.bearings[k - t.first] - (80.0 + 0.5 * k)) < 2.0 for t in found)
    ]
    assert len(covered) >= 15


@pytest.mark.parametrize("tracker", ALL, ids=IDS)
def test_a_record_without_rows_has_no_tracks(tracker):
    assert tracker.track(np.zeros((0, BEAMS))) == []


def test_bearings_of_a_mirrored_record_are_mirrored():
    rows = record(40, CROSSING, seed=4)
    straight, mirrored = (by_start(ROW.track(rows[:, ::step])) for step in (1, -1))
    assert len(straight) == len(mirrored) == 2
    for track, other in zip(straight, mirrored[::-1], strict=True):
        assert track.first == other.first and track.last == other.last
        np.testing.assert_allclose(track.bearings, 180.0 - other.bearings, atol=0.02)


def test_the_search_ends_though_every_new_chain_displaces_the_one_before(monkeypatch):
    def displace(self, new):
        self.chains[:] = [new]
        return True

    monkeypatch.setattr(JointSmoother, "_settle", displace)
    smoother = JointSmoother(ROW, record(40, CROSSING))
    smoother.search(attempts=2)
    assert len(smoother.chains) == 1


def solves_of(targets, monkeypatch):
    """How often chains are solved until all of some targets are found."""
    solves, smooth_one = [], JointSmoother._smooth

    def counted(self, chain, *arguments):
        solves.append(chain)
        smooth_one(self, chain, *arguments)

    with monkeypatch.context() as patched:
        patched.setattr(JointSmoother, "_smooth", counted)
        assert len(ROW.track(record(50, targets))) == len(targets)
    return len(solves)


def test_every_further_target_costs_as_many_solves(monkeypatch):
    targets = [(5, 44, 30.0 + 24.0 * i, 0.0, 100.0 - 8.0 * i, None) for i in range(6)]
    solves = [solves_of(targets[:count], monkeypatch) for count in range(1, 7)]
    # Search, turns of the new chain and its neighbors, and the last turns of all: no more beside five than beside four.
    assert np.diff(solves[3:]).max() <= 1 + (1 + ROW.search.neighbors) * ROW.sweeps + ROW.sweeps


@given(order=st.permutations(range(3)))
@settings(max_examples=6, deadline=None)
def test_the_order_of_the_targets_does_not_matter(order):
    targets = [(5, 34, 40.0, 0.0, 100.0, None), (5, 34, 90.0, 0.0, 40.0, None), (5, 34, 140.0, 0.0, 15.0, 1000.0)]
    first = by_start(ROW.track(record(40, targets)))
    again = by_start(ROW.track(record(40, [targets[i] for i in order])))
    assert len(first) == len(again) == 3
    for track, other in zip(first, again, strict=True):
        assert (track.first, track.last, track.label) == (other.first, other.last, other.label)
        np.testing.assert_allclose(track.bearings, other.bearings, atol=1e-6)


@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100.0))
@settings(max_examples=5, deadline=None)
def test_the_unit_of_power_does_not_matter(seed, scale):
    rows = record(30, CROSSING[:1], seed)
    one, other = ROW.track(rows), ROW.track(scale * rows)
    assert [track.first for track in one] == [track.first for track in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_allclose(a.bearings, b.bearings, atol=1e-6)


def test_likelihoods_and_existence_have_mean_one_under_noise():
    rng = np.random.default_rng(5)
    s = rng.normal(size=(400_000, 1))
    rules = LikelihoodRules()
    low = np.exp(rules.amplitude * s - rules.amplitude**2 / 2.0)
    assert low.mean() == pytest.approx(1.0, abs=0.02)
    known = known_power(s, np.ones_like(s), np.full(len(s), 1.5), 0.3, rules)
    assert known.mean() == pytest.approx(1.0, abs=0.03)
    # Strong amplitudes have their mean from what noise never shows: integrate instead of drawing.
    grid = np.linspace(-9.0, 14.0, 4001)[:, None]
    density = np.exp(-(grid**2) / 2.0) / np.sqrt(2.0 * np.pi) * (grid[1] - grid[0])
    assert (unknown_power(grid, np.ones_like(grid), rules) * density).sum() == pytest.approx(1.0, abs=1e-3)
    variance = np.full((400, BEAMS), 1.0 / ROW.averages)
    likelihood = known_power(noise(400, 6) - 1.0, variance, np.full(400, 0.03), 0.3, rules)
    found = np.concatenate([smooth(ROW.chain, likelihood[k : k + 10]).existence_likelihood for k in range(0, 400, 10)])
    assert abs(found.mean() - 1.0) < 4.0 * found.std() / np.sqrt(len(found))


@pytest.mark.parametrize("tracker", [ROW, *BASELINES[:2]], ids=["row", "neighbor", "kalman"])
def test_row_by_row_answers_late_with_stable_labels(tracker):
    rows = record(40, [(5, 34, 80.0, 0.5, 40.0, None)], seed=7)
    online = Stateful(tracker)
    answers = [online.step(row) for row in rows]
    labels, late = [], tracker.lag
    for k in range(15, 33):
        estimate = answers[k + late]
        nearest = np.abs(estimate.states[:, 0] - (80.0 + 0.5 * k)).argmin()
        assert abs(estimate.states[nearest, 0] - (80.0 + 0.5 * k)) < 1.5
        labels.append(int(estimate.labels[nearest]))
    assert len(set(labels)) == 1 and labels[0] >= 1
    assert all(len(answer.labels) == 0 for answer in answers[:late])


@pytest.mark.parametrize("tracker", [CELL, BASELINES[2]], ids=["cell", "viterbi"])
def test_cells_and_best_paths_answer_late_too(tracker):
    online = Stateful(tracker)
    answers = [online.step(row) for row in record(40, [(5, 34, 80.0, 0.5, 6.0, None)], seed=7)]
    errors = [np.abs(answers[k + tracker.lag].states[:, 0] - (80.0 + 0.5 * k)).min(initial=99.0) for k in range(12, 33)]
    assert np.median(errors) < 1.5
    assert all(len(answer.labels) == 0 for answer in answers[: tracker.lag])


def test_row_by_row_keeps_identities_through_a_crossing_and_a_constant_memory():
    online = Stateful(ROW)
    sizes, who = [], {0: set(), 1: set()}
    for k, row in enumerate(record(50, CROSSING)):
        estimate = online.step(row)
        at = k - ROW.lag
        sizes.append(len(online.state.rows) + sum(len(chain.presence) for chain in online.state.chains))
        for i, (first, last, bearing, rate, _, _) in enumerate(CROSSING):
            if first + 3 <= at <= last - 1 and not 20 <= at <= 30:
                near = np.abs(estimate.states[:, 0] - (bearing + rate * at)) < 1.5
                who[i] |= set(estimate.labels[near].tolist())
    assert len(who[0]) == len(who[1]) == 1 and who[0] != who[1]
    assert max(sizes) <= ROW.window * (1 + len(CROSSING))


def test_a_state_is_a_value():
    rows = record(20, CROSSING)
    state = ROW.initial(rows[0])
    for row in rows[:15]:
        state, _ = ROW.step(state, row)
    first, one = ROW.step(state, rows[15])
    again, other = ROW.step(state, rows[15])
    assert np.array_equal(one.states, other.states) and np.array_equal(first.rows, again.rows)


def test_the_batch_form_says_what_memory_it_needs():
    assert ROW.memory(200) == pytest.approx(2 * ROW.memory(100))
    with pytest.raises(ValueError, match=r"needs .* GB.*initial and step"):
        HMMBearings(**SETTINGS, memory_limit=1e6).track(noise(60, 0))


@pytest.mark.parametrize("tracker", ALL, ids=IDS)
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: np.where(np.arange(BEAMS) == 7, np.nan, rows), r"nan at index \[0, 7\]"),
        (lambda rows: -rows, "not negative"),
        (lambda rows: rows[:, :-1], f"must have shape \\(rows, {BEAMS}\\)"),
        (lambda rows: [rows[0], rows[1][:5]], "different lengths"),
    ],
)
def test_bad_records_are_named(tracker, spoil, message):
    with pytest.raises(ValueError, match=message):
        tracker.track(spoil(noise(5, 0)))


@pytest.mark.parametrize("tracker", ALL, ids=IDS)
def test_a_gap_in_time_and_a_row_of_another_length_are_named(tracker):
    rows = noise(5, 0)
    with pytest.raises(ValueError, match=r"3\.5 s after row 2: set period"):
        tracker.track(rows, times=[0.0, 1.0, 2.0, 5.5, 6.5])
    with pytest.raises(ValueError, match="times must have shape"):
        tracker.track(rows, times=[0.0, 1.0])
    with pytest.raises(ValueError, match="row must have shape"):
        tracker.initial(rows[0, :-1])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"beams": 181}, r"spacing=0\.5"),
        ({"max_targets": 13}, r"1\.\.12 for an array of 24 elements"),
        ({"likelihood": "pixel"}, "row, cell"),
        ({"lag": 20}, "lag"),
        ({"switching": 0.0}, "switching"),
        ({"power_spread": 0.0}, "power_spread"),
        ({"bridge": -1.0}, "bridge"),
        ({"sweeps": 0}, "sweeps"),
        ({"jump": 0.0}, "jump"),
    ],
)
def test_bad_settings_are_named(changed, message):
    with pytest.raises(ValueError, match=message):
        HMMBearings(**{**SETTINGS, **changed})


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf")])
def test_bad_rules_are_named(value):
    with pytest.raises(ValueError, match="neighbors must be positive and finite"):
        SearchRules(neighbors=value)


def test_a_larger_miss_probability_weakens_a_row():
    power, variance = np.full((1, 3), -3.0), np.ones((1, 3))
    ratios = [unknown_power(power, variance, LikelihoodRules(miss_probability=p)).max() for p in (0.02, 0.2)]
    assert ratios[0] < ratios[1] < 1.0
