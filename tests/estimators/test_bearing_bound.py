"""The bound of a bearing, against the Gaussian likelihood of the spectra, and that no agent passes it."""

from __future__ import annotations

import numpy as np
import pytest

from servotrack.baselines.evaluation.evaluate import evaluate
from servotrack.baselines.leaderboard.sonar_bound import episode_bounds, ospa_bound
from servotrack.envs.track.sonar.config import sonar_config
from servotrack.estimators.sonar.array import LineArray, steering
from servotrack.estimators.sonar.bearing_bound import bearing_information, expected_deviation

ARRAY = LineArray(12, 0.6, 1480.0)
FREQUENCIES = np.array([400.0, 700.0, 1100.0])
RATIO = np.array([0.02, 0.3, 5.0])


@pytest.mark.parametrize("bearing", [20.0, 61.0, 90.0, 140.0])
def test_information_of_a_sound_is_that_of_its_gaussian_likelihood(bearing):
    # K tr(R^-1 R' R^-1 R') of a complex Gaussian vector (Bangs 1971).
    snapshots, h, total = 7, 1e-4, 0.0

    def covariance(at, f, rho):
        a = steering(ARRAY, [f], [at])[0, 0]
        return rho * np.outer(a, a.conj()) + np.eye(ARRAY.elements)

    for f, rho in zip(FREQUENCIES, RATIO, strict=True):
        slope = (covariance(bearing + h, f, rho) - covariance(bearing - h, f, rho)) / (2.0 * h)
        part = np.linalg.solve(covariance(bearing, f, rho), slope)
        total += snapshots * np.trace(part @ part).real
    found = bearing_information(ARRAY, FREQUENCIES, RATIO, bearing, snapshots, False)
    assert found == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize("bearing", [35.0, 110.0])
def test_information_of_a_tone_is_that_left_by_its_unknown_phase(bearing):
    # The mean of every snapshot is sqrt(rho) e^(j phase) a; phase and bearing are unknown.
    snapshots, h, rho, f = 5, 1e-4, 0.4, 900.0
    a = [steering(ARRAY, [f], [at])[0, 0] for at in (bearing - h, bearing, bearing + h)]
    mean = np.sqrt(rho) * a[1]
    slopes = np.stack([np.sqrt(rho) * (a[2] - a[0]) / (2.0 * h), 1j * mean])
    whole = 2.0 * snapshots * (slopes.conj() @ slopes.T).real
    left = whole[0, 0] - whole[0, 1] ** 2 / whole[1, 1]
    assert bearing_information(ARRAY, [f], [rho], bearing, snapshots, True) == pytest.approx(left, rel=1e-5)


@pytest.mark.parametrize("deviation", [0.01, 1.0, 7.0, 1e4])
def test_expected_deviation_is_the_integral(deviation):
    x = np.linspace(-40.0, 40.0, 400_001) * deviation
    density = np.exp(-0.5 * (x / deviation) ** 2) / (deviation * np.sqrt(2.0 * np.pi))
    wanted = (np.minimum(np.abs(x), 5.0) * density).sum() * (x[1] - x[0])
    assert expected_deviation(deviation**2, 5.0) == pytest.approx(wanted, rel=1e-5)
    assert expected_deviation(0.0, 5.0) == pytest.approx(0.0, abs=1e-290)


def test_no_agent_passes_the_bound():
    seeds = [180_000, 180_001, 180_002]
    for level in (1, 2):
        bound = np.array([ospa_bound(sonar_config(level), seed) for seed in seeds])
        assert np.all(bound > 0.0)
        rows = evaluate("SonarTracking-v0", "hmm-row", seeds, env_kwargs={"level": level}).rows
        assert np.all(np.array([row["ospa"] for row in rows]) > bound), level
    faint, clear = ospa_bound(sonar_config(4), seeds[0]), ospa_bound(sonar_config(1), seeds[0])
    assert faint > 3.0 * clear
    assert episode_bounds({"level": 5}, seeds) is None


def test_bad_arguments_are_refused_by_name():
    with pytest.raises(ValueError, match=r"ratio must have the shape of frequencies, \(3,\), got \(2,\)"):
        bearing_information(ARRAY, FREQUENCIES, RATIO[:2], 90.0, 1, False)
    with pytest.raises(ValueError, match="ratio must be finite and >= 0"):
        bearing_information(ARRAY, FREQUENCIES, -RATIO, 90.0, 1, False)
    with pytest.raises(ValueError, match="snapshots must be at least 1"):
        bearing_information(ARRAY, FREQUENCIES, RATIO, 90.0, 0, False)
    with pytest.raises(ValueError, match="cutoff must be > 0"):
        expected_deviation(1.0, 0.0)
    with pytest.raises(ValueError, match="variance must be >= 0"):
        expected_deviation(-1.0, 1.0)
