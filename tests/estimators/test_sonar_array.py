"""The array against direct sums, and its noise."""

import numpy as np
import pytest

from servotrack.estimators.sonar import (
    Band,
    LineArray,
    beam_correlation,
    beam_pattern,
    beamform,
    bearings,
    normalize,
    shading_weights,
    steering,
    tabulate_pattern,
)

ARRAY = LineArray(elements=16)
F = Band(500.0, 1500.0, 100.0).frequencies
LOOKS = bearings(91)


def snapshots(rng, records, K=10):
    shape = (records, K, len(F), ARRAY.elements)
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)


@pytest.mark.parametrize("shading", ["conventional", "chebyshev"])
def test_beamforming_equals_the_direct_sum(shading):
    x = snapshots(np.random.default_rng(0), 2)
    beams = steering(ARRAY, F, LOOKS) * shading_weights(ARRAY, shading)
    direct = (np.abs(np.einsum("fbn,rkfn->rkfb", beams.conj(), x)) ** 2).mean(axis=(1, 2))
    np.testing.assert_allclose(beamform(ARRAY, F, x, LOOKS, shading), direct, rtol=1e-9)


def test_a_batch_has_the_bits_of_single_records():
    x = snapshots(np.random.default_rng(1), 3)
    together = beamform(ARRAY, F, x, LOOKS)
    assert np.array_equal(together, np.array([beamform(ARRAY, F, record, LOOKS) for record in x]))


@pytest.mark.parametrize("shading", ["conventional", "chebyshev"])
def test_the_pattern_is_what_a_source_adds(shading):
    power = np.linspace(0.0, 2.0, len(F))
    wave = np.sqrt(power)[:, None] * steering(ARRAY, F, [70.0])[:, 0]
    added = beamform(ARRAY, F, wave[None, None], LOOKS, shading)[0]
    np.testing.assert_allclose(beam_pattern(ARRAY, F, power, LOOKS, 70.0, shading), added, atol=1e-9)
    table = tabulate_pattern(ARRAY, F, power, shading)
    np.testing.assert_allclose(table.at(LOOKS, [70.0])[0], added, atol=1e-4 * added.max())


def test_chebyshev_sidelobes_are_30_db_down():
    tone = beam_pattern(LineArray(), [1500.0], [1.0], bearings(1801), 90.0, "chebyshev")
    beyond = np.abs(bearings(1801) - 90.0) > 5.0
    assert (tone >= 0.0).all()
    assert -30.5 < 10.0 * np.log10(tone[beyond].max() / tone.max()) < -29.5


def test_noise_powers_have_the_moments_of_a_gamma_and_the_beams_correlation():
    rng = np.random.default_rng(2)
    x = snapshots(rng, 3000)
    looks = bearings(19)
    z = beamform(ARRAY, F, x, looks)
    averages = len(F) * 10
    assert z.mean() == pytest.approx(1.0, abs=0.005)
    assert z.var(axis=0).mean() * averages == pytest.approx(1.0, abs=0.04)
    measured = np.corrcoef(z.T)
    np.testing.assert_allclose(measured, beam_correlation(ARRAY, F, looks), atol=0.08)


def test_normalization_finds_the_noise_beside_targets():
    rng = np.random.default_rng(3)
    z = 7.0 * rng.gamma(1110, 1.0 / 1110, size=(20, 721))
    z[:, 300:340] += 100.0
    level = np.median(normalize(z)[:, :300], axis=1)
    np.testing.assert_allclose(level, 1.0, atol=0.01)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LineArray(elements=1), "elements"),
        (lambda: LineArray(spacing=-1.0), "spacing"),
        (lambda: Band(low=2000.0), "low"),
        (lambda: Band(step=0.0), "step"),
        (lambda: bearings(1), "count"),
        (lambda: shading_weights(ARRAY, "hann"), "conventional, chebyshev"),
        (lambda: beamform(ARRAY, F, np.zeros((10, 3, 16)), LOOKS), "snapshots"),
        (lambda: normalize([1.0, np.nan, 1.0]), "nan at index"),
        (lambda: normalize([1.0, -0.5, 1.0]), "not negative"),
        (lambda: normalize(np.zeros(5)), "median"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
