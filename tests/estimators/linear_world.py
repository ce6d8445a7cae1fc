"""Worlds without geometry for tests: features that are exactly linear in joints and time, open loop and closed."""

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


class LinearWorld:
    """Rows of worlds with y = A (q - q*) and goal 0; A and q* are random."""

    def __init__(self, joints, features=8, rows=1, seed=0, scale=300.0, noise=0.0, far=0.3):
        rng = np.random.default_rng(seed)
        self.jacobian = rng.normal(0.0, scale, (rows, features, joints))
        self.goal_joints = rng.uniform(-far, far, (rows, joints))
        self.joints, self.noise, self.rng, self.time = np.zeros((rows, joints)), noise, rng, 0.0
        self.visible = np.ones((rows, features), np.bool_)

    @property
    def error(self):
        return np.einsum("bij,bj->bi", self.jacobian, self.joints - self.goal_joints)

    def measurement(self):
        rows, features = self.visible.shape
        noise = self.noise * self.rng.normal(size=(rows, features))
        time = np.full(rows, self.time)
        return ServoMeasurement(
            self.joints.copy(), self.error + noise, np.zeros((rows, features)), self.visible.copy(), time, time
        )

    def step(self, rate):
        self.joints = self.joints + rate * PERIOD
        self.time += PERIOD


def served(controller, world, steps):
    """Joint rates, mean errors and exploring rows of all steps."""
    state, rates, errors, exploring = None, [], [], []
    for _ in range(steps):
        seen = world.measurement()
        state = controller.initial(seen) if state is None else state
        state, rate = controller.step(state, seen)
        world.step(rate)
        rates.append(rate)
        errors.append(np.abs(world.error).mean(axis=-1))
        exploring.append(state.excitation.active)
    return np.array(rates), np.array(errors), np.array(exploring)
