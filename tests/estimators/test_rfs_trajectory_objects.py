"""Trajectories as objects: collected from estimates of any filter, in memory and by a smoother."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.estimators.rfs import (
    GMPHD,
    PMB,
    MeasurementBirth,
    Trajectory,
    TrajectoryPMB,
    collect_trajectories,
    constant_velocity,
    track_scans,
)

MODEL = constant_velocity(1.0, 1.0)
TIMES = np.cumsum([0.0, 1.0, 0.5, 2.0, 1.0, 1.0, 3.0, 1.0, 1.0, 1.0, 0.5, 1.0])


def scans():
    rng = np.random.default_rng(0)
    return [np.array([[4.0 * t, 0.0], [0.0, 100.0 - 3.0 * t]]) + rng.normal(0, 1.0, (2, 2)) for t in TIMES]


@pytest.mark.parametrize("kind", [PMB, GMPHD, TrajectoryPMB])
def test_two_targets_give_two_trajectories(kind):
    more = {"lag": 4} if kind is TrajectoryPMB else {}
    tracker = kind(MODEL, MeasurementBirth(0.2, 5.0), clutter_intensity=1e-6, **more)
    found = track_scans(tracker, scans(), TIMES)
    assert len(found) == 2
    for one in found:
        assert set(one.times) <= set(TIMES) and len(one) >= len(TIMES) - 1
        truth = [4.0 * one.times, 0.0 * one.times]
        if one.states[0, 2] > 50.0:
            truth = [0.0 * one.times, 100.0 - 3.0 * one.times]
        np.testing.assert_allclose(one.states[:, [0, 2]].T, truth, atol=4.0)
    if kind is TrajectoryPMB:
        # A smoother reports the first scan and, flushed, the last one.
        assert {tuple(one.times) for one in found} == {tuple(TIMES)}
        assert all((one.existence > 0.9).all() for one in found)


def test_a_smoother_longer_than_the_record_is_flushed_whole():
    tracker = TrajectoryPMB(MODEL, MeasurementBirth(0.2, 5.0), clutter_intensity=1e-6, lag=20)
    assert [len(one) for one in track_scans(tracker, scans(), TIMES)] == [len(TIMES)] * 2


def test_bad_input_is_named():
    tracker = PMB(MODEL, MeasurementBirth(), clutter_intensity=1e-6)
    with pytest.raises(ValueError, match="times must be finite, increasing"):
        track_scans(tracker, scans(), TIMES[::-1])
    with pytest.raises(ValueError, match="as many as estimates"):
        collect_trajectories([0.0], [])
    _, estimate = tracker.step(tracker.initial(np.zeros((2, 3, 3))), np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="estimates must be of one run"):
        collect_trajectories([0.0], [estimate])
    with pytest.raises(ValueError, match="times must have shape"):
        Trajectory(1, np.zeros(2), np.zeros((3, 4)), np.zeros((3, 4, 4)), np.zeros(3))
    with pytest.raises(ValueError, match="times must increase"):
        Trajectory(1, np.zeros(3), np.zeros((3, 4)), np.zeros((3, 4, 4)), np.zeros(3))
