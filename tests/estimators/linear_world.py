"""A world without geometry for tests: features that are exactly linear in joints and time."""

import numpy as np

from servotrack.estimators.jacobian import ServoMeasurement

PERIOD = 0.05


def linear_world(rng, steps, batch=(), n=2, m=2, noise=0.0, motion=0.03, dropped=0.0):
    """Measurements of features that are exactly linear in joints and time, and the Jacobian (*batch, m, n + 1)."""
    jacobian = rng.normal(0, 200, (*batch, m, n + 1))
    joints = np.cumsum(rng.normal(0, motion, (steps, *batch, n)), axis=0)
    time = np.arange(steps) * PERIOD
    clock = np.broadcast_to(time.reshape(-1, *[1] * len(batch)), (steps, *batch)).copy()
    features = np.einsum("...mj,s...j->s...m", jacobian, np.concatenate([joints, clock[..., None]], axis=-1))
    features = features + rng.normal(0, 1.0, features.shape) * noise
    visible = rng.random((steps, *batch)) >= dropped
    goal = np.zeros((*batch, m))
    rows = zip(joints, features, visible, clock, strict=True)
    return [ServoMeasurement(q, y, goal, v, t, t) for q, y, v, t in rows], jacobian


def run(estimator, measurements):
    state = estimator.initial(measurements[0])
    estimates = []
    for each in measurements:
        state, estimate = estimator.step(state, each)
        estimates.append(estimate)
    return state, estimates
