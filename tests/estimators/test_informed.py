"""The informed filter and its law: with the geometry given, nothing of the camera is left in what it tracks."""

from __future__ import annotations

import numpy as np
import pytest
from kinematic_world import KinematicWorld, closed_loop, ellipse_target

from servotrack.estimators.camera import ground_points, pack_camera, project_points
from servotrack.estimators.jacobian import (
    ElbowLaw,
    Excitation,
    Geometry,
    InformedKalman,
    InformedMeasurement,
    LiftedEstimate,
    LiftedKalman,
    LinearEstimate,
    OneStepExact,
    ServoController,
    ServoMeasurement,
)
from servotrack.estimators.jacobian.lifted import SWINGING_MODELS

ROWS = 8
LINKS = np.array([0.45, 0.6])
EXACT = LiftedKalman(
    models=SWINGING_MODELS, noise=(0.01,), encoder_noise=0.0, optics_error=0.0, outlier_rate=0.0, drift=0.0
)
"""Trusts what it sees, so that any error is the geometry's."""


def skewed_camera() -> np.ndarray:
    """Cameras with every fault of the ladder at once."""
    rng = np.random.default_rng(0)
    return pack_camera(
        focal=rng.uniform(120, 240, ROWS),
        depth=rng.uniform(0.25, 0.6, ROWS),
        mounting=rng.uniform(-np.pi, np.pi, ROWS),
        center=240.0 + rng.uniform(-40, 40, (ROWS, 2)),
        tilt=rng.uniform(-0.26, 0.26, (ROWS, 2)),
        aspect=rng.uniform(-0.1, 0.1, ROWS),
        distortion=rng.uniform(-0.2, 0.1, ROWS),
    )


class Seen:
    """The kinematic world's arms, looked at by other cameras: an estimator that swaps the image."""

    def __init__(self, world: KinematicWorld, camera: np.ndarray, latency: float = 0.0) -> None:
        self.world, self.camera, self.latency = world, camera, latency
        self.estimator = InformedKalman(EXACT)

    def measurement(self, plain: ServoMeasurement) -> InformedMeasurement:
        world, past = self.world, self.world._now - self.latency
        joints, links = world._joints_at(past), np.tile(LINKS, (ROWS, 1))
        seen, visible = project_points(self.camera, links, joints, world.target(past))
        goal, _ = project_points(self.camera, links, joints, world._tool(joints))
        geometry = Geometry(self.camera, links, np.full(ROWS, self.latency), np.zeros(ROWS))
        return InformedMeasurement(*plain._replace(features=seen, goal=goal, visible=visible)[:6], geometry)

    def initial(self, plain):
        return self.estimator.initial(self.measurement(plain))

    def step(self, state, plain):
        return self.estimator.step(state, self.measurement(plain))


@pytest.mark.parametrize("latency", [0.0, 0.05])
def test_follows_through_any_camera(latency):
    target = ellipse_target(np.random.default_rng(1), ROWS)
    world = KinematicWorld(target, rows=ROWS, links=LINKS, image_size=1e6, warmup=0)
    agent = Seen(world, skewed_camera(), latency)
    servo = ServoController(agent, OneStepExact(gain=0.9), excitation=Excitation(steps=0), supervisor=None)
    assert closed_loop(servo, world)[60:].mean(axis=0).max() < 2e-4


def test_ground_points_invert_the_projection():
    camera, rng = skewed_camera(), np.random.default_rng(2)
    joints, points = rng.uniform([-1, 0.5], [1, 2.5], (ROWS, 2)), rng.uniform(0.3, 0.8, (ROWS, 2))
    seen, _ = project_points(camera, LINKS, joints, points)
    at_tool = np.cumsum(LINKS * np.exp(1j * np.cumsum(joints, axis=1)), axis=1)[:, 1]
    angle = joints.sum(axis=1) + np.arctan2(camera[:, 6], camera[:, 5])
    expected = np.conj(np.exp(-1j * angle) * (points[:, 0] + 1j * points[:, 1] - at_tool))
    near = np.abs(expected) < 0.4
    found = ground_points(camera, seen)
    np.testing.assert_allclose(found[near], np.stack([expected.real, expected.imag], axis=-1)[near], atol=1e-9)
    assert near.sum() >= 4


def test_geometry_that_is_known_may_not_drift():
    with pytest.raises(ValueError, match="drift=0"):
        InformedKalman(LiftedKalman())


def arms_in_the_image(rng: np.random.Generator, count: int, reach: float) -> LiftedEstimate:
    """Arms with their elbow on one side, and targets at `reach` times the arm's length."""
    turn = np.exp(1j * rng.uniform(-np.pi, np.pi, (3, count)))
    upper, lower = rng.uniform(50, 300, (2, count))
    # Angles from the elbow's vector to the forearm's, as those of one side of the joint.
    forearm = lower * turn[0] * np.exp(-1j * rng.uniform(0.2, 2.9, count))
    elbow, target = upper * turn[0], reach * (upper + lower) * turn[1]
    velocity, acceleration = 30.0 * turn[2], np.zeros(count, complex)
    return LiftedEstimate(target, velocity, acceleration, elbow, forearm, *np.zeros((2, count)))


def test_inverse_kinematics_hold_the_tool_over_a_target_that_is_far_away() -> None:
    law = ElbowLaw()
    for seed in range(5):
        rng = np.random.default_rng(seed)
        estimate = arms_in_the_image(rng, 200, 0.75)
        _, rate = law.rate(law.initial(None), estimate)  # type: ignore[arg-type]
        reached = np.abs(np.abs(estimate.elbow) - np.abs(estimate.forearm)) < 0.7 * np.abs(estimate.target)
        assert reached.sum() > 100
        left = estimate.predict_error(law.period * rate, law.period)[reached]
        np.testing.assert_allclose(left, 0.0, atol=1e-8)
        assert (np.abs(law.period * rate) < 2 * np.pi).all()
        # The elbow stays on its side.
        bend = np.angle(estimate.forearm * np.conj(estimate.elbow)) - law.period * rate[:, 1]
        assert (bend[reached] < 1e-9).all()


def test_inverse_kinematics_stretch_the_arm_towards_a_target_beyond_its_reach() -> None:
    law, estimate = ElbowLaw(), arms_in_the_image(np.random.default_rng(0), 50, 1.5)
    _, rate = law.rate(law.initial(None), estimate)  # type: ignore[arg-type]
    left = estimate.predict_error(law.period * rate, law.period)
    length = np.abs(estimate.elbow) + np.abs(estimate.forearm)
    target = np.abs(estimate.target + law.period * estimate.velocity)
    np.testing.assert_allclose(np.linalg.norm(left, axis=-1), target - length, rtol=1e-6)


def test_inverse_kinematics_need_the_arm_s_vectors() -> None:
    silent = np.zeros(1)
    plain = LinearEstimate(np.zeros((1, 2)), np.ones((1, 2, 3)), silent, silent)
    with pytest.raises(ValueError, match="ElbowLaw needs a LiftedEstimate, got LinearEstimate"):
        ElbowLaw().rate(None, plain)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="period must be finite"):
        ElbowLaw(period=0.0)
