"""Whatever finite measurements come, the structured estimators answer with finite numbers and definite covariances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from servotrack.estimators.jacobian import (
    HypothesisBank,
    Latencies,
    LiftedKalman,
    Mountings,
    ParametricKalman,
    ServoMeasurement,
    TargetModel,
)

ROWS, STEPS = 20, 60

ESTIMATORS = {
    "lifted": LiftedKalman(),
    "lifted-plain": LiftedKalman(models=(TargetModel(jerk=60.0),), noise=(1.0,), outlier_rate=0.0),
    "lifted-without-outliers": LiftedKalman(noise_stay=0.999, model_stay=0.999, outlier_rate=0.0),
    "parametric-ekf": ParametricKalman(),
    "parametric-ukf": ParametricKalman(unscented=True),
    "mounting-bank": HypothesisBank(ParametricKalman(), Mountings(3)),
    "latency-bank": HypothesisBank(LiftedKalman(), Latencies()),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ESTIMATORS)
@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    pixels=st.sampled_from([0.0, 1.0, 300.0, 1e4, 1e6]),
    angles=st.sampled_from([0.0, 1e-3, 1.0, 100.0]),
    pause=st.sampled_from([0.05, 1.0, 20.0]),
)
def test_finite_in_finite_out(name, seed, pixels, angles, pause):
    rng, estimator = np.random.default_rng(seed), ESTIMATORS[name]
    time, state = np.zeros(ROWS), None
    for _ in range(STEPS):
        measurement = ServoMeasurement(
            joint_angles=angles * rng.standard_normal((ROWS, 2)),
            features=pixels * rng.standard_normal((ROWS, 2)),
            goal=np.full((ROWS, 2), 240.0),
            visible=rng.random(ROWS) > 0.1,
            frame_time=time - rng.uniform(0.0, 0.1, ROWS),
            time=time.copy(),
        )
        if state is None:
            state = estimator.initial(measurement)
        state, estimate = estimator.step(state, measurement)
        predicted = estimate.predict_error(rng.standard_normal((ROWS, 2)), 0.05)
        for values in (estimate.error, estimate.jacobian, estimate.log_likelihood, estimate.nis, predicted):
            assert np.isfinite(values).all()
        time += rng.uniform(0.01, pause)
    covariance = (state.members if hasattr(state, "members") else state).covariance
    spread = np.sqrt(np.einsum("...ii->...i", covariance).real)
    assert (spread > 0.0).all()
    correlation = covariance / spread[..., :, None] / spread[..., None, :]
    assert (np.linalg.eigvalsh(correlation) > -1e-9).all()
