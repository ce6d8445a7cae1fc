"""The adapter to Stone Soup: its models, detections and tracks; `scripts/check-stone-soup` has what it needs."""

from __future__ import annotations

import datetime

import numpy as np
import pytest

pytest.importorskip("stonesoup")

from stonesoup.metricgenerator.ospametric import OSPAMetric
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import (
    Cartesian2DToBearing,
    CartesianToBearingRange,
    CartesianToElevationBearingRangeRate,
)
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.models.transition.nonlinear import ConstantTurn
from stonesoup.types.array import StateVector
from stonesoup.types.detection import Detection
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState

from servotrack.estimators.rfs import (
    PMB,
    MeasurementBirth,
    TimedTracker,
    constant_velocity,
    range_bearing_sensor,
    spherical_sensor,
)
from servotrack.estimators.rfs.stone_soup import SetFilterTracker, sensor_of, target_model

START = datetime.datetime(2026, 1, 1)


def steady(axes, noise=2.0):
    return CombinedLinearGaussianTransitionModel([ConstantVelocity(noise**2)] * axes)


def at(seconds):
    return START + datetime.timedelta(seconds=seconds)


def test_models_are_the_same_as_ours():
    theirs = target_model(steady(2), LinearGaussian(4, (0, 2), 4.0 * np.eye(2)))
    ours = constant_velocity(2.0, 2.0)
    for dt in (0.3, 1.0, 7.0):
        np.testing.assert_allclose(theirs.at(dt).transition, ours.at(dt).transition, atol=1e-12)
        np.testing.assert_allclose(theirs.at(dt).process_noise, ours.at(dt).process_noise, rtol=1e-12)
    np.testing.assert_array_equal(theirs.packed.observation, ours.packed.observation)
    with pytest.raises(ValueError, match="transition must be a linear Gaussian model, got ConstantTurn"):
        target_model(ConstantTurn([0.1, 0.1], 0.01), LinearGaussian(5, (0, 2), np.eye(2)))


@pytest.mark.parametrize("distance", [10.0, 3000.0, 1e6])
def test_sensors_measure_and_invert_as_ours(distance):
    rng = np.random.default_rng(1)
    states = distance * rng.uniform(-1.0, 1.0, (20, 6))
    states[:, 1::2] /= distance
    offset = StateVector([10.0, 20.0, 5.0])
    noise = np.diag([0.005**2, 0.004**2, 25.0, 1.0])
    theirs = sensor_of(
        CartesianToElevationBearingRangeRate(
            ndim_state=6,
            mapping=(0, 2, 4),
            velocity_mapping=(1, 3, 5),
            noise_covar=noise,
            translation_offset=offset,
        )
    )
    ours = spherical_sensor(0.004, 0.005, 5.0, 1.0, at=(10.0, 20.0, 5.0))
    swapped = [1, 0, 2, 3]
    np.testing.assert_allclose(theirs.function(states), ours.function(states)[:, swapped], rtol=1e-9, atol=1e-9)
    assert theirs.angular.tolist() == [True, True, False, False]
    z = ours.function(states)
    expected, found = ours.places(z), theirs.places(z[:, swapped])
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-2, atol=1e-3 * distance)

    flat = CartesianToBearingRange(4, (0, 2), np.diag([0.01**2, 4.0]), translation_offset=StateVector([1.0, 2.0]))
    plane = range_bearing_sensor(2.0, 0.01, at=(1.0, 2.0))
    np.testing.assert_allclose(
        sensor_of(flat).function(states[:, :4]), plane.function(states[:, :4])[:, ::-1], rtol=1e-9, atol=1e-9
    )
    bearing = Cartesian2DToBearing(4, (0, 2), np.array([[0.01**2]]), translation_offset=StateVector([0.0, 0.0]))
    assert sensor_of(bearing).places is None


def test_metrics_of_stone_soup_take_the_tracks_of_two_sensors():
    transition = steady(2)
    sharp = LinearGaussian(4, (0, 2), np.eye(2))
    polar = CartesianToBearingRange(4, (0, 2), np.diag([0.01**2, 4.0]))
    filter = PMB(target_model(transition, sharp), MeasurementBirth(0.1, 10.0), clutter_intensity=1e-7)
    rng = np.random.default_rng(3)
    path, scans = GroundTruthPath(), []
    x = np.array([200.0, 5.0, 100.0, -3.0])
    for k in range(20):
        F, Q = transition.matrix(time_interval=datetime.timedelta(seconds=1)), 1e-3
        x = F @ x + Q * rng.standard_normal(4)
        time = at(k)
        path.append(GroundTruthState(StateVector(x), timestamp=time))
        detections = {Detection(StateVector(x[[0, 2]] + rng.standard_normal(2)), timestamp=time)}
        if k % 3 == 0:
            z = sensor_of(polar).function(x[None])[0] + [0.01, 2.0] * rng.standard_normal(2)
            detections.add(Detection(StateVector(z), timestamp=time, measurement_model=polar))
        scans.append((time, detections if k != 7 else set()))
    tracker = SetFilterTracker(scans, filter, sharp)
    seen = set()
    for _time, tracks in tracker:
        seen |= tracks
    assert _time == at(19)
    (track,) = tracks
    assert len(track) >= 17
    assert seen == {track}
    truth = [*path[2:]]
    metric = OSPAMetric(p=1, c=50.0).compute_over_time([*track], [0] * len(track), truth, [0] * len(truth))
    assert np.mean([one.value for one in metric.value]) < 6.0


def test_late_detections_are_put_in_their_place():
    sharp = LinearGaussian(4, (0, 2), np.eye(2))
    filter = PMB(target_model(steady(2), sharp), MeasurementBirth(0.1, 10.0), clutter_intensity=1e-7)
    scans = [(at(k), {Detection(StateVector([5.0 * k, -2.0 * k]), timestamp=at(k))}) for k in range(8)]
    ordered, late = (SetFilterTracker(None, filter, sharp) for _ in range(2))
    for time, detections in scans:
        ordered.update_tracker(time, detections)
    for k in (0, 1, 3, 2, 5, 4, 7, 6):
        late.update_tracker(*scans[k])
    (expected,), (found,) = ordered.tracks, late.tracks
    np.testing.assert_array_equal(found.state_vector, expected.state_vector)


def test_each_detection_has_its_own_noise_and_gives_its_metadata_to_its_track():
    model = LinearGaussian(4, (0, 2), np.eye(2))
    filter = PMB(target_model(steady(2), model), MeasurementBirth(0.1, 10.0), clutter_intensity=1e-7)
    tracker = SetFilterTracker(None, filter, model)
    plain = TimedTracker(filter)
    rng = np.random.default_rng(5)
    for k in range(10):
        where = np.array([[5.0 * k, 0.0], [0.0, 300.0 - 4.0 * k]])
        noise = np.stack([np.diag(rng.uniform(0.5, 9.0, 2)) for _ in range(2)])
        detections = {
            Detection(
                StateVector(z), timestamp=at(k), measurement_model=LinearGaussian(4, (0, 2), R), metadata={"ship": name}
            )
            for z, R, name in zip(where, noise, ("Ada", "Bea"), strict=True)
        }
        _, tracks = tracker.update_tracker(at(k), detections)
        order = [1, 0] if where[0, 0] > where[1, 0] else [0, 1]
        expected = plain.update(where[order], float(k), noise=noise[order])
    assert {track.metadata["ship"] for track in tracks} == {"Ada", "Bea"}
    (ada,) = (track for track in tracks if track.metadata["ship"] == "Ada")
    assert float(ada.state_vector[0]) == pytest.approx(45.0, abs=5.0)
    found = np.array(sorted(np.ravel(np.asarray(track.state_vector, dtype=float)).tolist() for track in tracks))
    np.testing.assert_allclose(found, sorted(expected.states.tolist()), rtol=1e-9, atol=1e-9)


def test_a_model_for_every_detection_does_not_fill_the_memory():
    model = LinearGaussian(4, (0, 2), np.eye(2))
    filter = PMB(target_model(steady(2), model), MeasurementBirth(0.1, 10.0), clutter_intensity=1e-7)
    tracker = SetFilterTracker(None, filter, model)
    for k in range(100):
        own = LinearGaussian(4, (0, 2), (1.0 + 0.01 * k) * np.eye(2))
        detection = Detection(StateVector([5.0 * k, 0.0]), timestamp=at(k), measurement_model=own)
        tracker.update_tracker(at(k), {detection})
    assert len(tracker._sensors) + len(tracker._linear) == 1


@pytest.mark.parametrize(
    ("time", "rows", "message"),
    [
        (at(1).replace(tzinfo=datetime.timezone.utc), [[0.0, 0.0]], "all with a time zone or all without"),
        ("noon", [[0.0, 0.0]], "time must be a datetime"),
        (at(1), [[np.nan, 0.0]], "measurements must be finite"),
        (at(1), [[0.0, 0.0, 0.0]], "measurements must have shape"),
        (at(1), [[0.0, 0.0], [0.0, 0.0, 0.0]], "detections of one model must be an array of numbers"),
    ],
)
def test_bad_times_and_detections_are_refused_by_name(time, rows, message):
    position = LinearGaussian(4, (0, 2), np.eye(2))
    filter = PMB(target_model(steady(2), position), MeasurementBirth(0.1, 20.0), clutter_intensity=1e-6)
    tracker = SetFilterTracker(None, filter, position)
    tracker.update_tracker(START, {Detection(StateVector([0.0, 0.0]), timestamp=START)})
    with pytest.raises(ValueError, match=message):
        tracker.update_tracker(time, {Detection(StateVector(row), timestamp=START) for row in rows})
    with pytest.raises(ValueError, match="measurement_model must be given"):
        SetFilterTracker(None, filter, None).update_tracker(
            START, {Detection(StateVector([0.0, 0.0]), timestamp=START)}
        )
