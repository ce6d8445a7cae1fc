"""Records that do not fit: lifted and missing rows, loud interferers, fast targets, wrong arrays and statistics."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from bearing_records import AVERAGES, BEAMS, SETTINGS, noise, record
from hydrophones import coverage

from servotrack.estimators.sonar import HMMBearings, LineArray, PeakKalmanHungarian, ViterbiNulling
from servotrack.estimators.sonar.array_check import measured_averages
from servotrack.estimators.sonar.background import prepare_rows
from servotrack.estimators.sonar.rules import BackgroundRules
from servotrack.estimators.stateful import Stateful

ADAPTIVE = {**SETTINGS, "rates": None}
ROW = HMMBearings(**ADAPTIVE)
SLOW = [(5, 54, 50.0, 0.4, 60.0, None), (8, 50, 120.0, -0.6, 25.0, None)]
TRUTHS = [
    np.where((np.arange(60) >= a) & (np.arange(60) <= b), s + r * np.arange(60), np.nan) for a, b, s, r, *_ in SLOW
]


def half_lifted(rows, seed, share=0.2, low=1.5, high=6.0):
    rng = np.random.default_rng(seed)
    out = rows.copy()
    for row in out:
        chance, lift, edge = rng.uniform(size=3)
        if chance < share:
            part = (
                slice(None, int((0.25 + 0.5 * edge) * BEAMS))
                if lift < 0.5
                else slice(int((0.25 + 0.5 * edge) * BEAMS), None)
            )
            row[part] *= low + (high - low) * lift
    return out


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_a_transient_lifts_make_no_tracks(seed):
    rows = half_lifted(record(60, SLOW, seed), seed)
    shares, false = coverage(ROW.track(rows), TRUTHS)
    assert min(shares) > 0.9 and false == 0


def test_the_background_keeps_the_edge_and_leaves_other_rows_alone():
    rows = noise(20, 3)
    lifted = rows.copy()
    lifted[7, 200:] *= 3.0
    prepared = prepare_rows(lifted, ROW.beam_width, BackgroundRules())
    assert np.flatnonzero(prepared.lifted).tolist() == [7]
    np.testing.assert_allclose(prepared.background[7, :190], 1.0, atol=0.2)
    np.testing.assert_allclose(prepared.background[7, 210:], 3.0, atol=0.5)
    assert np.array_equal(np.delete(prepared.rows, 7, 0), np.delete(lifted, 7, 0))
    untouched = prepare_rows(rows, ROW.beam_width, BackgroundRules())
    assert np.array_equal(untouched.rows, rows) and not untouched.lifted.any() and (untouched.background == 1.0).all()


def test_a_target_that_appears_is_no_transient():
    rows = record(30, [(12, 29, 90.0, 0.0, 3000.0, None)], seed=1)
    assert not prepare_rows(rows, ROW.beam_width, BackgroundRules()).lifted.any()


def test_one_rule_for_missing_rows_and_gaps():
    rows = record(60, SLOW, seed=5)
    gone = np.r_[20:24, 37]
    spoiled = rows.copy()
    spoiled[gone] = np.nan
    with_nan = ROW.track(spoiled)
    kept = np.delete(np.arange(60), gone)
    left_out = ROW.track(rows[kept], times=kept.astype(float))
    assert len(with_nan) == len(left_out) == 2
    for one, other in zip(with_nan, left_out, strict=True):
        inside = np.flatnonzero((kept >= one.first) & (kept <= one.last))
        assert other.first == inside[0] and other.last == inside[-1]
        np.testing.assert_array_equal(other.bearings, one.bearings[kept[inside] - one.first])
    shares, false = coverage(with_nan, TRUTHS)
    assert min(shares) > 0.9 and false == 0


def test_times_may_jitter_by_a_quarter_of_a_period():
    rows = record(60, SLOW, seed=5)
    jitter = np.random.default_rng(0).uniform(-0.12, 0.12, 60)
    plain, jittered = ROW.track(rows), ROW.track(rows, times=np.arange(60) + jitter)
    assert [t.first for t in plain] == [t.first for t in jittered]
    with pytest.raises(ValueError, match="gaps of at most 1000 rows"):
        ROW.track(rows, times=np.r_[np.arange(30.0), 5000.0 + np.arange(30.0)])
    with pytest.raises(ValueError, match=r"got 0\.5 s after row 3: set period"):
        ROW.track(rows, times=np.r_[0.0, 1.0, 2.0, 3.0, 3.5 + np.arange(56)])


def test_missing_rows_carry_no_information():
    """A target that is gone for some rows is bridged with its own uncertainty, not counted as absent."""
    rows = record(40, [(5, 34, 80.0, 0.5, 40.0, None)], seed=7)
    spoiled = rows.copy()
    spoiled[15:20] = np.nan
    (track,) = ROW.track(spoiled)
    assert track.first == 5 and track.last == 34 and track.presence.min() > 0.5
    assert track.deviations[10:15].max() > 1.2 * np.median(track.deviations)
    online = Stateful(ROW)
    answers = [online.step(row) for row in spoiled]
    errors = [np.abs(answers[k + ROW.lag].states[:, 0] - (80.0 + 0.5 * k)).min(initial=99.0) for k in range(10, 33)]
    assert max(errors) < 1.5


@pytest.mark.parametrize(
    "tracker",
    [
        PeakKalmanHungarian(beams=BEAMS, averages=AVERAGES, misses=6),
        ViterbiNulling(beams=BEAMS, averages=AVERAGES, rates=SETTINGS["rates"], acceleration=0.5),
    ],
)
def test_baselines_skip_missing_rows(tracker):
    rows = record(40, [(5, 34, 80.0, 0.5, 40.0, None)], seed=7)
    rows[15:18] = np.nan
    shares, _ = coverage(
        tracker.track(rows), [np.where((np.arange(40) >= 8) & (np.arange(40) < 33), 80.0 + 0.5 * np.arange(40), np.nan)]
    )
    assert shares[0] > 0.85
    assert tracker.track(np.full((10, BEAMS), np.nan)) == []


def test_all_rows_missing_is_no_track_and_a_row_with_some_nan_is_named():
    assert ROW.track(np.full((30, BEAMS), np.nan)) == []
    rows = noise(12, 0)
    rows[:, 40] = np.nan
    with pytest.raises(ValueError, match=r"nan at index \[0, 40\]; set the whole row to NaN.*or leave such beams out"):
        ROW.track(rows)
    with pytest.raises(ValueError, match=r"row .*nan at index \[40\]"):
        ROW.initial(rows[0])


def test_a_fast_target_widens_the_grid_and_a_fixed_grid_warns():
    fast = [(5, 30, 10.0, 5.0, 30.0, None)]
    rows = record(40, fast, seed=2)
    truth = np.where((np.arange(40) >= 5) & (np.arange(40) <= 30), 10.0 + 5.0 * np.arange(40), np.nan)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shares, false = coverage(ROW.track(rows), [truth])
    assert shares[0] > 0.9 and false == 0
    with pytest.warns(RuntimeWarning, match=r"a ridge moves at about 5 deg/s, and rates end at 2 deg/s"):
        HMMBearings(**SETTINGS).track(rows)


def test_a_fast_target_widens_the_grid_online():
    rows = record(40, [(5, 26, 10.0, 5.0, 30.0, None), (0, 39, 165.0, 0.0, 40.0, None)], seed=2)
    online = Stateful(ROW)
    answers = [online.step(row) for row in rows]
    # The line through eleven rows is seen in the eleventh.
    errors = [np.abs(answers[k + ROW.lag].states[:, 0] - (10.0 + 5.0 * k)).min(initial=99.0) for k in range(14, 25)]
    assert np.median(errors) < 2.0
    slow = {
        int(label) for a in answers[10:] for label, s in zip(a.labels, a.states, strict=True) if abs(s[0] - 165.0) < 1.5
    }
    assert len(slow) == 1


def test_slow_targets_keep_the_grid():
    state = ROW.initial(noise(1, 0)[0])
    for row in record(30, SLOW, seed=3):
        state, _ = ROW.step(state, row)
    assert state.fastest == ROW.fastest and state.level == 1.0


def test_the_spread_of_the_noise_is_measured():
    rows = noise(60, 1)
    assert measured_averages(rows) == pytest.approx(AVERAGES, rel=0.3)
    rough = 1.0 + 3.0 * (rows - 1.0)
    assert measured_averages(rough) == pytest.approx(AVERAGES / 9.0, rel=0.3)
    assert ROW._with_spread_of(rows) is ROW
    assert ROW._with_spread_of(rough).averages == pytest.approx(AVERAGES / 9.0, rel=0.3)
    assert ROW.track(rough) == []
    assert measured_averages(rows[:5]) is None


@pytest.mark.parametrize("elements", [8, 144])
def test_an_array_that_does_not_fit_is_said(elements):
    rows = record(40, SLOW, seed=4)
    wrong = replace(ROW, array=LineArray(elements=elements), max_targets=4)
    with pytest.warns(RuntimeWarning, match=r"about \S+ deg wide at half power, the array's beams \S+ to \S+ deg"):
        wrong.track(rows)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ROW.track(rows)
