"""Increments pair the joint motion and the feature motion of the same interval."""

import numpy as np
import pytest

from servotrack.estimators.jacobian import Alignment, ServoMeasurement

PERIOD = 0.05


def joints_at(time):
    """Piecewise linear between control instants, as the encoders see a velocity-controlled arm."""
    knots = np.arange(-20, 60) * PERIOD
    return np.stack([np.interp(time, knots, np.sin(3 * knots)), np.interp(time, knots, knots**2)], axis=-1)


def features_at(time):
    return np.stack([100 * time, 50 * time**2, np.cos(time)], axis=-1)


def measurement(time, frame_time, visible=True, offset=0.0):
    return ServoMeasurement(
        joints_at(np.asarray(time)),
        features_at(np.asarray(frame_time)),
        np.zeros(3),
        np.asarray(visible),
        np.asarray(frame_time) + offset,
        np.asarray(time),
    )


def run(alignment, measurements):
    state = alignment.initial(measurements[0])
    increments = []
    for each in measurements:
        state, increment = alignment.step(state, each)
        increments.append(increment)
    return state, increments


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.1, 0.033])
def test_increment_belongs_to_the_frames_interval_whatever_their_latency(latency):
    times = np.arange(12) * PERIOD
    _, increments = run(Alignment(), [measurement(t, t - latency) for t in times])
    # Before its first reading the arm is taken to have been at rest.
    for now, increment in list(zip(times, increments, strict=True))[5:]:
        frame, last = now - latency, now - PERIOD - latency
        assert increment.fresh
        np.testing.assert_allclose(increment.joints, joints_at(frame) - joints_at(last), atol=1e-12)
        np.testing.assert_allclose(increment.features, features_at(frame) - features_at(last), atol=1e-12)
        np.testing.assert_allclose(increment.time, PERIOD, atol=1e-12)
        np.testing.assert_allclose(increment.pending_joints, joints_at(now) - joints_at(frame), atol=1e-12)
        np.testing.assert_allclose(increment.pending_time, latency, atol=1e-12)


def test_a_known_latency_makes_up_for_missing_stamps():
    times = np.arange(12) * PERIOD
    stamped, with_stamps = run(Alignment(), [measurement(t, t - 0.07) for t in times])
    arrival, without = run(Alignment(latency=0.07), [measurement(t, t - 0.07, offset=0.07) for t in times])
    for a, b in zip([*stamped, *with_stamps[-1]], [*arrival, *without[-1]], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_an_increment_spans_dropped_frames():
    times = np.arange(8) * PERIOD
    seen = [True, True, True, False, False, True, True, True]
    stamps = [times[max(j for j in range(k + 1) if seen[j])] for k in range(8)]
    _, increments = run(Alignment(), [measurement(*each) for each in zip(times, stamps, seen, strict=True)])
    assert [bool(i.fresh) for i in increments] == [False, True, True, False, False, True, True, True]
    np.testing.assert_allclose(increments[4].pending_joints, joints_at(times[4]) - joints_at(times[2]), atol=1e-12)
    np.testing.assert_allclose(increments[4].pending_time, 2 * PERIOD, atol=1e-12)
    np.testing.assert_allclose(increments[5].time, 3 * PERIOD, atol=1e-12)
    np.testing.assert_allclose(increments[5].joints, joints_at(times[5]) - joints_at(times[2]), atol=1e-12)


def test_repeated_late_and_too_old_frames_are_ignored():
    frames = [(0.0, 0.0), (0.05, 0.05), (0.1, 0.05), (0.15, 0.02), (0.2, 0.2)]
    _, increments = run(Alignment(), [measurement(*each) for each in frames])
    assert [bool(i.fresh) for i in increments] == [False, True, False, False, True]
    np.testing.assert_allclose(increments[-1].time, 0.15, atol=1e-12)

    times = np.arange(10) * PERIOD
    _, increments = run(Alignment(history=4), [measurement(t, t - 0.3) for t in times])
    assert not increments[-1].fresh


def test_nothing_is_fresh_and_nothing_is_read_before_the_first_visible_frame():
    blind = measurement(0.0, 0.0, visible=False)._replace(features=np.full(3, np.nan), frame_time=np.asarray(np.nan))
    state, increments = run(Alignment(), [blind, blind._replace(time=np.asarray(0.05)), measurement(0.1, 0.1)])
    assert not any(i.fresh for i in increments)
    assert all(np.isfinite(part).all() for i in increments for part in i)
    np.testing.assert_array_equal(state.frame_features, features_at(0.1))


def test_rows_of_a_batch_do_not_know_of_each_other():
    times = np.arange(10) * PERIOD
    latencies = np.array([[0.0, 0.02], [0.05, 0.1]])
    batches = [measurement(np.full((2, 2), t), t - latencies) for t in times]
    batches = [b._replace(goal=np.zeros((2, 2, 3)), visible=np.ones((2, 2), bool)) for b in batches]
    state, increments = run(Alignment(), batches)
    for row in np.ndindex(2, 2):
        single, alone = run(Alignment(), [ServoMeasurement(*(part[row] for part in b[:6])) for b in batches])
        for whole, part in zip([*state, *increments[-1]], [*single, *alone[-1]], strict=True):
            np.testing.assert_array_equal(whole[row], part)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": np.array([0.0, np.nan, 0.0])}, r"features must be finite, got nan at index \[1\]"),
        ({"joint_angles": np.array([np.inf, 0.0])}, "joint_angles must be finite"),
        ({"goal": np.zeros(2)}, "goal must have shape"),
        ({"features": np.zeros((2, 3))}, "features must have shape"),
        ({"visible": np.array([True])}, "visible must have shape"),
        ({"frame_time": np.asarray(9.0)}, "frame_time must not lie after time"),
        ({"time": np.asarray(np.nan)}, "time must be finite"),
        ({"joint_angles": np.asarray(1.0)}, "joint_angles must have shape"),
    ],
)
def test_a_bad_measurement_is_named(change, message):
    alignment = Alignment()
    good = measurement(0.0, 0.0)
    state = alignment.initial(good)
    with pytest.raises(ValueError, match=message):
        alignment.step(state, good._replace(**change))
    with pytest.raises(ValueError, match=message):
        alignment.initial(good._replace(**change))


def test_a_measurement_that_does_not_belong_to_the_state_is_refused():
    alignment = Alignment()
    state, _ = run(alignment, [measurement(0.0, 0.0), measurement(0.05, 0.05)])
    with pytest.raises(ValueError, match=r"time must not go backwards, got 0\.0 after 0\.05"):
        alignment.step(state, measurement(0.0, 0.0))
    with pytest.raises(ValueError, match="joint_angles must have the shape"):
        alignment.step(state, measurement(0.1, 0.1)._replace(joint_angles=np.zeros(3)))
    with pytest.raises(ValueError, match="history=8"):
        Alignment(history=8).step(state, measurement(0.1, 0.1))


@pytest.mark.parametrize("arguments", [{"history": 1}, {"latency": -0.1}, {"latency": np.nan}])
def test_impossible_parameters_are_refused(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        Alignment(**arguments)


def turning(rng, steps, period=0.05):
    """Joint angles of a moving arm on a fine clock, as a function of time."""
    speed = rng.normal(0.0, 1.0, (steps, 2))
    angles = np.vstack([np.zeros(2), np.cumsum(speed * period, axis=0)])
    clock = np.arange(steps + 1) * period
    return lambda t: np.array([np.interp(t, clock, column) for column in angles.T])


@pytest.mark.parametrize("age", [0.05, 0.1, 0.125])
def test_frames_wait_for_encoders_with_a_clock_of_their_own(age):
    """Late encoder readings with stamps give the increments of a fresh clock, only later."""
    rng = np.random.default_rng(0)
    arm, jacobian = turning(rng, 40), rng.normal(0.0, 200.0, (3, 2))
    alignment, state, pairs = Alignment(), None, []
    for k in range(40):
        now = 0.05 * k
        late = ServoMeasurement(
            arm(max(now - age, 0.0)), jacobian @ arm(now), np.zeros(3), np.array(True), now, now, np.array(now - age)
        )
        state = alignment.initial(late) if state is None else state
        state, increment = alignment.step(state, late)
        if increment.fresh:
            pairs.append((increment.features, jacobian @ increment.joints, increment.pending_time))
    # The first readings, from before the start, are those of a resting arm.
    for seen, predicted, pending in pairs[3:]:
        np.testing.assert_allclose(seen, predicted, atol=40.0 if age % 0.05 > 1e-9 else 1e-9)
        assert age - 1e-9 <= pending <= age + 0.05 + 1e-9
    assert len(pairs) > 30


def test_encoders_that_jump_by_whole_turns_are_followed():
    alignment, jacobian = Alignment(), np.array([[100.0, -50.0]])
    state = None
    for k in range(30):
        angles = np.array([3.0 + 0.02 * k, -3.0 - 0.03 * k])
        wrapped = (angles + np.pi) % (2.0 * np.pi) - np.pi
        seen = ServoMeasurement(wrapped, jacobian @ angles, np.zeros(1), np.array(True), 0.05 * k, 0.05 * k)
        state = alignment.initial(seen) if state is None else state
        state, increment = alignment.step(state, seen)
        if k:
            np.testing.assert_allclose(increment.joints, [0.02, -0.03], atol=1e-12)


def test_joints_that_slide_may_move_far():
    alignment = Alignment(revolute=(False, True))
    state = None
    for k in range(3):
        far = ServoMeasurement(np.array([10.0 * k, 0.0]), np.zeros(1), np.zeros(1), np.array(True), 0.1 * k, 0.1 * k)
        state = alignment.initial(far) if state is None else state
        state, increment = alignment.step(state, far)
    np.testing.assert_array_equal(increment.joints, [10.0, 0.0])


@pytest.mark.parametrize(
    ("first", "then", "message"),
    [
        (0.0, -0.1, "joint_time must not go backwards"),
        (0.0, 0.2, "joint_time must not lie after time"),
        (0.0, np.nan, "joint_time must be finite"),
        (None, 0.0, "joint_time must be given at every step or at none"),
        (0.0, None, "joint_time must be given at every step or at none"),
    ],
)
def test_a_bad_clock_of_encoders_is_named(first, then, message):
    def at(time, joint_time):
        stamp = None if joint_time is None else np.array(joint_time)
        return ServoMeasurement(np.zeros(2), np.zeros(2), np.zeros(2), np.array(True), time, time, stamp)

    alignment = Alignment()
    state, _ = alignment.step(alignment.initial(at(0.0, first)), at(0.0, first))
    with pytest.raises(ValueError, match=message):
        alignment.step(state, at(0.1, then))


def test_a_wrong_number_of_revolute_entries_is_named():
    seen = ServoMeasurement(np.zeros(3), np.zeros(2), np.zeros(2), np.array(True), 0.0, 0.0)
    with pytest.raises(ValueError, match="revolute must have one entry per joint, got 2 for 3"):
        Alignment(revolute=(True, False)).initial(seen)
