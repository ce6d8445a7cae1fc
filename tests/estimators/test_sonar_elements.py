"""Arrays of elements at any places: delays, ambiguity, aliasing, beams at any angles, and MVDR."""

import warnings

import numpy as np
import pytest
from hydrophones import SOUND_SPEED, coverage, spectra, unit

from servotrack.estimators.hmm import grid_chain
from servotrack.estimators.sonar import (
    Band,
    ElementArray,
    HMMBearings,
    LineArray,
    aliasing_frequency,
    beam_correlation,
    beam_powers,
    beamform,
    bearings,
    loaded_covariance,
)
from servotrack.estimators.sonar.beam_patterns import Patterns
from servotrack.estimators.sonar.beamforming import noise_correlation
from servotrack.estimators.sonar.elements import aliasing_note, phases

BAND = Band(300.0, 900.0, 20.0)
GAPS = np.random.default_rng(1).uniform(0.3, 1.1, 20)
LINE = np.column_stack([np.cumsum(GAPS), np.zeros(20)])
ANGLE = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
RING = 2.0 * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])
ROWS = np.arange(40)


def tracked(places, directions, beams=None, beamformer="conventional", power=0.03, seed=0, **noise):
    """Tracks in a record of sources, and the tracker."""
    rng = np.random.default_rng(seed)
    tracker = HMMBearings.fitted(ElementArray(places), BAND, beams, beamformer=beamformer)
    f = BAND.frequencies
    powers = [
        beam_powers(
            tracker.array,
            f,
            spectra(rng, places, f, [(d[k], power, None) for d in directions], **noise),
            tracker.beam_bearings,
            beamformer,
        )
        for k in ROWS
    ]
    return tracker.track(np.array(powers)), tracker


def test_a_uniform_line_is_a_line_array():
    uniform, line = ElementArray(0.5 * np.column_stack([np.arange(16), np.zeros(16)])), LineArray(elements=16)
    f, looks = BAND.frequencies, bearings(91)
    x = np.random.default_rng(0).normal(size=(3, len(f), 16, 2)).view(np.complex128)[..., 0]
    np.testing.assert_allclose(beam_powers(uniform, f, x, looks), beamform(line, f, x, looks), rtol=1e-9)
    np.testing.assert_allclose(noise_correlation(uniform, f, looks), beam_correlation(line, f, looks), atol=1e-4)
    own, other = (Patterns(array, BAND).tables for array in (uniform, line))
    np.testing.assert_allclose(own, other, atol=1e-9)


def test_a_line_sees_mirrored_sources_alike_and_a_plane_does_not():
    turned = LINE @ np.array([unit(40.0), unit(130.0)])
    line, plane = ElementArray(turned), ElementArray(RING)
    assert line.is_line and not plane.is_line
    # Bearing 0 points from the last element to the first.
    assert line.heading == pytest.approx(40.0 - 180.0)
    np.testing.assert_allclose(line.delays([70.0]), line.delays([-70.0]), atol=1e-12)
    assert np.abs(plane.delays([70.0]) - plane.delays([-70.0])).max() > 1e-4
    # The wave from a bearing comes first to the elements on that side.
    for array, places in ((line, turned), (plane, RING)):
        true = -(places - places.mean(axis=0)) @ unit(25.0) / SOUND_SPEED
        seen = 25.0 - array.heading if array.is_line else 25.0
        np.testing.assert_allclose(array.delays([seen])[0], true, atol=1e-12)


def test_depth_does_not_matter_and_aliasing_is_half_a_wavelength():
    deep = np.column_stack([RING, np.random.default_rng(0).uniform(-9.0, 9.0, len(RING))])
    assert ElementArray(deep) == ElementArray(RING)
    side = np.linalg.norm(RING[1] - RING[0])
    assert aliasing_frequency(ElementArray(RING)) == pytest.approx(SOUND_SPEED / (2.0 * side))
    assert aliasing_frequency(LineArray()) == 1500.0
    assert aliasing_note(LineArray(), Band(500.0, 1500.0)) is None
    assert "1600 Hz exceeds 1500 Hz" in aliasing_note(LineArray(), Band(500.0, 1600.0))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (np.zeros((3, 4)), r"shape \(elements, 2\) or \(elements, 3\), got \(3, 4\)"),
        (np.zeros(5), "shape"),
        (np.zeros((1, 2)), "shape"),
        (np.array([[0.0, 0.0], [np.nan, 1.0]]), "positions must be finite"),
        (np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 5.0]]), "a vertical line has no bearings"),
    ],
)
def test_bad_positions_are_named(positions, message):
    with pytest.raises(ValueError, match=message):
        ElementArray(positions)


@pytest.mark.parametrize(
    ("array", "beams", "message"),
    [
        (LineArray(), (10.0, 200.0), r"0 to 180 deg, got 200; a line array"),
        (ElementArray(RING), (-5.0, 20.0), r"0 to 360 deg, got -5"),
        (LineArray(), (20.0, 10.0), "beams must rise, got 20 before 10"),
        (LineArray(), (20.0,), "at least two finite angles"),
        (LineArray(), 1, "beams must be at least 2"),
    ],
)
def test_bad_beams_are_named(array, beams, message):
    with pytest.raises(ValueError, match=message):
        HMMBearings(array=array, beams=beams, max_targets=2)


def test_shading_is_of_uniform_lines():
    with pytest.raises(ValueError, match="must be conventional, got 'chebyshev'"):
        HMMBearings(array=ElementArray(RING), shading="chebyshev", beams=72, max_targets=4)
    with pytest.raises(ValueError, match="beamformer must be one of conventional, mvdr"):
        HMMBearings(beamformer="music")


def test_loading_shrinks_noise_to_the_identity_and_keeps_the_trace_and_a_loud_source():
    rng = np.random.default_rng(2)
    noise = rng.normal(size=(12, 20, 2)).view(np.complex128)[..., 0]
    R = loaded_covariance(noise)
    assert R.trace().real == pytest.approx((np.abs(noise) ** 2).mean() * 20)
    S = noise.T @ noise.conj() / 12
    away = [np.linalg.norm(one - np.eye(20) * one.trace() / 20) for one in (R, S)]
    assert away[0] < 0.2 * away[1]
    loud = noise + 30.0 * rng.normal(size=(12, 2)).view(np.complex128) * np.exp(1j * np.arange(20.0))
    S = loud.T @ loud.conj() / 12
    # A single loud source scatters by its own power only.
    assert np.linalg.norm(loaded_covariance(loud) - S) < 0.35 * np.linalg.norm(S)
    assert np.linalg.eigvalsh(loaded_covariance(np.zeros((4, 20), np.complex128))).min() > 0.0


def test_mvdr_of_white_noise_is_one_and_a_beam_is_narrower():
    rng = np.random.default_rng(3)
    f, looks = BAND.frequencies, bearings(181)
    array = ElementArray(LINE)
    white = np.array([beam_powers(array, f, spectra(rng, LINE, f, []), looks, "mvdr") for _ in range(10)])
    assert white.mean() == pytest.approx(1.0, abs=0.1)
    x = spectra(rng, LINE, f, [(80.0, 1.0, None)], snapshots=60)
    plain, sharp = (beam_powers(array, f, x, looks, kind) for kind in ("conventional", "mvdr"))
    width = [int((p > 0.5 * p.max()).sum()) for p in (plain, sharp)]
    assert width[1] < width[0] and abs(int(sharp.argmax()) - 100) <= 1


def test_a_circular_chain_keeps_its_probability():
    chain = grid_chain(36, [-2.0, 0.0, 2.0], 1.0, 1.0, acceleration=1.0, circular=True)
    start = np.zeros(chain.states)
    start[2 * 36 + 35] = 1.0
    once = chain.predict(start)
    assert once.sum() == pytest.approx(1.0)
    # The fast state moves from the last position to the second.
    assert once[2 * 36 + 1] > 0.0


@pytest.mark.parametrize("beamformer", ["conventional", "mvdr"])
@pytest.mark.parametrize(
    "noise",
    [{}, {"errors": np.exp(0.3j * np.random.default_rng(0).normal(size=20))}],
    ids=["exact", "errors"],
)
def test_an_irregular_line_tracks_a_crossing(beamformer, noise):
    directions = [60.0 + 0.8 * ROWS, 110.0 - 0.8 * ROWS]
    tracks, _ = tracked(LINE, directions, beamformer=beamformer, **noise)
    shares, false = coverage(tracks, [180.0 - d for d in directions])
    assert min(shares) > 0.9 and false == 0


@pytest.mark.parametrize("beamformer", ["conventional", "mvdr"])
def test_a_ring_tracks_through_zero_and_beside_its_mirror_image(beamformer):
    directions = [345.0 + 0.8 * ROWS, 100.0 - 0.5 * ROWS, 260.0 + 0.0 * ROWS]
    tracks, tracker = tracked(RING, directions, beamformer=beamformer)
    shares, false = coverage(tracks, [d % 360.0 for d in directions], tolerance=5.0, turn=True)
    assert min(shares) > 0.9 and false == 0
    assert tracker.directions.circle and all((t.bearings >= 0.0).all() and (t.bearings < 360.0).all() for t in tracks)


@pytest.mark.parametrize(
    "beams", [np.degrees(np.arccos(np.linspace(0.98, -0.98, 61))), np.arange(45.0, 136.0)], ids=["cosine", "sector"]
)
def test_beams_at_given_angles(beams):
    directions = [60.0 + 0.8 * ROWS, 120.0 - 0.3 * ROWS]
    tracks, tracker = tracked(LINE, directions, beams=beams)
    shares, false = coverage(tracks, [180.0 - d for d in directions])
    assert min(shares) > 0.9 and false == 0
    assert tracker.grid_bearings[0] == beams[0] and np.ptp(np.diff(tracker.grid_bearings)) < 1e-9


@pytest.mark.parametrize("places", [LINE, RING], ids=["line", "ring"])
@pytest.mark.parametrize("beamformer", ["conventional", "mvdr"])
def test_noise_has_no_tracks_and_no_warnings(places, beamformer):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracks, _ = tracked(places, [], beamformer=beamformer)
    assert tracks == []


def test_online_on_a_ring():
    rng = np.random.default_rng(4)
    tracker = HMMBearings.fitted(ElementArray(RING), BAND)
    f = BAND.frequencies
    assert phases(tracker.array, f, [0.0]).shape == (len(f), 1, len(RING))
    state, found = None, []
    for k in range(25):
        row = beam_powers(tracker.array, f, spectra(rng, RING, f, [(350.0 + k, 0.05, None)]), tracker.beam_bearings)
        state = tracker.initial(row) if state is None else state
        state, estimate = tracker.step(state, row)
        found.append(estimate)
    for k in range(5, 18):
        away = (found[k + tracker.lag].states[:, 0] - (350.0 + k) + 180.0) % 360.0 - 180.0
        assert len(away) == 1 and abs(away[0]) < 5.0
