"""Paper 003's audit: scores of tracks worked out by hand, tables and files of a small run."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.baselines.paper003.scores import score_tracks
from servotrack.estimators.metrics import Track


def crossing_pair():
    """Two targets that cross after 20 of 40 records; both there from 5 to 35."""
    k = np.arange(40)
    bearings = np.stack([60.0 + k, 101.0 - k], axis=1)
    exists = np.repeat(((k >= 5) & (k <= 35))[:, None], 2, axis=1)
    return bearings, exists


def track(bearings, steps, target, error=0.0):
    return Track(np.asarray(steps), bearings[steps, target, None] + error)


def test_true_tracks_have_no_error():
    bearings, exists = crossing_pair()
    steps = np.arange(5, 36)
    scores = score_tracks(bearings, exists, [track(bearings, steps, 0), track(bearings, steps, 1)])
    assert scores.squared_error.tolist() == [0.0, 0.0]
    assert scores.tracked.tolist() == scores.present.tolist() == [31, 31]
    assert (scores.start.tolist(), scores.end.tolist()) == ([0, 0], [0, 0])
    assert (scores.crossings, scores.kept, scores.swapped, scores.false_tracks) == (1, 1, 0, 0)
    assert scores.count_right == 1.0


def test_late_short_and_false_tracks_are_counted():
    bearings, exists = crossing_pair()
    late = np.arange(8, 34)
    nobody = Track(np.arange(12), np.full((12, 1), 170.0))
    scores = score_tracks(bearings, exists, [track(bearings, late, 1, 0.5), nobody])
    assert np.sqrt(scores.squared_error[1] / scores.tracked[1]) == pytest.approx(0.5)
    assert scores.tracked.tolist() == [0, 26]
    assert np.isnan(scores.start[0])
    assert (scores.start[1], scores.end[1]) == (3, -2)
    assert scores.false_tracks == 1
    assert (scores.kept, scores.swapped) == (0, 0)
    # Right: 4 records before and 4 after in which nobody is there, less those in which the false track is.
    assert scores.count_right == pytest.approx((4 + 4) / 40)


def test_tracks_that_bounce_off_each_other_are_swapped():
    bearings, exists = crossing_pair()
    low, high = np.sort(bearings, axis=1).T
    steps = np.arange(5, 36)
    bounced = [Track(steps, low[steps, None]), Track(steps, high[steps, None])]
    scores = score_tracks(bearings, exists, bounced)
    assert (scores.crossings, scores.kept, scores.swapped) == (1, 0, 1)
    assert scores.tracked.tolist() == [31, 31]


def test_new_tracks_after_a_crossing_are_neither_kept_nor_swapped():
    bearings, exists = crossing_pair()
    pieces = [track(bearings, steps, i) for i in range(2) for steps in (np.arange(5, 19), np.arange(22, 36))]
    scores = score_tracks(bearings, exists, pieces)
    assert (scores.crossings, scores.kept, scores.swapped, scores.false_tracks) == (1, 0, 0, 0)


def test_no_tracks_and_no_targets_are_scored():
    bearings, exists = crossing_pair()
    assert score_tracks(bearings, exists, []).tracked.tolist() == [0, 0]
    nothing = score_tracks(np.zeros((40, 0)), np.zeros((40, 0), bool), [])
    assert (nothing.count_right, nothing.false_tracks, nothing.crossings) == (1.0, 0, 0)
