"""Recordings to bearing-time records: what is tracked, what is noted, and what is refused."""

import numpy as np
import pytest
from hydrophones import coverage, recording

from servotrack.estimators.sonar import ElementArray, bearing_record
from servotrack.estimators.sonar.array_check import measured_averages

RATE, SECONDS = 1600.0, 30
ANGLE = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
PLACES = np.vstack([4.0 * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)]), [[0.5, 0.3]]])
BAND = (100.0, 300.0)
K = np.arange(SECONDS)
DIRECTIONS = [(350.0 + K) % 360.0, 120.0 - 0.5 * K]


def samples(sources=((DIRECTIONS[0], 0.5, None), (DIRECTIONS[1], 0.3, 230.0)), seed=0):
    return recording(np.random.default_rng(seed), PLACES, RATE, SECONDS, sources)


@pytest.mark.parametrize("beamformer", ["conventional", "mvdr"])
def test_a_recording_is_tracked_in_ten_lines(beamformer):
    record = bearing_record(samples(), RATE, ElementArray(PLACES), BAND, beamformer=beamformer)
    tracks = record.tracker.track(record.powers)
    truths = [np.interp(record.times, K + 0.5, np.unwrap(d, period=360.0)) % 360.0 for d in DIRECTIONS]
    shares, false = coverage(tracks, truths, tolerance=6.0, turn=True)
    assert min(shares) > 0.9 and false == 0


def test_unit_gains_color_and_integers_do_not_matter():
    x = samples()
    gains = np.random.default_rng(1).uniform(0.2, 5.0, len(PLACES))
    colored = np.apply_along_axis(lambda s: np.convolve(s, [1.0, 0.9], "same"), 0, x)
    plain = bearing_record(x, RATE, ElementArray(PLACES), BAND)
    other = bearing_record((900.0 * colored).astype(np.int16), RATE, ElementArray(PLACES), BAND)
    louder = bearing_record(x * gains, RATE, ElementArray(PLACES), BAND)
    np.testing.assert_allclose(louder.powers, plain.powers, rtol=0.02)
    assert np.median(np.abs(other.powers / plain.powers - 1.0)) < 0.1


def test_the_averages_are_those_of_the_noise():
    x = np.random.default_rng(2).normal(size=(int(RATE * 60), len(PLACES)))
    record = bearing_record(x, RATE, ElementArray(PLACES), (100.0, 210.0))
    assert record.powers.mean() == pytest.approx(1.0, abs=0.1)
    assert measured_averages(record.powers) == pytest.approx(record.tracker.averages, rel=0.4)
    assert record.tracker.track(record.powers) == [] and record.notes == ()


def test_samples_that_are_missing_make_missing_rows():
    x = samples()
    x[int(10.2 * RATE) : int(12.0 * RATE), 3] = np.nan
    record = bearing_record(x, RATE, ElementArray(PLACES), BAND)
    missing = np.isnan(record.powers).all(axis=1)
    assert 2 <= missing.sum() <= 3 and any("not finite" in note for note in record.notes)
    assert len(record.tracker.track(record.powers)) == 2


def test_clipping_and_aliasing_are_noted():
    x = np.clip(samples(), -0.8, 0.8)
    notes = bearing_record(x, RATE, ElementArray(PLACES), (100.0, 700.0)).notes
    assert any("is clipped" in note for note in notes)
    assert any("half a wavelength" in note for note in notes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": np.zeros(100)}, r"shape \(samples, channels\)"),
        ({"samples": np.zeros((100, 5))}, "one channel for each of the array's 13 elements, got 5 channels"),
        ({"samples": np.zeros((13, 100))}, "transpose them"),
        ({"samples": np.array([["a"] * 13])}, "real numbers"),
        ({"rate": 0.0}, "rate must be positive, got 0.0"),
        ({"rate": float("nan")}, "rate must be positive"),
        ({"band": (100.0, 900.0)}, "half the sampling frequency, got 100 to 900"),
        ({"band": (300.0, 100.0)}, "band must satisfy"),
        ({"band": (0.0, 100.0)}, "band must satisfy"),
        ({"band": (100.1, 100.2)}, "must hold a frequency bin"),
        ({"period": 0.01}, "period must be at least"),
        ({"period": 100.0}, "at least one row of 100 s, got 30 s"),
        ({"beams": (10.0, 400.0)}, "beams must lie in 0 to 360 deg, got 400"),
        ({"beamformer": "capon"}, "beamformer must be one of"),
    ],
)
def test_bad_input_is_named(change, message):
    arguments = {"samples": samples(()), "rate": RATE, "array": ElementArray(PLACES), "band": BAND, **change}
    with pytest.raises(ValueError, match=message):
        bearing_record(**arguments)


@pytest.mark.parametrize(
    ("value", "message"), [(np.nan, "channel 4, 7 holds only NaN; leave it out"), (0.0, "channel 4, 7 is silent")]
)
def test_dead_channels_are_named(value, message):
    x = samples(())
    x[:, [4, 7]] = value
    with pytest.raises(ValueError, match=message):
        bearing_record(x, RATE, ElementArray(PLACES), BAND)
